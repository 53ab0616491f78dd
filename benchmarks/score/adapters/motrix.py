"""MotrixSim, which reads MJCF (float32); see `mjcf`. Its solver is not MuJoCo's."""

from __future__ import annotations

from typing import Any

import motrixsim
import numpy as np

from benchmarks.score.adapters import CannotExpress, Options, Running, Scene, get_moving
from benchmarks.score.adapters.mjcf import get_start, make_xml


def build(scene: Scene, options: Options) -> Running:
    """Use `motrixsim.step`; options are attributes of its `options`, and `hard` for stiff contacts."""
    if scene["restitution"] and "hard" not in options:
        raise CannotExpress("no restitution coefficient, only the damping ratio of a soft contact")
    dt = options["dt"]
    model = motrixsim.load_mjcf_str(make_xml(scene, dt, {}, "hard" in options))
    for key, value in options.items():
        if key not in ("dt", "hard"):
            setattr(model.options, key, value)
    data = motrixsim.SceneData(model)
    velocity, forces, control = get_start(scene)
    data.set_dof_vel(np.array(velocity, np.float32))
    if control:
        data.actuator_ctrls = np.array(control, np.float32)
    motrixsim.forward_kinematic(model, data)
    names = [f"b{i}" for i in range(len(forces))]
    links = [model.get_link(name) for name in names]
    geoms = [link.geoms[0] for link in links]
    pushes = [
        (link, np.array(f, np.float32)) for link, f in zip(links, forces, strict=True) if any(f)
    ]

    def step() -> None:
        for link, force in pushes:
            link.add_external_force(data, force, local=False)
        motrixsim.step(model, data)

    def state() -> list[Any]:
        rows = []
        for link in links:
            pose = link.get_pose(data)
            v, w = link.get_linear_velocity(data), link.get_angular_velocity(data)
            rows.append([*pose[:3], pose[6], *pose[3:6], *v, *w])
        return rows

    def properties() -> list[Any]:
        return [
            [None if b["kinematic"] else link.mass, None, None, None, np.ravel(g.friction)[0], None]
            for b, link, g in zip(get_moving(scene), links, geoms, strict=True)
        ]

    return Running(step, state, properties)
