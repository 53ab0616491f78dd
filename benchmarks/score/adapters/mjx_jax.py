"""MJX, MuJoCo's engine in JAX on the CPU; see `mjcf`. Float64 is enabled, as for MuJoCo."""

from __future__ import annotations

from typing import Any

import jax
import mujoco
import numpy as np
from mujoco import mjx

from benchmarks.score.adapters import Options, Running, Scene
from benchmarks.score.adapters.mjcf import get_start, make_xml

STEP = jax.jit(mjx.step)


def build(scene: Scene, options: Options) -> Running:
    """Use `mjx.step`; options are attributes of `<option>`, `hard` for stiff contacts, and `double` for float64."""
    jax.config.update("jax_enable_x64", "double" in options)
    settings = {k: v for k, v in options.items() if k not in ("dt", "hard", "double")}
    model = mujoco.MjModel.from_xml_string(
        make_xml(scene, options["dt"], settings, "hard" in options)
    )
    start = mujoco.MjData(model)
    velocity, forces, control = get_start(scene)
    ids = [model.body(f"b{i}").id for i in range(len(forces))]
    start.qvel[:], start.ctrl[:] = velocity, control
    start.xfrc_applied[ids, :3] = forces
    compiled = mjx.put_model(model)
    data = [mjx.put_data(model, start)]
    # The first two steps compile, because the types of the first state are other than those of its successors.
    jax.block_until_ready(STEP(compiled, STEP(compiled, data[0])))
    host = mujoco.MjData(model)

    def step() -> None:
        data[0] = STEP(compiled, data[0])

    def state() -> list[Any]:
        host.qpos[:], host.qvel[:] = np.array(data[0].qpos), np.array(data[0].qvel)
        for update in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            update(model, host)
        rows = []
        v = np.zeros(6)
        for i in ids:
            mujoco.mj_objectVelocity(model, host, mujoco.mjtObj.mjOBJ_BODY, i, v, 0)
            rows.append([*host.xpos[i], *host.xquat[i], *v[3:], *v[:3]])
        return rows

    def properties() -> list[Any]:
        mass, inertia = np.array(compiled.body_mass), np.array(compiled.body_inertia)
        friction = np.array(compiled.geom_friction)
        return [[mass[i], *inertia[i], friction[model.body_geomadr[i], 0], None] for i in ids]

    def read_step() -> Any:
        from lavender.io import step_from_mjx

        before = data[0]
        step()
        return step_from_mjx(model, before, data[0])

    return Running(step, state, properties, read_step=read_step)
