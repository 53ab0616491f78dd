"""Checks of arms, normals and masses, equations (1) and (2), for bodies and for J and M of free rigid bodies."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import FloatArray
from lavender.diagnostics.diagnostic import Diagnostic, make_diagnostic
from lavender.problem import Problem
from lavender.problem.rows import Rows

MAX_DENSE_VELOCITIES = (
    600  # M of up to this many velocities is converted to a dense matrix and inverted.
)
MISTAKEN_READINGS = (  # Possible mistakes in problems of bodies, and in problems of J and M.
    ("mass for inverse mass", "inertia for inverse inertia", "mass and inertia for their inverses"),
    ("inverse mass for mass", "inverse inertia for inertia", "inverses for mass and inertia"),
)


def reconstruct_bodies(p: Problem) -> Rows | None:
    """Return the contacts as `Rows`, also for J and M of free rigid bodies; None if they are not rigid bodies."""
    if __name__ not in p.derived.cache:
        p.derived.cache[__name__] = reconstruct_bodies_from_rows(p)
    return p.derived.cache[__name__]


def reconstruct_bodies_from_rows(
    p: Problem, rows: npt.NDArray[np.intp] | None = None
) -> Rows | None:
    """Compute the result of `reconstruct_bodies`.

    `rows` (c, 3) holds the rows of J of each contact; the default is the rows of the problem's cones.
    """
    g, c = p.generalized, p.cones
    contact = c.is_contact
    if (
        g is None
        or g.nv > MAX_DENSE_VELOCITIES
        or not contact.any()
        or np.any(c.n_tangents[contact] != 2)
    ):
        return p.rows
    if rows is None:
        rows = c.ptr[:-1][contact][:, None] + np.arange(3)
    mass = g.mass.toarray()
    part = g.jac.toarray()[rows]
    six: list[npt.NDArray[np.intp]] = []
    for j in find_free_bodies(
        mass
    ):  # Three equal entries of M may also be the rotational inertia of a ball.
        if j + 6 <= g.nv and (not six or j > six[-1][-1]):
            six.append(np.arange(j, j + 6))
    if not six or any(np.delete(mass[x], x, axis=1).any() for x in six):
        return None
    at = np.array(six)
    # Shape (bodies, c, 3, 3).
    push, turn = part[:, :, at].reshape(len(part), 3, -1, 2, 3).transpose(3, 2, 0, 1, 4)
    moment = push.swapaxes(2, 3) @ turn  # The sum of d (r x d)^T is [r]^T.
    on = push.any(axis=(2, 3))
    k = np.arange(len(part))
    count = on.sum(axis=0)
    first = on.argmax(axis=0)
    last = -1 - on[::-1].argmax(axis=0)
    axes = push[last, k]
    other = push[first, k] + np.where(count == 2, 1.0, -1.0)[:, None, None] * axes
    off = np.abs(axes @ axes.swapaxes(1, 2) - np.eye(3)).max() + np.abs(other).max()
    off += np.abs(moment + moment.swapaxes(2, 3)).max() / max(1.0, np.abs(moment).max())
    if not off < 1e-6 or np.delete(part, at, axis=2).any() or count.min() < 1 or count.max() > 2:
        return None
    arm = np.stack([moment[..., 1, 2], moment[..., 2, 0], moment[..., 0, 1]], axis=-1)
    return Rows(
        inv_mass=1.0 / mass[at[:, 0], at[:, 0]],
        inv_inertia=np.linalg.inv(mass[at[:, 3:, None], at[:, None, 3:]]),
        v_free=g.v_free[at],
        normal=axes[:, 0],
        tangent=axes[:, 1],
        arm_a=arm[first, k],
        arm_b=arm[last, k],
        contact_body=np.stack([np.where(count == 2, first, -1), len(six) + last], axis=1),
    )


def diagnose_geometry(p: Problem) -> Iterator[Diagnostic]:
    """Yield diagnostics about tangents before normals, normals from b to a, and duplicates."""
    r = reconstruct_bodies(p)
    if r is None or not r.n_contacts:
        return
    blocks = np.flatnonzero(p.cones.is_contact)
    a, b = r.contact_body.T
    arms = np.stack([r.arm_a, r.arm_b]) * (r.contact_body.T >= 0)[:, :, None]
    size = np.linalg.norm(arms, axis=2).sum(axis=0)
    axes = np.stack([r.normal, r.tangent, np.cross(r.normal, r.tangent)], axis=1)
    along, *aside = np.einsum("cki,ci->kc", axes, arms[0] - arms[1])
    for row, other in zip(("second", "third"), aside, strict=True):
        is_aside = np.all(other > 1e-3 * size) or np.all(-other > 1e-3 * size)
        if len(along) > 2 and is_aside and not np.all(along > 1e-6 * size):
            reason = f"the second body lies along the {row} row of the contacts, not along the first; the "
            reason += "rows of a contact are normal, tangent, tangent"
            yield make_diagnostic(p, "tangents first", reason, blocks)
            return
    against = np.flatnonzero(along < -0.1 * size)  # (1)
    if len(against):
        i = int(against[np.argmin(along[against] / size[against])])
        reason = f"{len(against)} of {len(along)} normals point from body b to body a by their arms: body {a[i]} to "
        reason += f"{b[i]}, {along[i]:.3g} m; a normal points from a to b, arms from the centres to the point"
        yield make_diagnostic(p, "normals", reason, blocks[against], along=float(along[i]))
    if (
        p.rows is not None
    ):  # With J and M, `blocks.diagnose_duplicate_contacts` compares the rows of J.
        yield from _diagnose_coincident_contacts(p, p.rows, size)


def _diagnose_coincident_contacts(p: Problem, r: Rows, size: FloatArray) -> Iterator[Diagnostic]:
    """Yield diagnostics about contacts of a pair that are equal up to rounding, or opposite within 1 %.

    Equal contacts with an open gap, a target below 0, are none: points of distant faces may coincide.
    """
    pair = np.sort(r.contact_body, axis=1)
    sign = np.where(r.contact_body[:, 0] > r.contact_body[:, 1], -1.0, 1.0)[:, None]
    # Compare the arms on the body with the larger number, which is a moving body.
    arm = np.where((r.contact_body[:, 1] == pair[:, 1])[:, None], r.arm_b, r.arm_a)
    n = sign * r.normal
    order = np.lexsort((arm[:, 2], arm[:, 1], arm[:, 0], pair[:, 1], pair[:, 0]))
    equal = []
    opposed = []
    blocks = np.flatnonzero(p.cones.is_contact)
    for step in (1, 2, 3):
        i = order[:-step]
        j = order[step:]
        near = np.linalg.norm(arm[i] - arm[j], axis=1)
        same = np.all(pair[i] == pair[j], axis=1)
        dot = np.einsum("ij,ij->i", n[i], n[j])
        equal.append(j[same & (near <= 1e-12 * size[i]) & (dot > 1.0 - 1e-12)])
        clash = same & (near <= 1e-2 * size[i]) & (dot < -0.9)
        opposed += [i[clash], j[clash]]
    again = np.unique(np.concatenate(equal))
    speed = p.jacobian @ r.v_free.ravel()
    is_open = p.b + speed < -1e-12 * np.abs(speed).max(initial=0.0)
    again = again[~is_open[p.cones.normal_rows][again]]
    if len(again):
        reason = f"{len(again)} contacts are at the position of another contact of the pair"
        yield make_diagnostic(p, "duplicate rows", reason, blocks[again])
    if any(map(len, opposed)):
        reason = "two contacts of a pair at one position have opposite normals"
        yield make_diagnostic(p, "opposed normals", reason, blocks[np.concatenate(opposed)])


def diagnose_masses(p: Problem) -> Iterator[Diagnostic]:
    """Yield diagnostics about masses and inertias that no real body has."""
    r = reconstruct_bodies(p)
    if r is None or not r.n_bodies:
        return
    eigen = np.linalg.eigvalsh(r.inv_inertia)
    # Compute the longest arm of each body over contacts and joint rows with a linear part.
    size = np.zeros(r.n_bodies)
    joint = np.repeat(r.joint_body, np.diff(r.joint_ptr), axis=0)
    for side in (0, 1):
        body = r.contact_body[:, side]
        arm = np.linalg.norm(r.arm_b if side else r.arm_a, axis=1)
        np.maximum.at(size, body[body >= 0], arm[body >= 0])
        push, turn = (
            np.linalg.norm(r.jac[:, 6 * side + k : 6 * side + k + 3], axis=1) for k in (0, 3)
        )
        has = (joint[:, side] >= 0) & (push > 0.0)
        np.maximum.at(size, joint[has, side], turn[has] / push[has])
    known = np.flatnonzero((r.inv_mass > 0.0) & (eigen[:, 0] > 1e-9 * eigen[:, -1]) & (size > 0.0))
    if not len(known):
        return
    m = r.inv_mass[known]
    e = eigen[known]
    s2 = size[known] ** 2
    given = MISTAKEN_READINGS[p.generalized is not None]
    # Left side of (2) with mass and inertia as given, and with one or both replaced by the inverse.
    readings = {
        "": (1.0 / e).sum(axis=1) * m,
        given[0]: (1.0 / e).sum(axis=1) / m,
        given[1]: e.sum(axis=1) * m,
        given[2]: e.sum(axis=1) / m,
    }
    share = {name: float(np.median(np.log10(0.5 * k2 / s2))) for name, k2 in readings.items()}
    own = share.pop("")
    best = min(share, key=lambda name: abs(share[name] + 0.4))
    if abs(own + 0.4) > 1.6 and abs(share[best] + 0.4) < 0.5:
        ratio = 10 ** (0.5 * own)
        reason = (
            f"radii of gyration are {ratio:.2g} times the arms of contacts and joints; ordinary "
        )
        reason += f"({10 ** (0.5 * share[best]):.2g}) if {best} was given"
        yield make_diagnostic(p, "masses", reason, ratio=ratio)
        return
    density = np.median(1.0 / m / s2**1.5)
    if density < 0.05 and 10.0 < np.median(m / s2**1.5) < 3e4:
        reason = f"bodies are lighter than air ({density:.2g} kg/m^3 by the arms), ordinary with {given[0]}"
        yield make_diagnostic(p, "masses", reason, density=float(density))


def find_free_bodies(mass: FloatArray) -> list[int]:
    """Return the index of the first linear velocity of each free body: the first of three uncoupled, equal masses."""
    n = len(mass)
    d = mass.diagonal()
    at = np.arange(n - 2)
    size = 1e-9 * d[:-2]
    equal = (np.abs(d[1:-1] - d[:-2]) <= size) & (np.abs(d[2:] - d[:-2]) <= size)
    off = sum(np.abs(mass[at + i, at + j]) for i, j in ((0, 1), (0, 2), (1, 2)))
    return [int(i) for i in np.flatnonzero(equal & (off <= size))]
