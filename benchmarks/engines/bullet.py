"""PyBullet: native shapes; joints are constraints between bodies, and no sweep is skipped."""

from __future__ import annotations

import numpy as np

from benchmarks.engines import Stepping, get_collision_shape
from lavender.base.arrays import FloatArray
from lavender.programs.running import quiet
from lavender.sim.scene import Body, Joint, Plane, Scene, Sphere
from lavender.sim.scene.parts import convert_to_rotation_matrix

with quiet(noisy=True):  # PyBullet prints a line at import.
    import pybullet


class Engine(Stepping):
    """`stepSimulation`; bodies of scenes without joints are in maximal coordinates."""

    def __init__(
        self, scene: Scene, sweeps: int, substeps: int = 1, dt: float = 1.0 / 240.0
    ) -> None:
        self.scene, self.dt = scene, dt
        self.client = pybullet.connect(pybullet.DIRECT)
        self.client_arguments = {"physicsClientId": self.client}
        self.maximal = {} if scene.joints else {"useMaximalCoordinates": True}
        pybullet.setGravity(*scene.parameters.gravity, **self.client_arguments)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self.dt,
            numSolverIterations=sweeps,
            numSubSteps=substeps,
            solverResidualThreshold=0.0,
            **self.client_arguments,
        )
        self.ids = [self._add_body(body) for body in scene.bodies]
        for body in self.ids:
            self._set_material(body)
        for joint in scene.joints:
            self._add_constraint(joint)

    def _create_shape(self, body: Body) -> int:
        """Create the collision shape of a body and return its index."""
        shape = get_collision_shape(body, "pybullet")
        if isinstance(shape, Plane):
            created = pybullet.createCollisionShape(
                pybullet.GEOM_PLANE, planeNormal=list(shape.normal), **self.client_arguments
            )
        elif isinstance(shape, Sphere):
            created = pybullet.createCollisionShape(
                pybullet.GEOM_SPHERE, radius=shape.radius, **self.client_arguments
            )
        else:
            half = [0.5 * x for x in shape.size]
            created = pybullet.createCollisionShape(
                pybullet.GEOM_BOX, halfExtents=half, **self.client_arguments
            )
        return int(created)

    def _add_body(self, body: Body) -> int:
        """Create a body and return its index."""
        created = int(
            pybullet.createMultiBody(
                body.mass,
                self._create_shape(body),
                basePosition=body.position.tolist(),
                baseOrientation=np.roll(body.quaternion, -1).tolist(),
                **self.maximal,
                **self.client_arguments,
            )
        )
        if body.mass:
            pybullet.resetBaseVelocity(
                created,
                body.velocity.tolist(),
                body.angular_velocity.tolist(),
                **self.client_arguments,
            )
        return created

    def _add_constraint(self, joint: Joint) -> None:
        """Create a joint as a constraint between two bodies."""
        # Bullet requires that the world, body -1, is the second body. Each anchor is in the frame of its body.
        world_first = joint.a < 0
        first, second = (joint.b, joint.a) if world_first else (joint.a, joint.b)
        anchors = (
            (joint.anchor_b, joint.anchor_a) if world_first else (joint.anchor_a, joint.anchor_b)
        )
        pybullet.createConstraint(
            self.ids[first],
            -1,
            -1 if second < 0 else self.ids[second],
            -1,
            pybullet.JOINT_POINT2POINT,
            [0, 0, 0],
            *(list(map(float, x)) for x in anchors),
            **self.client_arguments,
        )
        for i in (i for i in (first, second) if i >= 0):
            pybullet.setCollisionFilterGroupMask(self.ids[i], -1, 0, 0, **self.client_arguments)

    def _set_material(self, body: int) -> None:
        """Set friction, damping and sleeping of a body."""
        # Bullet multiplies the friction coefficients of two bodies; for torsional and rolling friction it adds the
        # coefficient of each times the friction of the other.
        p = self.scene.parameters
        lateral = p.friction**0.5
        pybullet.changeDynamics(
            body,
            -1,
            lateralFriction=lateral,
            linearDamping=0,
            angularDamping=0,
            jointDamping=0,
            spinningFriction=0.5 * lateral * p.patch_radius,
            rollingFriction=0.5 * p.rolling_radius / lateral if lateral else 0,
            **self.client_arguments,
        )
        pybullet.changeDynamics(
            body,
            -1,
            activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            **self.client_arguments,
        )

    def step(self) -> None:
        """See `Stepping.step`."""
        pybullet.stepSimulation(**self.client_arguments)

    def get_state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Stepping.get_state`."""
        n = len(self.ids)
        x, q, v = np.zeros((n, 3)), np.zeros((n, 4)), np.zeros((n, 6))
        for i, body in enumerate(self.ids):
            x[i], orientation = pybullet.getBasePositionAndOrientation(
                body, **self.client_arguments
            )
            v[i] = np.concatenate(pybullet.getBaseVelocity(body, **self.client_arguments))
            q[i] = np.roll(orientation, 1)
        return x, q, v

    def measure_last_step(self) -> tuple[int, float, float]:
        """See `Stepping.measure_last_step`; Bullet does not publish its problem."""
        points = pybullet.getContactPoints(**self.client_arguments) or ()
        x, q, _ = self.get_state()

        def point(i: int, anchor: FloatArray) -> FloatArray:
            """Return the world position of an anchor."""
            return anchor if i < 0 else x[i] + convert_to_rotation_matrix(q[i]) @ anchor

        gaps = [
            np.linalg.norm(point(j.b, j.anchor_b) - point(j.a, j.anchor_a))
            for j in self.scene.joints
        ]
        depth = max(gaps) if gaps else max((-p[8] for p in points), default=0.0)
        return len(points), max(0.0, float(depth)), float("nan")

    def close(self) -> None:
        """See `Stepping.close`."""
        pybullet.disconnect(self.client)
