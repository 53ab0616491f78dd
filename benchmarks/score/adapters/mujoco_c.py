"""MuJoCo, `mj_step`; see `mjcf`."""

from __future__ import annotations

import contextlib
import copy
from typing import Any

import mujoco
import numpy as np

from benchmarks.score.adapters import Options, Running, Scene
from benchmarks.score.adapters.mjcf import get_start, make_xml


def build(scene: Scene, options: Options) -> Running:
    """Use `mj_step`; options are attributes of `<option>`, and `hard` for stiff contacts."""
    settings = {k: v for k, v in options.items() if k not in ("dt", "hard")}
    model = mujoco.MjModel.from_xml_string(
        make_xml(scene, options["dt"], settings, "hard" in options)
    )
    data = mujoco.MjData(model)
    velocity, forces, control = get_start(scene)
    ids = [model.body(f"b{i}").id for i in range(len(forces))]
    data.qvel[:], data.ctrl[:] = velocity, control
    data.xfrc_applied[ids, :3] = forces
    mujoco.mj_forward(model, data)

    def state() -> list[Any]:
        for update in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            update(model, data)
        rows = []
        v = np.zeros(6)
        for i in ids:
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, i, v, 0)
            rows.append([*data.xpos[i], *data.xquat[i], *v[3:], *v[:3]])
        return rows

    def properties() -> list[Any]:
        friction = [model.geom_friction[model.body_geomadr[i], 0] for i in ids]
        return [
            [model.body_mass[i], *model.body_inertia[i], f, None]
            for i, f in zip(ids, friction, strict=True)
        ]

    def residual() -> float | None:
        with contextlib.suppress(ImportError):
            from lavender.io.mujoco import from_mujoco, impulse
            from lavender.judge.residuals import residual as judge

            now = copy.copy(data)  # The problem of the next step.
            mujoco.mj_forward(model, now)
            return float(judge(from_mujoco(model, now), impulse(model, now)).velocity)
        return None

    def read_step() -> Any:
        from lavender.io import step_from_mujoco

        record = step_from_mujoco(model, data)
        mujoco.mj_step(model, data)
        return record

    def step() -> None:
        mujoco.mj_step(model, data)

    return Running(step, state, properties, residual, read_step=read_step)
