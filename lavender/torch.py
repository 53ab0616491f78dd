"""The solve of one step as a PyTorch function, with gradients by all of its arguments (extra: torch).

```python
from lavender.torch import solve
velocity, impulse = solve(J, M, v_free, mu)      # tensors of float64 on the CPU
velocity[..., 0].sum().backward()
```
"""

from __future__ import annotations

from typing import Any

from lavender.base.errors import InputError, SolverUnavailable
from lavender.gradient.layer import ARGUMENT_AXES, ARGUMENTS, Step, infer_result_shapes, make_step
from lavender.problem.cones import Cones

try:
    import torch
except ImportError as error:
    raise SolverUnavailable(
        "lavender.torch needs PyTorch: pip install 'lavender-contact[torch]', or torch itself"
    ) from error


class _Solve(torch.autograd.Function):  # type: ignore[misc]
    """The solve as an autograd function. `vmap` adds a leading batch axis."""

    @staticmethod
    def forward(step: Step, *arrays: Any) -> Any:
        """Solve the step; return the velocity after the step, and its impulses."""
        return tuple(map(torch.from_numpy, step.forward(*(x.detach().numpy() for x in arrays))))

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        """Save the arguments and the impulse for the backward pass."""
        ctx.step = inputs[0]
        ctx.save_for_backward(*inputs[1:], output[1])

    @staticmethod
    def backward(ctx: Any, *cotangents: Any) -> Any:
        """Compute the gradients by all arrays."""
        return None, *_Adjoint.apply(
            ctx.step, ctx.needs_input_grad[1:], *ctx.saved_tensors, *cotangents
        )

    @staticmethod
    def vmap(info: Any, in_dims: Any, step: Step, *arrays: Any) -> Any:
        """Solve with one more leading batch axis."""
        return _Solve.apply(step, *_move_batch_axis(info, in_dims[1:], arrays, ARGUMENT_AXES)), (
            0,
            0,
        )


class _Adjoint(torch.autograd.Function):  # type: ignore[misc]
    """The adjoint of the solve as an autograd function, which cannot be differentiated again."""

    @staticmethod
    def forward(step: Step, needed: Any, *arrays: Any) -> Any:
        """Compute the gradients by all arrays."""
        return tuple(
            map(torch.from_numpy, step.backward(needed, *(x.detach().numpy() for x in arrays)))
        )

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        """Save no arguments, because no second derivatives exist."""

    @staticmethod
    def backward(ctx: Any, *cotangents: Any) -> Any:
        """Raise NotImplementedError: there are no second derivatives."""
        raise NotImplementedError(
            "lavender.torch has first derivatives only: leave create_graph=True out"
        )

    @staticmethod
    def vmap(info: Any, in_dims: Any, step: Step, needed: Any, *arrays: Any) -> Any:
        """Compute the gradients with one more leading batch axis."""
        axes = (*ARGUMENT_AXES, 1, 1, 1)
        batched = _move_batch_axis(info, in_dims[2:], arrays, axes)
        return _Adjoint.apply(step, needed, *batched), (0,) * len(ARGUMENTS)


def _move_batch_axis(info: Any, dims: Any, arrays: Any, axes: Any) -> list[Any]:
    """Move the new batch axis of every array to the front, before the batch axes that the arrays already have.

    `axes` holds the number of axes of each array without batch axes.
    """
    n_inner = max(x.ndim - (d is not None) - n for x, d, n in zip(arrays, dims, axes, strict=True))
    out = []
    for x, d, n in zip(arrays, dims, axes, strict=True):
        y = x.expand(info.batch_size, *x.shape) if d is None else x.movedim(d, 0)
        out.append(
            y.reshape(y.shape[0], *(1,) * (n_inner - (y.ndim - 1 - n)), *y.shape[1:]).contiguous()
        )
    return out


@torch.compiler.disable  # type: ignore[untyped-decorator]  # `torch.compile` splits its graph at this call
def solve(
    J: Any,
    M: Any,
    v_free: Any,
    mu: Any,
    *,
    target: Any = None,
    compliance: Any = None,
    cones: Cones | None = None,
    friction: str = "coulomb",
    solver: str = "auto",
    tol: float = 1e-10,
) -> tuple[Any, Any]:
    """Compute the velocities and impulses of one step, with gradients by all tensors.

    Parameters
    ----------
    J : (..., m, nv)
        Rows of constraints. Without `cones` they are rows of contacts, each with a normal and the same number of
        tangents.
    M : (..., nv, nv) kg, kg m^2
        Its symmetric part is used.
    v_free : (..., nv) m/s, rad/s
    mu : (..., k)
        Friction coefficient of each contact.
    target, compliance : (..., m), optional
        m/s and 1/kg; default 0.
    cones : Cones, optional
        Bounds of the rows; `cones.mu` is not used, as mu is an argument.
    friction, solver, tol
        As for `Problem.from_jacobian` and `lavender.solve`.

    Returns
    -------
    velocity : (..., nv) m/s, rad/s
    impulse : (..., m) N s

    Raises
    ------
    InputError
        The shapes disagree, a dtype is not float64, or a device is not the CPU.
    SolveFailed
        A member of the batch was not solved to `tol` or its floor.
    CapabilityError
        In the backward pass: the differentiated impulses are not unique, or the gradient by a tensor that requires one
        does not exist (for example by J if rows share a load).
    """
    arguments = [J, M, v_free, mu, target, compliance]
    for i, (name, x) in enumerate(zip(ARGUMENTS, arguments, strict=True)):
        if x is None and i > 3:
            arguments[i] = torch.zeros(J.shape[-2:-1], dtype=torch.float64)
        elif not isinstance(x, torch.Tensor):
            raise InputError(
                f"{name} is {type(x).__name__}; a float64 tensor is needed: torch.as_tensor"
            )
        elif x.dtype != torch.float64 or x.device.type != "cpu":  # pyright: ignore[reportOptionalMemberAccess]
            raise InputError(
                f"{name} is {x.dtype} on {x.device}; a tensor of float64 on the CPU is needed: {name}.double().cpu()"  # pyright: ignore[reportOptionalMemberAccess]
            )
    infer_result_shapes(arguments)  # Raises InputError if the shapes disagree.
    arguments[1] = 0.5 * (arguments[1] + arguments[1].transpose(-1, -2))
    velocity, impulse = _Solve.apply(make_step(arguments, cones, friction, solver, tol), *arguments)
    return velocity, impulse
