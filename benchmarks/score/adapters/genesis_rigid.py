"""Genesis' rigid solver on the CPU: bodies are its own shapes, scenes with hinges or a belt are read from MJCF.

The armature of 0.1 that Genesis gives joints of a file is 0 here, because it belongs to the masses of a scene.
"""

from __future__ import annotations

from typing import Any

import genesis as gs
import numpy as np

from benchmarks.score.adapters import (
    CannotExpress,
    Options,
    Running,
    Scene,
    get_half,
    get_moving,
    get_radius,
    has_ground,
)
from benchmarks.score.adapters.mjcf import get_start, make_xml

NAMES = ("integrator", "friction_cone", "contact_resolution", "constraint_solver")
PRECISION = [""]  # of the running process, bits


def start(precision: str) -> None:
    """Initialise Genesis; another precision needs a new start."""
    if PRECISION[0] != precision:
        if PRECISION[0]:
            gs.destroy()
        gs.init(backend=gs.cpu, precision=precision, logging_level="error")
        PRECISION[0] = precision


def build(scene: Scene, options: Options) -> Running:
    """Use `scene.step`; options are those of `RigidOptions`, and `precision` in bits."""
    if scene["restitution"]:
        raise CannotExpress("no restitution coefficient between rigid bodies")
    start(str(options.get("precision", 32)))
    settings = {k: v for k, v in options.items() if k not in ("dt", "precision")}
    settings |= {k: getattr(getattr(gs, k), settings[k]) for k in NAMES if k in settings}
    world = gs.Scene(
        show_viewer=False,
        sim_options=gs.options.SimOptions(dt=options["dt"], gravity=tuple(scene["gravity"])),
        rigid_options=gs.options.RigidOptions(**settings),
    )
    moving = get_moving(scene)
    velocity, forces, control = get_start(scene)
    is_file = bool(scene["joints"]) or any(b["kinematic"] for b in moving)
    if is_file:
        text = make_xml(scene, options["dt"], {})
        file = world.add_entity(gs.morphs.MJCF(file=text, default_armature=0.0))
    else:
        if has_ground(scene):
            world.add_entity(
                gs.morphs.Plane(), material=gs.materials.Rigid(friction=scene["friction"])
            )
        entities = [add_body(world, b, scene["friction"]) for b in moving]
    world.build()
    solver = world.sim.rigid_solver
    if is_file:
        links = [file.get_link(f"b{i}") for i in range(len(moving))]
        file.set_dofs_velocity(np.array(velocity))
        for joint, speed in zip(scene["joints"], control, strict=False):
            torque = joint["motor"][1]
            file.set_dofs_kp(np.zeros(1))
            file.set_dofs_kv(np.full(1, 100 * torque / speed))
            file.set_dofs_force_range(np.full(1, -torque), np.full(1, torque))
            file.control_dofs_velocity(np.full(1, speed))
    else:
        links = [entity.links[0] for entity in entities]
        for k, entity in enumerate(entities):
            entity.set_dofs_velocity(np.array(velocity[6 * k : 6 * k + 6]))
    numbers = [int(link.idx) for link in links]
    pushed = [k for k, force in enumerate(forces) if any(force)]

    def push() -> None:
        for k in pushed:
            solver.apply_links_external_force(np.array(forces[k])[None], [numbers[k]])

    def step() -> None:
        push()
        world.step()

    def state() -> list[Any]:
        read = (
            solver.get_links_pos(numbers),
            solver.get_links_quat(numbers),
            solver.get_links_vel(numbers),
            solver.get_links_ang(numbers),
        )
        return list(np.hstack([np.asarray(x, float) for x in read]))

    def properties() -> list[Any]:
        return [
            [
                float(np.ravel(link.get_mass())[0]),
                *np.diag(np.asarray(link.desc.inertia, float)),
                float(link.geoms[0].friction),
                None,
            ]
            for link in links
        ]

    def read_step() -> Any:
        from lavender.io import step_from_genesis

        push()
        return step_from_genesis(world)

    return Running(step, state, properties, close=world.destroy, read_step=read_step)


def add_body(world: Any, b: dict[str, Any], friction: float) -> Any:
    """Add a free body."""
    pose = {"pos": tuple(b["position"]), "quat": tuple(b["quaternion"])}
    half, radius = get_half(b), get_radius(b)
    if half:
        size = tuple(2.0 * x for x in half)
        volume, shape = float(np.prod(size)), gs.morphs.Box(size=size, **pose)
    else:
        volume, shape = 4.0 / 3.0 * np.pi * radius**3, gs.morphs.Sphere(radius=radius, **pose)
    return world.add_entity(
        shape, material=gs.materials.Rigid(rho=b["mass"] / volume, friction=friction)
    )
