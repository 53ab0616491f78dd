"""Mistakes in v* and targets, equations (3) and (4), and what the state before the step says of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import FloatArray, as_array, number
from lavender.base.errors import InputError
from lavender.lab.diagnostics.bodies import LARGE, bodies_of, free_bodies
from lavender.lab.diagnostics.diagnostic import Suspicion, suspect
from lavender.problem import Problem
from lavender.problem.rows import Rows

G = 9.81  # m/s^2
PUSHED = 30.0  # m/s, of a target that moves bodies apart: 6 cm in a step of 2 ms
LET = 1000.0  # m/s, of one that lets them approach: over a gap of 2 m in such a step
LEAST = 0.05  # coefficient of restitution of what bounces; targets multiplied by dt once more have less
SAME = 1e-6  # by which coefficients of restitution differ that are one, computed from velocities
FAST = 30.0, 1e4  # m/s, of a contact's approach before a step; what is faster is told in another unit


def motion_of(p: Problem) -> tuple[FloatArray, FloatArray, FloatArray] | None:
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


def targets(p: Problem) -> Iterator[Suspicion]:
    """Targets that no contact has."""
    c = p.cones
    motion = motion_of(p)
    contact = c.is_contact
    if motion is None or not contact.any():
        return
    u, target, _ = motion
    normal, tangent = c.normal_rows, c.friction_rows
    joints = int(np.count_nonzero(~c.contact_rows))
    if joints and np.any(target[tangent]) and not np.any(np.roll(target, joints)[tangent]):
        reason = f"tangents have targets up to {np.abs(target[tangent]).max():.3g} m/s, and none with the {joints} "
        yield suspect(p, "targets", reason + "targets of joints put first, where their rows stand")
        return
    full = np.flatnonzero(c.n_tangents == 2)
    each = np.abs(target[c.ptr[full][:, None] + np.arange(3)])
    used, most = each.any(axis=0), each.max(axis=1, initial=0.0)
    # A conveyor's are equal.
    if not used[:1].any() and used[1:].sum() == 1 and np.ptp(most) > 0.01 * most.max():
        reason = f"targets stand in the {'second' if used[1] else 'third'} row of contacts and never in the first; a "
        yield suspect(p, "tangents first", reason + "contact's rows are normal, tangent, tangent", full)
        return
    un, tn = u[normal], target[normal]
    r = bodies_of(p)
    rest = None if r is None or not _at_rest(r) else np.linalg.norm(r.v_free[:, :3], axis=1)
    wild = (tn > (PUSHED if rest is None else max(1.0, 20.0 * float(rest.max())))) | (tn < -LET)
    if wild.any():
        most = float(tn[np.argmax(np.abs(tn) * wild)])
        reason = (
            f"{np.count_nonzero(wild)} contacts have targets up to {most:.3g} m/s, more than moves there; "
        )
        reason += "a depth or a gap in m is divided by dt once, and a gap counts as negative"
        yield suspect(p, "targets", reason, np.flatnonzero(contact)[wild], target=most)
        return
    if r is None or rest is None:
        return
    if np.all(tn < 0.0) and np.any(un < 0.0) and np.any(np.all(r.contact_body >= 0, axis=1)):
        least = float(np.median(-tn))
        if least > 0.1 * float(np.median(rest)):
            reason = f"bodies at rest approach at every contact as over a gap (targets to {tn.min():.3g} m/s); of a "
            reason += "depth that is positive inside the target is +depth/dt"
            yield suspect(p, "targets", reason, np.flatnonzero(contact), target=float(tn.min()))


def speeds(p: Problem) -> Iterator[Suspicion]:
    """Speeds that are accelerations."""
    motion, r = motion_of(p), bodies_of(p)
    contact = np.flatnonzero(p.cones.is_contact)
    if motion is None or not len(contact):
        return
    if r is not None and np.any(r.inv_mass > 0.0):
        v = np.linalg.norm(r.v_free[r.inv_mass > 0.0, :3], axis=1)
        if np.median(np.abs(v - G)) <= 0.01 * G:
            reason = f"v* of bodies is {np.median(v):.3g} m/s, as g is in m/s^2: is it v + dt a?"
            yield suspect(p, "v_free", reason, speed=float(np.median(v)))
            return
    toward = -motion[0][p.cones.normal_rows]
    if FAST[0] < toward.max() < FAST[1]:
        i = int(np.argmax(toward))
        reason = f"bodies approach each other with {toward[i]:.3g} m/s; v* is v + dt a: do accelerations lack their dt?"
        yield suspect(p, "v_free", reason, contact[toward > FAST[0]], speed=float(toward[i]))


def above(p: Problem) -> Iterator[Suspicion]:
    """Most bodies have one velocity v*, that of a step of gravity; what stands still holds some of them from below."""
    r = bodies_of(p)
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
        yield suspect(
            p, "normals", reason, np.flatnonzero(p.cones.is_contact)[still], along=float(toward.mean())
        )


def _at_rest(r: Rows) -> bool:
    """Bodies have about one velocity v*, and each touches another: what one step of gravity makes of rest."""
    moving = r.inv_mass > 0.0
    if not np.isin(np.flatnonzero(moving), r.contact_body).all() or not moving.any():
        return False
    v = r.v_free[moving, :3]
    fall = np.median(v, axis=0)
    return bool(np.linalg.norm(v - fall, axis=1).max() <= 0.1 * np.linalg.norm(fall))


def state_before(
    p: Problem, velocity: Any, gap: Any, dt: float | None
) -> tuple[FloatArray | None, FloatArray | None, float]:
    """Velocity, gap and dt of `diagnose`, checked."""
    motion = None if velocity is None and gap is None else motion_of(p)
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


def stepped(p: Problem, velocity: Any, gap: Any, dt: float) -> Iterator[Suspicion]:
    """What v* = v + dt a says, and targets of normals, -gap/dt or a share of it where surfaces overlap."""
    motion = None if velocity is None and gap is None else motion_of(p)
    contact = np.flatnonzero(p.cones.is_contact)
    if motion is None or not len(contact):
        return
    normal, g, r = p.cones.normal_rows, p.generalized, p.rows

    def of_normals(v: FloatArray) -> FloatArray:
        return np.asarray(p.jacobian @ v.ravel() if g is None else g.velocity_of(v))[normal]

    if velocity is not None:
        step = (motion[2] - velocity).ravel()
        change = np.abs(of_normals(step))
        push = step.reshape(-1, 6)[r.inv_mass > 0.0, :3] if r is not None else np.zeros((0, 3))
        if g is not None and g.nv <= LARGE:
            push = np.array([step[j : j + 3] for j in free_bodies(g.mass.toarray())]).reshape(-1, 3)
        # light fingers are faster than what flies
        fall = np.linalg.norm(push, axis=1) if len(push) else change
        fall = fall[fall > 0.01 * fall.max()]  # of spins, and of bodies beside each other, nothing
        most = float(np.median(fall)) if len(fall) else 0.0
        if not step.any():
            yield suspect(
                p, "v_free", "v* is v: are the accelerations of the step, dt a, forgotten? (or no force acts)"
            )
        elif most > 0.5 * G:
            reason = f"v* differs from v by {most:.3g} m/s in the median: do accelerations lack their dt?"
            yield suspect(p, "v_free", reason, change=most)
    if gap is None:
        return
    target = motion[1][normal]
    told = (target != 0.0) & (np.abs(gap) > 1e-9)
    if velocity is not None:
        told &= ~_bounces(target, of_normals(velocity))
    if not told.any():
        return
    if np.mean(target[told] * gap[told] > 0.0) > 0.7:
        reason = "targets have the sign of the gaps: what is apart may approach (-gap/dt), what overlaps has to part"
        yield suspect(p, "targets", reason, contact[told])
    share = float(np.median(np.abs(target[told] / gap[told]))) * dt
    if not 1.5 * dt <= share <= 0.1 / dt:
        reason = f"targets are {share:.2g} of gap/dt in the median, where all of it is 1: "
        reason += "are they divided by dt twice?" if share > 1.0 else "are they multiplied by dt once more?"
        yield suspect(p, "targets", reason, contact[told], share=share)


def _bounces(target: FloatArray, before: FloatArray) -> npt.NDArray[np.bool_]:
    """Targets (c,) that are -e times the approach before the step (c,), with one e: they say nothing of gaps."""
    approach = before < 0.0
    e = np.zeros(len(target))
    np.divide(-target, before, out=e, where=approach)
    bounces = approach & (e > LEAST) & (e <= 1.0)
    return bounces & (np.abs(e - np.median(e[bounces])) <= SAME) if bounces.any() else bounces


CHECKS = (targets, speeds, above)
