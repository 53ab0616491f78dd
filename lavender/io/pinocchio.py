"""Pinocchio's model and constraint models as a problem in generalised coordinates.

    w = J v+ - target + compliance lambda,   v+ = v* + M^-1 J^T lambda,   v* = v + dt aba(q, v, tau)

M is `crba`'s, J each constraint's own Jacobian, rows in the order of the constraint models. In one step of dt

    anchors (point, frame)   all rows free,           target = -correction error / dt
    point contacts           Coulomb's cone, z first, target = -gap / dt along z, `correction` of it where gap < 0
    joint limits             lambda >= 0,             the same with the distance to the limit
    joint friction           |lambda| <= dt times the model's limits, target = 0

A contact's z axis points from the first joint's side to the second's: w > 0 along it is separation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from lavender._arrays import as_array
from lavender.cones import Cones
from lavender.errors import CapabilityError, InputError
from lavender.problem import Problem

__all__ = ["from_pinocchio"]

UNSEEN = 1e-9  # -, of |M| |a| + |tau - h|: M a must be what aba solved for


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
    name: str = "pinocchio",
) -> Problem:
    """The constraint problem of one step of a Pinocchio model.

    Parameters
    ----------
    model : pinocchio.Model
    data : pinocchio.Data
        Computed anew at q and v.
    constraint_models, constraint_datas : sequence
        Of Pinocchio 4: anchors, contacts, joint limits, joint friction, plain or as `ConstraintModel`; calculated anew.
    dt : float, s
    q : (nq,)
    v : (nv,) m/s, rad/s
        Before the step.
    tau : (nv,) N, N m, optional
        Joint efforts; default: none.
    friction : {"coulomb", "cone"}
    compliance : scalar or (m,) 1/kg, optional
        Default: none. What Pinocchio's constraint models hold of their own is not read.
    correction : float, default 0.2
        Share of a position error that the step takes back.

    Returns
    -------
    Problem

    Raises
    ------
    InputError
        Pinocchio cannot be imported, or what is given does not fit.
    CapabilityError
        A constraint model of another kind; accelerations that are not those of M.
    """
    try:
        import pinocchio as pin
    except ImportError:
        raise InputError("pinocchio cannot be imported: pip install pin; a model comes from it") from None
    if not isinstance(model, pin.Model) or not isinstance(data, pin.Data):
        raise InputError(
            f"got a {type(model).__name__} and a {type(data).__name__}; a pinocchio.Model and its Data are needed"
        )
    if len(constraint_models) != len(constraint_datas):
        raise InputError(
            f"{len(constraint_datas)} constraint data for {len(constraint_models)} models; one for each is needed"
        )
    dt, correction = float(dt), float(correction)
    if not 0.0 < dt < math.inf or not 0.0 <= correction <= 1.0:
        raise InputError(
            f"dt is {dt:g} s, correction {correction:g}; a time above 0 and a share in [0, 1] are needed"
        )
    nv = int(model.nv)
    q = np.array(as_array("q", q, (int(model.nq),)))
    v = np.array(as_array("v", v, (nv,), unit="m/s, rad/s"))
    tau = np.array(as_array("tau", 0.0 if tau is None else tau, (nv,), unit="N, N m"))
    a = np.array(pin.aba(model, data, q, v, tau))
    force = tau - np.array(pin.nle(model, data, q, v))
    upper = np.triu(np.array(pin.crba(model, data, q)))
    mass = upper + np.triu(upper, 1).T
    if np.abs(mass @ a - force).max(initial=0.0) > UNSEEN * float(
        (np.abs(mass) @ np.abs(a) + np.abs(force)).max()
    ):
        raise CapabilityError(
            "M aba(q, v, tau) differs from tau - nle(q, v): these are not accelerations of this M"
        )
    pin.forwardKinematics(model, data, q, v)
    pin.computeJointJacobians(model, data, q)
    rows: list[Any] = [np.zeros((0, nv))]
    targets: list[Any] = [np.zeros(0)]
    cones, names = Cones.free(0), []
    for i, (wrapped, kept) in enumerate(zip(constraint_models, constraint_datas, strict=True)):
        model_of, data_of = _plain(wrapped), _plain(kept)
        model_of.calc(model, data, data_of)
        jac = np.array(model_of.jacobian(model, data, data_of)).reshape(-1, nv)
        more, target, order = _constraint(model_of, data_of, len(jac), dt, correction)
        rows.append(jac[order])
        targets.append(target)
        cones = cones + more
        word = f"{type(model_of).__name__.removesuffix('ConstraintModel')} {i}"
        names += [word] if more.n_blocks == 1 else [f"{word}, row {k}" for k in range(more.n_blocks)]
    return Problem.from_jacobian(
        np.concatenate(rows),
        mass,
        v + dt * a,
        target=np.concatenate(targets),
        cones=cones,
        compliance=compliance,
        friction=friction,
        names=names,
        name=name,
    )


def _plain(given: Any) -> Any:
    return given.extract() if hasattr(given, "extract") else given


def _constraint(model: Any, data: Any, n: int, dt: float, correction: float) -> tuple[Cones, Any, list[int]]:
    """Cones, target (n,) and order of one constraint's rows."""
    kind = type(model).__name__
    order = list(range(n))
    if kind in ("PointAnchorConstraintModel", "FrameAnchorConstraintModel"):
        return Cones.free(n), -correction / dt * np.array(data.constraint_position_error), order
    if kind == "PointContactConstraintModel":
        gap = np.array([float(data.constraint_position_error[2]), 0.0, 0.0])
        return Cones.contacts(float(model.getFriction())), closing_speed(gap, dt, correction), [2, 0, 1]
    if kind == "JointLimitConstraintModel":
        gap = np.array(data.constraint_residual, float)
        return Cones.bounded(np.zeros(n), np.full(n, np.inf)), closing_speed(gap, dt, correction), order
    if kind == "JointFrictionConstraintModel":
        low, high = np.array(model.getFrictionLowerLimit()), np.array(model.getFrictionUpperLimit())
        return Cones.bounded(dt * low, dt * high), np.zeros(n), order
    raise CapabilityError(
        f"a {kind} is not known here; anchors, point contacts, joint limits and joint friction are"
    )


def closing_speed(gap: Any, dt: float, correction: float) -> Any:
    # What is apart may come as near as it is in one step; what is too near moves apart by a share.
    return -np.where(gap > 0.0, 1.0, correction) * gap / dt
