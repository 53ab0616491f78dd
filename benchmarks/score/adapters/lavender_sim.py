"""LavenderSim; a force is a velocity change before each step, a belt is a body whose velocity is set there."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

import lavender as lv
from benchmarks.score.adapters import Options, Running, Scene, get_moving, get_radius, has_ground
from lavender.causes.problems import record_of_problem


def build(scene: Scene, options: Options) -> Running:
    """Use `Simulation.step`; options are parameters of the scene."""
    dt = options["dt"]
    gravity = np.array(scene["gravity"])
    moving = get_moving(scene)
    materials = {"friction": scene["friction"], "restitution": scene["restitution"]}
    built = lv.Scene(gravity=tuple(gravity), **materials, **options)
    if has_ground(scene):
        built.add_plane()
    first = built.n_bodies
    for b in moving:
        motion = {"velocity": b["velocity"], "angular_velocity": b["spin"]}
        more = {
            "mass": b["mass"],
            "position": b["position"],
            "quaternion": b["quaternion"],
            **motion,
        }
        built.add_sphere(get_radius(b), **more) if get_radius(b) else built.add_box(
            b["shape"]["size"], **more
        )
    for joint in scene["joints"]:
        a, b = (k + first if k >= 0 else -1 for k in (joint["a"], joint["b"]))
        motor = dict(zip(("motor_speed", "motor_torque"), joint["motor"] or (), strict=False))
        built.add_joint("hinge", a, b, anchor=joint["anchor"], axis=joint["axis"], **motor)
    sim = lv.Simulation(built)
    observed = [sim.reset()[0]]

    def push() -> None:
        for i, b in enumerate(moving, first):
            if b["kinematic"]:
                sim.set_velocity(i, b["velocity"] - gravity * dt)
            elif any(b["force"]):
                sim.set_velocity(
                    i, observed[0]["velocities"][i, :3] + np.array(b["force"]) * dt / b["mass"]
                )

    def step() -> None:
        push()
        observed[0] = sim.step()[0]

    def read_step() -> Any:
        push()
        problem = sim.constraint_problem()
        observed[0] = sim.step()[0]
        record = record_of_problem(problem, sim.state.a["impulse"][: problem.m].copy())
        angular = np.tile([False] * 3 + [True] * 3, len(record.velocity) // 6)
        return replace(record, angular=angular)

    def state() -> list[np.ndarray]:
        return list(
            np.hstack(
                [observed[0][key][first:] for key in ("positions", "quaternions", "velocities")]
            )
        )

    def properties() -> list[list[float]]:
        p = sim.scene.parameters  # No body has values of its own.
        return [
            [b.mass, *np.diag(b.inertia), p.friction, p.restitution]
            for b in sim.scene.bodies[first:]
        ]

    def residual() -> float:
        return float(sim.residual()["velocity"])

    return Running(step, state, properties, residual, sim.close, read_step)
