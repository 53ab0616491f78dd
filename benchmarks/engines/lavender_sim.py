"""The C++ engine of the package lavendersim: y is up; an inclined plane is replaced by a wide static box."""

from __future__ import annotations

import lavendersim
import numpy as np

from benchmarks.engines import Stepping, get_collision_shape, reject_joints
from lavender.base.arrays import FloatArray
from lavender.sim.scene import Plane, Scene, Sphere
from lavender.sim.scene.arithmetic import convert_frame_to_quaternion
from lavender.sim.scene.parts import convert_to_rotation_matrix

GROUND_BOX_SIZE = (
    200.0,
    20.0,
    200.0,
)  # [m] Size of the box that replaces a plane; its second axis is up.


def _make_engine_axes(up: FloatArray) -> FloatArray:
    """Return the engine's axes in the scene's world as rows; the second axis is up."""
    side = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 0.0, -1.0])
    x = side - up * (side @ up)
    x /= np.linalg.norm(x)
    return np.stack([x, up, np.cross(x, up)])


class Engine(Stepping):
    """Engine that calls `CodeSceneEnv.step`, by default with 1/60 s, which it divides into substeps of 1/240 s."""

    def __init__(self, scene: Scene, sweeps: int, dt: float = 1.0 / 60.0) -> None:
        self.scene, self.dt = scene, dt
        self.substeps = max(1, int(np.ceil(240.0 * dt - 1e-9)))
        reject_joints(scene, "lavendersim")
        p = scene.parameters
        g = np.asarray(p.gravity, float)
        size = float(np.linalg.norm(g))
        self.frame = _make_engine_axes(-g / size if size else np.array([0.0, 0.0, 1.0]))
        self.material = {
            "static_friction": p.friction,
            "dynamic_friction": p.friction,
            "restitution": 0.0,
            "torsional_friction": p.friction if p.patch_radius else 0.0,
            "contact_radius": p.patch_radius or 0.02,
            # The engine multiplies the coefficient of rolling friction by the contact radius.
            "rolling_friction": p.rolling_radius / (p.patch_radius or 0.02),
        }
        engine_scene = lavendersim.Scene(
            "scene", gravity=-size, solver_iterations=sweeps, ground=False
        )
        for i in range(scene.n_bodies):
            self._add_body(engine_scene, i)
        self.env = lavendersim.CodeSceneEnv(engine_scene, control_dt=self.dt, horizon=None)
        self.env.reset()
        self.first = len(self.env.body_state()) - scene.n_bodies
        self.step = self.env.step  # type: ignore[method-assign]

    def _add_body(self, engine_scene: lavendersim.Scene, i: int) -> None:
        """Add body i to the engine's scene."""
        body = self.scene.bodies[i]
        shape = get_collision_shape(body, "lavendersim")
        if isinstance(shape, Plane):
            normal = self.frame @ np.asarray(shape.normal)
            orientation = _make_engine_axes(normal).T
            position = (shape.offset - 0.5 * GROUND_BOX_SIZE[1]) * normal
            engine_scene.box(
                f"b{i}",
                size=GROUND_BOX_SIZE,
                mass=0.0,
                position=position,
                rotation=np.roll(convert_frame_to_quaternion(orientation), -1),
                **self.material,
            )
            return
        orientation = convert_frame_to_quaternion(
            self.frame @ convert_to_rotation_matrix(body.quaternion)
        )
        body_options = {
            "mass": body.mass,
            "position": self.frame @ body.position,
            "rotation": np.roll(orientation, -1),
            "linear_velocity": self.frame @ body.velocity,
            "collision": True,
            "angular_velocity": self.frame @ body.angular_velocity,
            **self.material,
        }
        if isinstance(shape, Sphere):
            engine_scene.sphere(f"b{i}", radius=shape.radius, **body_options)
        else:
            engine_scene.box(f"b{i}", size=shape.size, **body_options)

    def get_state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Stepping.get_state`."""
        s = np.asarray(self.env.body_state()[self.first :], float)
        inverse_frame = self.frame.T
        q = np.array(
            [
                convert_frame_to_quaternion(
                    inverse_frame @ convert_to_rotation_matrix(np.roll(row[3:7], 1))
                )
                for row in s
            ]
        )
        return (
            s[:, :3] @ self.frame,
            q,
            np.hstack([s[:, 7:10] @ self.frame, s[:, 10:13] @ self.frame]),
        )

    def close(self) -> None:
        """See `Stepping.close`."""
        self.env.close()
