"""The constraint problem of a substep from the engine's arrays; how wrong a step was on it: residuals, motions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import lazy_module
from lavender.judge.residuals import Residual, residual
from lavender.problem import Problem
from lavender.problem.cones import Cones
from lavender.problem.rows import Rows
from lavender.sim.engine.layout import HEAD, SIZE
from lavender.sim.engine.state import State
from lavender.sim.scene.arithmetic import norm

motion = lazy_module("lavender.lab.motion")

PARTS = ("joint", "normal", "disk", "spin", "rolling")


def problem_of(state: State, bodies: Sequence[str], joints: Sequence[str], name: str) -> Problem:
    """The velocity problem of a substep after `kernel.prepare()`, with names of bodies and joints, in copies."""
    a = state.a
    kj, mj = int(state.size[SIZE["joints"]]), int(state.size[SIZE["joint_rows"]])
    c = int(state.head[HEAD["contacts"]])
    k, m = kj + c, mj + int(state.head[HEAD["contact_rows"]])
    normal = a["normal"][:c].copy()
    tangent = a["tangent"][:c].copy() if len(a["tangent"]) else np.zeros((c, 3))
    # contacts without friction have no tangent; any unit vector normal to the normal stands in
    bare = np.flatnonzero(a["mu"][kj:k] == 0.0)
    tangent[bare] = _any_tangent(normal[bare])
    rows = Rows(
        inv_mass=a["inv_mass"].copy(),
        inv_inertia=a["inv_inertia"].copy(),
        v_free=a["v_free"].copy(),
        jac=a["jac"].copy(),
        joint_ptr=a["ptr"][: kj + 1].copy(),
        joint_body=a["joint_body"].copy(),
        normal=normal,
        tangent=tangent,
        arm_a=a["arm_a"][:c].copy(),
        arm_b=a["arm_b"][:c].copy(),
        contact_body=a["contact_body"][:c].copy(),
        copy=False,
    )
    lower, upper = np.full(m, -np.inf), np.full(m, np.inf)
    lower[:mj], upper[:mj] = a["lower"][:mj], a["upper"][:mj]
    cones = Cones(
        ptr=a["ptr"][: k + 1].copy(),
        kind=a["kind"][:k].copy(),
        lower=lower,
        upper=upper,
        mu=a["mu"][:k].copy(),
        patch_radius=a["patch_radius"][:k].copy(),
        rolling=a["rolling"][:k].copy() if len(a["rolling"]) else np.zeros(k),
    )
    # joints above all contacts: 24 bits for each body leave the pair (2^24 - 1, ...) free
    above = np.uint64(0xFFFFFF << 40) + np.arange(kj, dtype=np.uint64)
    pairs = zip(a["contact_pair"][:c].tolist(), _point_numbers(a["key"][:c]), strict=True)
    guess = a["impulse"][:m].copy() if state.head[HEAD["warm_start"]] else None
    return Problem(
        a["b"][:m].copy(),
        cones,
        rows=rows,
        compliance=a["compliance"][:m].copy(),
        guess=guess,
        key=np.concatenate([above, a["key"][:c]]),
        names=[*joints, *(f"{bodies[j]} on {bodies[i]}, point {number}" for (i, j), number in pairs)],
        name=name,
        copy=False,
    )


def _point_numbers(key: np.ndarray) -> list[int]:
    """Number the contacts of each pair of bodies from 1 on, in the order of their keys."""
    order = np.argsort(key)
    pair = key[order] >> np.uint64(16)
    place = np.arange(len(key))
    first = np.maximum.accumulate(np.where(np.append(True, pair[1:] != pair[:-1])[: len(key)], place, 0))
    number = np.empty(len(key), np.int64)
    number[order] = 1 + place - first
    return list(number.tolist())


def _any_tangent(normal: FloatArray) -> FloatArray:
    out = np.zeros_like(normal)
    for i, n in enumerate(normal):
        t = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
        size = norm(t)
        if size > 0.0:  # a body so far off that its contact has no direction: Rows says so
            out[i] = t / size
    return out


def judged(problem: Problem, impulse: FloatArray) -> dict[str, Any]:
    """See `Simulation.residual`."""
    found = residual(problem, impulse)
    return {
        "relative": found.relative,
        "energy": found.energy,
        "velocity": found.velocity,
        "floor": found.roundoff_floor,
        "worst": found.worst_name,
        "share": _shares(problem, found),
    }


def moved(problem: Problem, impulse: FloatArray, moving: Sequence[str]) -> dict[str, Any]:
    """See `Simulation.motion`; `moving` names the bodies that are not static."""
    error, apart = motion.measure(problem, impulse, motion.reference(problem)), 0.0
    if problem.law == "coulomb":
        own = motion.branch(problem, impulse)
        near = motion.measure(problem, impulse, own)
        if own.accepted and error.reference.accepted:
            apart = motion.measure(problem, own.impulse, error.reference).speed or 0.0
        if near.kinetic is not None and (error.kinetic is None or near.kinetic < error.kinetic):
            error = near
    names = ("relative", "kinetic", "speed", "spin", "bound", "bound_speed")
    body = moving[error.body] if error.body >= 0 else ""
    return {**{name: getattr(error, name) for name in names}, "body": body, "open": apart}


def _shares(problem: Problem, found: Residual) -> dict[str, float]:
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
        size = np.sqrt(problem.d) * np.abs(found.error)
    top = float(size.max(initial=0.0))
    # Over the largest, so that squares neither overflow nor vanish; what is infinite has no shares.
    energy = (size / top) ** 2 if 0.0 < top < np.inf else np.zeros(problem.m)
    total = float(energy.sum())
    names = PARTS if c.has_rolling else PARTS[:4]
    sums = np.bincount(part, weights=energy, minlength=len(names)) if problem.m else np.zeros(len(names))
    return {name: float(x / total) if total > 0.0 else 0.0 for name, x in zip(names, sums, strict=True)}
