"""Mistakes that any problem may have: coefficients, keys, order and twins of rows, conflicts, impulses."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.judge.residuals import residual
from lavender.lab.diagnostics.bodies import are_grouped
from lavender.lab.diagnostics.diagnostic import Suspicion, suspect
from lavender.problem import Problem
from lavender.solvers.certify import conflict_of

MU = 10.0  # -, beyond any pair of materials
CONFLICT = 1000  # rows up to which a proof is asked for that there is no solution
CONFLICT_TOL = 1e-6  # relative residual that it rules out


def friction(p: Problem) -> Iterator[Suspicion]:
    """Coefficients beyond those of materials."""
    c = p.cones
    mu = c.coefficients.max(axis=1)
    wild = np.flatnonzero(mu > MU)
    if len(wild):
        most = float(mu[wild].max())
        yield suspect(p, "friction", f"mu up to {most:g}; dry materials have 0.1 to 2", wild, mu=most)


def keys(p: Problem) -> Iterator[Suspicion]:
    """Keys that stand more than once."""
    if p.key is None:
        return
    values, first, count = np.unique(p.key, return_index=True, return_counts=True)
    if len(values) < len(p.key):
        worst = int(np.argmax(count))
        blocks = np.flatnonzero(np.isin(p.key, values[count > 1]))
        reason = f"{len(p.key) - len(values)} of {len(p.key)} keys stand elsewhere already: block {first[worst]}'s "
        yield suspect(p, "duplicate keys", reason + f"is that of {count[worst]} blocks", blocks)


def order_of_rows(p: Problem) -> Iterator[Suspicion]:
    """Rows of contacts that do not stand as normal, tangent, tangent."""
    c = p.cones
    full = np.flatnonzero(c.n_tangents == 2)
    if p.rows is not None or len(full) < 2:
        return
    if are_grouped(p):
        reason = (
            "rows of J are those of rigid bodies if all normals stand first; rows stand by contact: normal, "
        )
        yield suspect(p, "all normals first", reason + "tangent, tangent, then those of the next", full)
        return
    # By b alone, which in the direction of a normal is an approach: gravity, a bounce, a depth.
    b = p.b[c.ptr[full][:, None] + np.arange(3)]
    whole, toward = np.abs(b).sum(axis=0), b.sum(axis=0)
    size = whole.sum()
    if size == 0.0:
        return
    for row, place in ((1, "second"), (2, "third")):
        if (
            toward[row] > 0.98 * whole[row]
            and whole[row] > 0.8 * size
            and toward[0] < 0.1 * whole[0] + 1e-9 * size
        ):
            reason = f"bodies approach along the {place} row of contacts and not along the first; a contact's rows are "
            yield suspect(p, "tangents first", reason + "normal, tangent, tangent", full, b=b[0].tolist())
            return
    flat = b.ravel()
    k = len(full)
    late = np.count_nonzero(np.abs(flat[k:]) > 1e-6 * np.abs(flat).max())
    if np.abs(flat[:k]).sum() > 0.9 * size and (flat[:k] > 0.0).mean() > 0.9 and 2 * late <= k:
        reason = f"the first {k} contact rows approach and the other {2 * k} hardly do; rows stand by contact: normal, "
        yield suspect(p, "all normals first", reason + "tangent, tangent, then those of the next", full)


def twins(p: Problem) -> Iterator[Suspicion]:
    """Blocks of the same rows, or of opposed ones that cannot both hold."""
    c = p.cones
    contacts = np.flatnonzero(c.is_contact)
    if p.rows is not None or len(contacts) < 2:
        return
    a = p.csr if p.generalized is None else p.generalized.jac
    seen: dict[bytes, int] = {}
    again, opposed = [], []
    for i in contacts.tolist():
        j, end = c.ptr[i], c.ptr[i + 1]
        part = slice(a.indptr[j], a.indptr[end])
        index, x = a.indices[part].tobytes() + np.diff(a.indptr[j : end + 1]).tobytes(), a.data[part]
        if len(x) and seen.setdefault(index + x.tobytes(), i) != i:
            again.append(i)
        row = slice(a.indptr[j], a.indptr[j + 1])
        other = seen.get(b"-" + a.indices[row].tobytes() + (0.0 - a.data[row]).tobytes())
        seen.setdefault(b"-" + a.indices[row].tobytes() + a.data[row].tobytes(), i)
        if other is not None and len(a.data[row]) and p.b[j] + p.b[c.ptr[other]] > 1e-9 * np.abs(p.b).max():
            opposed += [other, i]
    if len(again) > max(2, 0.3 * len(contacts)):  # collision detection repeats a point now and then
        yield suspect(p, "duplicate rows", f"{len(again)} contacts have the rows of an earlier one", again)
    if opposed:
        yield suspect(p, "opposed normals", "normals that ask the same row to go both ways at once", opposed)


def wrong_impulses(p: Problem, impulse: FloatArray) -> Iterator[Suspicion]:
    """What is wrong with impulses (m,) [N s] beyond being no solution."""
    r = residual(p, impulse)
    b = float(np.max(np.abs(p.b), initial=0.0))
    if r.nothing_to_do or b == 0.0:
        return
    if r.relative > 50.0:  # dt = 1/60 s and less; what a step before left is worse than nothing a few times
        reason = f"they are {r.relative:.2g} times as wrong as doing nothing; are they forces [N], for impulses [N s]?"
        yield suspect(p, "impulses", reason, [p.block_of(r.worst_row)], relative=r.relative)
        return
    own = np.abs(impulse) * np.where(p.d > 0.0, p.d, 0.0)  # the velocity that each gives its own row
    i = int(np.argmax(own))
    if own[i] > 1e4 * b * max(1.0, p.m / 100):  # a stack of n bodies multiplies its own momentum n times
        reason = f"an impulse of {impulse[i]:.3g} N s turns its row by {own[i]:.3g} m/s, where b is {b:.3g} m/s at most"
        yield suspect(
            p,
            "impulses",
            reason + ": far beyond the momentum at hand",
            [p.block_of(i)],
            velocity=float(own[i]),
        )


def conflict(p: Problem) -> Iterator[Suspicion]:
    """The blocks of a proof that there is no solution, of at most CONFLICT rows."""
    if not 0 < p.m <= CONFLICT or not np.isfinite(p.b).all():
        return
    found = conflict_of(p, CONFLICT_TOL)
    if found is not None:
        law = "Of the convex relaxation, " if p.law == "coulomb" else ""
        reason = law + found.proof.words + (f"; {found.advice}" if found.advice else "")
        soft = [p.row_name(i) for i in found.soft_rows]
        yield suspect(p, "conflict", reason, found.blocks, compliance=found.compliance, soft_rows=soft)


CHECKS = (friction, keys, order_of_rows, twins)
