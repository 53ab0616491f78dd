"""A step's solve as a function of PyTorch, with a gradient by all of its arguments (extra: torch).

```python
from lavender.torch import solve
velocity, impulse = solve(J, M, v_free, mu)      # tensors of float64 on the CPU
velocity[..., 0].sum().backward()
```
"""

from __future__ import annotations

from typing import Any

from lavender.base.errors import InputError, SolverUnavailable
from lavender.gradient.layer import NAMES, SIZES, Step, shapes, step
from lavender.problem.cones import Cones

try:
    import torch
except ImportError as error:
    raise SolverUnavailable(
        "lavender.torch needs PyTorch: pip install 'lavender-contact[torch]', or torch itself"
    ) from error


class _Solve(torch.autograd.Function):  # type: ignore[misc]
    """Forward and backward; a batch by `vmap` is leading axes."""

    @staticmethod
    def forward(made: Step, *arrays: Any) -> Any:
        """Velocity and impulse."""
        return tuple(map(torch.from_numpy, made.forward(*(x.detach().numpy() for x in arrays))))

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        """What the backward pass reads."""
        ctx.made = inputs[0]
        ctx.save_for_backward(*inputs[1:], output[1])

    @staticmethod
    def backward(ctx: Any, *cotangents: Any) -> Any:
        """Gradients by all arrays."""
        return None, *_Back.apply(ctx.made, ctx.needs_input_grad[1:], *ctx.saved_tensors, *cotangents)

    @staticmethod
    def vmap(info: Any, in_dims: Any, made: Step, *arrays: Any) -> Any:
        """One more leading axis."""
        return _Solve.apply(made, *_leading(info, in_dims[1:], arrays, SIZES)), (0, 0)


class _Back(torch.autograd.Function):  # type: ignore[misc]
    """The adjoint, which has no derivative of its own."""

    @staticmethod
    def forward(made: Step, needed: Any, *arrays: Any) -> Any:
        """Gradients by all arrays."""
        return tuple(map(torch.from_numpy, made.backward(needed, *(x.detach().numpy() for x in arrays))))

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        """Nothing is kept."""

    @staticmethod
    def backward(ctx: Any, *cotangents: Any) -> Any:
        """Refused: second derivatives."""
        raise NotImplementedError("lavender.torch has first derivatives alone: no gradient of a gradient")

    @staticmethod
    def vmap(info: Any, in_dims: Any, made: Step, needed: Any, *arrays: Any) -> Any:
        """One more leading axis."""
        sizes = (*SIZES, 1, 1, 1)
        return _Back.apply(made, needed, *_leading(info, in_dims[2:], arrays, sizes)), (0,) * len(NAMES)


def _leading(info: Any, dims: Any, arrays: Any, sizes: Any) -> list[Any]:
    # The new axis before all others, of every array: axes of a batch inside come after it.
    inner = max(x.ndim - (d is not None) - n for x, d, n in zip(arrays, dims, sizes, strict=True))
    out = []
    for x, d, n in zip(arrays, dims, sizes, strict=True):
        y = x.expand(info.batch_size, *x.shape) if d is None else x.movedim(d, 0)
        out.append(y.reshape(y.shape[0], *(1,) * (inner - (y.ndim - 1 - n)), *y.shape[1:]).contiguous())
    return out


@torch.compiler.disable  # type: ignore[untyped-decorator]  # a compiled function calls it between its parts
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
    """Velocities after a step and its impulses, with gradients by all tensors.

    Parameters
    ----------
    J : (..., m, nv)
        Rows of constraints; without `cones` those of contacts, each a normal and the same number of tangents.
    M : (..., nv, nv) kg, kg m^2
        Its symmetric part is taken.
    v_free : (..., nv) m/s, rad/s
    mu : (..., k)
        Of every contact.
    target, compliance : (..., m), optional
        m/s and 1/kg; default 0.
    cones : Cones, optional
        Bounds of the rows; its mu is not read.
    friction, solver, tol
        As `Problem.from_jacobian` and `lavender.solve`.

    Returns
    -------
    velocity : (..., nv) m/s, rad/s
    impulse : (..., m) N s

    Raises
    ------
    InputError
        Shapes that do not fit, another type than float64, or a device other than the CPU.
    SolveFailed
        A member of the batch was not solved to `tol` or its floor.
    CapabilityError
        In the backward pass, where impulses that are not unique are differentiated, or where by a tensor that requires
        a gradient there is none (rows that share a load, by J).
    """
    given = [J, M, v_free, mu, target, compliance]
    for i, (name, x) in enumerate(zip(NAMES, given, strict=True)):
        if x is None and i > 3:
            given[i] = torch.zeros(J.shape[-2:-1], dtype=torch.float64)
        elif not isinstance(x, torch.Tensor):
            raise InputError(
                f"{name} is {type(x).__name__}; a tensor of float64 is needed: torch.as_tensor({name})"
            )
        elif x.dtype != torch.float64 or x.device.type != "cpu":
            raise InputError(
                f"{name} is {x.dtype} on {x.device}; a tensor of float64 on the CPU is needed: {name}.double().cpu()"
            )
    shapes(given)
    given[1] = 0.5 * (given[1] + given[1].transpose(-1, -2))
    velocity, impulse = _Solve.apply(step(given, cones, friction, solver, tol), *given)
    return velocity, impulse
