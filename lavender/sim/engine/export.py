"""The constraint problem of a substep from the engine's arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.problem import Problem
from lavender.problem.cones import Cones
from lavender.problem.rows import Rows
from lavender.sim.engine.layout import HEAD, SIZE
from lavender.sim.engine.state import State
from lavender.sim.scene.arithmetic import norm


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
    points = (a["key"][:c] & np.uint64(0xFFFF)).tolist()
    pairs = zip(a["contact_pair"][:c].tolist(), points, strict=True)
    guess = a["impulse"][:m].copy() if state.head[HEAD["warm_start"]] else None
    return Problem(
        a["b"][:m].copy(),
        cones,
        rows=rows,
        compliance=a["compliance"][:m].copy(),
        guess=guess,
        key=np.concatenate([above, a["key"][:c]]),
        names=[*joints, *(f"{bodies[i]} on {bodies[j]}, point {f}" for (i, j), f in pairs)],
        name=name,
        copy=False,
    )


def _any_tangent(normal: FloatArray) -> FloatArray:
    out = np.zeros_like(normal)
    for i, n in enumerate(normal):
        t = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
        size = norm(t)
        if size > 0.0:  # a body so far off that its contact has no direction: Rows says so
            out[i] = t / size
    return out
