"""The solve of one step as a JAX function, with gradients by all of its arguments (extra: jax).

```python
jax.config.update("jax_enable_x64", True)
from lavender.jax import solve
velocity, impulse = solve(J, M, v_free, mu)      # arrays of float64; jit, grad and vmap apply
```
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any

from lavender.base.errors import InputError, SolverUnavailable
from lavender.gradient.layer import ARGUMENT_AXES, ARGUMENTS, Step, infer_result_shapes, make_step
from lavender.problem.cones import Cones

try:
    import jax
    import jax.numpy as jnp
except ImportError as error:
    raise SolverUnavailable(
        "lavender.jax needs JAX: pip install 'lavender-contact[jax]', or jax"
    ) from error


def _call(function: Any, like: Any, arrays: Any) -> Any:
    # With "broadcast_all", `vmap` adds a leading axis to every array.
    return jax.pure_callback(function, like, *arrays, vmap_method="broadcast_all")


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _solve(step: Step, *arrays: Any) -> Any:
    like = tuple(jax.ShapeDtypeStruct(shape, jnp.float64) for shape in infer_result_shapes(arrays))
    return _call(step.forward, like, arrays)


def _forward(step: Step, *arguments: Any) -> Any:
    """Solve, and return the result and the data for `_backward`."""
    arrays = tuple(x.value for x in arguments)
    result = _solve(step, *arrays)
    # `jit` traces saved values but compiles for each structure, so () and None mark whether a gradient is needed.
    return result, (arrays, result[1], tuple(() if x.perturbed else None for x in arguments))


def _backward(step: Step, saved: Any, cotangents: Any) -> Any:
    """Compute the gradients by all arrays from the data of `_forward`."""
    arrays, impulse, perturbed = saved
    needed = tuple(x is not None for x in perturbed)
    like = tuple(jax.ShapeDtypeStruct(x.shape, jnp.float64) for x in arrays)
    zero = jax.custom_derivatives.SymbolicZero
    dense = (jnp.zeros(x.shape, x.dtype) if isinstance(x, zero) else x for x in cotangents)
    return _call(_make_adjoint(step, needed), like, (*arrays, impulse, *dense))


@lru_cache(maxsize=256)  # JAX caches compiled callbacks by the identity of their object.
def _make_adjoint(step: Step, needed: tuple[bool, ...]) -> Any:
    return partial(step.backward, needed)


_solve.defvjp(_forward, _backward, symbolic_zeros=True)


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
    """Compute the velocities and impulses of one step, with gradients by all arrays.

    Parameters and results are as for `lavender.torch.solve`, with JAX arrays. The solve runs on the CPU, outside of
    the code that JAX compiles.

    Raises
    ------
    InputError
        A dtype or shape is wrong, or 64-bit numbers are not enabled in JAX.
    RuntimeError
        Raised by JAX with the message of an error that depends on numbers, such as a negative mu or a failed solve.
    """
    arguments = [jnp.asarray(x) for x in (J, M, v_free, mu)]
    zeros = jnp.zeros(arguments[0].shape[-2:-1], arguments[0].dtype)
    arguments += [zeros if x is None else jnp.asarray(x) for x in (target, compliance)]
    for name, x in zip(ARGUMENTS, arguments, strict=True):
        if x.dtype != jnp.float64:
            raise InputError(
                f"{name} is {x.dtype}; float64 is needed: jax.config.update('jax_enable_x64', True) before it is made"
            )
    infer_result_shapes(arguments)  # Raises InputError if the shapes disagree.
    # `broadcast_all` of `vmap` adds its axis at the front, so all arrays need the same number of batch axes.
    batch_axes = max(x.ndim - n for x, n in zip(arguments, ARGUMENT_AXES, strict=True))
    arguments = [
        x.reshape(*(1,) * (batch_axes + n - x.ndim), *x.shape)
        for x, n in zip(arguments, ARGUMENT_AXES, strict=True)
    ]
    arguments[1] = 0.5 * (arguments[1] + jnp.swapaxes(arguments[1], -1, -2))
    velocity, impulse = _solve(make_step(arguments, cones, friction, solver, tol), *arguments)
    return velocity, impulse
