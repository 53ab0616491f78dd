"""Chipmunk (pymunk) in the plane y = 0; the friction of a pair is a product, and so is its restitution."""

from __future__ import annotations

from typing import Any

import pymunk

from benchmarks.score.adapters import (
    Options,
    Running,
    Scene,
    get_half,
    get_moving,
    get_radius,
    has_ground,
)
from benchmarks.score.adapters.plane import PlaneScene


def build(scene: Scene, options: Options) -> Running:
    """Use `Space.step`; options are attributes of the space."""
    flat = PlaneScene(scene)
    space = pymunk.Space()
    moving = get_moving(scene)
    space.gravity = flat.project(scene["gravity"])
    for key, value in options.items():
        if key != "dt":
            setattr(space, key, value)
    bodies = [pymunk.Body(b["mass"], b["inertia"][1], 1 if b["kinematic"] else 0) for b in moving]
    shapes = (
        [pymunk.Poly(space.static_body, [(-100, -2), (100, -2), (100, 0), (-100, 0)])]
        if has_ground(scene)
        else []
    )
    for body, b in zip(bodies, moving, strict=True):
        half, radius = get_half(b), get_radius(b)
        shapes.append(
            pymunk.Poly.create_box(body, (2 * half[0], 2 * half[2]))
            if half
            else pymunk.Circle(body, radius)
        )
        body.position, body.angle = flat.project(b["position"]), flat.get_angle(b["quaternion"])
        body.velocity = flat.project(b["velocity"])
    for shape in shapes:
        shape.friction, shape.elasticity = scene["friction"] ** 0.5, scene["restitution"] ** 0.5
    space.add(*bodies, *shapes)
    for joint in scene["joints"]:
        pair = bodies[joint["a"]] if joint["a"] >= 0 else space.static_body, bodies[joint["b"]]
        space.add(pymunk.PivotJoint(*pair, flat.project(joint["anchor"])))
        if joint["motor"]:
            motor = pymunk.SimpleMotor(*pair, joint["motor"][0])
            motor.max_force = joint["motor"][1]
            space.add(motor)

    def step() -> None:
        for body, b in zip(bodies, moving, strict=True):
            if any(b["force"]):
                body.apply_force_at_world_point(flat.project(b["force"]), body.position)
        space.step(options["dt"])

    def properties() -> list[Any]:
        rows = zip(bodies, shapes[-len(bodies) :], strict=True)
        return [[b.mass, None, b.moment, None, s.friction**2, s.elasticity**2] for b, s in rows]

    def state() -> list[Any]:
        return [flat.lift(b.position, b.angle, b.velocity, b.angular_velocity) for b in bodies]

    return Running(step, state, properties)
