"""Read the last step of newton's `SolverMuJoCo` (MuJoCo Warp) as a `StepRecord`, and give records common names.

position, velocity = (x.numpy().copy() for x in (solver.mjw_data.qpos, solver.mjw_data.qvel))   # before the step
solver.step(state_in, state_out, control, contacts, dt)
record = lavender.io.step_from_newton_mujoco(solver, position, velocity)
record = lavender.io.align_step(record, other)           # names and order of another engine's record
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray, as_array, to_numpy
from lavender.base.errors import CapabilityError, InputError
from lavender.io.impedance import compute_impedance, measure_gap
from lavender.io.mujoco_memory import import_mujoco
from lavender.io.mujoco_step import StepReader
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
        reader = WarpReader(mj, model, data, before, moving, world)
        after = data.qvel.numpy()[world].astype(float)
        return reader.build(engine, after, "acceleration")
    except AttributeError as error:
        raise CapabilityError(
            f"an attribute of this solver is missing: {error}. {NEWTON_ADVICE}"
        ) from None


class WarpReader(StepReader):
    """Arrays of one world of MuJoCo Warp after a step, with MuJoCo's kinematics of the state before it."""

    tolerance = FLOAT32_TOLERANCE
    precision = "float32"

    def __init__(
        self, mj: Any, model: Any, data: Any, position: FloatArray, velocity: FloatArray, world: int
    ) -> None:
        self.mj, self.model = mj, model
        self.is_discrete = False
        self.name_elements()
        host = self.host = mj.MjData(model)
        host.qpos[:], host.qvel[:] = position, velocity
        if model.nu:
            host.ctrl[:] = data.ctrl.numpy()[world]
        if model.na:
            host.act[:] = data.act.numpy()[world]
        mj.mj_forward(model, host)
        n = int(data.nefc.numpy()[world])
        rows = {f"efc_{x}": getattr(data.efc, x).numpy()[world][:n] for x in ROW_ARRAYS}
        rows = {k: x.astype(int if k in ("efc_type", "efc_id") else float) for k, x in rows.items()}
        jac = data.efc.J.numpy()
        if jac.ndim != 3 or jac.shape[1] < n or jac.shape[2] < self.nv:
            raise CapabilityError("the Jacobian is sparse; set opt.jacobian of the solver to dense")
        self.jacobian = jac[world][:n, : self.nv].astype(float)
        arrays = {x: getattr(data, x).numpy()[world].astype(float) for x in FORCES}
        self.mass_values = data.M.numpy()[world].astype(float)
        contacts = {x: getattr(data.contact, x).numpy() for x in CONTACT_ARRAYS}
        count = int(data.nacon.numpy()[0])
        contact = [
            SimpleNamespace(
                **{
                    k: x[i] if x[i].dtype == np.int32 else x[i].astype(float)
                    for k, x in contacts.items()
                }
            )
            for i in range(min(count, len(contacts["dim"])))
        ]
        moving = data.efc.vel.numpy()[world][:n].astype(float)
        self.data = SimpleNamespace(
            nefc=n, contact=contact, efc_R=1.0 / data.efc.D.numpy()[world][:n].astype(float),
            efc_vel=moving, qpos=position, qvel=velocity, **rows, **arrays,
        )  # fmt: skip

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
            "partner in the record"
        )
    order = [known.index(name) for name in like.names]
    own = sorted({name for key in record.weights for name in _split_key(key)})
    theirs = sorted({name for key in like.weights for name in _split_key(key)})
    names = match_names(own, theirs)
    blocks = tuple(_rename_block(x, names) for x in record.blocks)
    moved = permute_velocities(record, order, like.names)
    return replace(
        moved,
        blocks=tuple(replace(x, jacobian=x.jacobian[:, order]) for x in blocks),
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
    """Return the names of a body or joint in a key of weights."""
    return [key.rpartition(" of ")[2]]


def _rename_key(key: str, names: Mapping[str, str]) -> str:
    """Return a key with the other engine's name."""
    head, of, name = key.rpartition(" of ")
    return f"{head}{of}{names.get(name, name)}"


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
