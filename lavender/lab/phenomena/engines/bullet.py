"""PyBullet: native shapes; joints as links of one multibody, whose motors are switched off."""

from __future__ import annotations

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.external.running import capture_output
from lavender.lab.phenomena.engines import Stepping
from lavender.lab.phenomena.engines.tree import collision_shape, parents, relative, xyzw
from lavender.sim.scene import Body, Joint, Plane, Scene, Sphere
from lavender.sim.scene.parts import rotation

with capture_output(noisy=True):  # it greets
    import pybullet


class Engine(Stepping):
    """`stepSimulation`, by default of 1/240 s.

    Parameters
    ----------
    sweeps, substeps : int
    dt : float, s
    bodies : bool
        Bodies in maximal coordinates where there are no joints, joints as constraints between bodies, and every sweep
        made; False: Bullet's own ways, and joints those of a tree.
    """

    def __init__(
        self, scene: Scene, sweeps: int, substeps: int = 1, dt: float = 1.0 / 240.0, bodies: bool = False
    ) -> None:
        self.scene, self.up = scene, {} if bodies else parents(scene, "pybullet")
        self.dt = dt
        self.client = pybullet.connect(pybullet.DIRECT)
        self.at = {"physicsClientId": self.client}
        self.maximal = {"useMaximalCoordinates": True} if bodies and not scene.joints else {}
        self.setting = f"{1e3 * dt:.3g} ms in {substeps} of {sweeps} sweeps"
        pybullet.setGravity(*scene.parameters.gravity, **self.at)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self.dt, numSolverIterations=sweeps, numSubSteps=substeps,
            **({"solverResidualThreshold": 0.0} if bodies else {}), **self.at,
        )  # fmt: skip
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
        for joint in scene.joints if bodies else ():
            self._tie(joint)

    def _shape(self, body: Body) -> int:
        shape = collision_shape(body, "pybullet")
        if isinstance(shape, Plane):
            made = pybullet.createCollisionShape(
                pybullet.GEOM_PLANE, planeNormal=list(shape.normal), **self.at
            )
        elif isinstance(shape, Sphere):
            made = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=shape.radius, **self.at)
        else:
            half = [0.5 * x for x in shape.size]
            made = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, **self.at)
        return int(made)

    def _single(self, i: int) -> None:
        body = self.scene.bodies[i]
        made = pybullet.createMultiBody(
            body.mass, self._shape(body), basePosition=body.position.tolist(),
            baseOrientation=xyzw(body.quaternion), **self.maximal, **self.at,
        )  # fmt: skip
        if body.mass:
            pybullet.resetBaseVelocity(
                made, body.velocity.tolist(), body.angular_velocity.tolist(), **self.at
            )
        self.ids[i] = (made, -1)

    def _tie(self, joint: Joint) -> None:
        # The world is body -1 and stands second; anchors are in the frames of their bodies.
        flip = joint.a < 0
        first, second = (joint.b, joint.a) if flip else (joint.a, joint.b)
        anchors = (joint.anchor_b, joint.anchor_a) if flip else (joint.anchor_a, joint.anchor_b)
        pybullet.createConstraint(
            self.ids[first][0], -1, -1 if second < 0 else self.ids[second][0], -1, pybullet.JOINT_POINT2POINT,
            [0, 0, 0], *(list(map(float, x)) for x in anchors), **self.at,
        )  # fmt: skip
        for i in (i for i in (first, second) if i >= 0):
            pybullet.setCollisionFilterGroupMask(self.ids[i][0], -1, 0, 0, **self.at)

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
            turn.append(xyzw(q))
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
        x, q, v = self.placed()
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

    def left(self) -> tuple[int, float, float]:
        """See `Stepping.left`; Bullet does not publish its problem."""
        points = pybullet.getContactPoints(**self.at) or ()
        x, q, _ = self.state()

        def point(i: int, anchor: FloatArray) -> FloatArray:
            return anchor if i < 0 else x[i] + rotation(q[i]) @ anchor

        gaps = [np.linalg.norm(point(j.b, j.anchor_b) - point(j.a, j.anchor_a)) for j in self.scene.joints]
        depth = max(gaps) if gaps else max((-p[8] for p in points), default=0.0)
        return len(points), max(0.0, float(depth)), float("nan")

    def close(self) -> None:
        """See `Stepping.close`."""
        pybullet.disconnect(self.client)
