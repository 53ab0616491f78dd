"""Checks of v* and targets, equations (3) and (4), and their comparison with the state before the step."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, as_array, check_float, get_shape
from lavender.base.errors import InputError
from lavender.diagnostics.bodies import MAX_DENSE_VELOCITIES, find_free_bodies
from lavender.diagnostics.diagnostic import Diagnostic, make_diagnostic
from lavender.problem import Problem

G = 9.81  # [m/s^2]
# [m/s] A larger target would separate bodies by more than 6 cm in a step of 2 ms.
MAX_SEPARATION_TARGET = 30.0
# [m/s] A larger target would allow an approach of more than 5 m in a step of 0.5 ms.
MAX_APPROACH_TARGET = 10_000.0
# [-] A smaller ratio of target to approach speed is not a bounce: dt is a factor too many.
MIN_RESTITUTION = 0.05
# [-] Coefficients of restitution that are computed from velocities differ by this.
RESTITUTION_ROUNDING = 1e-6


def get_targets_and_velocity(p: Problem) -> tuple[FloatArray, FloatArray] | None:
    """Return the targets b + J v* (m,) [m/s], and v*; None for a problem in matrix form."""
    bodies = p.rows or p.generalized
    if bodies is None:
        return None
    u = p.jacobian @ bodies.v_free.ravel()
    target = p.b + u
    # Smaller targets are rounding of b + J v*.
    target[np.abs(target) <= 1e-12 * np.abs(u).max(initial=0.0)] = 0.0
    return target, bodies.v_free


def diagnose_targets(p: Problem) -> Iterator[Diagnostic]:
    """Yield diagnostics about implausible targets of joint rows that connect points of two bodies, and of contacts."""
    motion = get_targets_and_velocity(p)
    if motion is None:
        return
    target = motion[0]
    c = p.cones
    if p.rows is not None and p.compliance is not None:
        jac = p.rows.jac
        own = slice(len(p.rows.jac))
        is_linear = np.any(jac[:, 0:3] != 0.0, axis=1) | np.any(jac[:, 6:9] != 0.0, axis=1)
        is_rigid = (c.lower[own] == -np.inf) & (c.upper[own] == np.inf) & (p.compliance[own] == 0.0)
        rows = np.flatnonzero(is_linear & is_rigid & (np.abs(target[own]) > MAX_SEPARATION_TARGET))
        if len(rows):
            largest = float(target[rows[np.argmax(np.abs(target[rows]))]])
            reason = f"{len(rows)} rows of joints have targets up to {largest:.3g} m/s: are the anchors of both bodies "
            reason += "in world coordinates, and is the error of the joint divided by dt once?"
            blocks = np.searchsorted(c.ptr, rows, side="right") - 1
            yield make_diagnostic(p, "joint targets", reason, blocks, target=largest)
    contact, normal, tangent = c.is_contact, c.normal_rows, c.friction_rows
    joints = int(np.count_nonzero(~c.contact_rows))
    if joints and np.any(target[tangent]) and not np.any(np.roll(target, joints)[tangent]):
        largest = np.abs(target[tangent]).max()
        reason = f"tangents have targets up to {largest:.3g} m/s, and none if the {joints} targets of joints come "
        reason += "first, in the order of the rows"
        yield make_diagnostic(p, "targets", reason)
        return
    tn = target[normal]
    wild = (tn > MAX_SEPARATION_TARGET) | (tn < -MAX_APPROACH_TARGET)
    if wild.any():
        largest = float(tn[np.argmax(np.abs(tn) * wild)])
        reason = f"{np.count_nonzero(wild)} contacts have targets up to {largest:.3g} m/s: divide a penetration depth "
        reason += "or a gap in m by dt once, and count a gap as negative"
        yield make_diagnostic(p, "targets", reason, np.flatnonzero(contact)[wild], target=largest)


def diagnose_state(p: Problem, velocity: Any, gap: Any, dt: float | None) -> Iterator[Diagnostic]:
    """Yield diagnostics if v* is not v + dt a, or targets of normals are not -gap/dt (or a share of it on overlap).

    This function validates the arguments, which `diagnose` describes.
    """
    if dt is not None:
        dt = check_float("dt [s]", dt, above=0.0)
    if velocity is None and gap is None:
        return
    motion = get_targets_and_velocity(p)
    if motion is None:
        raise InputError(
            "velocity and gap are compared with v* and J, which a problem in matrix form does not have: leave them out"
        )
    target, v_free = motion
    if velocity is not None:
        shape = v_free.shape
        if p.rows is not None and get_shape("velocity", velocity) == (p.rows.n_bodies, 3):
            out_of_plane = np.reshape([2, 3, 4] + 6 * np.arange(shape[0])[:, None], -1)
            if v_free[:, 2:5].any() or p.jacobian[:, out_of_plane].count_nonzero():
                raise InputError(
                    f"velocity [m/s] has shape {(shape[0], 3)}; {shape} is needed, because the problem is not in the "
                    "xy plane: numpy.insert(v, [2, 2, 2], 0.0, axis=1) converts (v_x, v_y, omega_z)"
                )
            planar = as_array("velocity", velocity, (shape[0], 3), unit="m/s")
            velocity = np.insert(planar, [2, 2, 2], 0.0, axis=1)
        velocity = as_array("velocity", velocity, shape, unit="m/s")
    if gap is not None:
        if dt is None:
            raise InputError(
                "gap [m] is compared with targets [m/s] by the step size: give dt [s], too"
            )
        gap = as_array("gap", gap, (int(np.count_nonzero(p.cones.is_contact)),), unit="m")
    contact = np.flatnonzero(p.cones.is_contact)
    if not len(contact):
        return
    normal = p.cones.normal_rows
    g = p.generalized
    r = p.rows
    if velocity is not None:
        step = (v_free - velocity).ravel()
        change = np.abs((p.jacobian @ step)[normal])
        push = step.reshape(-1, 6)[r.inv_mass > 0.0, :3] if r is not None else np.zeros((0, 3))
        if g is not None and g.nv <= MAX_DENSE_VELOCITIES:
            push = np.array([step[j : j + 3] for j in find_free_bodies(g.mass.toarray())]).reshape(
                -1, 3
            )
        # Use free bodies only, if there are any: light links of a robot have larger accelerations than gravity.
        fall = np.linalg.norm(push, axis=1) if len(push) else change
        fall = fall[fall > 0.01 * fall.max()]  # Ignore bodies on which no force acts.
        typical = float(np.median(fall)) if len(fall) else 0.0
        if not step.any():
            reason = (
                "v* equals v: are the accelerations of the step, dt a, missing? (or no force acts)"
            )
            yield make_diagnostic(p, "v_free", reason)
        elif typical > 0.5 * G:
            reason = (
                f"v* differs from v by {typical:.3g} m/s in the median: do accelerations lack dt?"
            )
            yield make_diagnostic(p, "v_free", reason, change=typical)
    if gap is None or dt is None:
        return
    target = target[normal]
    comparable = (target != 0.0) & (np.abs(gap) > 1e-9)
    if (
        velocity is not None
    ):  # Targets that are -e times the normal velocities, with one e for all, are bounces.
        before = (p.jacobian @ velocity.ravel())[normal]
        e = np.divide(-target, before, out=np.zeros(len(target)), where=before < 0.0)
        bounces = (e > MIN_RESTITUTION) & (e <= 1.0)
        if bounces.any():
            comparable &= ~bounces | (np.abs(e - np.median(e[bounces])) > RESTITUTION_ROUNDING)
    if not comparable.any():
        return
    if np.mean(target[comparable] * gap[comparable] > 0.0) > 0.7:
        reason = "targets have the sign of the gaps: distant bodies may approach (-gap/dt), overlapping ones separate"
        yield make_diagnostic(p, "targets", reason, contact[comparable])
    share = float(np.median(np.abs(target[comparable] / gap[comparable]))) * dt
    if not 1.5 * dt <= share <= 0.1 / dt:
        reason = f"targets are {share:.2g} times gap/dt in the median; 1 is expected: "
        reason += (
            "are they divided by dt twice?"
            if share > 1.0
            else "are they multiplied by dt once more?"
        )
        yield make_diagnostic(p, "targets", reason, contact[comparable], share=share)
