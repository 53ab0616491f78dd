"""Scenes as MJCF, for the engines that read it: hinges are native, and a connect constraint closes a loop.

A belt is a body of 1e6 kg on a slide joint. A motor's torque falls below its limit within 1 % of its speed.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from benchmarks.score.adapters import CannotExpress, get_half, get_moving, get_radius, has_ground

FLAGS = ("diagexact",)
SHIPPED = 'friction="{} 0.005 0.0001"'


def join(numbers: Any) -> str:
    """Format numbers for an attribute."""
    return " ".join(repr(float(x)) for x in numbers)


def make_contact(scene: dict[str, Any], dt: float, hard: bool) -> str:
    """Return the contact attributes; a restitution needs `hard`: a spring and damper whose contact lasts ten steps."""
    e = scene["restitution"]
    friction = SHIPPED.format(scene["friction"])
    if e and not hard:
        raise CannotExpress("no restitution coefficient, only the damping ratio of a soft contact")
    if not hard:
        return friction
    ratio = -math.log(e) / math.hypot(math.pi, math.log(e)) if e else 1.0
    time, width = (10 * dt / (math.pi * ratio), "0.99 0.99") if e else (2 * dt, "0.99 0.9999")
    return f'{friction} solref="{time!r} {ratio!r}" solimp="{width} 0.001"'


def make_xml(scene: dict[str, Any], dt: float, options: dict[str, Any], hard: bool = False) -> str:
    """Return the MJCF of a scene; `hard` is stiff contacts and loops.

    `options` are attributes of `<option>`, `diagexact` one of its flags.
    """
    loops = motors = ""
    moving = get_moving(scene)
    world = ""
    children: dict[int, str] = {}
    for i in reversed(range(len(moving))):
        b = moving[i]
        radius = get_radius(moving[i])
        ties = ""
        joints = [joint for joint in scene["joints"] if joint["b"] == i]
        a = joints[0]["a"] if joints else -1
        for k, joint in enumerate(joints):
            anchor = join(np.subtract(joint["anchor"], b["position"]))
            if k:
                loops += f'<connect body1="b{i}" anchor="{anchor}"/>'
            else:
                ties = f'<joint name="j{i}" axis="{join(joint["axis"])}" pos="{anchor}"/>'
            if joint["motor"]:
                speed, limit = joint["motor"]
                motors += f'<velocity joint="j{i}" kv="{100 * limit / speed}" forcerange="{-limit} {limit}"/>'
        if b["kinematic"]:
            ties = f'<joint type="slide" axis="{join(b["velocity"])}"/>'
        shape = (
            f'type="box" size="{join(get_half(b))}"'
            if not radius
            else f'type="sphere" size="{radius}"'
        )
        start = np.subtract(b["position"], moving[a]["position"] if a >= 0 else 0.0)
        body = (
            f'<body name="b{i}" pos="{join(start)}" quat="{join(b["quaternion"])}" gravcomp="{int(b["kinematic"])}">'
            f'{ties or "<freejoint/>"}<geom {shape} mass="{1e6 if b["kinematic"] else b["mass"]}"/>'
            f"{children.pop(i, '')}</body>"
        )
        if a >= 0:
            children[a] = body + children.get(a, "")
        else:
            world = body + world
    ground = '<geom type="plane" size="0 0 1"/>' if has_ground(scene) else ""
    stiff = f'solref="{2 * dt!r} 1" solimp="0.99 0.9999 0.001"' if hard else ""
    plain = {key: value for key, value in options.items() if key not in FLAGS}
    attributes = " ".join(f'{key}="{value}"' for key, value in plain.items())
    flags = "".join(f'<flag {key}="{options[key]}"/>' for key in FLAGS if key in options)
    return (
        f'<mujoco><option timestep="{dt!r}" gravity="{join(scene["gravity"])}" {attributes}>'
        f"{flags}</option><default><geom {make_contact(scene, dt, hard)}/><equality {stiff}/></default>"
        f"<worldbody>{ground}{world}</worldbody>"
        f"<equality>{loops}</equality><actuator>{motors}</actuator></mujoco>"
    )


def get_start(scene: dict[str, Any]) -> tuple[list[float], list[list[float]], list[float]]:
    """Return the initial generalized velocity, the force on each body and the control of the motors."""
    velocity: list[float] = []
    for i, b in enumerate(get_moving(scene)):
        joined = any(joint["b"] == i for joint in scene["joints"])
        free = [
            *b["velocity"],
            *b["spin"],
        ]  # All bodies that spin start with the identity as orientation.
        velocity += [math.hypot(*b["velocity"])] if b["kinematic"] else [0.0] if joined else free
    forces = [b["force"] for b in get_moving(scene)]
    return velocity, forces, [joint["motor"][0] for joint in scene["joints"] if joint["motor"]]
