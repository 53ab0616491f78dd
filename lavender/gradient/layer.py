"""One step's solve as a function of arrays, with its adjoint: what `lavender.torch` and `lavender.jax` call.

Leading axes of any argument are a batch, as NumPy broadcasts them. Nothing is kept between the two ways: the adjoint
takes the impulses that were found.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from math import prod
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.batch.solve import solve_many
from lavender.gradient import derivatives
from lavender.problem import Problem
from lavender.problem.cones import Cones

NAMES = ("J", "M", "v_free", "mu", "target", "compliance")
SIZES = (2, 2, 1, 1, 1, 1)  # axes of each that are no batch


@dataclass(frozen=True)
class Step:
    """What is no array: bounds, law, who solves."""

    cones: Cones = field(compare=False)
    bounds: tuple[bytes, ...]  # the cones' numbers without mu, which is not read
    friction: str
    solver: str
    tol: float

    def problems(self, arrays: Sequence[FloatArray]) -> Iterator[Problem]:
        """One for each member of the batch, in C order."""
        contacts = self.cones.is_contact
        for jac, mass, free, mu, target, soft in zip(*arrays, strict=True):
            cones = self.cones
            if contacts.any():
                every = cones.mu.copy()
                every[contacts] = mu
                cones = replace(cones, mu=every)
            yield Problem.from_jacobian(
                jac, mass, free, target=target, cones=cones, compliance=soft, friction=self.friction
            )

    def forward(self, *arrays: Any) -> tuple[FloatArray, FloatArray]:
        """Velocities (..., nv) and impulses (..., m)."""
        flat, batch = _flat(arrays)
        problems = list(self.problems(flat))
        found = [s.raise_for_status() for s in solve_many(problems, self.solver, tol=self.tol)]
        impulse = np.array([s.impulse for s in found]).reshape(*batch, self.cones.n_rows)
        velocity = [p.velocity(s.impulse) for p, s in zip(problems, found, strict=True)]
        return np.array(velocity).reshape(*batch, flat[0].shape[-1]), impulse

    def backward(self, needed: Any, *arrays: Any) -> tuple[FloatArray, ...]:
        """Gradients by the arrays of `forward`, of these, impulses, and cotangents of velocities and impulses.

        Zeros where `needed` is false: what is not asked for need not exist.
        """
        given = arrays[: len(NAMES)]
        flat, batch = _flat(given)
        found: list[list[FloatArray]] = [[] for _ in NAMES]
        others = [
            np.broadcast_to(x, (*batch, x.shape[-1])).reshape(prod(batch), x.shape[-1])
            for x in arrays[len(given) :]
        ]
        problems, (impulses, y, c) = list(self.problems(flat)), others
        for p, g in zip(problems, derivatives(problems, impulses).vjp(velocity=y, impulse=c), strict=True):
            for to, name, need, like in zip(found, NAMES, needed, flat, strict=True):
                if not need:
                    to.append(np.zeros(like.shape[1:]))
                elif name == "mu":
                    to.append(g.mu[p.cones.is_contact])
                else:
                    to.append(g.full(name) if name in ("J", "M") else getattr(g, name))
        made = (np.array(x).reshape(*batch, *like.shape[1:]) for x, like in zip(found, flat, strict=True))
        return tuple(_summed(x, np.shape(like)) for x, like in zip(made, given, strict=True))


def _flat(arrays: Sequence[Any]) -> tuple[list[FloatArray], tuple[int, ...]]:
    """Every array with one leading axis over the batch, and the batch's shape."""
    given = [np.asarray(x, np.float64) for x in arrays]
    leads = [x.shape[: x.ndim - n] for x, n in zip(given, SIZES, strict=True)]
    batch = np.broadcast_shapes(*leads)
    count = prod(batch)  # of -1 NumPy cannot tell where an array has no rows
    return [
        np.broadcast_to(x, (*batch, *x.shape[x.ndim - n :])).reshape(count, *x.shape[x.ndim - n :])
        for x, n in zip(given, SIZES, strict=True)
    ], batch


def _summed(x: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Over the axes along which an array of this shape was repeated."""
    x = x.sum(axis=tuple(range(x.ndim - len(shape))))
    ones = tuple(i for i, n in enumerate(shape) if n == 1 and x.shape[i] != 1)
    return x.sum(axis=ones, keepdims=True) if ones else x


def shapes(arrays: Sequence[Any]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Shapes of velocities and impulses; InputError where those of the arguments do not fit."""
    sizes = [tuple(x.shape) for x in arrays]
    for name, size, n in zip(NAMES, sizes, SIZES, strict=True):
        if len(size) < n:
            raise InputError(f"{name} has shape {size}; {n} axes are needed, and before them any of a batch")
    m, nv = sizes[0][-2:]
    wanted = ((m, nv), (nv, nv), (nv,), sizes[3][-1:], (m,), (m,))
    for name, size, fits in zip(NAMES, sizes, wanted, strict=True):
        if size[len(size) - len(fits) :] != fits:
            raise InputError(
                f"{name} has shape {size}; (..., {', '.join(map(str, fits))}) is needed, as J is {sizes[0]}"
            )
    try:
        batch = np.broadcast_shapes(*(size[: len(size) - n] for size, n in zip(sizes, SIZES, strict=True)))
    except ValueError:
        raise InputError(
            f"shapes {sizes} of {', '.join(NAMES)} have batches that do not fit each other"
        ) from None
    return (*batch, nv), (*batch, m)


def step(arrays: Sequence[Any], cones: Cones | None, friction: str, solver: str, tol: float) -> Step:
    """The step of these arrays; without cones all rows are contacts, as many as mu has values."""
    m, k = arrays[0].shape[-2], arrays[3].shape[-1]
    if cones is None:
        if (m or k) and (k == 0 or m % k or not 1 <= m // k <= 3):
            raise InputError(
                f"J has {m} rows for {k} values of mu; without cones= each contact has a normal and up to two tangents"
            )
        cones = Cones.contacts(0.0, m // k - 1 if k else 0, count=k)
    contacts = int(np.count_nonzero(cones.is_contact))
    if cones.n_rows != m or contacts != k:
        raise InputError(
            f"cones have {cones.n_rows} rows and {contacts} contacts; J has {m} rows and mu {k} values"
        )
    bounds = tuple(np.asarray(getattr(cones, f.name)).tobytes() for f in fields(cones) if f.name != "mu")
    made = Step(cones, bounds, friction, solver, tol)
    try:
        return _first_of_equals(made)
    except TypeError:  # no name or no number, which has no hash: the solve refuses it
        return made


@lru_cache(maxsize=256)
def _first_of_equals(made: Step) -> Step:
    # JAX keeps what it compiles of a callback by the identity of its object: another one each call is compiled anew.
    return made
