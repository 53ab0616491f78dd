"""A step's solve as a function of JAX, with a gradient by all of its arguments (extra: jax).

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
from lavender.gradient.layer import NAMES, SIZES, Step, shapes, step
from lavender.problem.cones import Cones

try:
    import jax
    import jax.numpy as jnp
except ImportError as error:
    raise SolverUnavailable(
        "lavender.jax needs JAX: pip install 'lavender-contact[jax]', or jax itself"
    ) from error


def _call(function: Any, like: Any, arrays: Any) -> Any:
    # What vmap adds are leading axes, on all arrays alike.
    return jax.pure_callback(function, like, *arrays, vmap_method="broadcast_all")


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _solve(made: Step, *arrays: Any) -> Any:
    like = tuple(jax.ShapeDtypeStruct(shape, jnp.float64) for shape in shapes(arrays))
    return _call(made.forward, like, arrays)


def _forward(made: Step, *given: Any) -> Any:
    arrays = tuple(x.value for x in given)
    found = _solve(made, *arrays)
    # An array kept is traced: what is needed stands in the structure, where jit compiles for it.
    return found, (arrays, found[1], tuple(() if x.perturbed else None for x in given))


def _backward(made: Step, kept: Any, cotangents: Any) -> Any:
    arrays, impulse, perturbed = kept
    needed = tuple(x is not None for x in perturbed)
    like = tuple(jax.ShapeDtypeStruct(x.shape, jnp.float64) for x in arrays)
    zero = jax.custom_derivatives.SymbolicZero
    given = (jnp.zeros(x.shape, x.dtype) if isinstance(x, zero) else x for x in cotangents)
    return _call(_back_of(made, needed), like, (*arrays, impulse, *given))


@lru_cache(maxsize=256)  # of one object JAX keeps what it compiled
def _back_of(made: Step, needed: tuple[bool, ...]) -> Any:
    return partial(made.backward, needed)


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
    """Velocities after a step and its impulses, with gradients by all arrays.

    Parameters and results are those of `lavender.torch.solve`, of arrays of JAX. The solve itself runs on the
    CPU, outside of what JAX compiles.

    Raises
    ------
    InputError
        Types and shapes that do not fit; also where 64-bit numbers are not switched on.
    RuntimeError
        JAX's own, with the words of the error in it: what only numbers tell, such as a negative mu or no solution.
    """
    given = [jnp.asarray(x) for x in (J, M, v_free, mu)]
    none = jnp.zeros(given[0].shape[-2:-1], given[0].dtype)
    given += [none if x is None else jnp.asarray(x) for x in (target, compliance)]
    for name, x in zip(NAMES, given, strict=True):
        if x.dtype != jnp.float64:
            raise InputError(
                f"{name} is {x.dtype}; float64 is needed: jax.config.update('jax_enable_x64', True) before it is made"
            )
    shapes(given)
    # As many axes of a batch on all arrays: `broadcast_all` of vmap puts its own before them.
    most = max(x.ndim - n for x, n in zip(given, SIZES, strict=True))
    given = [x.reshape(*(1,) * (most + n - x.ndim), *x.shape) for x, n in zip(given, SIZES, strict=True)]
    given[1] = 0.5 * (given[1] + jnp.swapaxes(given[1], -1, -2))
    velocity, impulse = _solve(step(given, cones, friction, solver, tol), *given)
    return velocity, impulse
