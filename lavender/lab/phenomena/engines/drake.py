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
from lavender.lab.phenomena.engines.tree import collision_shape, parents, relative
from lavender.sim.scene import Body, Plane, Scene, Sphere

MODULUS = 1e8  # Pa, of compliant bodies
DISSIPATION = 10.0  # s/m


class Engine(Stepping):
    """`Simulator.AdvanceTo` by 1 ms."""

    def __init__(self, scene: Scene, approximation: str, hydroelastic: bool) -> None:
        self.scene, self.hydroelastic, self.dt = scene, hydroelastic, 1e-3
        self.up = parents(scene, "drake")
        kind = "hydroelastic" if hydroelastic else "point contacts"
        self.setting = f"1 ms, {approximation}, {kind}"
        builder = DiagramBuilder()
        plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=self.dt)
        self.plant = plant
        plant.set_discrete_contact_approximation(
            getattr(DiscreteContactApproximation, "k" + approximation.capitalize())
        )
        plant.mutable_gravity_field().set_gravity_vector(np.asarray(scene.parameters.gravity))
        self.bodies: list[Any] = [self._add(i) for i in range(scene.n_bodies)]
        for i in self.up:
            self._join(i)
        plant.Finalize()
        diagram = builder.Build()
        self.simulator = Simulator(diagram)
        self.context = plant.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())
        for i, body in enumerate(scene.bodies):
            if self.bodies[i] is not None and i not in self.up:
                plant.SetFreeBodyPose(self.context, self.bodies[i], _pose(body.position, body.quaternion))
                plant.SetFreeBodySpatialVelocity(
                    self.context, self.bodies[i],
                    SpatialVelocity(w=_any(body.angular_velocity), v=_any(body.velocity)),
                )  # fmt: skip
        self.simulator.Initialize()
        self.steps = 0

    def _material(self, rigid: bool) -> ProximityProperties:
        mu, made = self.scene.parameters.friction, ProximityProperties()
        AddContactMaterial(
            dissipation=DISSIPATION if self.hydroelastic else None,
            friction=CoulombFriction(mu, mu),
            properties=made,
        )
        if self.hydroelastic and rigid:
            AddRigidHydroelasticProperties(1.0, made)
        elif self.hydroelastic:
            AddCompliantHydroelasticProperties(0.1, MODULUS, made)
        return made

    def _add(self, i: int) -> Any:
        body = self.scene.bodies[i]
        shape = collision_shape(body, "drake", static=False)
        if isinstance(shape, Plane):
            normal = _any(shape.normal)
            pose = HalfSpace.MakePose(normal, _any(shape.offset * normal))
            ground = self.plant.world_body()
            self.plant.RegisterCollisionGeometry(ground, pose, HalfSpace(), f"b{i}", self._material(True))
            return None
        about = np.diag(body.inertia) / body.mass
        unit = UnitInertia(*about)
        made = self.plant.AddRigidBody(f"b{i}", SpatialInertia(body.mass, _any(np.zeros(3)), unit))
        if not self.up:
            solid = DrakeSphere(shape.radius) if isinstance(shape, Sphere) else DrakeBox(*shape.size)
            self.plant.RegisterCollisionGeometry(
                made, RigidTransform(), solid, f"b{i}", self._material(False)
            )
        return made

    def _join(self, i: int) -> None:
        joint, plant = self.up[i], self.plant
        above: Body | None = None if joint.a < 0 else self.scene.bodies[joint.a]
        _, turn = relative(above, self.scene.bodies[i])
        base = plant.world_frame() if above is None else self.bodies[joint.a].body_frame()
        own = self.bodies[i].body_frame()
        first = plant.AddFrame(FixedOffsetFrame(f"f{i}", base, _pose(joint.anchor_a, turn)))
        second = plant.AddFrame(FixedOffsetFrame(f"m{i}", own, RigidTransform(_any(joint.anchor_b))))
        if joint.kind == "hinge":
            plant.AddJoint(RevoluteJoint(joint.name, first, second, _any(joint.axis_b), 0.0))
        else:
            plant.AddJoint(BallRpyJoint(joint.name, first, second, 0.0))

    def step(self) -> None:
        """See `Stepping.step`."""
        self.steps += 1
        self.simulator.AdvanceTo(self.steps * self.dt)

    def state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Stepping.state`."""
        x, q, v = self.placed()
        for i, body in enumerate(self.bodies):
            if body is None:
                continue
            pose = self.plant.EvalBodyPoseInWorld(self.context, body)
            speed = self.plant.EvalBodySpatialVelocityInWorld(self.context, body)
            x[i], q[i] = pose.translation(), pose.rotation().ToQuaternion().wxyz()
            v[i] = np.concatenate([speed.translational(), speed.rotational()])
        return x, q, v


def _any(x: Any) -> Any:
    # its stubs ask for arrays of a type that NumPy has no name for
    return np.asarray(x, float)


def _pose(place: FloatArray, turn: FloatArray) -> RigidTransform:
    return RigidTransform(RotationMatrix(Quaternion(_any(turn / np.linalg.norm(turn)))), _any(place))
