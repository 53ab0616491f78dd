"""Read the last step of newton's `SolverMuJoCo`, of MuJoCo Warp or of MJX as a `StepRecord`, and give common names.

position, velocity = (x.numpy().copy() for x in (solver.mjw_data.qpos, solver.mjw_data.qvel))   # before the step
solver.step(state_in, state_out, control, contacts, dt)
record = lavender.io.step_from_newton_mujoco(solver, position, velocity)

position, velocity = data.qpos.numpy().copy(), data.qvel.numpy().copy()
mujoco_warp.step(warp_model, data)
record = lavender.io.step_from_warp(model, data, position, velocity)

after = mjx.step(mjx_model, before)
record = lavender.io.step_from_mjx(model, before, after)

record = lavender.io.align_step(record, other)           # names and order of another engine's record
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray, as_array, to_numpy
from lavender.base.errors import CapabilityError, InputError
from lavender.io.impedance import compute_impedance, measure_gap
from lavender.io.mujoco import find_mover
from lavender.io.mujoco_memory import import_mujoco
from lavender.io.mujoco_step import MODEL_TOLERANCE, StepReader, read_mass
from lavender.io.newton_mujoco import NEWTON_ADVICE
from lavender.io.step_record import ConstraintBlock, StepRecord, permute_velocities

FORCES = ("qfrc_smooth", "qfrc_damper", "qfrc_actuator", "qfrc_bias", "qacc")
ROW_ARRAYS = ("type", "id", "pos", "margin", "aref", "force", "frictionloss")
CONTACT_ARRAYS = (
    "dim",
    "dist",
    "friction",
    "solref",
    "solreffriction",
    "solimp",
    "geom",
    "pos",
    "frame",
)
SEPARATORS = re.compile("( of | between | and |^equality )")  # Of the names in a key.
CONTACT_FRICTIONLESS = 5  # The smallest value of mjtConstraint of a contact.
# [-] Rounding of float32 in R and in references, which are sums of large terms.
FLOAT32_TOLERANCE = 1e-3


def step_from_newton_mujoco(
    solver: Any,
    position: Any,
    velocity: Any,
    *,
    world: int = 0,
    engine: str = "newton SolverMuJoCo",
) -> StepRecord:
    """Return the last step of a `SolverMuJoCo` that runs MuJoCo Warp.

    Parameters
    ----------
    solver : newton.solvers.SolverMuJoCo
        After `step`.
    position, velocity : (n, nq), (n, nv)
        `solver.mjw_data.qpos` and `qvel` before the step, copied.
    world : int, default 0
    engine : str
        Name in sentences.

    Raises
    ------
    InputError
        `solver` is not a SolverMuJoCo with MuJoCo Warp, or an array has another shape.
    CapabilityError
        The integrator is neither Euler nor implicitfast, or attributes of this version are missing.
    """
    data, model = getattr(solver, "mjw_data", None), getattr(solver, "mj_model", None)
    if data is None or model is None:
        raise InputError(
            f"solver is a {type(solver).__name__}; a newton.solvers.SolverMuJoCo that runs MuJoCo Warp is needed"
        )
    mj = import_mujoco()
    kinds = mj.mjtIntegrator
    if int(model.opt.integrator) not in (int(kinds.mjINT_EULER), int(kinds.mjINT_IMPLICITFAST)):
        raise CapabilityError(
            "the integrator of this solver is not Euler or implicitfast, which are supported"
        )
    before = as_array("position", to_numpy("position", position)[world], (model.nq,))
    moving = as_array("velocity", to_numpy("velocity", velocity)[world], (model.nv,))
    try:
        # The length of a step is an argument of the solver's `step`, and gravity one of newton's model.
        option = solver.mjw_model.opt
        stepped = copy.copy(model)
        steps, gravity = option.timestep.numpy().ravel(), option.gravity.numpy().reshape(-1, 3)
        stepped.opt.timestep = float(steps[world % len(steps)])
        stepped.opt.gravity[:] = gravity[world % len(gravity)]
        return _read_warp(mj, stepped, data, before, moving, world, engine)
    except AttributeError as error:
        raise CapabilityError(
            f"an attribute of this solver is missing: {error}. {NEWTON_ADVICE}"
        ) from None


def step_from_warp(
    model: Any,
    data: Any,
    position: Any,
    velocity: Any,
    *,
    world: int = 0,
    engine: str = "MuJoCo Warp",
) -> StepRecord:
    """Return the last step of MuJoCo Warp.

    Parameters
    ----------
    model : mujoco.MjModel
        From which the engine's model was made.
    data : mujoco_warp.Data
        After `mujoco_warp.step`.
    position, velocity : (n, nq), (n, nv)
        `data.qpos` and `data.qvel` before the step, copied.
    world : int, default 0
    engine : str
        Name in sentences.

    Raises
    ------
    InputError
        `model` is not a model of MuJoCo, or an array has another shape.
    CapabilityError
        The integrator is neither Euler nor implicitfast, or attributes of this version are missing.
    """
    mj = import_mujoco()
    _check_model(mj, model)
    if not hasattr(data, "efc") or not hasattr(data, "nacon"):
        raise InputError(f"data is a {type(data).__name__}; the data of mujoco_warp are needed")
    before = as_array("position", to_numpy("position", position)[world], (model.nq,))
    moving = as_array("velocity", to_numpy("velocity", velocity)[world], (model.nv,))
    try:
        return _read_warp(mj, model, data, before, moving, world, engine)
    except AttributeError as error:
        raise CapabilityError(f"an attribute of these data is missing: {error}") from None


def _check_model(mj: Any, model: Any) -> None:
    """Raise an error unless the model is MuJoCo's, with an integrator that MJX and MuJoCo Warp have in common."""
    if not isinstance(model, mj.MjModel):
        raise InputError(f"model is a {type(model).__name__}; a mujoco.MjModel is needed")
    kinds = mj.mjtIntegrator
    if int(model.opt.integrator) not in (int(kinds.mjINT_EULER), int(kinds.mjINT_IMPLICITFAST)):
        raise CapabilityError(
            "the integrator of this model is not Euler or implicitfast, which are supported"
        )


def _read_warp(
    mj: Any, model: Any, data: Any, position: FloatArray, velocity: FloatArray, world: int, engine: str
) -> StepRecord:  # fmt: skip
    """Return the last step of one world of MuJoCo Warp's data."""
    n = int(data.nefc.numpy()[world])
    rows = {x: getattr(data.efc, x).numpy()[world][:n] for x in (*ROW_ARRAYS, "D", "vel")}
    jac = data.efc.J.numpy()
    if jac.ndim != 3 or jac.shape[1] < n or jac.shape[2] < model.nv:
        raise CapabilityError("the Jacobian is sparse; set opt.jacobian of the solver to dense")
    forces = {x: getattr(data, x).numpy()[world] for x in FORCES}
    count = min(int(data.nacon.numpy()[0]), len(data.contact.dim))
    contacts = {x: getattr(data.contact, x).numpy()[:count] for x in CONTACT_ARRAYS}
    control, activation = (getattr(data, x).numpy()[world] for x in ("ctrl", "act"))
    reader = ArrayReader(
        mj, model, position, velocity, control, activation, rows | {"J": jac[world][:n]}, forces,
        contacts, data.M.numpy()[world], "float32",
    )  # fmt: skip
    return reader.build(engine, data.qvel.numpy()[world].astype(float), "acceleration")


def step_from_mjx(model: Any, before: Any, after: Any, *, engine: str = "MJX") -> StepRecord:
    """Return a step of MJX in its implementation in JAX.

    Parameters
    ----------
    model : mujoco.MjModel
        From which the engine's model was made.
    before, after : mujoco.mjx.Data
        Argument and result of `mjx.step`, of one world.
    engine : str
        Name in sentences.

    Raises
    ------
    InputError
        `model` is not a model of MuJoCo, or the data are those of several worlds.
    CapabilityError
        The integrator is neither Euler nor implicitfast; the rows are not the ones of the model's constraints; or
        attributes of this version are missing.
    """
    mj = import_mujoco()
    _check_model(mj, model)
    try:
        inner = getattr(after, "_impl", after)
        position, velocity = (np.asarray(getattr(before, x), float) for x in ("qpos", "qvel"))
        if position.shape != (model.nq,) or velocity.shape != (model.nv,):
            raise InputError(
                f"qpos and qvel of before have shapes {position.shape} and {velocity.shape}; ({model.nq},) and "
                f"({model.nv},) of one world are needed"
            )
        jac = np.asarray(inner.efc_J)
        names = "pos", "margin", "aref", "force", "frictionloss", "D"
        rows = {x: np.asarray(getattr(inner, f"efc_{x}")) for x in names}
        rows |= {"J": jac, "vel": jac @ velocity, "type": np.asarray(inner.efc_type)}
        contacts = {x: np.asarray(getattr(inner.contact, x)) for x in CONTACT_ARRAYS}
        forces = {x: np.asarray(_get(after, inner, x)) for x in FORCES if x != "qfrc_damper"}
        rows["id"] = _number_rows(mj, model, rows["type"], inner.contact)
        if len(rows["type"]) != len(jac):
            raise CapabilityError(
                f"MJX has {len(jac)} rows for {len(rows['type'])} of the model's constraints, which is not supported"
            )
        # Rows of a constraint that is not active are 0; one row of an active one may be.
        own = rows["type"] * (1 + rows["id"].max(initial=0)) + rows["id"]
        used = np.isin(own, own[np.abs(jac).max(axis=1, initial=0.0) > 0.0])
        is_single = jac.dtype == np.float32
        reader = MjxReader(
            mj, model, position, velocity, np.asarray(before.ctrl), np.asarray(before.act),
            {k: x[used] for k, x in rows.items()}, forces, contacts, np.asarray(_get(after, inner, "M", "qM")),
            "float32" if is_single else "float64",
        )  # fmt: skip
        moved_by = find_mover(mj, model, model.opt.integrator, False, False)
        return reader.build(engine, np.asarray(after.qvel, float), moved_by)
    except AttributeError as error:
        raise CapabilityError(f"an attribute of these data is missing: {error}") from None


def _get(data: Any, inner: Any, *names: str) -> Any:
    """Return the first of some arrays that the data or their inner part have."""
    for name in names:
        for owner in (data, inner):
            if hasattr(owner, name):
                return getattr(owner, name)
    raise AttributeError(" or ".join(names))


def _number_rows(mj: Any, model: Any, kinds: IntArray, contact: Any) -> np.ndarray:
    """Return the number of the constraint of each row of MJX, in its order."""
    numbers: list[int] = []
    types = mj.mjtEq
    for kind, size in (("CONNECT", 3), ("WELD", 6), ("JOINT", 1), ("TENDON", 1)):
        own = np.flatnonzero(model.eq_type == int(getattr(types, f"mjEQ_{kind}")))
        numbers += np.repeat(own, size).tolist()
    numbers += np.flatnonzero(model.dof_frictionloss > 0).tolist()
    numbers += np.flatnonzero(model.tendon_frictionloss > 0).tolist()
    limited = np.flatnonzero(model.jnt_limited)
    is_ball = model.jnt_type[limited] == int(mj.mjtJoint.mjJNT_BALL)
    numbers += [*limited[is_ball].tolist(), *limited[~is_ball].tolist()]
    numbers += np.flatnonzero(model.tendon_limited).tolist()
    result = np.full(len(kinds), -1, np.int64)
    first = int(np.count_nonzero(kinds < CONTACT_FRICTIONLESS))
    result[:first] = np.resize(numbers, first) if numbers else -1
    for k, start in enumerate(np.asarray(contact.efc_address)):
        dim = int(np.asarray(contact.dim)[k])
        is_pyramid = dim > 1 and int(model.opt.cone) == int(mj.mjtCone.mjCONE_PYRAMIDAL)
        result[start : start + (2 * (dim - 1) if is_pyramid else dim)] = k
    return result


class ArrayReader(StepReader):
    """Arrays of another engine after a step, with MuJoCo's kinematics of the state before it.

    Parameters
    ----------
    rows : dict of (m, ...) arrays
        `ROW_ARRAYS`, J, D and vel of the constraint rows of the step.
    forces : dict of (nv,) arrays
        `FORCES`; MuJoCo's own where one is missing.
    contacts : dict of (n, ...) arrays
        `CONTACT_ARRAYS`; `efc_id` of a contact's row counts them.
    """

    def __init__(
        self, mj: Any, model: Any, position: FloatArray, velocity: FloatArray, control: FloatArray,
        activation: FloatArray, rows: Mapping[str, Any], forces: Mapping[str, Any],
        contacts: Mapping[str, Any], mass: Any, precision: str,
    ) -> None:  # fmt: skip
        self.mj, self.model = mj, model
        self.is_discrete = False
        self.precision = precision
        self.tolerance = FLOAT32_TOLERANCE if precision == "float32" else MODEL_TOLERANCE
        self.name_elements()
        host = self.host = mj.MjData(model)
        host.qpos[:], host.qvel[:] = position, velocity
        if model.nu:
            host.ctrl[:] = control
        if model.na:
            host.act[:] = activation
        mj.mj_forward(model, host)
        self.mass_values = np.asarray(mass, float)
        self.jacobian = np.asarray(rows["J"], float)[:, : self.nv]
        integers = "type", "id"
        named = {
            f"efc_{x}": np.asarray(rows[x], int if x in integers else float) for x in ROW_ARRAYS
        }
        kinds = {k: np.asarray(x) for k, x in contacts.items()}
        kinds = {k: x if x.dtype.kind == "i" else x.astype(float) for k, x in kinds.items()}
        contact = [
            SimpleNamespace(**{k: x[i] for k, x in kinds.items()}) for i in range(len(kinds["dim"]))
        ]
        self.data = SimpleNamespace(
            nefc=len(self.jacobian), contact=contact, efc_R=1.0 / np.asarray(rows["D"], float),
            efc_vel=np.asarray(rows["vel"], float), qpos=position, qvel=velocity, **named,
            **{x: np.asarray(forces.get(x, getattr(host, x)), float) for x in FORCES},
        )  # fmt: skip

    def measure_added_matrix(self, mass: FloatArray) -> FloatArray:
        """Return H (nv, nv) by MuJoCo's integrator with its own M, which is not rounded to float32."""
        return super().measure_added_matrix(read_mass(self.mj, self.model, self.host))

    def read_mass(self) -> FloatArray:
        """Return M (nv, nv), which Warp stores as lower triangles in compressed rows, or densely."""
        values, model, nv = self.mass_values, self.model, self.nv
        if values.ndim == 2 and min(values.shape) >= nv:
            return values[:nv, :nv]
        values = values.ravel()
        mass = np.zeros((nv, nv))
        for i in range(nv):
            entries = slice(model.M_rowadr[i], model.M_rowadr[i] + model.M_rownnz[i])
            columns = model.M_colind[entries]
            mass[i, columns] = mass[columns, i] = values[entries]
        return mass

    def read_actuator_matrix(self) -> FloatArray:
        """Return minus the derivative of actuator forces, by MuJoCo's own moments of the same state."""
        own, self.data = self.data, self.host
        try:
            return super().read_actuator_matrix()
        finally:
            self.data = own

    def read_rates(
        self, block: ConstraintBlock, rows: IntArray, rates: FloatArray, springs: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return B, K d and d of the impedance model: Warp does not store its own."""
        impedance = compute_impedance(block.softness.solimp, measure_gap(block))
        return rates.copy(), springs.copy(), np.full(len(rows), impedance)

    def read_forces_before_noslip(self, groups: Any) -> None:
        """Return None: Warp has no pass against slip."""
        return


class MjxReader(ArrayReader):
    """Arrays of MJX after a step."""

    def measure_added_matrix(self, mass: FloatArray) -> FloatArray:
        """Return H (nv, nv): of dampings and actuators, without MuJoCo's gyroscopic terms of free bodies."""
        option, bits = self.model.opt, self.mj.mjtDisableBit
        if int(option.integrator) != int(self.mj.mjtIntegrator.mjINT_EULER):
            return self.dt * (self.read_damping() + self.read_actuator_matrix())
        is_explicit = int(option.disableflags) & int(bits.mjDSBL_EULERDAMP)
        dampings = np.diag(np.array(self.model.dof_damping, float))
        return self.dt * (0.0 if is_explicit else 1.0) * dampings


def align_step(record: StepRecord, like: StepRecord) -> StepRecord:
    """Return a record with the names of bodies and joints, and the order of velocities, of another engine's record.

    A name belongs to the only name of `like` that it equals or ends with, as "world/hand/finger_1" and "finger_1".

    Parameters
    ----------
    record, like : StepRecord

    Raises
    ------
    InputError
        A velocity of one record has no partner in the other one, or several.
    """
    for name, value in (("record", record), ("like", like)):
        if not isinstance(value, StepRecord):
            raise InputError(f"{name} is a {type(value).__name__}; a StepRecord is needed")
    velocities = match_names(record.names, like.names)
    known = list(velocities.values())
    missing = sorted(set(like.names) - set(known))
    if len(record.names) != len(like.names) or missing or len(set(known)) < len(known):
        raise InputError(
            f"velocities of both records do not correspond: {', '.join(missing[:3]) or 'a name'} of like has no unique "
            "partner in the record (lavender.io.permute_velocities gives it other names)"
        )
    order = [known.index(name) for name in like.names]
    own = sorted({name for key in record.weights for name in _split_key(key)})
    theirs = sorted({name for key in like.weights for name in _split_key(key)})
    names = match_names(own, theirs)
    moved = permute_velocities(record, order, like.names)
    return replace(
        moved,
        blocks=tuple(_rename_block(x, names) for x in moved.blocks),
        weights={_rename_key(k, names): x for k, x in record.weights.items()},
        softnesses={_rename_key(k, names): x for k, x in record.softnesses.items()},
        position=None,
    )


def match_names(own: Sequence[str], theirs: Sequence[str]) -> dict[str, str]:
    """Return for each own name the longest of the other names that it equals or ends with after a separator."""
    result = {}
    for name in own:
        fitting = [x for x in theirs if name == x or name.endswith(("_" + x, "/" + x))]
        result[name] = max(fitting, key=len) if fitting else name
    return result


def _split_key(key: str) -> list[str]:
    """Return the names of bodies, joints or equalities in a key."""
    return SEPARATORS.split(key)[::2]


def _rename_key(key: str, names: Mapping[str, str]) -> str:
    """Return a key with the other engine's name."""
    return "".join(names.get(x, x) for x in SEPARATORS.split(key))


def _rename_block(block: ConstraintBlock, names: Mapping[str, str]) -> ConstraintBlock:
    """Return a block with the other engine's names; geoms of two engines are not compared."""
    if block.role != "contact":
        return replace(block, key=_rename_key(block.key, names))
    bodies = tuple(names.get(x, x) for x in block.bodies)
    return replace(
        block,
        key=f"contact of {' and '.join(sorted(bodies))}",
        bodies=bodies,
        geoms=(),
        geom_keys=(),
    )
