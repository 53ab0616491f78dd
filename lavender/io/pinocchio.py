"""Convert a Pinocchio model and its constraint models to a problem in generalised coordinates.

    w = J v+ - target + compliance lambda,   v+ = v* + M^-1 J^T lambda,   v* = v + dt aba(q, v, tau)

M is computed by `crba`, J by each constraint model; rows are in the order of the constraint models. For one step dt:

    anchors (point, frame)   all rows free,           target = -correction error / dt + desired velocity
    point contacts           Coulomb's cone, z first, target = -gap / dt along z, times `correction` if gap < 0,
                             + desired velocity
    joint limits             lambda >= 0,             target as for contacts, with gap = distance to the limit
    joint friction           |lambda| <= dt times the model's limits, target = 0

With level="acceleration", all rows are anchors with target = J v - dt (dJ/dt) v: then J (v+ - v) / dt = -(dJ/dt) v, and
(v+ - v) / dt is the constrained acceleration. At the level of velocities it lacks the term (dJ/dt) v, for every dt.

A contact's z axis points from the first joint's side to the second's: w > 0 along it is separation.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from lavender.base.arrays import as_array, check_choice, check_float
from lavender.base.errors import CapabilityError, InputError, LavenderError
from lavender.problem import Problem
from lavender.problem.cones import Cones

OTHER_MODEL_ADVICE = (
    "The model was changed, or the data belong to another model: give data made from this model"
)
ANCHORS = {"PointAnchorConstraintModel", "FrameAnchorConstraintModel"}
# Largest accepted deviation of a quaternion from unit length and of a matrix from a rotation [-]. With a larger one,
# J does not map joint velocities to velocities.
ROTATION_TOLERANCE = 1e-6
# Largest accepted difference of M a and tau - h, relative to |M| |a| + |tau - h| [-]. Above it, aba used another M.
ACCELERATION_TOLERANCE = 1e-9
# Largest accepted relative difference of a constraint's own time step from dt [-].
TIME_STEP_TOLERANCE = 1e-9


def from_pinocchio(
    model: Any,
    data: Any,
    constraint_models: Sequence[Any],
    constraint_datas: Sequence[Any],
    dt: float,
    *,
    q: Any,
    v: Any,
    tau: Any = None,
    friction: str = "coulomb",
    compliance: Any = None,
    correction: float = 0.2,
    level: str = "velocity",
    name: str = "pinocchio",
) -> Problem:
    """Return the constraint problem of one step of a Pinocchio model.

    Parameters
    ----------
    model : pinocchio.Model
    data : pinocchio.Data
        It is recomputed at q and v.
    constraint_models, constraint_datas : sequence
        Anchors, contacts, joint limits and joint friction of Pinocchio 4, plain or as `ConstraintModel`. They are
        evaluated in new data.
    dt : float, s
    q : (nq,)
    v : (nv,) m/s, rad/s
        Before the step.
    tau : (nv,) N, N m, optional
        Joint efforts; default: none.
    friction : {"coulomb", "cone"}
    compliance : scalar or (m,) 1/kg, optional
        Default: none. The compliance of Pinocchio's constraint models is not read.
    correction : float, default 0.2
        Fraction of a position error that the step corrects.
    level : {"velocity", "acceleration"}
        "acceleration": (v+ - v) / dt is the acceleration of the constrained model, as of `pinocchio.constraintDynamics`
        without stabilisation; anchors only. (dJ/dt) v is a central difference, exact to about 1e-9 of its size.

    Returns
    -------
    Problem

    Raises
    ------
    InputError
        Pinocchio cannot be imported, or an argument has the wrong type, size or value.
    CapabilityError
        A constraint model of another kind, or accelerations that do not belong to M; with level="acceleration", a
        constraint that is not an anchor.
    """
    check_choice("level", level, ("velocity", "acceleration"))
    try:
        import pinocchio as pin
    except ImportError:
        raise InputError(
            "pinocchio cannot be imported: pip install pin, which provides models"
        ) from None
    for word, sequence in (("models", constraint_models), ("data", constraint_datas)):
        if not (hasattr(sequence, "__len__") and hasattr(sequence, "__iter__")):
            raise InputError(
                f"constraint {word}: got a {type(sequence).__name__}; a sequence is needed"
            )
    n_models, n_datas = len(constraint_models), len(constraint_datas)
    if n_models != n_datas:
        raise InputError(f"{n_datas} constraint data for {n_models} models; one for each is needed")
    dt = check_float("dt", dt, above=0.0)
    correction = check_float("correction", correction, low=0.0, high=1.0)
    _check_model(pin, model, data)
    nv = int(model.nv)
    q = np.array(as_array("q", q, (int(model.nq),)))
    v = np.array(as_array("v", v, (nv,), unit="m/s, rad/s"))
    tau = np.array(as_array("tau", 0.0 if tau is None else tau, (nv,), unit="N, N m"))
    if not pin.isNormalized(model, q, ROTATION_TOLERANCE):
        raise InputError(
            "q has a quaternion that is not of unit length: pinocchio.normalize(model, q) normalises quaternions"
        )
    mass, a = _compute_mass_and_acceleration(pin, model, data, q, v, tau)
    with wrap_engine_errors("Pinocchio", OTHER_MODEL_ADVICE):
        pin.forwardKinematics(model, data, q, v)
        pin.computeJointJacobians(model, data, q)
        data.q_in = (
            q  # Pinocchio evaluates joint limits at q_in, which none of its algorithms sets.
        )
    pairs = zip(constraint_models, constraint_datas, strict=True)
    rows, target, cones, names, angular = _convert_constraints(model, data, pairs, dt, correction)
    if level == "acceleration":
        kinds = {type(_unwrap_constraint(constraint)).__name__ for constraint in constraint_models}
        if kinds - ANCHORS:
            raise CapabilityError(
                f"level is 'acceleration' and there is a {min(kinds - ANCHORS)}; only anchors have an acceleration "
                "level: give level='velocity' for contacts, limits and friction"
            )
        target = rows @ v - dt * _differentiate_constraint_velocity(
            pin, model, constraint_models, q, v
        )
    return Problem.from_jacobian(
        rows,
        mass,
        v + dt * a,
        target=target,
        cones=cones,
        compliance=compliance,
        friction=friction,
        names=names,
        angular=angular,
        name=name,
    )


def _differentiate_constraint_velocity(
    pin: Any, model: Any, constraints: Any, q: Any, v: Any
) -> Any:
    """Return (dJ/dt) v (m,): the central difference of J(q) v along v."""
    # The step in which the error of the difference and its rounding are equal.
    h = np.cbrt(np.finfo(float).eps) / max(1.0, float(np.abs(v).max(initial=0.0)))
    speeds = []
    for step in (h, -h):
        data = model.createData()
        moved = pin.integrate(model, q, step * v)
        pin.forwardKinematics(model, data, moved, v)
        pin.computeJointJacobians(model, data, moved)
        data.q_in = moved
        pairs = [
            (constraint, _unwrap_constraint(constraint).createData()) for constraint in constraints
        ]
        speeds.append(_convert_constraints(model, data, pairs, 1.0, 0.0)[0] @ v)
    return (speeds[0] - speeds[1]) / (2.0 * h)


def _convert_constraints(
    model: Any, data: Any, pairs: Iterable[Any], dt: float, correction: float
) -> tuple[Any, Any, Cones, list[str], list[bool]]:
    """Return J (m, nv), targets (m,), blocks, their names, and which rows are angular, of all constraints in order."""
    nv = int(model.nv)
    rows: list[Any] = [np.zeros((0, nv))]
    targets: list[Any] = [np.zeros(0)]
    cones = Cones.free(0)
    names = []
    angular = []
    rotates = np.zeros(nv, bool)
    for joint in list(model.joints)[1:]:  # Mark the angular velocities of the model [rad/s].
        name = joint.shortname().removeprefix("JointModel")
        first = int(joint.idx_v)
        count = int(joint.nv)
        is_angular = name.startswith(("R", "Spherical", "Universal", "Helical", "H"))
        begin = 0 if is_angular else {"FreeFlyer": 3, "Planar": 2}.get(name, count)
        rotates[first + begin : first + count] = True
    for i, (wrapped_model, wrapped_data) in enumerate(pairs):
        model_of = _unwrap_constraint(wrapped_model)
        _check_constraint(i, model, model_of, _unwrap_constraint(wrapped_data))
        own = model_of.getTimeStep() if hasattr(model_of, "getTimeStep") else dt
        if not abs(own - dt) <= TIME_STEP_TOLERANCE * dt:
            raise InputError(
                f"constraint {i}, a {type(model_of).__name__}, has a time step of {own:g} s, and dt is {dt:g} s: "
                f"Pinocchio's impulses would be bounded for {own:g} s. Call setTimeStep({dt:g}) on the constraint model"
            )
        with wrap_engine_errors("Pinocchio", OTHER_MODEL_ADVICE):
            data_of = (
                model_of.createData()
            )  # Data of the caller could have the sizes of another model.
            model_of.calc(model, data, data_of)
            jac = np.array(model_of.jacobian(model, data, data_of)).reshape(-1, nv)
        own_cones, target, order = _convert_constraint(model_of, data_of, len(jac), dt, correction)
        if hasattr(model_of, "desired_constraint_velocity"):
            target = target + np.array(model_of.desired_constraint_velocity)[order]
        rows.append(jac[order])
        kind = type(model_of).__name__
        if kind.startswith("Joint"):  # Each row is one velocity of a joint.
            angular += [bool(rotates[row != 0.0].any()) for row in jac]
        else:
            angular += [kind == "FrameAnchorConstraintModel" and k >= 3 for k in range(len(jac))]
        targets.append(target)
        cones = cones + own_cones
        word = f"{kind.removesuffix('ConstraintModel')} {i}"
        blocks = own_cones.n_blocks
        names += [word] if blocks == 1 else [f"{word}, row {k}" for k in range(blocks)]
    return np.concatenate(rows), np.concatenate(targets), cones, names, angular


def _compute_mass_and_acceleration(
    pin: Any, model: Any, data: Any, q: Any, v: Any, tau: Any
) -> tuple[Any, Any]:
    """Return M (nv, nv) and the free acceleration a (nv,); raise CapabilityError if M a is not the applied force."""
    with wrap_engine_errors("Pinocchio", OTHER_MODEL_ADVICE):
        a = np.array(pin.aba(model, data, q, v, tau))
        force = tau - np.array(pin.nle(model, data, q, v))
        upper = np.triu(np.array(pin.crba(model, data, q)))
    mass = upper + np.triu(upper, 1).T
    if np.abs(mass @ a - force).max(initial=0.0) > ACCELERATION_TOLERANCE * float(
        (np.abs(mass) @ np.abs(a) + np.abs(force)).max(initial=0.0)
    ):
        raise CapabilityError(
            "M times the acceleration of aba(q, v, tau) differs from tau - nle(q, v), so aba used another "
            "mass matrix than crba: give the model with which the data was made, unchanged"
        )
    return mass, a


@contextmanager
def wrap_engine_errors(engine: str, advice: str) -> Iterator[None]:
    """Convert errors that an engine raises about unsuitable data to InputError with `advice`."""
    try:
        yield
    except LavenderError:
        raise
    except (RuntimeError, ValueError, TypeError, IndexError) as error:
        message = " ".join(str(error).split())
        raise InputError(f"{engine} does not accept these data: {message:.300}. {advice}") from None


def _check_model(pin: Any, model: Any, data: Any) -> None:
    """Check a model, its data and the indices of every joint, because Pinocchio does not check them."""
    if not isinstance(model, pin.Model) or not isinstance(data, pin.Data):
        raise InputError(
            f"got a {type(model).__name__} and a {type(data).__name__}; a pinocchio.Model and its Data are needed"
        )
    if len(model.mimicking_joints):
        raise CapabilityError(
            f"the model has {len(model.mimicking_joints)} mimicking joints; 0 are supported"
        )
    n, nv, nq = int(model.njoints), int(model.nv), int(model.nq)
    lists = ("joints", "parents", "idx_vs", "nvs", "idx_qs", "nqs", "inertias", "jointPlacements")
    short = [name for name in lists if len(getattr(model, name)) != n]
    if short or n < 1:
        raise InputError(
            f"the model has {n} joints, but its lists {', '.join(short)} have other lengths; one entry for "
            f"each joint is needed. {OTHER_MODEL_ADVICE}"
        )
    at_v = at_q = 0
    for i in range(1, n):
        joint = model.joints[i]
        places = (model.idx_vs[i], model.nvs[i], model.idx_qs[i], model.nqs[i])
        if (
            not 0 <= model.parents[i] < i
            or places != (at_v, joint.nv, at_q, joint.nq)
            or (joint.idx_v, joint.idx_q) != (at_v, at_q)
        ):
            raise InputError(
                f"joint {i} has parent {model.parents[i]} and (idx_v, nv, idx_q, nq) = {places}; a smaller "
                f"parent and ({at_v}, {joint.nv}, {at_q}, {joint.nq}) are needed. {OTHER_MODEL_ADVICE}"
            )
        if not _is_rotation(model.jointPlacements[i].rotation):
            raise InputError(f"the placement of joint {i} has a matrix that is not a rotation")
        at_v, at_q = at_v + joint.nv, at_q + joint.nq
    sizes = {len(data.oMi), len(data.v), len(data.f)}
    if (at_v, at_q) != (nv, nq) or sizes != {n} or np.shape(data.M) != (nv, nv):
        raise InputError(
            f"the data hold {len(data.oMi)} joints, and the model {n} joints with {nv} velocities; both "
            f"must belong together: create the data with model.createData(). {OTHER_MODEL_ADVICE}"
        )
    if not model.check(data):
        raise InputError(
            "Pinocchio's own check of the model and its data fails: the joints of a subtree must follow one another. "
            f"{OTHER_MODEL_ADVICE}"
        )


def _check_constraint(i: int, model: Any, constraint: Any, data: Any) -> None:
    """Check that the joints of constraint i belong to this model and its data to its kind."""
    kind = type(constraint).__name__
    if not hasattr(constraint, "createData") or not hasattr(constraint, "calc"):
        raise InputError(
            f"constraint model {i} is a {kind}; a constraint model of Pinocchio is needed"
        )
    if type(data).__name__ != kind.replace("Model", "Data"):
        raise InputError(
            f"constraint data {i} are a {type(data).__name__}; the data of a {kind} are needed"
        )
    for name in ("joint1_placement", "joint2_placement"):
        if hasattr(constraint, name) and not _is_rotation(getattr(constraint, name).rotation):
            raise InputError(
                f"constraint {i}, a {kind}: {name} has a matrix that is not a rotation"
            )
    if kind == "FrameAnchorConstraintModel" and np.any(constraint.desired_constraint_offset):
        raise CapabilityError(
            f"constraint {i}, a {kind}, has a desired offset, which Pinocchio does not read: put it into a placement"
        )
    joints = [
        getattr(constraint, name)
        for name in ("joint1_id", "joint2_id")
        if hasattr(constraint, name)
    ]
    for name in ("getSelectedJoints", "getActiveJoints"):
        if hasattr(constraint, name):
            joints += list(getattr(constraint, name)())
    velocities = list(constraint.getActiveDofs()) if hasattr(constraint, "getActiveDofs") else []
    n_velocities = int(getattr(constraint, "nv", model.nv))
    if (
        any(not 0 <= j < model.njoints for j in joints)
        or any(not 0 <= k < model.nv for k in velocities)
        or n_velocities != model.nv
    ):
        raise InputError(
            f"constraint {i}, a {kind}, refers to joints {joints} and {n_velocities} velocities; the model "
            f"has {model.njoints} joints and {model.nv} velocities. {OTHER_MODEL_ADVICE}"
        )


def _is_rotation(r: Any) -> bool:
    return bool(np.abs(r @ r.T - np.eye(3)).max() <= ROTATION_TOLERANCE and np.linalg.det(r) > 0.0)


def _unwrap_constraint(constraint: Any) -> Any:
    return constraint.extract() if hasattr(constraint, "extract") else constraint


def _convert_constraint(
    model: Any, data: Any, n: int, dt: float, correction: float
) -> tuple[Cones, Any, list[int]]:
    """Return the cones, the target (n,) [m/s, rad/s] and the order of the rows of one constraint."""
    kind = type(model).__name__
    order = list(range(n))
    if kind in ANCHORS:
        return Cones.free(n), -correction / dt * np.array(data.constraint_position_error), order
    if kind == "PointContactConstraintModel":
        gap = np.array([float(data.constraint_position_error[2]), 0.0, 0.0])
        return (
            Cones.contacts(float(model.getFriction())),
            compute_target_velocity(gap, dt, correction),
            [2, 0, 1],
        )
    if kind == "JointLimitConstraintModel":
        gap = np.array(data.constraint_residual, float)
        return (
            Cones.bounded(np.zeros(n), np.full(n, np.inf)),
            compute_target_velocity(gap, dt, correction),
            order,
        )
    if kind == "JointFrictionConstraintModel":
        low, high = np.array(model.getFrictionLowerLimit()), np.array(model.getFrictionUpperLimit())
        return Cones.bounded(dt * low, dt * high), np.zeros(n), order
    raise CapabilityError(
        f"a {kind} is not supported; anchors, points, joint limits and joint friction are"
    )


def compute_target_velocity(gap: Any, dt: float, correction: float) -> Any:
    """Return the target velocity for a gap: -gap / dt if it is open, -correction gap / dt if it is negative.

    An open gap may close within one step; a fraction `correction` of a penetration is removed.
    """
    return -np.where(gap > 0.0, 1.0, correction) * gap / dt
