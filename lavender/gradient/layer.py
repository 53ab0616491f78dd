"""The solve of one step as a function of arrays, with its adjoint, for `lavender.torch` and `lavender.jax`.

Leading axes of the arguments are batch axes with NumPy's broadcasting. No state is stored between the two functions:
the impulses of the solution are arguments of the adjoint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import lru_cache
from math import prod
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.batch.data import Batch
from lavender.batch.solve import solve_many
from lavender.gradient import derivatives
from lavender.problem.cones import Cones

ARGUMENTS = ("J", "M", "v_free", "mu", "target", "compliance")
ARGUMENT_AXES = (2, 2, 1, 1, 1, 1)  # Number of axes of each argument without batch axes.


@dataclass(frozen=True)
class Step:
    """Settings of a step that are not arrays of numbers."""

    # Blocks of the rows. The coefficients `cones.mu` are not used; mu is an argument.
    cones: Cones = field(compare=False)
    bounds: tuple[
        bytes, ...
    ]  # Contents of all other fields of `cones`, by which two steps are compared.
    friction: str
    solver: str
    tol: float

    def make_batch(self, arrays: Sequence[FloatArray]) -> Batch:
        """Return the members of the batch, in C order, as worlds."""
        jac, mass, free, mu, target, compliance = arrays
        is_contact = self.cones.is_contact
        mu_of_block = np.repeat(self.cones.mu[None], len(jac), axis=0)
        mu_of_block[:, is_contact] = mu
        return Batch(
            jac,
            mass,
            free,
            target=target,
            cones=self.cones,
            compliance=compliance,
            mu=mu_of_block,
            friction=self.friction,
        )

    def forward(self, *arrays: Any) -> tuple[FloatArray, FloatArray]:
        """Compute velocities (..., nv) and impulses (..., m)."""
        flat, batch = _flatten_batch(arrays)
        solutions = solve_many(self.make_batch(flat), self.solver, tol=self.tol)
        for i in np.flatnonzero(~solutions.success).tolist():
            solutions[i].raise_for_status()
        impulse = solutions.impulse.reshape(*batch, self.cones.n_rows)
        return solutions.velocity.reshape(*batch, flat[0].shape[-1]), impulse

    def backward(self, needed: Any, *arrays: Any) -> tuple[FloatArray, ...]:
        """Compute the gradients by the arrays of `forward`.

        Parameters
        ----------
        needed : sequence of bool
            Whether to compute the gradient by each array. Gradients that are not needed are returned as zeros, even if
            they do not exist.
        *arrays
            Arrays of `forward`, then its impulses, then cotangents of velocities and of impulses.
        """
        arguments = arrays[: len(ARGUMENTS)]
        flat, batch = _flatten_batch(arguments)
        sizes = ((x, x.shape[-1]) for x in arrays[len(arguments) :])
        impulses, y, c = (np.broadcast_to(x, (*batch, n)).reshape(prod(batch), n) for x, n in sizes)
        of_batch = derivatives(self.make_batch(flat), impulses).vjp(velocity=y, impulse=c)
        gradients = []
        for name, is_needed, like in zip(ARGUMENTS, needed, flat, strict=True):
            if not is_needed:
                gradients.append(np.zeros(like.shape))
            elif name == "mu":
                by_block = of_batch.mu.reshape(len(like), self.cones.n_blocks)
                gradients.append(by_block[:, self.cones.is_contact])
            else:
                gradients.append(getattr(of_batch, name))
        shapes = ((x.shape[1:], np.shape(like)) for x, like in zip(flat, arguments, strict=True))
        parts = zip(gradients, shapes, strict=True)
        return tuple(_sum_to_shape(x.reshape(*batch, *own), shape) for x, (own, shape) in parts)


def _flatten_batch(arrays: Sequence[Any]) -> tuple[list[FloatArray], tuple[int, ...]]:
    """Return all arrays with a single leading batch axis, and the shape of the batch."""
    arrays = [np.asarray(x, np.float64) for x in arrays]
    batch_shapes = [x.shape[: x.ndim - n] for x, n in zip(arrays, ARGUMENT_AXES, strict=True)]
    batch = np.broadcast_shapes(*batch_shapes)
    count = prod(batch)  # Computed here, as `reshape(-1, ...)` fails for arrays without entries.
    return [
        np.broadcast_to(x, (*batch, *x.shape[x.ndim - n :])).reshape(count, *x.shape[x.ndim - n :])
        for x, n in zip(arrays, ARGUMENT_AXES, strict=True)
    ], batch


def _sum_to_shape(x: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Sum over the axes along which an array of this shape was broadcast."""
    x = x.sum(axis=tuple(range(x.ndim - len(shape))))
    ones = tuple(i for i, n in enumerate(shape) if n == 1 and x.shape[i] != 1)
    return x.sum(axis=ones, keepdims=True) if ones else x


def infer_result_shapes(arrays: Sequence[Any]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the shapes of velocities and impulses; raise InputError if the shapes of the arguments disagree."""
    shapes = [tuple(x.shape) for x in arrays]
    for name, shape, n in zip(ARGUMENTS, shapes, ARGUMENT_AXES, strict=True):
        if len(shape) < n:
            raise InputError(f"{name} has shape {shape}; {n} axes after any batch axes are needed")
    m, nv = shapes[0][-2:]
    required_shapes = ((m, nv), (nv, nv), (nv,), shapes[3][-1:], (m,), (m,))
    for name, shape, required in zip(ARGUMENTS, shapes, required_shapes, strict=True):
        if shape[len(shape) - len(required) :] != required:
            raise InputError(
                f"{name} has shape {shape}; (..., {', '.join(map(str, required))}) is needed, as J is {shapes[0]}"
            )
    batches = [shape[: len(shape) - n] for shape, n in zip(shapes, ARGUMENT_AXES, strict=True)]
    try:
        batch = np.broadcast_shapes(*batches)
    except ValueError:
        raise InputError(
            f"the batch axes of {', '.join(ARGUMENTS)} cannot be broadcast together: the shapes are {shapes}"
        ) from None
    return (*batch, nv), (*batch, m)


def make_step(
    arrays: Sequence[Any], cones: Cones | None, friction: str, solver: str, tol: float
) -> Step:
    """Build the `Step` of these arrays; if `cones` is None, the rows are divided evenly among one contact per mu."""
    m, k = arrays[0].shape[-2], arrays[3].shape[-1]
    if cones is None:
        if (m or k) and (k == 0 or m % k or not 1 <= m // k <= 3):
            raise InputError(
                f"J has {m} rows and mu {k} values; without cones= each contact has one value of mu, a "
                f"normal row and up to two tangent rows: give {k} to {3 * k} rows, or cones="
            )
        cones = Cones.contacts(0.0, m // k - 1 if k else 0, count=k)
    contacts = int(np.count_nonzero(cones.is_contact))
    if cones.n_rows != m or contacts != k:
        raise InputError(
            f"cones have {cones.n_rows} rows and {contacts} contacts; they must have the {m} rows of J, and "
            f"a contact for each of the {k} values of mu"
        )
    bounds = tuple(
        np.asarray(getattr(cones, f.name)).tobytes() for f in fields(cones) if f.name != "mu"
    )
    step = Step(cones, bounds, friction, solver, tol)
    try:
        return _reuse_equal_step(step)
    except (
        TypeError
    ):  # An invalid solver or tolerance may not be hashable; the solve raises the error.
        return step


@lru_cache(maxsize=256)
def _reuse_equal_step(step: Step) -> Step:
    """Return an equal step of an earlier call if there is one, else `step`.

    JAX caches compiled callbacks by the identity of their object, so a new object would be compiled in every call.
    """
    return step
