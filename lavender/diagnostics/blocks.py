"""Checks for any problem: friction coefficients, keys, order of rows, duplicate rows, conflicts, impulses."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.diagnostics.bodies import reconstruct_bodies, reconstruct_bodies_from_rows
from lavender.diagnostics.diagnostic import Diagnostic, make_diagnostic
from lavender.judge.certificates import list_conflicting_blocks
from lavender.judge.residuals import residual
from lavender.problem import Problem
from lavender.solvers.certify import prove_relaxation_infeasible

MAX_PLAUSIBLE_FRICTION = 10.0  # [-] No pair of materials has a larger friction coefficient.
# Impulses this many times above the momentum of the problem are reported. At the foot of a stack of n bodies they
# exceed the momentum of one body n times, so the ratio is multiplied by rows / 100.
MAX_MOMENTUM_RATIO = 1e4
# [rows] For larger problems, no proof that no solution exists is searched: it takes seconds.
MAX_CONFLICT_ROWS = 1000
TIME_STEPS = tuple(0.02 * 0.8**k for k in range(34))  # [s] 20 ms to 13 us
CONFLICT_TOL = (
    1e-6  # [-] A proof counts only if it excludes every answer with up to this relative residual.
)


def diagnose_blocks(p: Problem) -> Iterator[Diagnostic]:
    """Yield diagnostics about implausible friction, keys of several blocks, and rows that no impulse moves."""
    mu = p.cones.coefficients.max(axis=1)
    blocks = np.flatnonzero(mu > MAX_PLAUSIBLE_FRICTION)
    if len(blocks):
        reason = f"mu up to {mu[blocks].max():g}; dry materials have 0.1 to 2"
        yield make_diagnostic(p, "friction", reason, blocks, mu=float(mu[blocks].max()))
    if p.key is not None:
        values, first, count = np.unique(p.key, return_index=True, return_counts=True)
        if len(values) < len(p.key):
            worst = int(np.argmax(count))
            reason = f"{len(p.key) - len(values)} of {len(p.key)} keys repeat another block's: {count[worst]} blocks "
            reason += f"have the key of block {first[worst]}"
            blocks = np.flatnonzero(np.isin(p.key, values[count > 1]))
            yield make_diagnostic(p, "duplicate keys", reason, blocks)
    rows = np.setdiff1d(p.metric.empty, np.flatnonzero(p.cones.friction_rows))
    rows = rows[
        p.cones.contact_rows[rows] | (np.abs(p.b[rows]) > 2.0**-51 * np.abs(p.b).max(initial=0.0))
    ]
    if len(rows):
        reason = "no impulse changes their velocity, as between immovable bodies: remove them, or give a body a mass"
        yield make_diagnostic(p, "immovable", reason, [p.block_of(int(i)) for i in rows])


def diagnose_row_order(p: Problem) -> Iterator[Diagnostic]:
    """Yield a diagnostic if the rows of contacts do not have the order normal, tangent, tangent."""
    c = p.cones
    full = np.flatnonzero(c.n_tangents == 2)
    if p.rows is not None or len(full) < 2:
        return
    k = len(full)
    i = np.arange(len(full))[:, None]
    all_full = 3 * k == np.count_nonzero(c.contact_rows)
    if p.generalized is not None and all_full and reconstruct_bodies(p) is None:
        # After the normals, the tangents come contact by contact, or all first tangents before all second ones.
        orders = np.hstack([i, k + 2 * i, k + 2 * i + 1]), np.hstack([i, k + i, 2 * k + i])
        if any(
            reconstruct_bodies_from_rows(p, c.ptr[full[0]] + order) is not None for order in orders
        ):
            reason = (
                "J has the rows of rigid bodies if all normals come first; the order is contact by "
            )
            reason += "contact: normal, tangent, tangent, then the next contact"
            yield make_diagnostic(p, "all normals first", reason, full)
            return
    # For a matrix, only b can be checked. On a normal row, b is an approach velocity from gravity, bounce or
    # penetration.
    b = p.b[c.ptr[full][:, None] + np.arange(3)]
    whole = np.abs(b).sum(axis=0)
    toward = b.sum(axis=0)
    row = int(whole.argmax())
    is_alone = toward[row] > 0.98 * whole[row] and whole[row] > 0.8 * whole.sum()
    if row and is_alone and toward[0] < 0.1 * whole[0] + 1e-9 * whole.sum():
        reason = f"bodies approach along the {('second', 'third')[row - 1]} row of contacts, not the first; the rows "
        reason += "of a contact are normal, tangent, tangent"
        yield make_diagnostic(p, "tangents first", reason, full, b=b[0].tolist())


def _moves_without_turning(p: Problem, i: int, a: Any) -> bool:
    """Return whether contact i has bodies of so few motions that all of their points may have its rows of `a`.

    A free body has more velocities than a contact has rows. Of a body that cannot rotate, each velocity is a unit
    vector at every point, and A has the same mobility 1/mass in all rows.
    """
    j, end = (int(k) for k in p.cones.ptr[i : i + 2])
    block = a[j:end].toarray()
    if p.generalized is None:
        block = block[:, j:end]
        alike = np.abs(block - block[0, 0] * np.eye(end - j)) <= 1e-9 * block[0, 0]
        return end - j >= 3 and bool(alike.all())
    squares = (block[:, block.any(axis=0)] ** 2).sum(axis=0)
    return len(squares) <= min(end - j, 3) or (
        end - j >= 3 and bool(np.all(np.abs(squares - 1.0) <= 1e-9))
    )


def diagnose_duplicate_contacts(p: Problem) -> Iterator[Diagnostic]:
    """Yield diagnostics about contacts with equal rows, or with opposite rows that cannot both hold."""
    c = p.cones
    contacts = np.flatnonzero(c.is_contact)
    if p.rows is not None or len(contacts) < 2:
        return
    a = p.csr if p.generalized is None else p.generalized.jac
    seen: dict[bytes, int] = {}
    again, opposed = [], []
    for i in contacts.tolist():
        j = c.ptr[i]
        end = c.ptr[i + 1]
        part = slice(a.indptr[j], a.indptr[end])
        index = a.indices[part].tobytes() + np.diff(a.indptr[j : end + 1]).tobytes()
        x = a.data[part]
        if len(x) and seen.setdefault(index + x.tobytes(), i) != i:
            again.append(i)
        row = slice(a.indptr[j], a.indptr[j + 1])
        other = seen.get(b"-" + a.indices[row].tobytes() + (0.0 - a.data[row]).tobytes())
        seen.setdefault(b"-" + a.indices[row].tobytes() + a.data[row].tobytes(), i)
        if (
            other is not None
            and len(a.data[row])
            and p.b[j] + p.b[c.ptr[other]] > 1e-9 * np.abs(p.b).max()
        ):
            opposed += [other, i]
    again = [i for i in again if not _moves_without_turning(p, i, a)]
    # Fewer duplicates are normal: collision detection repeats points.
    if len(again) > max(2, 0.3 * len(contacts)):
        reason = f"{len(again)} contacts have the same rows as an earlier one"
        yield make_diagnostic(p, "duplicate rows", reason, again)
    if opposed:
        reason = "two normals require the same relative motion in opposite directions"
        yield make_diagnostic(p, "opposed normals", reason, opposed)


def diagnose_impulses(p: Problem, impulse: FloatArray) -> Iterator[Diagnostic]:
    """Yield a diagnostic if impulses (m,) [N s] seem to be forces, or are far above the momentum of the problem.

    The momentum is the sum of M_jj max(|v*_j|, max |b|) over the velocities.
    """
    r = residual(p, impulse)
    b = float(np.max(np.abs(p.b), initial=0.0))
    if r.nothing_to_do or b == 0.0:
        return
    # Forces are impulses divided by dt: with some dt they solve the problem better than zero. A true start can have
    # a large error, too: of a heavy body on a light one.
    if r.relative > 50.0 and any(residual(p, dt * impulse).relative < 0.5 for dt in TIME_STEPS):
        reason = (
            f"their error is {r.relative:.2g} times that of the zero impulse: are they forces [N]?"
        )
        yield make_diagnostic(p, "impulses", reason, [p.block_of(r.worst_row)], relative=r.relative)
        return
    if p.rows is not None:
        mass = np.divide(
            1.0, p.rows.inv_mass, out=np.zeros(p.rows.n_bodies), where=p.rows.inv_mass > 0.0
        )
        turn = np.diagonal(np.linalg.pinv(p.rows.inv_inertia, hermitian=True), axis1=1, axis2=2)
        masses = np.column_stack([mass, mass, mass, turn]).ravel()
    elif p.generalized is not None:
        masses = p.generalized.mass.diagonal()
    else:
        return
    momentum = float(masses @ np.maximum(np.abs(p.velocity(np.zeros(p.m)).ravel()), b))
    # Forces on immovable bodies change no momentum.
    push = (abs(p.jacobian.tocsr()) @ (masses > 0.0).astype(float)) * np.abs(impulse)
    i = int(np.argmax(push))
    if push[i] > max(1.0, p.m / 100) * MAX_MOMENTUM_RATIO * momentum:
        reason = (
            f"the impulse of {p.row_name(i)}, {impulse[i]:.3g} N s, pushes with {push[i]:.3g} N s, but the momentum "
            f"of the problem is {momentum:.3g} N s: is its row of J nearly zero, or nearly equal to another?"
        )
        yield make_diagnostic(
            p, "impulses", reason, [p.block_of(i)], push=float(push[i]), momentum=momentum
        )


def diagnose_conflict(p: Problem) -> Iterator[Diagnostic]:
    """Yield a diagnostic that names the conflicting blocks if the problem provably has no solution."""
    if not 0 < p.m <= MAX_CONFLICT_ROWS or not np.isfinite(p.b).all():
        return
    proof = prove_relaxation_infeasible(p, CONFLICT_TOL)
    if proof is not None:
        law = "Of the convex relaxation, " if p.law == "coulomb" else ""
        joints, contacts = list_conflicting_blocks(p, proof.y)
        yield make_diagnostic(p, "conflict", law + proof.message, joints + contacts)
