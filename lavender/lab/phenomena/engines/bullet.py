"""PyBullet: native shapes; joints as links of one multibody, with disabled motors."""

from __future__ import annotations

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.external.running import capture_backend_output
from lavender.lab.phenomena.engines import Stepping
from lavender.lab.phenomena.engines.tree import (
    compute_relative_pose,
    get_collision_shape,
    map_bodies_to_parent_joints,
    reorder_to_xyzw,
)
from lavender.sim.scene import Body, Joint, Plane, Scene, Sphere
from lavender.sim.scene.parts import convert_to_rotation_matrix

with capture_backend_output(noisy=True):  # PyBullet prints a line at import.
    import pybullet


class Engine(Stepping):
    """`stepSimulation`, with steps of 1/240 s by default.

    Parameters
    ----------
    sweeps, substeps : int
    dt : float, s
    bodies : bool
        True: joints are constraints between bodies, bodies of scenes without joints are in maximal coordinates, and no
        sweep is skipped. False: joints connect the links of one multibody, with Bullet's defaults.
    """

    def __init__(
        self, scene: Scene, sweeps: int, substeps: int = 1, dt: float = 1.0 / 240.0, bodies: bool = False
    ) -> None:
        self.scene, self.up = scene, {} if bodies else map_bodies_to_parent_joints(scene, "pybullet")
        self.dt = dt
        self.client = pybullet.connect(pybullet.DIRECT)
        self.client_arguments = {"physicsClientId": self.client}
        self.maximal = {"useMaximalCoordinates": True} if bodies and not scene.joints else {}
        self.setting = f"{1e3 * dt:.3g} ms in {substeps} of {sweeps} sweeps"
        pybullet.setGravity(*scene.parameters.gravity, **self.client_arguments)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self.dt, numSolverIterations=sweeps, numSubSteps=substeps,
            **({"solverResidualThreshold": 0.0} if bodies else {}), **self.client_arguments,
        )  # fmt: skip
        self.ids: dict[int, tuple[int, int]] = {}  # Body -> (multibody, link); link -1 is its base.
        for i in range(scene.n_bodies):
            if i not in self.up:
                self._add_single_body(i)
        roots = [i for i, joint in self.up.items() if joint.a < 0]
        if len(roots) + (len(self.up) > 0) > 2:
            raise CapabilityError(
                f"the scene has {len(roots)} joints to the world, so several trees of joints; pybullet "
                "accepts one tree"
            )
        if self.up:
            self._add_tree()
        for body, link in self.ids.values():
            self._set_material(body, link)
        for joint in scene.joints if bodies else ():
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

    def _add_single_body(self, i: int) -> None:
        """Create a body that is not a link of the multibody."""
        body = self.scene.bodies[i]
        created = pybullet.createMultiBody(
            body.mass, self._create_shape(body), basePosition=body.position.tolist(),
            baseOrientation=reorder_to_xyzw(body.quaternion), **self.maximal, **self.client_arguments,
        )  # fmt: skip
        if body.mass:
            pybullet.resetBaseVelocity(
                created, body.velocity.tolist(), body.angular_velocity.tolist(), **self.client_arguments
            )
        self.ids[i] = (created, -1)

    def _add_constraint(self, joint: Joint) -> None:
        """Create a joint as a constraint between two bodies."""
        # Bullet requires that the world, body -1, is the second body. Each anchor is in the frame of its body.
        world_first = joint.a < 0
        first, second = (joint.b, joint.a) if world_first else (joint.a, joint.b)
        anchors = (joint.anchor_b, joint.anchor_a) if world_first else (joint.anchor_a, joint.anchor_b)
        pybullet.createConstraint(
            self.ids[first][0], -1, -1 if second < 0 else self.ids[second][0], -1, pybullet.JOINT_POINT2POINT,
            [0, 0, 0], *(list(map(float, x)) for x in anchors), **self.client_arguments,
        )  # fmt: skip
        for i in (i for i in (first, second) if i >= 0):
            pybullet.setCollisionFilterGroupMask(self.ids[i][0], -1, 0, 0, **self.client_arguments)

    def _add_tree(self) -> None:
        """Create all joints of the tree as links of one multibody."""
        # A link's frame is at its joint with its parent's orientation; its body is placed in this frame.
        order = sorted(self.up)
        link_positions, inertial_positions, orientation, axis = [], [], [], []
        for i in order:
            joint = self.up[i]
            parent = None if joint.a < 0 else self.scene.bodies[joint.a]
            # Position of the link's frame relative to the parent's centre of mass.
            anchor_in_parent = np.zeros(3) if joint.a < 0 else self.up[joint.a].anchor_b
            _, q = compute_relative_pose(parent, self.scene.bodies[i])
            if abs(abs(q[0]) - 1.0) > 1e-12 and joint.a >= 0:
                raise CapabilityError(
                    "bodies of the tree start in different orientations; pybullet needs equal orientations "
                    "of all bodies in a tree"
                )
            link_positions.append((joint.anchor_a - anchor_in_parent).tolist())
            orientation.append(reorder_to_xyzw(q))
            inertial_positions.append((-joint.anchor_b).tolist())
            axis.append(joint.axis_b.tolist())
        kinds = {"hinge": pybullet.JOINT_REVOLUTE, "ball": pybullet.JOINT_SPHERICAL}
        created = pybullet.createMultiBody(
            0.0, -1, basePosition=[0, 0, 0],
            linkMasses=[self.scene.bodies[i].mass for i in order],
            linkCollisionShapeIndices=[self._create_shape(self.scene.bodies[i]) for i in order],
            linkVisualShapeIndices=[-1] * len(order), linkPositions=link_positions, linkOrientations=orientation,
            linkInertialFramePositions=inertial_positions, linkInertialFrameOrientations=[[0, 0, 0, 1]] * len(order),
            linkParentIndices=[0 if self.up[i].a < 0 else order.index(self.up[i].a) + 1 for i in order],
            linkJointTypes=[kinds[self.up[i].kind] for i in order], linkJointAxis=axis, **self.client_arguments,
        )  # fmt: skip
        for k, i in enumerate(order):
            self.ids[i] = (created, k)
            pybullet.setCollisionFilterGroupMask(created, k, 0, 0, **self.client_arguments)
            if self.up[i].kind == "hinge":
                pybullet.setJointMotorControl2(
                    created, k, pybullet.VELOCITY_CONTROL, force=0, **self.client_arguments
                )
            else:
                pybullet.setJointMotorControlMultiDof(
                    created,
                    k,
                    pybullet.POSITION_CONTROL,
                    targetPosition=[0, 0, 0, 1],
                    force=[0, 0, 0],
                    **self.client_arguments,
                )

    def _set_material(self, body: int, link: int) -> None:
        """Set friction, damping and sleeping of a link."""
        # Bullet multiplies the friction coefficients of two bodies; for torsional and rolling friction it adds the
        # coefficient of each times the friction of the other.
        p = self.scene.parameters
        lateral = p.friction**0.5
        pybullet.changeDynamics(
            body, link, lateralFriction=lateral, linearDamping=0, angularDamping=0, jointDamping=0,
            spinningFriction=0.5 * lateral * p.patch_radius,
            rollingFriction=0.5 * p.rolling_radius / lateral if lateral else 0, **self.client_arguments,
        )  # fmt: skip
        pybullet.changeDynamics(
            body, link, activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING, **self.client_arguments
        )

    def step(self) -> None:
        """See `Stepping.step`."""
        pybullet.stepSimulation(**self.client_arguments)

    def get_state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Stepping.get_state`."""
        x, q, v = self.make_initial_state()
        for i, (body, link) in self.ids.items():
            if link < 0:
                x[i], orientation = pybullet.getBasePositionAndOrientation(body, **self.client_arguments)
                v[i] = np.concatenate(pybullet.getBaseVelocity(body, **self.client_arguments))
            else:
                link_state = pybullet.getLinkState(
                    body, link, computeLinkVelocity=1, computeForwardKinematics=1, **self.client_arguments
                )
                x[i], orientation, v[i] = link_state[0], link_state[1], np.concatenate(link_state[6:8])
            q[i] = np.roll(orientation, 1)
        return x, q, v

    def measure_last_step(self) -> tuple[int, float, float]:
        """See `Stepping.measure_last_step`; Bullet does not publish its problem."""
        points = pybullet.getContactPoints(**self.client_arguments) or ()
        x, q, _ = self.get_state()

        def point(i: int, anchor: FloatArray) -> FloatArray:
            """Return the world position of an anchor."""
            return anchor if i < 0 else x[i] + convert_to_rotation_matrix(q[i]) @ anchor

        gaps = [np.linalg.norm(point(j.b, j.anchor_b) - point(j.a, j.anchor_a)) for j in self.scene.joints]
        depth = max(gaps) if gaps else max((-p[8] for p in points), default=0.0)
        return len(points), max(0.0, float(depth)), float("nan")

    def close(self) -> None:
        """See `Stepping.close`."""
        pybullet.disconnect(self.client)
