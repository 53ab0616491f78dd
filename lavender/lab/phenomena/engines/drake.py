"""Drake: MultibodyPlant in discrete time, native shapes, joints as a tree."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    HalfSpace,
    ProximityProperties,
)
from pydrake.geometry import Box as DrakeBox
from pydrake.geometry import Sphere as DrakeSphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
    DiscreteContactApproximation,
)
from pydrake.multibody.tree import (
    BallRpyJoint,
    FixedOffsetFrame,
    RevoluteJoint,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from lavender.base.arrays import FloatArray
from lavender.lab.phenomena.engines import Stepping
from lavender.lab.phenomena.engines.tree import (
    compute_relative_pose,
    get_collision_shape,
    map_bodies_to_parent_joints,
)
from lavender.sim.scene import Body, Plane, Scene, Sphere

MODULUS = 1e8  # [Pa] Hydroelastic modulus of compliant bodies.
DISSIPATION = 10.0  # [s/m] Hunt-Crossley dissipation of hydroelastic contacts.


class Engine(Stepping):
    """Engine that steps a scene with Drake's `Simulator.AdvanceTo` in steps of 1 ms."""

    def __init__(self, scene: Scene, approximation: str, hydroelastic: bool) -> None:
        self.scene, self.hydroelastic, self.dt = scene, hydroelastic, 1e-3
        self.up = map_bodies_to_parent_joints(scene, "drake")
        kind = "hydroelastic" if hydroelastic else "point contacts"
        self.setting = f"1 ms, {approximation}, {kind}"
        builder = DiagramBuilder()
        plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=self.dt)
        self.plant = plant
        plant.set_discrete_contact_approximation(
            getattr(DiscreteContactApproximation, "k" + approximation.capitalize())
        )
        plant.mutable_gravity_field().set_gravity_vector(np.asarray(scene.parameters.gravity))
        self.bodies: list[Any] = [self._add_body(i) for i in range(scene.n_bodies)]
        for i in self.up:
            self._add_joint(i)
        plant.Finalize()
        diagram = builder.Build()
        self.simulator = Simulator(diagram)
        self.context = plant.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())
        for i, body in enumerate(scene.bodies):
            if self.bodies[i] is not None and i not in self.up:
                plant.SetFreeBodyPose(
                    self.context, self.bodies[i], _make_pose(body.position, body.quaternion)
                )
                plant.SetFreeBodySpatialVelocity(
                    self.context, self.bodies[i],
                    SpatialVelocity(w=_as_drake_array(body.angular_velocity), v=_as_drake_array(body.velocity)),
                )  # fmt: skip
        self.simulator.Initialize()
        self.steps = 0

    def _make_contact_properties(self, rigid: bool) -> ProximityProperties:
        """Build the contact properties of a body."""
        mu, created = self.scene.parameters.friction, ProximityProperties()
        AddContactMaterial(
            dissipation=DISSIPATION if self.hydroelastic else None,
            friction=CoulombFriction(mu, mu),
            properties=created,
        )
        if self.hydroelastic and rigid:
            AddRigidHydroelasticProperties(1.0, created)
        elif self.hydroelastic:
            AddCompliantHydroelasticProperties(0.1, MODULUS, created)
        return created

    def _add_body(self, i: int) -> Any:
        """Add a body to the plant and return it; a plane belongs to the world: return None."""
        body = self.scene.bodies[i]
        shape = get_collision_shape(body, "drake", static=False)
        if isinstance(shape, Plane):
            normal = _as_drake_array(shape.normal)
            pose = HalfSpace.MakePose(normal, _as_drake_array(shape.offset * normal))
            ground = self.plant.world_body()
            self.plant.RegisterCollisionGeometry(
                ground, pose, HalfSpace(), f"b{i}", self._make_contact_properties(True)
            )
            return None
        unit = UnitInertia(*(np.diag(body.inertia) / body.mass))
        created = self.plant.AddRigidBody(
            f"b{i}", SpatialInertia(body.mass, _as_drake_array(np.zeros(3)), unit)
        )
        if not self.up:
            solid = DrakeSphere(shape.radius) if isinstance(shape, Sphere) else DrakeBox(*shape.size)
            self.plant.RegisterCollisionGeometry(
                created, RigidTransform(), solid, f"b{i}", self._make_contact_properties(False)
            )
        return created

    def _add_joint(self, i: int) -> None:
        """Add the joint of body i to its parent."""
        joint, plant = self.up[i], self.plant
        parent: Body | None = None if joint.a < 0 else self.scene.bodies[joint.a]
        _, quaternion = compute_relative_pose(parent, self.scene.bodies[i])
        base = plant.world_frame() if parent is None else self.bodies[joint.a].body_frame()
        child_frame = self.bodies[i].body_frame()
        first = plant.AddFrame(FixedOffsetFrame(f"f{i}", base, _make_pose(joint.anchor_a, quaternion)))
        second = plant.AddFrame(
            FixedOffsetFrame(f"m{i}", child_frame, RigidTransform(_as_drake_array(joint.anchor_b)))
        )
        if joint.kind == "hinge":
            plant.AddJoint(RevoluteJoint(joint.name, first, second, _as_drake_array(joint.axis_b), 0.0))
        else:
            plant.AddJoint(BallRpyJoint(joint.name, first, second, 0.0))

    def step(self) -> None:
        """See `Stepping.step`."""
        self.steps += 1
        self.simulator.AdvanceTo(self.steps * self.dt)

    def get_state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Stepping.get_state`."""
        x, q, v = self.make_initial_state()
        for i, body in enumerate(self.bodies):
            if body is None:
                continue
            pose = self.plant.EvalBodyPoseInWorld(self.context, body)
            speed = self.plant.EvalBodySpatialVelocityInWorld(self.context, body)
            x[i], q[i] = pose.translation(), pose.rotation().ToQuaternion().wxyz()
            v[i] = np.concatenate([speed.translational(), speed.rotational()])
        return x, q, v


def _as_drake_array(x: Any) -> Any:
    """Convert to an array of untyped shape: Drake's stubs need an array type that NumPy has no name for."""
    return np.asarray(x, float)


def _make_pose(position: FloatArray, quaternion: FloatArray) -> RigidTransform:
    """Build a pose of a position (3,) [m] and a quaternion (4,)."""
    return RigidTransform(
        RotationMatrix(Quaternion(_as_drake_array(quaternion / np.linalg.norm(quaternion)))),
        _as_drake_array(position),
    )
