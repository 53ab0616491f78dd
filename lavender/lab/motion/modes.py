"""Enumeration of all motions of a few contacts with one tangent; one linear system per mode of all contacts.

Each contact is open, stuck, or slides in one of two directions, and each bounded row is at a bound or inside:

    open    lambda = 0                                      w_n >= 0
    stuck   w = 0                                           |lambda_t| <= mu lambda_n
    slides  w_n = 0,  lambda_t = -s mu lambda_n, s = +-1    s w_t >= 0,  lambda_n >= 0
    row     lambda at a bound, or w = 0                     w away from the bound, or lambda within

Every solution is in one of these modes, of which there are four to the power of the number of contacts. If a mode's
system is singular, its solutions are x + N y, with the columns of N its null vectors. They are one motion if A N = 0
and some y satisfies the inequalities. With two tangents, a contact may slide in a continuum of directions, which
cannot be listed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.problem import Problem

MAX_ENUMERATED_CONTACTS = 8  # Problems with more contacts are not enumerated.
MAX_MODES = 4**MAX_ENUMERATED_CONTACTS  # Problems with more modes are not enumerated.
MODES_PER_BATCH = 4096  # Number of systems that are in memory at once.
# At most this many singular modes with two or more null vectors are examined; each needs a linear program.
MAX_SINGULAR_MODES = 300
# Rounding may violate an inequality by this fraction of the largest number of a system.
INEQUALITY_TOL = 1e-9
# Singular values of a scaled system count as zero if they do not exceed this fraction of the largest.
NULL_VALUE_TOL = 1e-11


class _BlockModes(NamedTuple):
    """The modes of one block: equations E x = e and inequalities F x >= f, with x the scaled impulses.

    Parameters
    ----------
    equal : (modes, r, m)
        E.
    rhs : (modes, r)
        e.
    above : (modes, 3, m)
        F.
    bound : (modes, 3)
        f.
    """

    equal: FloatArray
    rhs: FloatArray
    above: FloatArray
    bound: FloatArray


def enumerate_modes(problem: Problem) -> tuple[list[FloatArray], bool] | None:
    """Compute the impulses (m,) [N s] of every mode that has a solution, and whether the list is complete.

    The list is not complete if a mode has a continuum of motions, or if more than MAX_SINGULAR_MODES modes need a
    linear program. Return None if the problem has more than eight contacts or 65,536 modes, a contact with friction in
    two tangents or torsional friction, or if intermediate numbers exceed float64.
    """
    c = problem.cones
    contact = c.is_contact
    one_tangent = (np.diff(c.ptr) == 1 + c.n_together) & ((c.n_tangents <= 1) | (c.mu == 0.0))
    if np.count_nonzero(contact) > MAX_ENUMERATED_CONTACTS or not np.all(one_tangent[contact]):
        return None
    counts = np.where(contact, 2 + 2 * (c.n_tangents > 0) * (c.mu > 0.0), 1).astype(float)
    bound_choices = 1 + (c.lower < c.upper) * (0.0 + np.isfinite(c.lower) + np.isfinite(c.upper))
    counts[~contact] = [
        float(np.prod(bound_choices[c.ptr[i] : c.ptr[i + 1]])) for i in np.flatnonzero(~contact)
    ]
    if np.log(counts).sum() > np.log(MAX_MODES) + 1e-9:
        return None
    with np.errstate(all="ignore"):
        scale = 1.0 / np.sqrt(problem.d)
        a = scale[:, None] * problem.dense() * scale
        b = scale * problem.b
        unit = (
            float(np.abs(b).max(initial=0.0)) or 1.0
        )  # [sqrt J] Unit in which the largest number of a system is 1.
        b, scale = b / unit, unit * scale
        block_modes = [w for i in range(c.n_blocks) for w in _list_block_modes(problem, i, a, b, scale)]
    if not all(np.isfinite(field).all() for modes in block_modes for field in modes):
        return None
    impulses, complete = [], True
    remaining_singular = MAX_SINGULAR_MODES
    for equal, rhs, above, bound in _build_mode_systems(block_modes):
        value = np.linalg.svd(equal, compute_uv=False)
        regular = value[:, -1] > NULL_VALUE_TOL * value[:, 0]
        x = np.linalg.solve(equal[regular], rhs[regular][:, :, None])[:, :, 0]
        tolerance = INEQUALITY_TOL * np.maximum(1.0, np.abs(x).max(axis=1, initial=0.0))
        inside = np.all(
            np.einsum("kij,kj->ki", above[regular], x) >= bound[regular] - tolerance[:, None], axis=1
        )
        impulses += list(scale * x[inside])
        equal, rhs, above, bound = equal[~regular], rhs[~regular], above[~regular], bound[~regular]
        u, value, vt = np.linalg.svd(equal)
        inverse = np.divide(1.0, value, out=np.zeros_like(value), where=value > NULL_VALUE_TOL * value[:, :1])
        along = inverse * np.einsum("klj,kl->kj", u, rhs)
        x = np.einsum("kji,kj->ki", vt, along)
        residual = np.abs(np.einsum("kij,kj->ki", equal, x) - rhs).max(axis=1, initial=0.0)
        for i in np.flatnonzero(residual <= INEQUALITY_TOL):
            null = vt[i][inverse[i] == 0.0].T
            remaining_singular -= null.shape[1] > 1
            if remaining_singular < 0:
                return impulses, False
            y = _find_feasible_point(above[i] @ null, bound[i] - above[i] @ x[i] - INEQUALITY_TOL)
            if y is not None:
                complete &= bool(np.abs(a @ null).max() <= INEQUALITY_TOL)
                impulses.append(scale * (x[i] + null @ y))
    return impulses, complete


def _list_block_modes(
    problem: Problem, block: int, a: FloatArray, b: FloatArray, scale: FloatArray
) -> Iterator[_BlockModes]:
    """Yield the modes of a contact, or the modes of each row of a joint."""
    c = problem.cones
    unit_row = np.eye(problem.m)
    zero_row, zero = np.zeros(problem.m), 0.0
    start, end = c.ptr[block], c.ptr[block + 1]
    if not c.is_contact[block]:
        for i in range(start, end):
            low, high = c.lower[i] / scale[i], c.upper[i] / scale[i]
            mode_list = []
            if low < high:
                inside = [
                    (unit_row[i], low if np.isfinite(low) else None),
                    (-unit_row[i], -high if np.isfinite(high) else None),
                ]
                mode_list.append(([(a[i], b[i])], [(x, y) for x, y in inside if y is not None]))
                mode_list += [([(unit_row[i], low)], [(a[i], b[i])])] * bool(np.isfinite(low))
                mode_list += [([(unit_row[i], high)], [(-a[i], -b[i])])] * bool(np.isfinite(high))
            else:
                mode_list.append(([(unit_row[i], low)], []))
            yield _to_arrays(mode_list, problem.m)
        return
    n, mu = start, c.mu[block]
    no_friction = [(unit_row[t], zero) for t in range(start + 1, end)]
    open_mode = ([(unit_row[n], zero), *no_friction], [(a[n], b[n])])
    if mu == 0.0 or end - start == 1:
        yield _to_arrays([open_mode, ([(a[n], b[n]), *no_friction], [(unit_row[n], zero)])], problem.m)
        return
    t = start + 1
    tangent_bound = mu * scale[n] / scale[t] * unit_row[n]  # Bound of the scaled tangent.
    stuck_mode = (
        [(a[n], b[n]), (a[t], b[t])],
        [(unit_row[n], zero), (tangent_bound - unit_row[t], zero), (tangent_bound + unit_row[t], zero)],
    )
    slide_modes = [
        (
            [(a[n], b[n]), (unit_row[t] + s * tangent_bound, zero)],
            [(unit_row[n], zero), (s * a[t], s * b[t]), (zero_row, zero)],
        )
        for s in (1.0, -1.0)
    ]
    yield _to_arrays([open_mode, stuck_mode, *slide_modes], problem.m)


def _to_arrays(mode_list: list[Any], m: int) -> _BlockModes:
    """Collect modes, as lists of equations and inequalities, in arrays."""
    r = len(mode_list[0][0])
    out = _BlockModes(
        np.zeros((len(mode_list), r, m)),
        np.zeros((len(mode_list), r)),
        np.zeros((len(mode_list), 3, m)),
        np.zeros((len(mode_list), 3)),
    )
    for k, (equal, above) in enumerate(mode_list):
        for i, (x, y) in enumerate(equal):
            out.equal[k, i], out.rhs[k, i] = x, y
        for i, (x, y) in enumerate(above):
            out.above[k, i], out.bound[k, i] = x, y
    return out


def _build_mode_systems(block_modes: list[_BlockModes]) -> Iterator[tuple[FloatArray, ...]]:
    """Yield the arrays E (k, m, m), e, F and f of the modes of all contacts, with k <= MODES_PER_BATCH at a time."""
    counts = [len(w.rhs) for w in block_modes]
    for first in range(0, int(np.prod(counts)), MODES_PER_BATCH):
        mode = np.unravel_index(np.arange(first, min(first + MODES_PER_BATCH, int(np.prod(counts)))), counts)
        yield tuple(
            np.concatenate([w[field][i] for w, i in zip(block_modes, mode, strict=True)], axis=1)
            for field in range(4)
        )


def _find_feasible_point(g: FloatArray, h: FloatArray) -> FloatArray | None:
    """Return a y with G y >= h, or None if no y has this property."""
    if g.shape[1] == 1:
        slope = g[:, 0]
        low = np.max(h[slope > NULL_VALUE_TOL] / slope[slope > NULL_VALUE_TOL], initial=-np.inf)
        high = np.min(h[slope < -NULL_VALUE_TOL] / slope[slope < -NULL_VALUE_TOL], initial=np.inf)
        if low > high or np.any(h[np.abs(slope) <= NULL_VALUE_TOL] > 0.0):
            return None
        return np.array([min(max(low, 0.0), high)])
    from scipy.optimize import linprog

    end = linprog(np.zeros(g.shape[1]), A_ub=-g, b_ub=-h, bounds=(None, None), method="highs")
    return end.x if end.status == 0 else None
