"""Build the constraint problem of a substep from the engine's arrays; compute its residual and motion error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import import_module_lazily
from lavender.judge.residuals import Residual, residual
from lavender.problem import Problem
from lavender.problem.cones import Cones
from lavender.problem.rows import Rows
from lavender.sim.engine.layout import HEAD, SIZE
from lavender.sim.engine.state import State
from lavender.sim.scene.arithmetic import compute_norm

motion = import_module_lazily("lavender.diagnostics.motion_error")

RESIDUAL_PARTS = ("joint", "normal", "disk", "spin", "rolling")


def build_problem(state: State, bodies: Sequence[str], joints: Sequence[str], name: str) -> Problem:
    """Return the velocity problem of a substep after `kernel.prepare_substep()` has built its rows; arrays are copied.

    The name of a block contains names of `bodies` and `joints`.
    """
    a = state.a
    kj, mj = int(state.size[SIZE["joints"]]), int(state.size[SIZE["joint_rows"]])
    c = int(state.head[HEAD["contacts"]])
    k = kj + c
    m = mj + int(state.head[HEAD["contact_rows"]])
    normal = a["normal"][:c].copy()
    tangent = a["tangent"][:c].copy() if len(a["tangent"]) else np.zeros((c, 3))
    # Contacts without friction have no tangent; `Rows` needs a unit vector orthogonal to the normal.
    for i in np.flatnonzero(a["mu"][kj:k] == 0.0):
        side = np.cross(normal[i], np.eye(3)[np.argmin(np.abs(normal[i]))])
        size = compute_norm(side)
        tangent[i] = (
            side / size if size > 0.0 else 0.0
        )  # For a zero normal, `Rows` raises the error.
    rows = Rows(
        **{
            name: a[name].copy()
            for name in ("inv_mass", "inv_inertia", "v_free", "jac", "joint_body")
        },
        **{name: a[name][:c].copy() for name in ("arm_a", "arm_b", "contact_body")},
        joint_ptr=a["ptr"][: kj + 1].copy(),
        normal=normal,
        tangent=tangent,
        copy=False,
    )
    lower = np.full(m, -np.inf)
    upper = np.full(m, np.inf)
    lower[:mj], upper[:mj] = a["lower"][:mj], a["upper"][:mj]
    cones = Cones(
        **{name: a[name][:k].copy() for name in ("kind", "mu", "patch_radius")},
        lower=lower,
        upper=upper,
        ptr=a["ptr"][: k + 1].copy(),
        rolling=a["rolling"][:k].copy() if len(a["rolling"]) else np.zeros(k),
    )
    # Keys of joints are larger than keys of contacts: body numbers have 24 bits, and the pair (2^24 - 1, ...) is
    # unused.
    joint_keys = np.uint64(0xFFFFFF << 40) + np.arange(kj, dtype=np.uint64)
    pairs = zip(a["contact_pair"][:c].tolist(), _number_contact_points(a["key"][:c]), strict=True)
    guess = a["impulse"][:m].copy() if state.head[HEAD["warm_start"]] else None
    return Problem(
        a["b"][:m].copy(),
        cones,
        rows=rows,
        compliance=a["compliance"][:m].copy(),
        guess=guess,
        key=np.concatenate([joint_keys, a["key"][:c]]),
        names=[
            *joints,
            *(f"{bodies[j]} on {bodies[i]}, point {number}" for (i, j), number in pairs),
        ],
        name=name,
        copy=False,
    )


def _number_contact_points(key: np.ndarray) -> list[int]:
    """Return the numbers of the contacts of each pair of bodies, from 1 on, in the order of their keys."""
    order = np.argsort(key)
    pair = key[order] >> np.uint64(16)
    position = np.arange(len(key))
    first = np.maximum.accumulate(
        np.where(np.append(True, pair[1:] != pair[:-1])[: len(key)], position, 0)
    )
    number = np.empty(len(key), np.int64)
    number[order] = 1 + position - first
    return list(number.tolist())


def summarise_residual(problem: Problem, impulse: FloatArray) -> dict[str, Any]:
    """Return the values of `Simulation.residual` for impulses (m,) [N s]."""
    result = residual(problem, impulse)
    return {
        "relative": result.relative,
        "energy": result.energy,
        "velocity": result.velocity,
        "floor": result.roundoff_floor,
        "worst": result.worst_name,
        "share": _compute_energy_fractions(problem, result),
    }


def summarise_motion(
    problem: Problem, impulse: FloatArray, moving_bodies: Sequence[str]
) -> dict[str, Any]:
    """Return the values of `Simulation.motion` for impulses (m,) [N s]; `moving_bodies` names the dynamic bodies."""
    error = motion.motion_error(problem, impulse)
    body = moving_bodies[error.body] if error.body >= 0 else ""
    return {
        "relative": error.relative,
        "kinetic": error.kinetic,
        "speed": error.speed,
        "spin": error.spin,
        "body": body,
    }


def _compute_energy_fractions(problem: Problem, result: Residual) -> dict[str, float]:
    """Return the fraction of the squared energy error [-] on joints, normals, friction, torsion and rolling."""
    c = problem.cones
    part = np.zeros(problem.m, np.int32)
    contact = np.flatnonzero(c.kind > 0)
    part[c.ptr[0] :] = 2
    joints = len(c.kind) - len(contact)
    part[: c.ptr[joints]] = 0
    part[c.ptr[:-1][contact]] = 1
    part[c.spin_rows[c.spin_rows >= 0]] = 3
    for k in (0, 1):
        part[c.rolling_rows[c.rolling_rows >= 0] + k] = 4
    with np.errstate(invalid="ignore"):
        size = np.sqrt(problem.d) * np.abs(result.error)
    top = float(size.max(initial=0.0))
    # Divide by the largest entry before squaring, to prevent overflow and underflow. Fractions of infinite errors are
    # 0.
    energy = (size / top) ** 2 if 0.0 < top < np.inf else np.zeros(problem.m)
    total = float(energy.sum())
    names = RESIDUAL_PARTS if c.has_rolling else RESIDUAL_PARTS[:4]
    sums = (
        np.bincount(part, weights=energy, minlength=len(names))
        if problem.m
        else np.zeros(len(names))
    )
    return {
        name: float(x / total) if total > 0.0 else 0.0 for name, x in zip(names, sums, strict=True)
    }
