"""Convert many MuJoCo constraint problems at once, from MuJoCo states or from the arrays of MJX and MuJoCo Warp.

    imported = lavender.io.from_mujoco_many(model, states)
    many = lavender.solve_many(imported.batch)
    lavender.residual_many(imported.batch, imported.impulse).verdict        # judge MuJoCo's own answers

Each problem equals the one that `lavender.io.mujoco` builds, with the same order of rows. With the time step dt:

    v* = qvel + dt a0      target = dt aref + J qvel      compliance = 1 / D      lambda = dt f

Tangents of an elliptic contact are scaled by friction[j] / friction[0]. float32 numbers are converted exactly, and the
judge uses the round-off floor of float32. MJX and Warp pad worlds with rows of zeros, which have no effect.
"""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np

from lavender.base.array_libraries import find_converter
from lavender.base.arrays import (
    FloatArray,
    as_array,
    as_float_array,
    check_choice,
    check_float,
    check_int,
    get_common_precision,
    get_shape,
)
from lavender.base.errors import CapabilityError, InputError
from lavender.base.threads import run_on_threads
from lavender.batch.data import ERRORS, Batch, check_row_counts, check_shared_lower_triangles
from lavender.io import mujoco as single
from lavender.io.engine_motion import MOVERS
from lavender.io.mujoco_discrete import MASS_TOLERANCE, compute_discrete_matrix
from lavender.io.mujoco_memory import CHANGED_ADVICE, import_mujoco, read_sizes, read_step
from lavender.io.rest import set_worlds_at_rest
from lavender.io.start_states import can_sleep
from lavender.io.stiff_rows import make_engine_batch
from lavender.problem import FRICTION_LAWS
from lavender.problem.cones import Cones, get_block_kinds
from lavender.problem.generalized import Compressed
from lavender_ext.core.blocks import concatenate_blocks
from lavender_ext.io.mujoco_rows import copy_rows, copy_state, join_worlds

# Values of mjtConstraint: equality; friction loss of a joint and of a tendon; elliptic contact, the largest value.
# Rows of all other types have impulses >= 0.
EQUALITY = 0
FRICTION = (1, 2)
ELLIPTIC = 7
ONE_SIDED = (
    3,
    4,
    5,
    6,
)  # Limits of joints and tendons, contacts without friction, edges of pyramids.
MAX_CONTACT_ROWS = 6  # The largest condim: a contact has a normal and up to five friction rows.
CHUNK_ENTRIES = 2**21  # Number of entries of J that are converted to float64 at a time.
# Largest accepted difference of M a0 and the smooth force, relative to their size: 64 roundings in float64; more in
# float32, in which the factors of M are rounded, too.
MASS_TOLERANCES = {"float64": MASS_TOLERANCE, "float32": 2.0**-14}


# MuJoCo restarts a simulation at a larger acceleration (mjMAXVAL) [m/s^2, rad/s^2]; MJX and MuJoCo Warp continue.
MAX_ACCELERATION = 1e10
# [-] A force that differs by more from the force that follows from qacc is one of an earlier step. Differences of
# one step are roundings, which `FORCE_ROUNDING` bounds relative to the terms of the force.
OLD_FORCE_TOLERANCE, FORCE_ROUNDING = 0.1, 1e-4
NEFC_ADVICE = "MuJoCo Warp leaves rows of earlier steps beyond nefc: pass nefc of the step"


class Imported(NamedTuple):
    """Problems of many worlds, and the engine's own answers."""

    batch: Batch
    impulse: FloatArray | None  # [N s] dt efc_force in the rows and in the shape of the batch.


@np.errstate(divide="ignore", over="ignore", invalid="ignore")  # Unused rows may hold any numbers.
def from_efc(
    *,
    efc_J: Any,
    efc_D: Any,
    efc_aref: Any,
    efc_type: Any,
    M: Any,
    qvel: Any,
    qacc_smooth: Any,
    timestep: float,
    efc_frictionloss: Any = 0.0,
    nefc: Any = None,
    contacts: tuple[Any, Any, Any, Any] | None = None,
    efc_force: Any = None,
    qfrc_smooth: Any = None,
    qacc: Any = None,
    moved_by: str = "acceleration",
    friction: str = "cone",
    like: Any = None,
) -> Imported:
    """Build constraint problems from stacked arrays of n worlds with at most m rows each, in float32 or float64.

    Parameters
    ----------
    efc_J : (n, m, nv)
    efc_D, efc_aref : (n, m)
    efc_type : (n, m) or (m,) int
        Values of mjtConstraint, 0 to 7.
    M : (n, nv, nv)
        Mass matrix, both triangles. Or its lower triangles in compressed rows, as MuJoCo Warp stores them: (values
        (n, entries), indices, indptr).
    qvel, qacc_smooth : (n, nv)
        Velocity before the step and unconstrained acceleration.
    timestep : float, s
    efc_frictionloss : scalar, (n, m) or (m,)
        Read on rows of friction loss.
    nefc : (n,) int, optional
        Number of rows in use, 0 to m; default m. The rows behind them are not read. MuJoCo Warp leaves rows of earlier
        steps there.
    contacts : (world, efc_address, dim, friction), optional
        Arrays of the contacts: (c,), (c,), (c,) int and (c, 5). A contact is read if `efc_address` is an elliptic row
        in use, and ignored otherwise. The contacts that are read must cover each elliptic row exactly once.
    efc_force : (n, m), optional
        The engine's answer.
    qfrc_smooth : (n, nv), optional
        Force without constraints. If given, it must equal M qacc_smooth to the precision of the data.
    qacc : (n, nv), optional
        The engine's acceleration. If a number of a world is not finite or above 1e10, the engine's answer is not
        usable, whatever its forces are: all impulses of this world are NaN.
    moved_by : {"acceleration", "forces"}
        Quantity that the engine's integrator uses, if qacc is given. MJX moves bodies by forces with `implicitfast`,
        and with Euler unless eulerdamp is disabled; MuJoCo Warp by qacc always. An acceleration is judged by the
        distance of its velocities from the exact solution.
    friction : {"cone", "coulomb"}, default "cone"
        Law of elliptic contacts: "cone" is MuJoCo's convex relaxation. Engines that solve the Signorini condition with
        Coulomb's law need "coulomb"; their contacts have three rows and one coefficient for both tangents.
    like : array, optional
        The impulses are returned as an array of this array's library, as by `solve_many`. Default: NumPy.

    Returns
    -------
    Imported
        The batch, and `impulse` if `efc_force` was given.

    Warns
    -----
    UserWarning
        nefc is not given, and forces do not follow from qacc: they are of an earlier step, or of noslip iterations.

    Raises
    ------
    InputError
        Shapes do not fit; an efc_type is not a value of mjtConstraint; a D is not above 0; a friction loss is below 0;
        an elliptic row is named by no contact or by several.
    CapabilityError
        M qacc_smooth is not the smooth force: the problem was built with another matrix. Or friction="coulomb" for a
        contact with torsional or rolling friction, or with different coefficients of its tangents.
    """
    friction = check_choice("friction", friction, FRICTION_LAWS)
    check_choice("moved_by", moved_by, MOVERS)
    convert = find_converter(like)
    jac, before = as_float_array("efc_J", efc_J), as_float_array("qvel", qvel)
    # MJX and Warp store the time step as an array of one number.
    is_one = np.prod(get_shape("timestep", timestep)) == 1
    dt = check_float("timestep", np.asarray(timestep).item() if is_one else timestep, above=0.0)
    if jac.ndim != 3:
        raise InputError(f"efc_J has shape {jac.shape}; (n, m, nv) is needed")
    n, m, nv = jac.shape
    inv_compliance = as_array("efc_D", efc_D, (n, m), finite=False)
    aref = as_array("efc_aref", efc_aref, (n, m), finite=False)
    target = dt * aref
    smooth = as_array("qacc_smooth", qacc_smooth, (n, nv), finite=False)
    row_type = _broadcast_numbers_to_rows("efc_type", efc_type, n, m)
    loss = _broadcast_numbers_to_rows("efc_frictionloss", efc_frictionloss, n, m)
    count = np.full(n, m) if nefc is None else check_row_counts("nefc", nefc, n, m)
    used_rows = np.arange(m) < count[:, None]
    is_type = (row_type >= 0.0) & (row_type <= ELLIPTIC) & (row_type == np.rint(row_type))
    _check_rows("efc_type", row_type, used_rows & ~is_type, "a value of mjtConstraint, 0 to 7,")
    _check_rows("efc_D", inv_compliance, used_rows & (inv_compliance <= 0.0), "above 0")
    has_loss = used_rows & ((row_type == FRICTION[0]) | (row_type == FRICTION[1]))
    is_wrong = has_loss & ~((loss >= 0.0) & (loss < np.inf))
    _check_rows("efc_frictionloss", loss, is_wrong, "a finite number of at least 0")
    mass = _convert_mass(M, n, nv)
    precision = get_common_precision(jac, mass, before)
    before = as_array("qvel", before, (n, nv), finite=False)
    if qfrc_smooth is not None:
        # M a0 must be the unconstrained force, up to MASS_TOLERANCES.
        force = as_array("qfrc_smooth", qfrc_smooth, (n, nv), finite=False)
        dense = mass.astype(float)
        gap = np.abs(np.einsum("nij,nj->ni", dense, smooth) - force).max(axis=1, initial=0.0)
        size = np.einsum("nij,nj->ni", np.abs(dense), np.abs(smooth)).max(axis=1, initial=0.0)
        bad = np.flatnonzero(gap > MASS_TOLERANCES[precision] * size)
        if len(bad):
            raise CapabilityError(
                f"world {bad[0]}: M qacc_smooth differs from qfrc_smooth by {(gap / size)[bad[0]]:.1e} of their size: "
                "give the M of this step, and use an integrator that does not add damping to M"
            )
    free = before + dt * smooth
    step = max(1, CHUNK_ENTRIES // max(1, m * nv))
    for i in range(0, n, step):
        target[i : i + step] += np.einsum(
            "nij,nj->ni", jac[i : i + step].astype(float), before[i : i + step]
        )
    compliance = np.where(used_rows, 1.0 / inv_compliance, 0.0)
    cones, scale = _make_blocks(row_type, loss, used_rows, contacts, dt)
    if friction == "coulomb" and (scale is not None or cones.has_round):
        raise CapabilityError(
            "friction='coulomb' is for contacts of three rows with one coefficient; a contact with torsional or "
            "rolling friction, or with different coefficients of its tangents, has the law 'cone' only"
        )
    if scale is not None:
        jac = jac * scale[:, :, None].astype(jac.dtype)
        target = target * scale
        compliance = compliance * scale * scale
    target[~used_rows] = 0.0
    set_worlds_at_rest(jac.reshape(-1, nv), free, target.reshape(-1), m * np.arange(n + 1))

    def make_batch(soft: FloatArray) -> Batch:
        batch = Batch(
            jac,
            mass,
            free,
            target=target,
            cones=cones,
            compliance=soft,
            friction=friction,
            count=count,
        )
        batch.precision = precision
        return batch

    if efc_force is None:
        return Imported(make_engine_batch(make_batch, compliance), None)
    force = as_array("efc_force", efc_force, (n, m), finite=False)
    lam = np.where(used_rows, dt * force, 0.0)
    change = None
    lam = lam if scale is None else lam / scale
    if qacc is not None:
        acceleration = as_array("qacc", qacc, (n, nv), finite=False)
        lam[~(np.abs(acceleration) <= MAX_ACCELERATION).all(axis=1)] = np.nan
        change = dt * (acceleration - smooth)
        if nefc is None:
            _warn_of_old_forces(jac, inv_compliance, aref, row_type, force, acceleration)
    batch = make_engine_batch(make_batch, compliance, lam, change, moved_by)
    return Imported(batch, lam if convert is None else convert(lam))


class MujocoScratch:
    """An `MjData` that calls of `from_mujoco_many` on one model reuse: making one takes longer than a few worlds.

    A call in another thread while a call uses the data makes its own. The data are made anew if sizes of the model
    change, and are freed with this object.

    Parameters
    ----------
    model : mujoco.MjModel

    Raises
    ------
    InputError
        `model` is not an MjModel, or MuJoCo is not installed or too old.
    """

    def __init__(self, model: Any) -> None:
        mj = import_mujoco()
        if not isinstance(model, mj.MjModel):
            raise InputError(f"model is a {type(model).__name__}; a mujoco.MjModel is needed")
        self.model = model
        self._sizes = b""
        self._kept: list[
            Any
        ] = []  # Not more than one MjData, which a call takes out while it uses it.

    def take_data(self) -> Any:
        """Return an MjData as after its creation, to be given back by `keep_data`."""
        mj = import_mujoco()
        sizes = read_sizes(mj, self.model)
        try:
            data = self._kept.pop()
        except IndexError:
            data = None
        if data is None or not sizes or sizes != self._sizes:
            self._sizes = sizes
            return mj.MjData(self.model)
        mj.mj_resetData(self.model, data)
        return data

    def keep_data(self, data: Any) -> None:
        """Keep an MjData that `take_data` returned. An MjData in which MuJoCo raised an error must not be kept."""
        self._kept[:] = [data]


def from_mujoco_many(
    model: Any,
    states: Any,
    *,
    threads: int = 1,
    errors: str = "raise",
    scratch: MujocoScratch | None = None,
    velocity: Any = None,
) -> Imported:
    """Call `mj_forward` on many states of one MuJoCo model; return the problems and MuJoCo's own answers.

    A model with <flag sleep="enable"/> is rejected: a state does not contain which trees sleep, so that MuJoCo would
    wake all of them with another warm start. Clear the flag in the simulation and here.

    Parameters
    ----------
    model : mujoco.MjModel
        Its options (solver, tolerance, iterations, jacobian, ...) determine the answers.
    states : (n, nq + nv), or (n, size) of mjSTATE_FULLPHYSICS or mjSTATE_INTEGRATION
        The results of `mj_getState`, or rows of qpos and qvel. MuJoCo's answer depends on its warm start and its
        controls, which only mjSTATE_INTEGRATION contains. With other states, both are zero, and the answer and its
        error differ from the simulation.
    threads : int
        Number of threads; the results do not depend on it.
    errors : {"raise", "status"}
        Treatment of a state that is not finite: raise an error, or convert it to a world without rows and with a
        v_free of NaN. A state whose acceleration is not finite raises an error, or has impulses of NaN. `solve_many`
        and `residual_many` reject such a world by its number, or accept it with errors="status".
    scratch : MujocoScratch, optional
        Made once for `model`, it saves each call the time to make an MjData, more than that of 30 worlds. It needs
        threads=1. The results do not depend on it.
    velocity : (n, nv) array, optional
        It receives the velocity after each step that MuJoCo's answer predicts, as in `engine_answer`.
        It needs states of mjSTATE_INTEGRATION.

    Returns
    -------
    Imported
        `batch[i]` is the problem that `from_mujoco` builds for state i, to rounding, with a block for each row of an
        equality. With `noslip_iterations`, `impulse` is not a solution of the problem.

    Raises
    ------
    InputError
        `model` is not an MjModel or has sleep enabled; states have the wrong size; a state or an acceleration is not
        finite; `scratch` was made for another model or is given with several threads; or MuJoCo raises an error.
    CapabilityError
        MuJoCo does not store the stiffness of a flex, which the integrator adds to M; see `from_mujoco`.
    """
    import mujoco as mj

    if not isinstance(model, mj.MjModel):
        raise InputError(f"model is a {type(model).__name__}; a mujoco.MjModel is needed")
    if can_sleep(mj, model):
        raise InputError(
            'the model has <flag sleep="enable"/>, and no state has the trees that sleep: clear it here '
            "and in the simulation: model.opt.enableflags &= ~mujoco.mjtEnableBit.mjENBL_SLEEP"
        )
    check_choice("errors", errors, ERRORS)
    try:
        checked = as_array("states", states, (None, None), finite=errors == "raise")
    except InputError as error:
        full = mj.mj_stateSize(model, mj.mjtState.mjSTATE_INTEGRATION)
        raise InputError(
            f"{error}; each row is a state of mj_getState, best mjSTATE_INTEGRATION with {full} numbers"
        ) from None
    values = np.ascontiguousarray(checked)
    size = values.shape[1]
    kinds = {model.nq + model.nv: mj.mjtState.mjSTATE_QPOS | mj.mjtState.mjSTATE_QVEL}
    for kind in (mj.mjtState.mjSTATE_FULLPHYSICS, mj.mjtState.mjSTATE_INTEGRATION):
        kinds.setdefault(mj.mj_stateSize(model, kind), kind)
    if size not in kinds:
        raise InputError(
            f"each state has {size} numbers; one of {sorted(kinds)} is needed, as of mjSTATE_PHYSICS"
        )
    if velocity is not None and kinds[size] != mj.mjtState.mjSTATE_INTEGRATION:
        raise InputError(
            f"velocity was given with states of {size} numbers; mjSTATE_INTEGRATION is needed"
        )
    n = len(values)
    nv = model.nv
    dt = float(model.opt.timestep)
    # v, a0, a and dt J^T f of each state, and the entries of M.
    moves = np.zeros((n, 4, nv))
    mass = np.zeros((n, len(model.M_colind)))
    mover = ""
    # Matrices of the integrator "discrete", which may have other patterns.
    matrices: dict[int, Compressed] = {}
    # J, numbers of rows, number of contacts, and blocks of each finite state.
    rows_of_states: list[Any] = [None] * n
    bad = [] if errors == "raise" else (~np.isfinite(values).all(axis=1)).nonzero()[0].tolist()
    pending = iter(range(n) if not bad else [i for i in range(n) if i not in set(bad)])
    threads = min(check_int("threads", threads, 1, None), max(n, 1))

    if scratch is not None and (
        not isinstance(scratch, MujocoScratch) or scratch.model is not model or threads > 1
    ):
        raise InputError(
            f"scratch is {scratch!r:.60}, with threads={threads}; MujocoScratch(model) of this model is needed, "
            "with threads=1"
        )

    has_moving_surfaces = bool(getattr(model, "flg_surfacevel", 0))
    kind = int(kinds[size])

    def work(stop: bytearray) -> Any:
        nonlocal mover
        data = mj.MjData(model) if scratch is None else scratch.take_data()
        step = read_step(model, data)
        for i in pending:
            if stop[0]:
                break
            mj.mj_setState(model, data, values[i], kind)
            try:
                mj.mj_forward(model, data)
            except mj.FatalError as error:
                raise InputError(f"state {i}: MuJoCo raised an error, {error}") from None
            if has_moving_surfaces:  # efc_vel contains their velocities, too.
                mj.mj_mulJacVec(model, data, data.efc_vel, data.qvel)
            step.read(data)
            mover = mover or single.find_mover_of_step(step, is_stepped=False)
            if not copy_state(step, i, moves, mass):
                if errors == "raise":
                    raise InputError(f"state {i}: {single.DIVERGED_TEXT}")
                data.efc_force[:] = np.nan
            if step.is_discrete:
                try:
                    matrix = compute_discrete_matrix(mj, model, data, CHANGED_ADVICE)
                except CapabilityError as error:
                    raise CapabilityError(f"state {i}: {error}") from None
                matrices[i] = matrix.lower
                moves[i, 1] += 0.0 if matrix.change is None else matrix.change
            blocks = single.make_blocks(step, data, 1)
            rows = copy_rows(step, blocks)
            rows_of_states[i] = *rows, blocks
            if velocity is None:
                continue
            if model.opt.integrator == mj.mjtIntegrator.mjINT_RK4:
                velocity[i] = np.nan  # RK4 uses the answers of four forward passes.
            elif mover == "acceleration":
                velocity[i] = data.qvel + dt * data.qacc
            else:
                force, scale = rows[1][:, 2], rows[1][:, 4]
                force = np.divide(force, scale, out=np.zeros(len(force)), where=scale != 0.0)
                velocity[i] = single.integrate_forces(mj, model, data, rows[0], force)
        if scratch is not None:
            scratch.keep_data(data)
        return step

    indptr, indices = single.find_mass_pattern(run_on_threads(work, threads)[0])
    if bad:
        moves[bad, :3:2] = np.nan
        mass[np.ix_(bad, indptr[1:] - 1)] = 1.0  # The identity.
    jac, (target, compliance, lam), free, change, places, contact_counts = join_worlds(
        rows_of_states, moves, dt
    )
    set_worlds_at_rest(jac, free, target, places[0])
    if matrices:
        mass, indices, indptr = _merge_lower_triangles(matrices, mass, indices, indptr)
    blocks_of_states = [None if rows is None else rows[3] for rows in rows_of_states]
    cones = Cones._from_blocks(
        concatenate_blocks([each for each in blocks_of_states if each is not None])
    )

    def make_batch(soft: FloatArray) -> Batch:
        return Batch._from_valid_rows(
            jac, mass, (indptr, indices), free, target, soft, cones, places
        )

    answer = None if model.opt.noslip_iterations else change
    batch = make_engine_batch(make_batch, compliance, lam, answer, mover, moves[:, 3])

    def name_blocks_of_world(i: int) -> Any:
        blocks = blocks_of_states[i]
        m = 0 if blocks is None else blocks.n_rows
        return (
            []
            if blocks is None
            else single.make_block_names(mj, model, blocks.ints[2 * m + 1 :], m, 1)
        )

    def find_angular_rows_of_world(i: int) -> Any:
        blocks = blocks_of_states[i]
        m = 0 if blocks is None else blocks.n_rows
        return (
            None
            if blocks is None
            else single.find_angular_rows(mj, model, blocks.ints[2 * m + 1 :], m)
        )

    batch.names_of, batch.angular_of = name_blocks_of_world, find_angular_rows_of_world
    batch.contact_counts = contact_counts
    batch.key = np.concatenate(
        [np.zeros(0, np.uint64)]
        + [single.get_block_keys(each) for each in blocks_of_states if each is not None]
    )
    return Imported(batch, lam)


def _merge_lower_triangles(
    matrices: dict[int, Compressed], mass: FloatArray, indices: Any, indptr: Any
) -> Any:
    """Return (values (n, entries), indices, indptr) of lower triangles, with the union of their patterns.

    Worlds without a matrix in `matrices` keep their row of `mass`, with the pattern (indices, indptr).
    """
    nv = len(indptr) - 1

    def positions(columns: Any, first: Any) -> Any:
        return np.repeat(np.arange(nv), np.diff(first)) * np.int64(nv) + columns

    own = positions(indices, indptr)
    places = {i: positions(columns, first) for i, (first, columns, _) in matrices.items()}
    union = np.unique(np.concatenate([own, *places.values()]))
    values = np.zeros((len(mass), len(union)))
    values[:, np.searchsorted(union, own)] = mass
    for i, place in places.items():
        values[i] = 0.0
        values[i, np.searchsorted(union, place)] = matrices[i][2]
    rows, columns = np.divmod(union, nv)
    return values, columns.astype(np.int32), rows.searchsorted(np.arange(nv + 1)).astype(np.int32)


def _warn_of_old_forces(
    jac: Any, inv_compliance: Any, aref: Any, row_type: Any, force: Any, qacc: Any
) -> None:
    """Warn of forces of one-sided rows that do not follow from the acceleration: f = D max(0, aref - J qacc)."""
    jac = jac.astype(float)
    expected = inv_compliance * np.maximum(aref - np.einsum("nij,nj->ni", jac, qacc), 0.0)
    terms = inv_compliance * (np.abs(aref) + np.einsum("nij,nj->ni", np.abs(jac), np.abs(qacc)))
    allowed = OLD_FORCE_TOLERANCE * np.maximum(np.abs(force), expected) + FORCE_ROUNDING * terms
    is_old = np.isin(row_type, ONE_SIDED) & (force > 0.0) & (np.abs(force - expected) > allowed)
    if is_old.any():
        i, row = np.argwhere(is_old)[0]
        warnings.warn(
            f"efc_force of world {i}, row {row} is {force[i, row]:g}, and {expected[i, row]:g} follows from qacc "
            f"({is_old.sum()} such rows). {NEFC_ADVICE}. Forces of MuJoCo after noslip iterations differ, too",
            stacklevel=3,
        )


def _broadcast_numbers_to_rows(name: str, values: Any, n: int, m: int) -> FloatArray:
    """Return the numbers of all rows (n, m), given as (n, m), (m,) or one number."""
    if len(get_shape(name, values)) == 2:
        return as_array(name, values, (n, m), finite=False)
    return np.broadcast_to(as_array(name, values, (m,), finite=False), (n, m))


def _check_rows(name: str, numbers: FloatArray, wrong: Any, needed: str) -> None:
    """Raise InputError with the first row of a world that is `wrong` (n, m)."""
    if wrong.any():
        at = np.argwhere(wrong)
        i, row = at[0]
        raise InputError(
            f"{name} of world {i}, row {row} is {numbers[i, row]:g} ({len(at)} such rows); {needed} is needed"
        )


def _convert_mass(values: Any, n: int, nv: int) -> Any:
    """Return M (n, nv, nv), given as full matrices or as lower triangles in compressed rows."""
    values, *pattern = values if isinstance(values, tuple) and values else (values,)
    values = as_float_array("M", values)
    if not pattern:
        if values.ndim == 2:
            values = np.broadcast_to(values, (n, *values.shape))
        if values.shape != (n, nv, nv):
            raise InputError(f"M has shape {values.shape}; {(n, nv, nv)} is needed")
        return values
    if values.ndim != 2 or len(values) != n:
        raise InputError(
            f"values of M have shape {values.shape}; ({n}, entries) is needed, a row for a world"
        )
    ptr, col = check_shared_lower_triangles(pattern, np.full(n, nv), values)
    row = np.repeat(np.arange(nv), np.diff(ptr))
    full = np.zeros((n, nv, nv), values.dtype)
    full[:, row, col] = values
    full[:, col, row] = values
    return full


def _find_elliptic_contacts(contacts: Any, elliptic: Any) -> tuple[Any, ...]:
    """Return world, first row, rows and coefficients of each contact that begins at a row of `elliptic` (n, m)."""
    if not isinstance(contacts, (tuple, list)) or len(contacts) != 4:
        raise InputError(
            f"contacts is {contacts!r:.60}; (world, efc_address, dim, friction) is needed"
        )
    names = [f"{name} of contacts" for name in ("world", "efc_address", "dim")]
    size = (get_shape(names[0], contacts[0]) or (None,))[0]
    world, address, dim = (
        as_array(name, x, (size,), dtype=np.int32) for name, x in zip(names, contacts, strict=False)
    )
    rub = as_array("friction of contacts", contacts[3], (size, MAX_CONTACT_ROWS - 1), finite=False)
    n, m = elliptic.shape
    here = np.flatnonzero((address < m) & (world >= 0) & (world < n) & (address >= 0))
    here = here[elliptic[world[here], address[here]] & (dim[here] > 1)]
    world, address, dim, rub = world[here], address[here], dim[here], rub[here]
    large = np.flatnonzero(dim > np.minimum(MAX_CONTACT_ROWS, m - address))
    if len(large):
        k = large[0]
        raise InputError(
            f"dim of contact {here[k]} is {dim[k]}; at most {MAX_CONTACT_ROWS} is needed, and efc_address + "
            f"dim must be at most {m}, the number of rows"
        )
    used = np.arange(1, MAX_CONTACT_ROWS) < dim[:, None]
    bad = np.argwhere(used & ~((rub > 0.0) & (rub < np.inf)))
    if len(bad):
        k, j = bad[0]
        raise InputError(
            f"friction of contact {here[k]} is {rub[k, j]:g} at position {j}; a finite number above 0 is needed"
        )
    first = world * np.int64(m) + address
    rows = [first[dim > j] + j for j in range(MAX_CONTACT_ROWS)]
    named = np.bincount(np.concatenate(rows), minlength=n * m).reshape(n, m)
    if (named != elliptic).any():
        off = np.argwhere(named != elliptic)
        i, row = off[0]
        kind = "an" if elliptic[i, row] else "no"
        raise InputError(
            f"row {row} of world {i} belongs to {named[i, row]} of the contacts, and by efc_type it is "
            f"{kind} elliptic row ({len(off)} such rows); each elliptic row must belong to exactly one "
            f"contact: give contacts and efc_type of the same step. {NEFC_ADVICE}"
        )
    return world, address, dim, rub


def _make_blocks(
    row_type: Any, loss: Any, used_rows: Any, contacts: Any, dt: float
) -> tuple[Cones, FloatArray | None]:
    """Return the blocks of all used rows, world after world, and the factor of each row (n, m) or None if all are 1."""
    n, m = row_type.shape
    begins = np.ones((n, m), bool)
    tangents = np.zeros((n, m), np.int32)
    mu = np.zeros((n, m))
    scale = None
    elliptic = (row_type == ELLIPTIC) & used_rows
    if elliptic.any() and contacts is None:
        raise InputError(
            "efc_type has rows of elliptic contacts; contacts= is needed, with their friction"
        )
    if contacts is not None:
        world, address, dim, rub = _find_elliptic_contacts(contacts, elliptic)
        tangents[world, address] = dim - 1
        mu[world, address] = rub[:, 0]
        factor = np.ones((n, m))
        for j in range(1, int(np.max(dim, initial=1))):
            at = dim > j
            begins[world[at], address[at] + j] = False
            factor[world[at], address[at] + j] = rub[at, j - 1] / rub[at, 0]
        if (factor != 1.0).any():
            scale = factor
    free = row_type == EQUALITY
    has_loss = np.isin(row_type, FRICTION)
    upper = np.where(has_loss, dt * loss, np.inf)[used_rows]
    lower = np.where(has_loss, -dt * loss, np.where(free, -np.inf, 0.0))[used_rows]
    first = begins[used_rows]
    ptr = np.append(np.flatnonzero(first), len(first)).astype(np.int32)
    none = np.zeros(len(ptr) - 1)
    tangents = tangents[used_rows][first]
    kinds = get_block_kinds(tangents > 0, tangents=tangents)
    return Cones(
        ptr=ptr, kind=kinds, lower=lower, upper=upper, mu=mu[used_rows][first], patch_radius=none
    ), scale
