"""Possible mistakes in a problem's data, reported as suspicions and never as errors.

A solver converges on a problem with a normal that points the wrong way as on any other. `diagnose` checks relations
that hold in data of real bodies:

    centres     c_b - c_a = arm_a - arm_b, whatever contact of the pair says so; n points from a to b:
                n.(c_b - c_a) > 0 between bodies without hollows                                        (1)
    size        k^2 = tr(I) / 2m, the radius of gyration, is of the size of the arms                    (2)
    targets     target = b + J v*: zero on tangents, not negative where bodies overlap                  (3)
    speeds      v* is a velocity, not g = 9.81 m/s^2; targets and approaches are those of things that move (4)

Of J and M, (1) is known where contacts are of rigid bodies alone: six velocities, coupled to no other, of which three
have one mass, in the frame of the world: a row of direction d has J = (d, r x d) there, with the arm r.

Every threshold keeps a distance from the values in the built-in suite, the scenes of the gallery, robots and recorded
problems. If the numbers would be ordinary under another reading (M^-1 read as M), the suspicion says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import FloatArray, as_array, number
from lavender.base.errors import InputError
from lavender.base.later import sparse as sp
from lavender.judge.residuals import residual
from lavender.problem import Problem, check_problem
from lavender.problem.rows import Rows
from lavender.solvers.certify import conflict_of

__all__ = ["Suspicion", "diagnose"]

MU = 10.0  # -, beyond any pair of materials
LARGE = 600  # velocities up to which an inverse of M is looked at
FAR = 0.25  # -, of the arms: bodies further off each other than another contact of the pair says
G = 9.81  # m/s^2
PUSHED = 30.0  # m/s, of a target that moves bodies apart: 6 cm in a step of 2 ms
LET = 1000.0  # m/s, of one that lets them approach: over a gap of 2 m in such a step
CONFLICT = 1000  # rows up to which a proof is asked for that there is no solution
CONFLICT_TOL = 1e-6  # relative residual that it rules out
FAST = 30.0, 1e4  # m/s, of a contact's approach before a step; what is faster is told in another unit


@dataclass(frozen=True)
class Suspicion:
    """One thing that looks wrong; `str()` is a line."""

    kind: str  # in a few words, the same for the same mistake
    reason: str  # what was found, and what to look at
    blocks: tuple[int, ...] = ()  # blocks concerned; empty: the whole
    names: tuple[str, ...] = ()  # of these blocks
    data: dict[str, Any] = field(default_factory=dict)  # the numbers behind it

    def __str__(self) -> str:
        where = ", ".join(self.names[:3]) + (f", {len(self.names) - 3} more" if len(self.names) > 3 else "")
        return f"{self.kind}: {self.reason}" + (f" ({where})" if where else "")


def diagnose(
    problem: Problem, impulse: Any = None, *, velocity: Any = None, gap: Any = None, dt: float | None = None
) -> tuple[Suspicion, ...]:
    """Look for mistakes in a problem's data, or in the impulses that a solver found for it.

    Examines signs and order of normals, bodies and their sizes, masses, order of rows, targets, coefficients, keys and
    the guess. Of at most 1000 rows, it asks Newton's method for a proof that the convex relaxation has no solution, and
    names the blocks that fight. A suspicion need not be an error: a hook has normals against its arms, a conveyor has
    targets on tangents. An empty result proves nothing.

    Parameters
    ----------
    problem : Problem
    impulse : (m,) N s, optional
        A solution to examine; default: the problem's guess.
    velocity : (n, 6) of bodies, (nv,) of J and M, m/s and rad/s, optional
        Before the step. v* is held to it: it alone tells accelerations without their dt, or forgotten.
    gap : (n_contacts,) m, optional
        Between the surfaces of each contact, negative where they overlap; with `dt`. Targets are held to it: it alone
        tells their sign, and a dt too many or too few.
    dt : float, s, optional
        The step.

    Returns
    -------
    tuple of Suspicion
        Empty if nothing is suspicious.

    Raises
    ------
    InputError
        `problem` is not a Problem, an array has another shape, `gap` comes without `dt`, or either it or `velocity`
        with a matrix, which has no v*.

    Examples
    --------
    >>> import numpy as np
    >>> import lavender as lv
    >>> problem = lv.Problem.contact(np.eye(6), [0.0, 0.0, 0.2, 0.0, 0.0, 0.2], mu=[0.5, 12.0])
    >>> [s.kind for s in lv.diagnose(problem)]
    ['friction', 'tangents first']
    """
    check_problem(problem)
    state = _state(problem, velocity, gap, dt)
    given = problem.guess if impulse is None else problem.impulse_array(impulse)
    with np.errstate(all="ignore"):  # what is beyond float64 is no larger and no smaller than anything
        found = [s for check in _CHECKS for s in check(problem)]
        found += _stepped(problem, *state)
        if given is not None:
            found += _impulses(problem, given)
    return tuple(found)


def _of(problem: Problem, kind: str, reason: str, blocks: Any = (), **data: Any) -> Suspicion:
    at = tuple(int(i) for i in np.unique(np.asarray(blocks, int)))
    names = tuple(problem.row_name(int(problem.cones.ptr[i])).rsplit(", ", 1)[0] for i in at[:100])
    return Suspicion(kind, reason, at, names, data)


# -- any problem ------------------------------------------------------------------------------------------


def _friction(p: Problem) -> Iterator[Suspicion]:
    c = p.cones
    mu = c.coefficients.max(axis=1)
    wild = np.flatnonzero(mu > MU)
    if len(wild):
        most = float(mu[wild].max())
        yield _of(p, "friction", f"mu up to {most:g}; dry materials have 0.1 to 2", wild, mu=most)


def _keys(p: Problem) -> Iterator[Suspicion]:
    if p.key is None:
        return
    values, first, count = np.unique(p.key, return_index=True, return_counts=True)
    if len(values) < len(p.key):
        worst = int(np.argmax(count))
        blocks = np.flatnonzero(np.isin(p.key, values[count > 1]))
        reason = f"{len(p.key) - len(values)} of {len(p.key)} keys stand elsewhere already: block {first[worst]}'s "
        yield _of(p, "duplicate keys", reason + f"is that of {count[worst]} blocks", blocks)


def _order(p: Problem) -> Iterator[Suspicion]:
    # By b alone, which in the direction of a normal is an approach: gravity, a bounce, a depth.
    c = p.cones
    full = np.flatnonzero(c.n_tangents == 2)
    if p.rows is not None or len(full) < 2:
        return
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
            yield _of(p, "tangents first", reason + "normal, tangent, tangent", full, b=b[0].tolist())
            return
    flat = b.ravel()
    k = len(full)
    late = np.count_nonzero(np.abs(flat[k:]) > 1e-6 * np.abs(flat).max())
    if np.abs(flat[:k]).sum() > 0.9 * size and (flat[:k] > 0.0).mean() > 0.9 and 2 * late <= k:
        reason = f"the first {k} contact rows approach and the other {2 * k} hardly do; rows stand by contact: normal, "
        yield _of(p, "all normals first", reason + "tangent, tangent, then those of the next", full)


def _twins(p: Problem) -> Iterator[Suspicion]:
    # Blocks of the same rows, or of opposed ones that cannot both hold.
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
        yield _of(p, "duplicate rows", f"{len(again)} contacts have the rows of an earlier one", again)
    if opposed:
        yield _of(p, "opposed normals", "normals that ask the same row to go both ways at once", opposed)


def _impulses(p: Problem, impulse: FloatArray) -> Iterator[Suspicion]:
    r = residual(p, impulse)
    b = float(np.max(np.abs(p.b), initial=0.0))
    if r.nothing_to_do or b == 0.0:
        return
    if r.relative > 50.0:  # dt = 1/60 s and less; what a step before left is worse than nothing a few times
        reason = f"they are {r.relative:.2g} times as wrong as doing nothing; are they forces [N], for impulses [N s]?"
        yield _of(p, "impulses", reason, [p.block_of(r.worst_row)], relative=r.relative)
        return
    own = np.abs(impulse) * np.where(p.d > 0.0, p.d, 0.0)  # the velocity that each gives its own row
    i = int(np.argmax(own))
    if own[i] > 1e4 * b * max(1.0, p.m / 100):  # a stack of n bodies multiplies its own momentum n times
        reason = f"an impulse of {impulse[i]:.3g} N s turns its row by {own[i]:.3g} m/s, where b is {b:.3g} m/s at most"
        yield _of(
            p,
            "impulses",
            reason + ": far beyond the momentum at hand",
            [p.block_of(i)],
            velocity=float(own[i]),
        )


# -- J and v*: targets -------------------------------------------------------------------------------------


def _motion(p: Problem) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """J v* and target (m,) [m/s], and v*; None for a matrix."""
    if p.rows is not None:
        v = p.rows.v_free
        u = p.jacobian @ v.ravel()
    elif p.generalized is not None:
        v = p.generalized.v_free
        u = p.generalized.velocity_of(v)
    else:
        return None
    target = p.b + u
    target[np.abs(target) <= 1e-12 * np.abs(u).max(initial=0.0)] = 0.0  # rounding of both
    return u, target, v


def _targets(p: Problem) -> Iterator[Suspicion]:
    c = p.cones
    motion = _motion(p)
    contact = c.is_contact
    if motion is None or not contact.any():
        return
    u, target, _ = motion
    normal, tangent = c.normal_rows, c.friction_rows
    joints = int(np.count_nonzero(~c.contact_rows))
    if joints and np.any(target[tangent]) and not np.any(np.roll(target, joints)[tangent]):
        reason = f"tangents have targets up to {np.abs(target[tangent]).max():.3g} m/s, and none with the {joints} "
        yield _of(p, "targets", reason + "targets of joints put first, where their rows stand")
        return
    full = np.flatnonzero(c.n_tangents == 2)
    each = np.abs(target[c.ptr[full][:, None] + np.arange(3)])
    used, most = each.any(axis=0), each.max(axis=1, initial=0.0)
    # A conveyor's are equal.
    if not used[:1].any() and used[1:].sum() == 1 and np.ptp(most) > 0.01 * most.max():
        reason = f"targets stand in the {'second' if used[1] else 'third'} row of contacts and never in the first; a "
        yield _of(p, "tangents first", reason + "contact's rows are normal, tangent, tangent", full)
        return
    un, tn = u[normal], target[normal]
    r = _bodies(p)
    rest = None if r is None or not _at_rest(r) else np.linalg.norm(r.v_free[:, :3], axis=1)
    wild = (tn > (PUSHED if rest is None else max(1.0, 20.0 * float(rest.max())))) | (tn < -LET)
    if wild.any():
        most = float(tn[np.argmax(np.abs(tn) * wild)])
        reason = (
            f"{np.count_nonzero(wild)} contacts have targets up to {most:.3g} m/s, more than moves there; "
        )
        reason += "a depth or a gap in m is divided by dt once, and a gap counts as negative"
        yield _of(p, "targets", reason, np.flatnonzero(contact)[wild], target=most)
        return
    if r is None or rest is None:
        return
    if np.all(tn < 0.0) and np.any(un < 0.0) and np.any(np.all(r.contact_body >= 0, axis=1)):
        least = float(np.median(-tn))
        if least > 0.1 * float(np.median(rest)):
            reason = f"bodies at rest approach at every contact as over a gap (targets to {tn.min():.3g} m/s); of a "
            reason += "depth that is positive inside the target is +depth/dt"
            yield _of(p, "targets", reason, np.flatnonzero(contact), target=float(tn.min()))


def _speeds(p: Problem) -> Iterator[Suspicion]:
    motion, r = _motion(p), _bodies(p)
    contact = np.flatnonzero(p.cones.is_contact)
    if motion is None or not len(contact):
        return
    if r is not None and np.any(r.inv_mass > 0.0):
        v = np.linalg.norm(r.v_free[r.inv_mass > 0.0, :3], axis=1)
        if np.median(np.abs(v - G)) <= 0.01 * G:
            reason = f"v* of bodies is {np.median(v):.3g} m/s, as g is in m/s^2: is it v + dt a?"
            yield _of(p, "v_free", reason, speed=float(np.median(v)))
            return
    toward = -motion[0][p.cones.normal_rows]
    if FAST[0] < toward.max() < FAST[1]:
        i = int(np.argmax(toward))
        reason = f"bodies approach each other with {toward[i]:.3g} m/s; v* is v + dt a: do accelerations lack their dt?"
        yield _of(p, "v_free", reason, contact[toward > FAST[0]], speed=float(toward[i]))


def _above(p: Problem) -> Iterator[Suspicion]:
    # Most bodies have one velocity v*, that of a step of gravity; what stands still holds some of them from below.
    r = _bodies(p)
    if r is None or np.count_nonzero(r.inv_mass) < 2:
        return
    still = np.flatnonzero((r.contact_body < 0).any(axis=1))
    v = r.v_free[r.inv_mass > 0.0, :3]
    fall = np.median(v, axis=0)
    size = float(np.linalg.norm(fall))
    if len(still) < 4 or size == 0.0 or np.median(np.abs(v @ fall / size - size)) > 0.6 * size:
        return
    toward = np.where(r.contact_body[still, 1:] < 0, -1.0, 1.0) * r.normal[still] @ fall[:, None] / size
    if toward.mean() > 0.3 and (toward > -0.1).mean() > 0.9:
        reason = "what stands still pushes bodies the way they fall: are normals flipped, or bodies swapped?"
        yield _of(p, "normals", reason, np.flatnonzero(p.cones.is_contact)[still], along=float(toward.mean()))


def _conflict(p: Problem) -> Iterator[Suspicion]:
    if not 0 < p.m <= CONFLICT or not np.isfinite(p.b).all():
        return
    found = conflict_of(p, CONFLICT_TOL)
    if found is not None:
        law = "Of the convex relaxation, " if p.law == "coulomb" else ""
        reason = law + found.proof.words + (f"; {found.advice}" if found.advice else "")
        soft = [p.row_name(i) for i in found.soft_rows]
        yield _of(p, "conflict", reason, found.blocks, compliance=found.compliance, soft_rows=soft)


def _at_rest(r: Rows) -> bool:
    """Bodies have about one velocity v*, and each touches another: what one step of gravity makes of rest."""
    moving = r.inv_mass > 0.0
    if not np.isin(np.flatnonzero(moving), r.contact_body).all() or not moving.any():
        return False
    v = r.v_free[moving, :3]
    fall = np.median(v, axis=0)
    return bool(np.linalg.norm(v - fall, axis=1).max() <= 0.1 * np.linalg.norm(fall))


# -- the state before the step ------------------------------------------------------------------------------


def _state(
    p: Problem, velocity: Any, gap: Any, dt: float | None
) -> tuple[FloatArray | None, FloatArray | None, float]:
    motion = None if velocity is None and gap is None else _motion(p)
    if motion is None and (velocity is not None or gap is not None):
        raise InputError(
            "velocity and gap are held to v* and J, which a matrix does not have: leave them out"
        )
    if velocity is not None and motion is not None:
        velocity = as_array("velocity", velocity, motion[2].shape, unit="m/s")
    if gap is not None:
        if dt is None:
            raise InputError("gap [m] is held to targets [m/s] by the step: give dt [s] too")
        gap = as_array("gap", gap, (int(np.count_nonzero(p.cones.is_contact)),), unit="m")
    return velocity, gap, 0.0 if dt is None else number("dt [s]", dt, above=0.0)


def _stepped(p: Problem, velocity: Any, gap: Any, dt: float) -> Iterator[Suspicion]:
    # v* = v + dt a; the target of a normal is -gap/dt, or a share of it where surfaces overlap
    motion = None if velocity is None and gap is None else _motion(p)
    contact = np.flatnonzero(p.cones.is_contact)
    if motion is None or not len(contact):
        return
    normal = p.cones.normal_rows
    if velocity is not None:
        g, r = p.generalized, p.rows
        step = (motion[2] - velocity).ravel()
        change = np.abs(p.jacobian @ step if g is None else g.velocity_of(step))[normal]
        push = step.reshape(-1, 6)[r.inv_mass > 0.0, :3] if r is not None else np.zeros((0, 3))
        if g is not None and g.nv <= LARGE:
            push = np.array([step[j : j + 3] for j in _free(g.mass.toarray())]).reshape(-1, 3)
        fall = (
            np.linalg.norm(push, axis=1) if len(push) else change
        )  # light fingers are faster than what flies
        fall = fall[fall > 0.01 * fall.max()]  # of spins, and of bodies beside each other, nothing
        most = float(np.median(fall)) if len(fall) else 0.0
        if not step.any():
            yield _of(
                p, "v_free", "v* is v: are the accelerations of the step, dt a, forgotten? (or no force acts)"
            )
        elif most > 0.5 * G:
            reason = f"v* differs from v by {most:.3g} m/s in the median: do accelerations lack their dt?"
            yield _of(p, "v_free", reason, change=most)
    if gap is None:
        return
    target = motion[1][normal]
    told = (target != 0.0) & (np.abs(gap) > 1e-9)
    if not told.any():
        return
    if np.mean(target[told] * gap[told] > 0.0) > 0.7:
        reason = "targets have the sign of the gaps: what is apart may approach (-gap/dt), what overlaps has to part"
        yield _of(p, "targets", reason, contact[told])
    share = float(np.median(np.abs(target[told] / gap[told]))) * dt
    if not 1.5 * dt <= share <= 0.1 / dt:
        reason = f"targets are {share:.2g} of gap/dt in the median, where all of it is 1: "
        reason += "are they divided by dt twice?" if share > 1.0 else "are they multiplied by dt once more?"
        yield _of(p, "targets", reason, contact[told], share=share)


# -- contacts of bodies --------------------------------------------------------------------------------------


def _bodies(p: Problem) -> Rows | None:
    """The rows, or contacts of J and M as rows; None where these are of something else than rigid bodies."""
    g, c = p.generalized, p.cones
    contact = c.is_contact
    if g is None or g.nv > LARGE or not contact.any() or np.any(c.n_tangents[contact] != 2):
        return p.rows
    mass, part = g.mass.toarray(), g.jac.toarray()[c.ptr[:-1][contact][:, None] + np.arange(3)]
    six: list[npt.NDArray[np.intp]] = []
    for j in _free(mass):  # a ball's spin has one mass, too
        if j + 6 <= g.nv and (not six or j > six[-1][-1]):
            six.append(np.arange(j, j + 6))
    if not six or any(np.delete(mass[x], x, axis=1).any() for x in six):
        return None
    at = np.array(six)
    push, turn = part[:, :, at].reshape(len(part), 3, -1, 2, 3).transpose(3, 2, 0, 1, 4)  # (bodies, c, 3, 3)
    moment = push.swapaxes(2, 3) @ turn  # sum of d (r x d)^T = [r]^T
    on = push.any(axis=(2, 3))
    k, count, first, last = (
        np.arange(len(part)),
        on.sum(axis=0),
        on.argmax(axis=0),
        -1 - on[::-1].argmax(axis=0),
    )
    axes = push[last, k]
    other = push[first, k] + np.where(count == 2, 1.0, -1.0)[:, None, None] * axes
    off = np.abs(axes @ axes.swapaxes(1, 2) - np.eye(3)).max() + np.abs(other).max()
    off += np.abs(moment + moment.swapaxes(2, 3)).max() / max(1.0, np.abs(moment).max())
    if not off < 1e-6 or np.delete(part, at, axis=2).any() or count.min() < 1 or count.max() > 2:
        return None
    arm = np.stack([moment[..., 1, 2], moment[..., 2, 0], moment[..., 0, 1]], axis=-1)
    return Rows(
        inv_mass=1.0 / mass[at[:, 0], at[:, 0]], inv_inertia=np.broadcast_to(np.eye(3), (len(six), 3, 3)),
        v_free=g.v_free[at], normal=axes[:, 0], tangent=axes[:, 1], arm_a=arm[first, k], arm_b=arm[last, k],
        contact_body=np.stack([np.where(count == 2, first, -1), len(six) + last], axis=1),
    )  # fmt: skip


def _geometry(p: Problem) -> Iterator[Suspicion]:
    r = _bodies(p)
    if r is None or not r.n_contacts:
        return
    blocks = np.flatnonzero(p.cones.is_contact)
    a, b = r.contact_body.T
    reach = np.linalg.norm(np.stack([r.arm_a, r.arm_b]), axis=2) * np.stack([a >= 0, b >= 0])
    size = reach.sum(axis=0)
    between = r.arm_a * (a >= 0)[:, None] - r.arm_b * (b >= 0)[:, None]
    axes = np.stack([r.normal, r.tangent, np.cross(r.normal, r.tangent)], axis=1)
    along, *aside = np.einsum("cki,ci->kc", axes, between)
    for row, other in zip(("second", "third"), aside, strict=True):
        for sign in (1.0, -1.0):
            if len(along) > 2 and np.all(sign * other > 1e-3 * size) and not np.all(along > 1e-6 * size):
                reason = f"bodies lie behind each other along the {row} row of contacts and not along the first; a "
                reason += "contact's rows are normal, tangent, tangent"
                yield _of(p, "tangents first", reason, blocks)
                return
    against = np.flatnonzero(along < -0.1 * size)  # (1)
    if len(against):
        i = int(against[np.argmin(along[against] / size[against])])
        reason = f"{len(against)} of {len(along)} normals point from body b to body a by their arms: body {a[i]} to "
        reason += f"{b[i]}, {along[i]:.3g} m; a normal points from a to b, arms from the centres to the point"
        yield _of(p, "normals", reason, blocks[against], along=float(along[i]))
    if p.rows is None:
        return  # repeated rows are told by J
    again, opposed = _same_place(r, size)
    if len(again):
        reason = f"{len(again)} contacts stand where another of the pair does"
        yield _of(p, "duplicate rows", reason, blocks[again])
    if len(opposed):
        reason = "two contacts of a pair in one place push opposite ways"
        yield _of(p, "opposed normals", reason, blocks[opposed])
    moving = np.flatnonzero((a >= 0) & (b >= 0))
    off = _loops(r.contact_body[moving], (r.arm_a - r.arm_b)[moving], r.n_bodies)
    wrong = moving[off > FAR * size[moving]]
    if len(wrong) and len(wrong) <= 0.2 * len(moving):
        i = int(wrong[0])
        reason = (
            f"by its arms contact {i} has the centres of bodies {a[i]} and {b[i]} elsewhere than the others "
        )
        yield _of(
            p,
            "bodies",
            reason + "have them: does it name another body?",
            blocks[wrong],
            off=float(off.max()),
        )


def _same_place(r: Rows, size: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Contacts that repeat another of their pair to rounding, and those that oppose one within a hundredth."""
    pair = np.sort(r.contact_body, axis=1)
    turned = np.where(r.contact_body[:, 0] > r.contact_body[:, 1], -1.0, 1.0)[:, None]
    arm = np.where(
        (r.contact_body[:, 1] == pair[:, 1])[:, None], r.arm_b, r.arm_a
    )  # of the later, a moving body
    n = turned * r.normal
    order = np.lexsort((arm[:, 2], arm[:, 1], arm[:, 0], pair[:, 1], pair[:, 0]))
    again, opposed = [], []
    for step in (1, 2, 3):
        i, j = order[:-step], order[step:]
        near = np.linalg.norm(arm[i] - arm[j], axis=1)
        same = np.all(pair[i] == pair[j], axis=1)
        dot = np.einsum("ij,ij->i", n[i], n[j])
        again.append(j[same & (near <= 1e-12 * size[i]) & (dot > 1.0 - 1e-12)])
        clash = same & (near <= 1e-2 * size[i]) & (dot < -0.9)
        opposed += [i[clash], j[clash]]
    return np.unique(np.concatenate(again)), np.unique(np.concatenate(opposed))


def _loops(pair: Any, between: FloatArray, n: int) -> FloatArray:
    """|c_b - c_a - between| (e,) [m] with centres c of least sum of such distances: few that err stand out."""
    if not len(pair):
        return np.zeros(0)
    at = np.arange(len(pair))
    incidence = sp.csr_array(
        (np.r_[-np.ones(len(pair)), np.ones(len(pair))], (np.r_[at, at], pair.T.ravel())),
        shape=(len(pair), n),
    )
    scale = np.abs(between).max()
    if not 0.0 < scale < np.inf:
        return np.zeros(len(pair))
    weight = np.ones(len(pair))
    for _ in range(8):
        normal = incidence.T @ sp.diags_array(weight) @ incidence + 1e-9 * sp.eye_array(n)
        centre = sp.linalg.splu(sp.csc_array(normal)).solve(
            incidence.T @ (weight[:, None] * (between / scale))
        )
        off = np.linalg.norm(incidence @ centre - between / scale, axis=1)
        weight = 1.0 / (off + 1e-4)
    return scale * off


# -- masses --------------------------------------------------------------------------------------------------


def _masses(p: Problem) -> Iterator[Suspicion]:
    if p.rows is None or not p.rows.n_bodies:
        return
    r = p.rows
    turning = np.abs(r.inv_inertia).max(axis=(1, 2)) > 0.0
    still = np.flatnonzero((r.inv_mass == 0.0) & turning)
    if len(still):
        reason = f"body {still[0]} has a finite inertia and an infinite mass (inv_mass 0): it turns and never moves"
        yield _of(p, "masses", reason, bodies=still.tolist())
    eigen = np.linalg.eigvalsh(r.inv_inertia)
    size = _sizes(r)
    known = np.flatnonzero((r.inv_mass > 0.0) & (eigen[:, 0] > 1e-9 * eigen[:, -1]) & (size > 0.0))
    if not len(known):
        return
    m, e, s2 = r.inv_mass[known], eigen[known], size[known] ** 2
    readings = {  # (2), with each number read as given, or as its inverse
        "": (1.0 / e).sum(axis=1) * m,
        "mass for inverse mass": (1.0 / e).sum(axis=1) / m,
        "inertia for inverse inertia": e.sum(axis=1) * m,
        "mass and inertia for their inverses": e.sum(axis=1) / m,
    }
    share = {name: float(np.median(np.log10(0.5 * k2 / s2))) for name, k2 in readings.items()}
    own = share.pop("")
    best = min(share, key=lambda name: abs(share[name] + 0.4))
    if abs(own + 0.4) > 1.6 and abs(share[best] + 0.4) < 0.5:
        reason = (
            f"radii of gyration are {10 ** (0.5 * own):.2g} times the arms of contacts and joints; ordinary "
        )
        yield _of(
            p,
            "masses",
            reason + f"({10 ** (0.5 * share[best]):.2g}) if {best} was given",
            ratio=10 ** (0.5 * own),
        )
        return
    density = np.median(1.0 / m / s2**1.5)
    if density < 0.05 and 10.0 < np.median(m / s2**1.5) < 3e4:
        reason = f"bodies are lighter than air ({density:.2g} kg/m^3 by the arms), ordinary with mass for inverse mass"
        yield _of(p, "masses", reason, density=float(density))


def _sizes(r: Any) -> FloatArray:
    """Longest arm of each body (n,) [m], of contacts and of joint rows that push."""
    size = np.zeros(r.n_bodies)
    joint = np.repeat(r.joint_body, np.diff(r.joint_ptr), axis=0)
    for side in (0, 1):
        body = r.contact_body[:, side]
        arm = np.linalg.norm(r.arm_b if side else r.arm_a, axis=1)
        np.maximum.at(size, body[body >= 0], arm[body >= 0])
        push, turn = (np.linalg.norm(r.jac[:, 6 * side + k : 6 * side + k + 3], axis=1) for k in (0, 3))
        has = (joint[:, side] >= 0) & (push > 0.0)
        np.maximum.at(size, joint[has, side], turn[has] / push[has])
    return size


def _inverse(p: Problem) -> Iterator[Suspicion]:
    g = p.generalized
    if g is None or not 3 <= g.nv <= LARGE:
        return
    mass = g.mass.toarray()
    inverse = np.linalg.inv(mass)
    given, other = _free(mass), _free(inverse)
    if len(other) and not len(given):
        reason = "three velocities have one mass, uncoupled, in the inverse of M and not in M: was M^-1 given for M?"
        yield _of(p, "masses", reason, velocities=other)
    elif (
        p.m == g.nv
        and len(given)
        and not _orthogonal(p, g.jac, given)
        and _orthogonal(p, g.jac.T.tocsr(), given)
    ):
        reason = (
            "contacts' rows are orthogonal unit vectors of a free body in J^T and not in J: is J transposed?"
        )
        yield _of(p, "J transposed", reason)
    weight = np.abs(g.jac).max(axis=0).toarray().ravel() if p.m else np.zeros(g.nv)
    seen = weight > 0.0
    if len(other) > len(given) or np.count_nonzero(seen) < 3:
        return
    spread = [np.ptp(np.log10(d[seen] / weight[seen] ** 2)) for d in (mass.diagonal(), inverse.diagonal())]
    if spread[0] > 2.0 and spread[1] < 0.25 * spread[0]:
        reason = f"effective masses of the velocities span 10^{spread[0]:.1f}, with the inverse of M 10^{spread[1]:.1f}"
        yield _of(p, "masses", reason + ": was M^-1 given for M?", spread=spread)


def _free(mass: FloatArray) -> list[int]:
    """First of each three velocities with equal mass and nothing between them: those of a body that flies."""
    n = len(mass)
    d = mass.diagonal()
    at = np.arange(n - 2)
    size = 1e-9 * d[:-2]
    equal = (np.abs(d[1:-1] - d[:-2]) <= size) & (np.abs(d[2:] - d[:-2]) <= size)
    off = sum(np.abs(mass[at + i, at + j]) for i, j in ((0, 1), (0, 2), (1, 2)))
    return [int(i) for i in np.flatnonzero(equal & (off <= size))]


def _orthogonal(p: Problem, jac: Any, free: list[int]) -> bool:
    """Most contacts that move a free body do so by three orthogonal unit vectors."""
    c = p.cones
    first = c.ptr[:-1][c.is_contact & (np.diff(c.ptr) == 3)]
    eye = np.eye(3)
    for j in free:
        parts = [jac[i : i + 3][:, j : j + 3].toarray() for i in first]
        unit = [np.allclose(x @ x.T, eye, atol=1e-6) for x in parts if x.any()]
        if unit and np.mean(unit) > 0.5:
            return True
    return False


_CHECKS: tuple[Callable[[Problem], Iterator[Suspicion]], ...] = (
    _friction, _keys, _order, _twins, _targets, _speeds, _above, _geometry, _masses, _inverse, _conflict
)  # fmt: skip
