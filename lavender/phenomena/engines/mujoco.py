"""MuJoCo: native shapes and joints, its default step and solver."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from lavender._arrays import FloatArray
from lavender.errors import CapabilityError
from lavender.phenomena.engines import Stepping
from lavender.phenomena.engines.tree import parents, relative
from lavender.scene import Box, Plane, Scene, Sphere
from lavender.scene.parts import rotation

__all__ = ["Engine"]


def _text(x: Any) -> str:
    return " ".join(repr(float(v)) for v in x)


class Engine(Stepping):
    """`mj_step` at its default of 2 ms with Newton to 1e-8."""

    def __init__(self, scene: Scene, cone: str, noslip: int) -> None:
        self.scene, self.up = scene, parents(scene, "mujoco")
        p = scene.parameters
        spin = ' condim="6"' if p.rolling_radius else ' condim="4"' if p.patch_radius else ""
        friction = f'friction="{p.friction!r} {p.friction * p.patch_radius!r} {p.rolling_radius!r}"'
        option = f'<option cone="{cone}" noslip_iterations="{noslip}" gravity="{_text(p.gravity)}"/>'
        trees = "".join(self._body(i) for i in range(scene.n_bodies) if i not in self.up or self.up[i].a < 0)
        self.model = mujoco.MjModel.from_xml_string(
            f"<mujoco>{option}<size memory='64M'/><default><geom {friction}{spin}/></default>"
            f"<worldbody>{trees}</worldbody></mujoco>"
        )
        self.data = mujoco.MjData(self.model)
        self.dt = float(self.model.opt.timestep)
        self.setting = f"2 ms, Newton, {cone}" + (f", noslip {noslip}" if noslip else "")
        self.ids = [
            mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, f"b{i}") for i in range(scene.n_bodies)
        ]
        for i, body in enumerate(scene.bodies):
            if i not in self.up and not body.is_static:
                at = self.model.jnt_dofadr[self.model.body_jntadr[self.ids[i]]]
                # of a free joint the spin is in the body's frame
                spun = rotation(body.quaternion).T @ body.angular_velocity
                self.data.qvel[at : at + 6] = np.concatenate([body.velocity, spun])
        mujoco.mj_forward(self.model, self.data)

    def _body(self, i: int) -> str:
        body, joint = self.scene.bodies[i], self.up.get(i)
        shape = body.shape
        if isinstance(shape, Plane):
            at = f'pos="{_text(shape.offset * np.asarray(shape.normal))}" zaxis="{_text(shape.normal)}"'
            return f'<body name="b{i}"><geom type="plane" size="0 0 1" {at}/></body>'
        if isinstance(shape, Sphere):
            geom = f'type="sphere" size="{shape.radius!r}"'
        elif isinstance(shape, Box):
            geom = f'type="box" size="{_text(0.5 * np.asarray(shape.size))}"'
        else:
            raise CapabilityError(f"{body.name} has no shape that mujoco could be given")
        above = None if joint is None or joint.a < 0 else self.scene.bodies[joint.a]
        place, turn = relative(above, body)
        tie = "" if body.is_static else "<freejoint/>"
        if joint is not None:
            geom += ' contype="0" conaffinity="0"'
            kind = f'type="hinge" axis="{_text(joint.axis_b)}"' if joint.kind == "hinge" else 'type="ball"'
            tie = f'<joint {kind} pos="{_text(joint.anchor_b)}"/>'
        inside = "".join(self._body(j) for j, other in self.up.items() if other.a == i)
        weight = f' mass="{body.mass!r}"' if body.mass else ""
        return f'<body name="b{i}" pos="{_text(place)}" quat="{_text(turn)}">{tie}<geom {geom}{weight}/>{inside}</body>'

    def step(self) -> None:
        """See `Stepping.step`."""
        mujoco.mj_step(self.model, self.data)

    def state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Stepping.state`; poses belong to the velocities of the same time."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_comVel(self.model, self.data)
        v, one = np.zeros((len(self.ids), 6)), np.zeros(6)
        for k, i in enumerate(self.ids):
            mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_BODY, i, one, 0)
            v[k] = np.roll(one, 3)  # it gives spin first
        return self.data.xpos[self.ids].copy(), self.data.xquat[self.ids].copy(), v
