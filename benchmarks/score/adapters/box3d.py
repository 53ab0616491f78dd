"""Box3D by the package robox3d, with default joints of Box3D; the friction of a pair is the geometric mean."""

from __future__ import annotations

from typing import Any

import numpy as np
import robox3d
from robox3d.core.world import lib

from benchmarks.score import adapters as tools


def build(scene: tools.Scene, options: tools.Options) -> tools.Running:
    """Use `World.step`.

    Options are `substeps`, `sleep`, `bounce_speed` [m/s], `recycle` [m], `contact_hertz` and `joint_hertz`.
    """
    steps = options.get("substeps", 4)
    sleep = options.get("sleep", True)
    world = robox3d.World(scene["gravity"], substeps=steps, enable_sleep=sleep)
    moving = tools.get_moving(scene)
    bodies = []
    if "bounce_speed" in options:
        lib.b3World_SetRestitutionThreshold(world.id, options["bounce_speed"])
    if "recycle" in options:
        lib.b3World_SetContactRecycleDistance(world.id, options["recycle"])
    if (
        "contact_hertz" in options
    ):  # Damping ratio 10 and push speed 3 m/s are those that Box3D ships.
        lib.b3World_SetContactTuning(world.id, options["contact_hertz"], 10.0, 3.0)
    material = {"friction": scene["friction"], "restitution": scene["restitution"]}
    ground = world.create_body((0, 0, -1), kind="static")
    if tools.has_ground(scene):
        ground.add_box((100, 100, 1), **material)
    for b in moving:
        turn = tools.shift(b["quaternion"])
        kind = "kinematic" if b["kinematic"] else "dynamic"
        body = world.create_body(b["position"], rotation=turn, kind=kind)
        half = tools.get_half(b)
        body.add_box(half, **material) if half else body.add_sphere(tools.get_radius(b), **material)
        if not b["kinematic"]:
            body.set_mass_data(b["mass"], (0, 0, 0), np.diag(b["inertia"]))
        body.linear_velocity, body.angular_velocity = b["velocity"], b["spin"]
        bodies.append(body)
    for joint in scene["joints"]:
        first = bodies[joint["a"]] if joint["a"] >= 0 else ground
        motor = joint["motor"][::-1] if joint["motor"] else None
        how = {"motor": motor, "constraint_hertz": options.get("joint_hertz")}
        world.create_revolute_joint(
            first, bodies[joint["b"]], joint["anchor"], joint["axis"], **how
        )

    def step() -> None:
        for body, b in zip(bodies, moving, strict=True):
            if any(b["force"]):
                body.apply_force(b["force"])
        world.step(options["dt"])

    def get_row(r: Any) -> list[Any]:
        return [
            *r.position,
            r.rotation[3],
            *r.rotation[:3],
            *r.linear_velocity,
            *r.angular_velocity,
        ]

    def properties() -> list[Any]:
        rows = []
        for r in bodies:
            inertia = lib.b3Body_GetLocalRotationalInertia(r.id)
            rows.append([r.mass, inertia.cx.x, inertia.cy.y, inertia.cz.z, None, None])
        return rows

    return tools.Running(
        step, lambda: [get_row(r) for r in bodies], properties, close=world.destroy
    )
