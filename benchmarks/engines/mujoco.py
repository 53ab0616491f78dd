"""MuJoCo: native shapes; joints are equality constraints between free bodies."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from benchmarks.engines import Stepping, get_collision_shape
from lavender.base.arrays import FloatArray
from lavender.io.mujoco import from_mujoco, impulse
from lavender.judge.residuals import residual
from lavender.problem import Problem
from lavender.sim.scene import Joint, Plane, Scene, Sphere
from lavender.sim.scene.parts import convert_to_rotation_matrix


def _format_numbers(x: Any) -> str:
    """Format numbers for an MJCF attribute."""
    return " ".join(repr(float(v)) for v in x)


def _make_equality_constraint(joint: Joint) -> str:
    """Build the MJCF equality constraint of a joint; its first body is not the world, and its frame has the anchor."""
    first, second, anchor = (
        (joint.b, joint.a, joint.anchor_b) if joint.a < 0 else (joint.a, joint.b, joint.anchor_a)
    )
    other = "" if second < 0 else f'body2="b{second}"'
    return f'<connect body1="b{first}" {other} anchor="{_format_numbers(anchor)}"/>'


class Engine(Stepping):
    """`mj_step`, Newton to 1e-8 by default; with `sweeps`, PGS with this many iterations at tolerance 0 instead."""

    def __init__(self, scene: Scene, cone: str, dt: float, sweeps: int = 0) -> None:
        self.scene = scene
        p = scene.parameters
        spin = ' condim="6"' if p.rolling_radius else ' condim="4"' if p.patch_radius else ""
        friction = f'friction="{p.friction!r} {p.friction * p.patch_radius!r} {p.rolling_radius!r}"'
        solver = f' solver="PGS" iterations="{sweeps}" tolerance="0"' if sweeps else ""
        option = f'<option cone="{cone}" gravity="{_format_numbers(p.gravity)}" timestep="{dt!r}"{solver}/>'
        self.no_collision = ' contype="0" conaffinity="0"' if scene.joints else ""
        bodies = "".join(self._make_body_element(i) for i in range(scene.n_bodies))
        # Of the size element, 1G is the memory for contacts and constraint rows.
        self.model = mujoco.MjModel.from_xml_string(
            f"<mujoco>{option}<size memory='1G'/><default><geom {friction}{spin}/></default>"
            f"<worldbody>{bodies}</worldbody>"
            f"<equality>{''.join(map(_make_equality_constraint, scene.joints))}</equality></mujoco>"
        )
        self.data = mujoco.MjData(self.model)
        self.dt = float(self.model.opt.timestep)
        self.ids = [
            mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, f"b{i}")
            for i in range(scene.n_bodies)
        ]
        for i, body in enumerate(scene.bodies):
            if not body.is_static:
                at = self.model.jnt_dofadr[self.model.body_jntadr[self.ids[i]]]
                # The angular velocity of a free joint is in the body's frame.
                angular_velocity = (
                    convert_to_rotation_matrix(body.quaternion).T @ body.angular_velocity
                )
                self.data.qvel[at : at + 6] = np.concatenate([body.velocity, angular_velocity])
        mujoco.mj_forward(self.model, self.data)

    def _make_body_element(self, i: int) -> str:
        """Build the MJCF element of a body."""
        body = self.scene.bodies[i]
        shape = get_collision_shape(body, "mujoco")
        if isinstance(shape, Plane):
            point = _format_numbers(shape.offset * np.asarray(shape.normal))
            at = f'pos="{point}" zaxis="{_format_numbers(shape.normal)}"'
            return f'<body name="b{i}"><geom type="plane" size="0 0 1" {at}/></body>'
        if isinstance(shape, Sphere):
            geom = f'type="sphere" size="{shape.radius!r}"'
        else:
            geom = f'type="box" size="{_format_numbers(0.5 * np.asarray(shape.size))}"'
        tie = "" if body.is_static else "<freejoint/>"
        geom += self.no_collision if not body.is_static else ""
        weight = f' mass="{body.mass!r}"' if body.mass else ""
        pose = f'pos="{_format_numbers(body.position)}" quat="{_format_numbers(body.quaternion)}"'
        return f'<body name="b{i}" {pose}>{tie}<geom {geom}{weight}/></body>'

    def step(self) -> None:
        """See `Stepping.step`."""
        mujoco.mj_step(self.model, self.data)

    def read_last_problem(self) -> Problem:
        """Return the constraint problem of the last step."""
        return from_mujoco(self.model, self.data, name=f"mujoco {self.scene.name}")

    def measure_last_step(self) -> tuple[int, float, float]:
        """See `Stepping.measure_last_step`."""
        d = self.data
        depth = max(0.0, -float(d.contact.dist[: d.ncon].min())) if d.ncon else 0.0
        if self.scene.joints:
            depth = float(np.abs(d.efc_pos[: d.nefc]).max(initial=0.0))
        return (
            int(d.ncon),
            depth,
            residual(self.read_last_problem(), impulse(self.model, d)).relative,
        )

    def get_state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Stepping.get_state`; velocities are evaluated at the same time as the poses."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_comVel(self.model, self.data)
        v = np.zeros((len(self.ids), 6))
        body_velocity = np.zeros(6)
        for k, i in enumerate(self.ids):
            mujoco.mj_objectVelocity(
                self.model, self.data, mujoco.mjtObj.mjOBJ_BODY, i, body_velocity, 0
            )
            v[k] = np.roll(body_velocity, 3)  # MuJoCo returns the angular velocity first.
        return self.data.xpos[self.ids].copy(), self.data.xquat[self.ids].copy(), v
