"""PyBullet: native shapes; joints as links of one multibody, whose motors are switched off."""

from __future__ import annotations

import numpy as np

from lavender._arrays import FloatArray
from lavender.errors import CapabilityError
from lavender.external._running import quiet
from lavender.phenomena.engines import Stepping
from lavender.phenomena.engines.tree import parents, relative
from lavender.scene import Body, Box, Plane, Scene, Sphere

with quiet(noisy=True):  # it greets
    import pybullet

__all__ = ["Engine"]


def _xyzw(q: FloatArray) -> list[float]:
    return [*map(float, q[1:]), float(q[0])]


class Engine(Stepping):
    """`stepSimulation` at 1/240 s."""

    def __init__(self, scene: Scene, sweeps: int, substeps: int) -> None:
        self.scene, self.up = scene, parents(scene, "pybullet")
        self.dt = 1.0 / 240.0
        self.client = pybullet.connect(pybullet.DIRECT)
        self.at = {"physicsClientId": self.client}
        self.setting = f"4.17 ms in {substeps} of {sweeps} sweeps"
        pybullet.setGravity(*scene.parameters.gravity, **self.at)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self.dt, numSolverIterations=sweeps, numSubSteps=substeps, **self.at
        )
        self.ids: dict[int, tuple[int, int]] = {}  # body -> multibody, link; link -1 is its base
        for i in range(scene.n_bodies):
            if i not in self.up:
                self._single(i)
        roots = [i for i, joint in self.up.items() if joint.a < 0]
        if len(roots) + (len(self.up) > 0) > 2:
            raise CapabilityError("pybullet is given one tree of joints")
        if self.up:
            self._tree()
        for body, link in self.ids.values():
            self._material(body, link)

    def _shape(self, body: Body) -> int:
        if isinstance(body.shape, Plane):
            made = pybullet.createCollisionShape(
                pybullet.GEOM_PLANE, planeNormal=list(body.shape.normal), **self.at
            )
        elif isinstance(body.shape, Sphere):
            made = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=body.shape.radius, **self.at)
        elif isinstance(body.shape, Box):
            half = [0.5 * x for x in body.shape.size]
            made = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, **self.at)
        else:
            raise CapabilityError(f"{body.name} has no shape that pybullet could be given")
        return int(made)

    def _single(self, i: int) -> None:
        body = self.scene.bodies[i]
        made = pybullet.createMultiBody(
            body.mass, self._shape(body), basePosition=body.position.tolist(),
            baseOrientation=_xyzw(body.quaternion), **self.at,
        )  # fmt: skip
        if body.mass:
            pybullet.resetBaseVelocity(
                made, body.velocity.tolist(), body.angular_velocity.tolist(), **self.at
            )
        self.ids[i] = (made, -1)

    def _tree(self) -> None:
        # a link's frame stands at its joint and is turned as its parent's; its body stands in it
        order = sorted(self.up)
        place, shift, turn, axis = [], [], [], []
        for i in order:
            joint = self.up[i]
            above = None if joint.a < 0 else self.scene.bodies[joint.a]
            before = np.zeros(3) if joint.a < 0 else self.up[joint.a].anchor_b  # its frame, from its body
            _, q = relative(above, self.scene.bodies[i])
            if abs(abs(q[0]) - 1.0) > 1e-12 and joint.a >= 0:
                raise CapabilityError("pybullet is given trees whose bodies stand alike")
            place.append((joint.anchor_a - before).tolist())
            turn.append(_xyzw(q))
            shift.append((-joint.anchor_b).tolist())
            axis.append(joint.axis_b.tolist())
        kinds = {"hinge": pybullet.JOINT_REVOLUTE, "ball": pybullet.JOINT_SPHERICAL}
        made = pybullet.createMultiBody(
            0.0, -1, basePosition=[0, 0, 0],
            linkMasses=[self.scene.bodies[i].mass for i in order],
            linkCollisionShapeIndices=[self._shape(self.scene.bodies[i]) for i in order],
            linkVisualShapeIndices=[-1] * len(order), linkPositions=place, linkOrientations=turn,
            linkInertialFramePositions=shift, linkInertialFrameOrientations=[[0, 0, 0, 1]] * len(order),
            linkParentIndices=[0 if self.up[i].a < 0 else order.index(self.up[i].a) + 1 for i in order],
            linkJointTypes=[kinds[self.up[i].kind] for i in order], linkJointAxis=axis, **self.at,
        )  # fmt: skip
        for k, i in enumerate(order):
            self.ids[i] = (made, k)
            pybullet.setCollisionFilterGroupMask(made, k, 0, 0, **self.at)
            if self.up[i].kind == "hinge":
                pybullet.setJointMotorControl2(made, k, pybullet.VELOCITY_CONTROL, force=0, **self.at)
            else:
                pybullet.setJointMotorControlMultiDof(
                    made,
                    k,
                    pybullet.POSITION_CONTROL,
                    targetPosition=[0, 0, 0, 1],
                    force=[0, 0, 0],
                    **self.at,
                )

    def _material(self, body: int, link: int) -> None:
        # Bullet multiplies the coefficients of two bodies; of spin and rolling it adds a's x friction b and the reverse
        p = self.scene.parameters
        lateral = p.friction**0.5
        pybullet.changeDynamics(
            body, link, lateralFriction=lateral, linearDamping=0, angularDamping=0, jointDamping=0,
            spinningFriction=0.5 * lateral * p.patch_radius,
            rollingFriction=0.5 * p.rolling_radius / lateral if lateral else 0, **self.at,
        )  # fmt: skip
        pybullet.changeDynamics(
            body, link, activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING, **self.at
        )

    def step(self) -> None:
        """See `Stepping.step`."""
        pybullet.stepSimulation(**self.at)

    def state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Stepping.state`."""
        n = self.scene.n_bodies
        x, q, v = np.zeros((n, 3)), np.zeros((n, 4)), np.zeros((n, 6))
        for i, (body, link) in self.ids.items():
            if link < 0:
                x[i], turn = pybullet.getBasePositionAndOrientation(body, **self.at)
                v[i] = np.concatenate(pybullet.getBaseVelocity(body, **self.at))
            else:
                found = pybullet.getLinkState(
                    body, link, computeLinkVelocity=1, computeForwardKinematics=1, **self.at
                )
                x[i], turn, v[i] = found[0], found[1], np.concatenate(found[6:8])
            q[i] = np.roll(turn, 1)
        return x, q, v

    def close(self) -> None:
        """See `Stepping.close`."""
        pybullet.disconnect(self.client)
