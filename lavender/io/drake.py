"""A discrete MultibodyPlant of Drake as a problem in generalised coordinates: point contact and joint limits.

    w = J v+ - target + compliance lambda,   v+ = v* + A^-1 J^T lambda
    A = M(q0) + dt D,   A (v* - v0) = dt (tau - C(q0, v0) - D v0)

with D the joints' viscous damping, which SAP (Castro et al. 2022) integrates implicitly, and tau gravity, springs,
actuation and applied forces. In one step of dt

    contacts       Coulomb's cone, normal first, J at the point between both surfaces, target = correction depth / dt
    joint limits   lambda >= 0, target = -gap / dt, `correction` of it where gap < 0

SAP's own contacts are softer than that: stiffness, dissipation and a regularisation of friction, which it derives from
materials and from diag(J A^-1 J^T) and does not publish. What it answers is nevertheless here: `impulse` has its
impulses, which give, under this A and J, its next velocity, or the problem is refused. On a box, a cart and an arm
that come to rest in steps of 2 ms the velocities of the rigid problem differ from SAP's by 1.2e-4 m/s in the median
(0.6 % of what contact changes; 1.3e-9 with the "lagged" approximation), at the moment of an impact by up to 0.1 m/s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_float
from lavender.base.errors import CapabilityError, InputError
from lavender.io.pinocchio import closing_speed, told
from lavender.problem import Problem
from lavender.problem.cones import Cones

REACH = 4.0  # steps at the present speed within which a joint limit may push
UNSEEN = 1e-6  # -, of |A| |v+ - v*| + |J|^T |lambda| in SAP's own norm: above what its tolerance leaves of its momentum


def from_drake(
    plant: Any,
    context: Any,
    dt: float | None = None,
    *,
    friction: str = "coulomb",
    compliance: Any = None,
    correction: float = 0.0,
    name: str = "drake",
) -> Problem:
    """The constraint problem of the next step of a discrete MultibodyPlant.

    Parameters
    ----------
    plant : pydrake.multibody.plant.MultibodyPlant
        Discrete, finalised, with its scene graph connected.
    context : pydrake.systems.framework.Context
        Of the plant, inside the diagram's.
    dt : float, optional, s
        The plant's own time step; another is refused, since impulses and v* are of that step.
    friction : {"coulomb", "cone"}
    compliance : scalar or (m,) 1/kg, optional
        Default: none.
    correction : float, default 0
        Share of a depth that the step takes back. SAP's contacts rest at a depth and take nothing back.

    Returns
    -------
    Problem
        Without a start: SAP's own impulses are an answer, `impulse(plant, context)`.

    Raises
    ------
    InputError
        Drake cannot be imported, or what is given does not fit.
    CapabilityError
        What the plant holds beside joints, contacts at points and joint limits; momentum that does not add up.
    """
    return _solved(plant, context, dt, friction, compliance, correction, name)[0]


def impulse(plant: Any, context: Any) -> FloatArray:
    """SAP's own answer as impulses (m,) [N s] of the problem's rows: what `lavender.residual` judges."""
    return _solved(plant, context, None, "coulomb", None, 0.0, "")[1]


def _solved(plant: Any, context: Any, *how: Any) -> tuple[Problem, FloatArray]:
    try:
        from pydrake.multibody.plant import MultibodyPlant_
        from pydrake.systems.framework import Context_
    except ImportError:
        raise InputError("pydrake cannot be imported: pip install drake; a plant comes from it") from None
    if not isinstance(plant, MultibodyPlant_[float]) or not isinstance(context, Context_[float]):
        raise InputError(
            f"got a {type(plant).__name__} and a {type(context).__name__}; a MultibodyPlant and its Context are needed"
        )
    with told(
        "Drake",
        "Give a finalised plant with its scene graph connected, and its own context of finite numbers",
    ):
        return _problem(plant, context, *how)


def _problem(
    plant: Any, context: Any, dt: Any, friction: str, compliance: Any, correction: Any, name: str
) -> tuple[Problem, FloatArray]:
    step = float(plant.time_step())
    if not step > 0.0:
        raise InputError(
            "the plant is continuous; one with a time step is needed (MultibodyPlant(time_step=dt))"
        )
    dt = step if dt is None else check_float("dt", dt)
    if not math.isclose(dt, step, rel_tol=1e-12):
        raise InputError(f"dt is {dt:g} s, the plant's own step {step:g} s; they must be one")
    correction = check_float("correction", correction, low=0.0, high=1.0)
    if plant.num_constraints() > 0:
        raise CapabilityError(
            f"the plant has {plant.num_constraints()} constraints (couplers, distances, balls, welds); joints, "
            "contacts at points and joint limits are known here"
        )
    _refuse_locked(plant, context)
    dynamics, v_free = free_motion(plant, context, dt)
    contacts = _contacts(plant, context)
    limits = _limits(plant, context)
    nv = int(plant.num_velocities())
    jac = np.concatenate([np.zeros((0, nv)), *(c.jac for c in contacts), *(x.jac for x in limits)])
    gaps = [closing_speed(np.array([-c.depth, 0.0, 0.0]), dt, correction) for c in contacts]
    gaps += [closing_speed(np.array([x.gap]), dt, correction) for x in limits]
    cones = Cones.contacts(np.array([c.mu for c in contacts])) if contacts else Cones.free(0)
    if limits:
        cones = cones + Cones.bounded(np.zeros(len(limits)), np.full(len(limits), np.inf))
    own = np.concatenate([np.zeros(0), *(dt * c.force for c in contacts), np.zeros(len(limits))])
    _complete(plant, context, dynamics, v_free, jac, own, limits, 3 * len(contacts), dt)
    made = Problem.from_jacobian(
        jac,
        dynamics,
        v_free,
        target=np.concatenate([np.zeros(0), *gaps]),
        cones=cones,
        compliance=compliance,
        friction=friction,
        names=[c.name for c in contacts] + [x.name for x in limits],
        dof_names=list(plant.GetVelocityNames(always_add_suffix=True)),
        name=name,
    )
    return made, own


def _refuse_locked(plant: Any, context: Any) -> None:
    """Drake takes the velocities of locked joints out of its step, and fails by a signal where they carry contacts."""
    from pydrake.multibody.tree import JointIndex

    joints = [plant.get_joint(JointIndex(int(i))) for i in plant.GetJointIndices()]
    locked = [joint.name() for joint in joints if joint.num_velocities() and joint.is_locked(context)]
    if locked:
        raise CapabilityError(f"locked joints are not known here: {', '.join(locked):.200}; weld them")


@dataclass(frozen=True)
class _Contact:
    name: str
    jac: FloatArray  # (3, nv) normal, two tangents, of B against A
    depth: float  # m
    mu: float
    force: FloatArray  # (3,) N, SAP's own


@dataclass(frozen=True)
class _Limit:
    name: str
    jac: FloatArray  # (1, nv)
    gap: float  # m or rad
    at: int  # velocity
    sign: float


def free_motion(plant: Any, context: Any, dt: float) -> tuple[FloatArray, FloatArray]:
    """A (nv, nv) and v* (nv,) of SAP."""
    from pydrake.multibody.tree import JacobianWrtVariable, JointActuatorIndex, JointIndex, MultibodyForces_

    nv = int(plant.num_velocities())
    forces = MultibodyForces_[float](plant)
    plant.CalcForceElementsContribution(context, forces)
    push = -np.array(plant.CalcInverseDynamics(context, np.zeros(nv), forces))  # the joints' damping is in it
    if plant.num_actuators():
        for i in plant.GetJointActuatorIndices():
            actuator = plant.get_joint_actuator(JointActuatorIndex(int(i)))
            if actuator.has_controller():
                raise CapabilityError(
                    f"actuator {actuator.name()} has a PD controller, which SAP integrates implicitly; that is not "
                    "known here"
                )
        push += plant.MakeActuationMatrix() @ plant.get_net_actuation_output_port().Eval(context)
    applied = plant.get_applied_generalized_force_input_port()
    if applied.HasValue(context):
        push += applied.Eval(context)
    spatial = plant.get_applied_spatial_force_input_port()
    world = plant.world_frame()
    for one in spatial.Eval(context) if spatial.HasValue(context) else ():
        frame = plant.get_body(one.body_index).body_frame()
        jac = plant.CalcJacobianSpatialVelocity(
            context, JacobianWrtVariable.kV, frame, one.p_BoBq_B, world, world
        )
        push += jac.T @ np.concatenate([one.F_Bq_W.rotational(), one.F_Bq_W.translational()])
    damping = np.zeros(nv)
    for i in plant.GetJointIndices():
        joint = plant.get_joint(JointIndex(int(i)))
        first = joint.velocity_start()
        damping[first : first + joint.num_velocities()] = joint.GetDampingVector(context)
    mass = np.array(plant.CalcMassMatrix(context))
    dynamics = 0.5 * (mass + mass.T) + dt * np.diag(damping)
    return dynamics, np.array(plant.GetVelocities(context)) + dt * np.linalg.solve(dynamics, push)


def _contacts(plant: Any, context: Any) -> list[_Contact]:
    from pydrake.multibody.tree import JacobianWrtVariable

    if hasattr(plant, "has_sampled_output_ports") and plant.has_sampled_output_ports():
        raise CapabilityError(
            "the plant's output ports are sampled: its contacts are those of the step before; call "
            "plant.SetUseSampledOutputPorts(False) before Finalize"
        )
    port = plant.get_geometry_query_input_port()
    if not port.HasValue(context):
        return []
    results = plant.get_contact_results_output_port().Eval(context)
    if results.num_hydroelastic_contacts():
        raise CapabilityError(
            f"{results.num_hydroelastic_contacts()} hydroelastic contacts; contacts at points are known here "
            "(plant.set_contact_model(ContactModel.kPoint))"
        )
    inspector = port.Eval(context).inspector()
    world, found = plant.world_frame(), []
    for i in range(results.num_point_pair_contacts()):
        info = results.point_pair_contact_info(i)
        pair = info.point_pair()
        bodies = [plant.get_body(x) for x in (info.bodyA_index(), info.bodyB_index())]
        normal = -np.array(pair.nhat_BA_W)
        axes = np.stack([normal, *_tangents(normal)])
        jac = [
            plant.CalcJacobianTranslationalVelocity(
                context, JacobianWrtVariable.kV, body.body_frame(),
                plant.EvalBodyPoseInWorld(context, body).inverse() @ info.contact_point(), world, world,
            )
            for body in bodies
        ]  # fmt: skip
        mu = [
            inspector.GetProximityProperties(x).GetProperty("material", "coulomb_friction").dynamic_friction()
            for x in (pair.id_A, pair.id_B)
        ]
        found.append(
            _Contact(
                f"{bodies[0].name()} {bodies[1].name()} {i}",
                axes @ (jac[1] - jac[0]),
                float(pair.depth),
                2.0 * mu[0] * mu[1] / (mu[0] + mu[1]) if mu[0] + mu[1] > 0.0 else 0.0,
                axes @ np.array(info.contact_force()),
            )
        )
    return found


def _tangents(normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    axis = np.zeros(3)
    axis[int(np.argmin(np.abs(normal)))] = 1.0
    first = np.cross(normal, axis)
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)


def _limits(plant: Any, context: Any) -> list[_Limit]:
    """Of joints of one velocity, as SAP knows them."""
    from pydrake.multibody.tree import JointIndex

    found = []
    nv = int(plant.num_velocities())
    for i in plant.GetJointIndices():
        joint = plant.get_joint(JointIndex(int(i)))
        if joint.num_velocities() != 1 or joint.num_positions() != 1:
            continue
        at = joint.velocity_start()
        q = float(plant.GetPositions(context)[joint.position_start()])
        low, high = float(joint.position_lower_limits()[0]), float(joint.position_upper_limits()[0])
        for word, sign, gap in (("lower", 1.0, q - low), ("upper", -1.0, high - q)):
            if math.isfinite(gap):
                row = np.zeros((1, nv))
                row[0, at] = sign
                found.append(_Limit(f"{joint.name()} {word}", row, gap, at, sign))
    return found


def _complete(
    plant: Any,
    context: Any,
    dynamics: FloatArray,
    v_free: FloatArray,
    jac: FloatArray,
    own: FloatArray,
    limits: list[_Limit],
    first: int,
    dt: float,
) -> None:
    """Check A (v+ - v*) = J^T lambda against Drake's own next step; limits, whose impulses it hides, take the rest."""
    nv = len(v_free)
    state = np.array(plant.EvalUniquePeriodicDiscreteUpdate(context).value())
    change = state[-nv:] - v_free
    left = dynamics @ change - jac.T @ own
    size = np.abs(dynamics) @ np.abs(change) + np.abs(jac).T @ np.abs(own)
    size += np.abs(dynamics @ v_free).max(initial=0.0)
    speed = np.maximum(np.abs(v_free), np.abs(plant.GetVelocities(context)))
    for k, limit in enumerate(limits):
        if limit.gap > REACH * dt * speed[limit.at]:
            continue  # too far away to push
        if limit.sign * left[limit.at] > UNSEEN * size[limit.at]:
            own[first + k] = limit.sign * left[limit.at]
            left[limit.at] = 0.0
    weight = 1.0 / np.sqrt(np.diag(dynamics))  # what SAP weighs momenta by when it ends
    if not np.linalg.norm(weight * left) <= UNSEEN * np.linalg.norm(weight * size):
        worst = int(np.argmax(weight * np.abs(left)))
        raise CapabilityError(
            f"A (v+ - v*) of Drake's own next step is not J^T times its impulses: {left[worst]:.3g} of "
            f"{size[worst]:.3g} is left at {plant.GetVelocityNames(always_add_suffix=True)[worst]}; something acts "
            "on the plant that is not known here"
        )
