"""Box2D 2.3 in the plane y = 0; horizontal velocities and forces become their magnitude along x."""

from __future__ import annotations

from typing import Any

import Box2D as box2d

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
    """Use `b2World.Step`; options are `velocity` and `position`, the numbers of iterations, and `sleep`."""
    flat = PlaneScene(scene)
    world = box2d.b2World(
        gravity=flat.project(scene["gravity"]), doSleep=options.get("sleep", True)
    )
    material = {"friction": scene["friction"], "restitution": scene["restitution"]}
    ground = world.CreateStaticBody()
    if has_ground(scene):
        ground.CreateFixture(
            box2d.b2FixtureDef(shape=box2d.b2PolygonShape(box=(100, 1, (0, -1), 0)), **material)
        )
    bodies = []
    moving = get_moving(scene)
    for b in moving:
        half = get_half(b)
        shape = (
            box2d.b2PolygonShape(box=(half[0], half[2]))
            if half
            else box2d.b2CircleShape(radius=get_radius(b))
        )
        create = world.CreateKinematicBody if b["kinematic"] else world.CreateDynamicBody
        body = create(position=flat.project(b["position"]), angle=flat.get_angle(b["quaternion"]))
        body.CreateFixture(box2d.b2FixtureDef(shape=shape, density=1.0, **material))
        body.massData = box2d.b2MassData(mass=b["mass"], center=(0, 0), I=b["inertia"][1])
        body.linearVelocity = flat.project(b["velocity"])
        bodies.append(body)
    for joint in scene["joints"]:
        first = bodies[joint["a"]] if joint["a"] >= 0 else ground
        speed, torque = joint["motor"] or (0.0, 0.0)
        motor = {"enableMotor": torque > 0, "motorSpeed": -speed, "maxMotorTorque": torque}
        world.CreateRevoluteJoint(
            bodyA=first, bodyB=bodies[joint["b"]], anchor=flat.project(joint["anchor"]), **motor
        )
    iterations = options.get("velocity", 8), options.get("position", 3)

    def step() -> None:
        for body, b in zip(bodies, moving, strict=True):
            if any(b["force"]):
                body.ApplyForceToCenter(flat.project(b["force"]), True)
        world.Step(options["dt"], *iterations)

    def properties() -> list[Any]:
        rows = [(body.massData, body.fixtures[0]) for body in bodies]
        return [[m.mass, None, m.I, None, f.friction, f.restitution] for m, f in rows]

    def state() -> list[Any]:
        return [flat.lift(b.position, b.angle, b.linearVelocity, b.angularVelocity) for b in bodies]

    return Running(step, state, properties)
