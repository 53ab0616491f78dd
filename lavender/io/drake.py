"""Convert a discrete Drake MultibodyPlant to a problem in generalised coordinates: point contacts and joint limits.

    w = J v+ - target + compliance lambda,   v+ = v* + A^-1 J^T lambda
    A = M(q0) + dt D,   A (v* - v0) = dt (tau - C(q0, v0) - D v0)

D is the viscous damping of the joints, which SAP (Castro et al. 2022) integrates implicitly; tau contains gravity,
springs, actuation and applied forces. For one step dt:

    contacts       Coulomb's cone, normal first, J at the point between both surfaces, target = correction depth / dt
    joint limits   lambda >= 0, target = -gap / dt, times `correction` if gap < 0

SAP's own contacts are softer: SAP derives a stiffness, a dissipation and a regularisation of friction from the
materials and from diag(J A^-1 J^T), and does not publish them. `impulse` returns SAP's impulses: with this A and J
they must give SAP's next velocity, otherwise the plant is rejected. For a box, a cart and an arm that come to rest in
steps of 2 ms, the velocities of the rigid problem differ from SAP's by 1.2e-4 m/s in the median (0.6 % of the velocity
change by contact; 1.3e-9 with Drake's "lagged" approximation), and by up to 0.1 m/s during an impact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_float
from lavender.base.errors import CapabilityError, InputError
from lavender.io.pinocchio import compute_target_velocity, wrap_engine_errors
from lavender.problem import Problem
from lavender.problem.cones import Cones

# A joint limit is converted to a row only if the joint reaches it within this many steps at its present speed.
LIMIT_HORIZON_STEPS = 4.0
# Largest accepted error of A (v+ - v*) = J^T lambda, as a fraction of |A| |v+ - v*| + |J|^T |lambda| in SAP's norm
# [-]. SAP's own tolerance leaves less than this; above it, a force that this module does not read acts on the plant.
MOMENTUM_TOLERANCE = 1e-6


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
    """Return the constraint problem of the next step of a discrete MultibodyPlant.

    Parameters
    ----------
    plant : pydrake.multibody.plant.MultibodyPlant
        Discrete, finalised, with its scene graph connected.
    context : pydrake.systems.framework.Context
        The plant's context within the context of its diagram.
    dt : float, optional, s
        Must equal the plant's own time step, the default, because Drake computes impulses and v* for that step.
    friction : {"coulomb", "cone"}
    compliance : scalar or (m,) 1/kg, optional
        Default: none.
    correction : float, default 0
        Fraction of a penetration depth that the step corrects. SAP's contacts rest at a depth and correct nothing.

    Returns
    -------
    Problem
        Without an initial guess: SAP's impulses are an answer to be judged, see `impulse`.

    Raises
    ------
    InputError
        Drake cannot be imported, or an argument has the wrong type or value.
    CapabilityError
        The plant has something other than joints, point contacts and joint limits, or SAP's impulses do not explain
        its next velocity.
    """
    return _convert_contact_problem(plant, context, dt, friction, compliance, correction, name)[0]


def impulse(plant: Any, context: Any) -> FloatArray:
    """Return SAP's own answer as impulses (m,) [N s] of the problem's rows, for `lavender.residual`."""
    return _convert_contact_problem(plant, context, None, "coulomb", None, 0.0, "")[1]


def _convert_contact_problem(plant: Any, context: Any, *options: Any) -> tuple[Problem, FloatArray]:
    """Check the types and return the problem and SAP's impulses (m,) [N s]; errors of Drake become InputError."""
    try:
        from pydrake.multibody.plant import MultibodyPlant_
        from pydrake.systems.framework import Context_
    except ImportError:
        raise InputError(
            "pydrake cannot be imported: pip install drake, which provides plants"
        ) from None
    if not isinstance(plant, MultibodyPlant_[float]) or not isinstance(context, Context_[float]):
        raise InputError(
            f"got a {type(plant).__name__} and a {type(context).__name__}; a MultibodyPlant and its Context are needed"
        )
    with wrap_engine_errors(
        "Drake",
        "Give a finalised plant with its scene graph connected, and its own context of finite numbers",
    ):
        return _build_problem(plant, context, *options)


def _build_problem(
    plant: Any, context: Any, dt: Any, friction: str, compliance: Any, correction: Any, name: str
) -> tuple[Problem, FloatArray]:
    """Build the problem and SAP's impulses (m,) [N s]; raise an error for a plant that cannot be converted."""
    step = float(plant.time_step())
    if not step > 0.0:
        raise InputError(
            "the plant is continuous; a time step is needed: MultibodyPlant(time_step=dt)"
        )
    dt = step if dt is None else check_float("dt", dt)
    if not math.isclose(dt, step, rel_tol=1e-12):
        raise InputError(f"dt is {dt:g} s, the plant's own step {step:g} s; they must be equal")
    correction = check_float("correction", correction, low=0.0, high=1.0)
    if plant.num_constraints() > 0:
        raise CapabilityError(
            f"the plant has {plant.num_constraints()} constraints (couplers, distances, balls, welds); only "
            "joints, point contacts and joint limits are supported"
        )
    # Drake leaves out the velocities of locked joints, and crashes the process if their bodies have contacts.
    joints = list_joints(plant)
    locked = [
        joint.name() for joint in joints if joint.num_velocities() and joint.is_locked(context)
    ]
    if locked:
        raise CapabilityError(
            f"the joints {', '.join(locked):.200} are locked; welds are supported"
        )
    dynamics, v_free = compute_free_motion(plant, context, dt)
    contacts = _read_contacts(plant, context)
    limits = _read_joint_limits(plant, context)
    nv = int(plant.num_velocities())
    jac = np.concatenate([np.zeros((0, nv)), *(c.jac for c in contacts), *(x.jac for x in limits)])
    gaps = [
        compute_target_velocity(np.array([-c.depth, 0.0, 0.0]), dt, correction) for c in contacts
    ]
    gaps += [compute_target_velocity(np.array([x.gap]), dt, correction) for x in limits]
    cones = Cones.contacts(np.array([c.mu for c in contacts])) if contacts else Cones.free(0)
    if limits:
        cones = cones + Cones.bounded(np.zeros(len(limits)), np.full(len(limits), np.inf))
    impulses = np.concatenate(
        [np.zeros(0), *(dt * c.force for c in contacts), np.zeros(len(limits))]
    )
    _complete_impulses(
        plant, context, dynamics, v_free, jac, impulses, limits, 3 * len(contacts), dt
    )
    problem = Problem.from_jacobian(
        jac,
        dynamics,
        v_free,
        target=np.concatenate([np.zeros(0), *gaps]),
        cones=cones,
        compliance=compliance,
        friction=friction,
        names=[c.name for c in contacts] + [x.name for x in limits],
        angular=[False] * (3 * len(contacts)) + [x.is_angular for x in limits],
        dof_names=list(plant.GetVelocityNames(always_add_suffix=True)),
        name=name,
    )
    return problem, impulses


def list_joints(plant: Any) -> list[Any]:
    """Return the joints of a plant."""
    from pydrake.multibody.tree import JointIndex

    return [plant.get_joint(JointIndex(int(i))) for i in plant.GetJointIndices()]


@dataclass(frozen=True)
class _Contact:
    """One point contact."""

    name: str
    # (3, nv): Jacobian of the normal and two tangential velocities of body B relative to body A.
    jac: FloatArray
    depth: float  # [m]
    mu: float
    force: FloatArray  # (3,) N: SAP's own contact force.


@dataclass(frozen=True)
class _Limit:
    """One limit of a joint."""

    name: str
    jac: FloatArray  # (1, nv)
    gap: float  # m or rad: distance to the limit; negative if it is violated.
    velocity: int  # Index of the joint's velocity.
    sign: float  # 1 for a lower limit, -1 for an upper limit.
    is_angular: bool  # Whether the joint rotates.


def compute_free_motion(plant: Any, context: Any, dt: float) -> tuple[FloatArray, FloatArray]:
    """Return A (nv, nv) and v* (nv,) of SAP's discretisation (see the module)."""
    from pydrake.multibody.tree import JacobianWrtVariable, JointActuatorIndex, MultibodyForces_

    nv = int(plant.num_velocities())
    forces = MultibodyForces_[float](plant)
    plant.CalcForceElementsContribution(context, forces)
    # This includes joint damping.
    force = -np.array(plant.CalcInverseDynamics(context, np.zeros(nv), forces))
    if plant.num_actuators():
        for i in plant.GetJointActuatorIndices():
            actuator = plant.get_joint_actuator(JointActuatorIndex(int(i)))
            if actuator.has_controller():
                raise CapabilityError(
                    f"actuator {actuator.name()} has a PD controller, which is not supported: replace it by a torque"
                )
        force += plant.MakeActuationMatrix() @ plant.get_net_actuation_output_port().Eval(context)
    applied = plant.get_applied_generalized_force_input_port()
    if applied.HasValue(context):
        force += applied.Eval(context)
    spatial = plant.get_applied_spatial_force_input_port()
    world = plant.world_frame()
    for applied_force in spatial.Eval(context) if spatial.HasValue(context) else ():
        frame = plant.get_body(applied_force.body_index).body_frame()
        jac = plant.CalcJacobianSpatialVelocity(
            context, JacobianWrtVariable.kV, frame, applied_force.p_BoBq_B, world, world
        )
        force += jac.T @ np.concatenate(
            [applied_force.F_Bq_W.rotational(), applied_force.F_Bq_W.translational()]
        )
    damping = np.zeros(nv)
    for joint in list_joints(plant):
        start = joint.velocity_start()
        damping[start : start + joint.num_velocities()] = joint.GetDampingVector(context)
    mass = np.array(plant.CalcMassMatrix(context))
    dynamics = 0.5 * (mass + mass.T) + dt * np.diag(damping)
    return dynamics, np.array(plant.GetVelocities(context)) + dt * np.linalg.solve(dynamics, force)


def _read_contacts(plant: Any, context: Any) -> list[_Contact]:
    """Return the point contacts of the plant; raise CapabilityError for sampled ports or hydroelastic contacts."""
    from pydrake.multibody.tree import JacobianWrtVariable

    if hasattr(plant, "has_sampled_output_ports") and plant.has_sampled_output_ports():
        raise CapabilityError(
            "the plant's output ports are sampled: its contacts belong to the previous step; call "
            "plant.SetUseSampledOutputPorts(False) before Finalize"
        )
    port = plant.get_geometry_query_input_port()
    if not port.HasValue(context):
        return []
    results = plant.get_contact_results_output_port().Eval(context)
    if results.num_hydroelastic_contacts():
        raise CapabilityError(
            f"there are {results.num_hydroelastic_contacts()} hydroelastic contacts; only point contacts are supported"
        )
    inspector = port.Eval(context).inspector()
    world = plant.world_frame()
    contacts = []
    for i in range(results.num_point_pair_contacts()):
        info = results.point_pair_contact_info(i)
        pair = info.point_pair()
        bodies = [plant.get_body(x) for x in (info.bodyA_index(), info.bodyB_index())]
        normal = -np.array(pair.nhat_BA_W)
        first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        first /= np.linalg.norm(first)
        axes = np.stack([normal, first, np.cross(normal, first)])
        jac = [
            plant.CalcJacobianTranslationalVelocity(
                context,
                JacobianWrtVariable.kV,
                body.body_frame(),
                plant.EvalBodyPoseInWorld(context, body).inverse() @ info.contact_point(),
                world,
                world,
            )
            for body in bodies
        ]
        mu = [
            inspector.GetProximityProperties(x)
            .GetProperty("material", "coulomb_friction")
            .dynamic_friction()
            for x in (pair.id_A, pair.id_B)
        ]
        contacts.append(
            _Contact(
                f"{bodies[0].name()} {bodies[1].name()} {i}",
                axes @ (jac[1] - jac[0]),
                float(pair.depth),
                2.0 * mu[0] * mu[1] / (mu[0] + mu[1]) if mu[0] + mu[1] > 0.0 else 0.0,
                axes @ np.array(info.contact_force()),
            )
        )
    return contacts


def _read_joint_limits(plant: Any, context: Any) -> list[_Limit]:
    """Return the finite limits of joints with one velocity, the only ones that SAP supports."""
    limits = []
    nv = int(plant.num_velocities())
    for joint in list_joints(plant):
        if joint.num_velocities() != 1 or joint.num_positions() != 1:
            continue
        velocity = joint.velocity_start()
        is_angular = joint.type_name() == "revolute"
        q = float(plant.GetPositions(context)[joint.position_start()])
        low, high = float(joint.position_lower_limits()[0]), float(joint.position_upper_limits()[0])
        for word, sign, gap in (("lower", 1.0, q - low), ("upper", -1.0, high - q)):
            if math.isfinite(gap):
                row = np.zeros((1, nv))
                row[0, velocity] = sign
                limits.append(
                    _Limit(f"{joint.name()} {word}", row, gap, velocity, sign, is_angular)
                )
    return limits


def _complete_impulses(
    plant: Any,
    context: Any,
    dynamics: FloatArray,
    v_free: FloatArray,
    jac: FloatArray,
    impulses: FloatArray,
    limits: list[_Limit],
    first_limit_row: int,
    dt: float,
) -> None:
    """Check A (v+ - v*) = J^T lambda against Drake's own next step.

    Drake does not publish the impulses of joint limits. They are set in `impulses` to the momentum that the contacts
    do not explain, if the limit is close enough to act and the sign fits.
    """
    nv = len(v_free)
    state = np.array(plant.EvalUniquePeriodicDiscreteUpdate(context).value())
    change = state[-nv:] - v_free
    momentum_error = dynamics @ change - jac.T @ impulses
    size = np.abs(dynamics) @ np.abs(change) + np.abs(jac).T @ np.abs(impulses)
    size += np.abs(dynamics @ v_free).max(initial=0.0)
    speed = np.maximum(np.abs(v_free), np.abs(plant.GetVelocities(context)))
    for k, limit in enumerate(limits):
        i = limit.velocity
        if limit.gap > LIMIT_HORIZON_STEPS * dt * speed[i]:
            continue  # The joint does not reach this limit within LIMIT_HORIZON_STEPS.
        if limit.sign * momentum_error[i] > MOMENTUM_TOLERANCE * size[i]:
            impulses[first_limit_row + k] = limit.sign * momentum_error[i]
            momentum_error[i] = 0.0
    weight = 1.0 / np.sqrt(np.diag(dynamics))  # SAP uses these weights in its stopping test.
    if not np.linalg.norm(weight * momentum_error) <= MOMENTUM_TOLERANCE * np.linalg.norm(
        weight * size
    ):
        worst = int(np.argmax(weight * np.abs(momentum_error)))
        raise CapabilityError(
            "a force that the import does not read acts on the plant: A (v+ - v*) and J^T times the impulses "
            f"differ by {momentum_error[worst]:.3g}, of terms up to {size[worst]:.3g}, at "
            f"{plant.GetVelocityNames(always_add_suffix=True)[worst]}: remove it"
        )
