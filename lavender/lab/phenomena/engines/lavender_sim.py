"""The C++ engine of the package lavendersim: y is up; a plane that is not level is a wide static box."""

from __future__ import annotations

import lavendersim
import numpy as np

from lavender.base.arrays import FloatArray
from lavender.lab.phenomena.engines import Stepping
from lavender.lab.phenomena.engines.tree import collision_shape, parents, xyzw
from lavender.sim.scene import Plane, Scene, Sphere
from lavender.sim.scene.arithmetic import frame_quaternion
from lavender.sim.scene.parts import rotation

WIDE = (200.0, 20.0, 200.0)  # m, of a box in the place of a plane, its second axis up


def _frame(up: FloatArray) -> FloatArray:
    # rows: axes of the engine in the scene's world, the second of them up
    side = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 0.0, -1.0])
    x = side - up * (side @ up)
    x /= np.linalg.norm(x)
    return np.stack([x, up, np.cross(x, up)])


class Engine(Stepping):
    """`CodeSceneEnv.step`, by default of 1/60 s, which it divides into substeps of 1/240 s by itself."""

    def __init__(self, scene: Scene, sweeps: int, dt: float = 1.0 / 60.0) -> None:
        self.scene, self.dt = scene, dt
        self.substeps = max(1, int(np.ceil(240.0 * dt - 1e-9)))
        self.setting = f"{1e3 * dt:.3g} ms in {self.substeps} of {sweeps} sweeps"
        up, p = parents(scene, "lavendersim"), scene.parameters
        g = np.asarray(p.gravity, float)
        size = float(np.linalg.norm(g))
        self.frame = _frame(-g / size if size else np.array([0.0, 0.0, 1.0]))
        self.material = {
            "static_friction": p.friction, "dynamic_friction": p.friction, "restitution": 0.0,
            "torsional_friction": p.friction if p.patch_radius else 0.0, "contact_radius": p.patch_radius or 0.02,
            "rolling_friction": p.rolling_radius / (p.patch_radius or 0.02),  # it multiplies by the contact radius
        }  # fmt: skip
        made = lavendersim.Scene("phenomenon", gravity=-size, solver_iterations=sweeps, ground=False)
        refs = [self._add(made, i, jointed=i in up or bool(up)) for i in range(scene.n_bodies)]
        for i, joint in up.items():
            body = scene.bodies[i]
            turn = rotation(body.quaternion)
            parent = lavendersim.WORLD if joint.a < 0 else refs[joint.a]
            anchor = self.frame @ (body.position + turn @ joint.anchor_b)
            if joint.kind == "hinge":
                axis = self.frame @ turn @ joint.axis_b
                still = lavendersim.PD(0.0, 0.0, 0.0)
                made.revolute(
                    joint.name, parent, refs[i], anchor=anchor, axis=axis, limits=(-100.0, 100.0), pd=still
                )
            else:
                made.spherical(joint.name, parent, refs[i], anchor=anchor)
        self.env = lavendersim.CodeSceneEnv(made, control_dt=self.dt, horizon=None)
        self.env.reset()
        self.first = len(self.env.body_state()) - scene.n_bodies
        self.step = self.env.step  # type: ignore[method-assign]

    def _add(self, made: lavendersim.Scene, i: int, jointed: bool) -> lavendersim.BodyRef:
        body = self.scene.bodies[i]
        shape = collision_shape(body, "lavendersim")
        if isinstance(shape, Plane):
            normal = self.frame @ np.asarray(shape.normal)
            turn = _frame(normal).T
            place = (shape.offset - 0.5 * WIDE[1]) * normal
            return made.box(
                f"b{i}",
                size=WIDE,
                mass=0.0,
                position=place,
                rotation=xyzw(frame_quaternion(turn)),
                **self.material,
            )
        turn = frame_quaternion(self.frame @ rotation(body.quaternion))
        more = {
            "mass": body.mass, "position": self.frame @ body.position, "rotation": xyzw(turn),
            "linear_velocity": self.frame @ body.velocity, "collision": not jointed,
            "angular_velocity": self.frame @ body.angular_velocity, **self.material,
        }  # fmt: skip
        if isinstance(shape, Sphere):
            return made.sphere(f"b{i}", radius=shape.radius, **more)
        return made.box(f"b{i}", size=shape.size, **more)

    def state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Stepping.state`."""
        s = np.asarray(self.env.body_state()[self.first :], float)
        back = self.frame.T
        q = np.array([frame_quaternion(back @ rotation(np.roll(row[3:7], 1))) for row in s])
        return s[:, :3] @ self.frame, q, np.hstack([s[:, 7:10] @ self.frame, s[:, 10:13] @ self.frame])

    def close(self) -> None:
        """See `Stepping.close`."""
        self.env.close()
