"""Worlds of one MuJoCo model, stepped by a selectable engine, and the constraint problem of every step.

World 0 is the world that `lavender record` simulates. The other worlds differ from it by their initial velocities and
their random controls:

    qvel += spread N(0, 1) [m/s, rad/s], drawn with (seed, world)        controls drawn with seed + world

If start states are given, world i starts from state i without this noise. If there are more worlds than states, the
states are used again with noise. The first step uses the controls of the start state, if it has any.

The constraint problem of a step is the one of the engine's own forward pass, with its warm start and its answer. MJX
and MuJoCo Warp step all worlds at once, in float32.
"""

from __future__ import annotations

import contextlib
import copy
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray, IntArray, check_float, check_int
from lavender.base.errors import InputError
from lavender.batch.data import Batch
from lavender.io.contact_count import count_contacts
from lavender.io.efc import from_efc
from lavender.io.engine_step import EngineStep
from lavender.io.mujoco_memory import import_mujoco
from lavender.io.start_states import (
    Control,
    StartStates,
    can_sleep,
    load_controls,
    load_model,
    make_controller,
    name_model,
    read_states,
    without_sleep,
)
from lavender.report.runner import Event

ENGINES = ("mujoco", "mjx", "mujoco_warp")
# Arrays of the state from which MJX and Warp start.
START_FIELDS = ("qpos", "qvel", "act", "qacc_warmstart", "mocap_pos", "mocap_quat")
ACCELERATION_FIELDS = ("qacc_smooth", "qfrc_smooth", "qacc")  # Arrays of each step for `from_efc`.
STEP_FIELDS = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart")  # Arrays on which a step depends.
# mjtConstraint -> name of a block that is not a contact.
BLOCK_KINDS = {
    0: "equality",
    1: "friction loss",
    2: "friction loss",
    3: "limit of a joint",
    4: "limit of a tendon",
}
PYRAMIDAL_CONTACT = 6  # Value of mjtConstraint of an edge of a pyramidal contact.
MIN_WARP_ROWS = 256  # Smallest number of rows per world for which MuJoCo Warp allocates memory.
SLEEP_NOTE = (
    'Sleep was off in all worlds, although the model has <flag sleep="enable"/>: a state does not contain which trees '
    "sleep, so that a repeated step would wake them."
)
# Matches the numbers in a warning of MuJoCo, such as a degree of freedom. Warnings are counted without them.
WARNING_NUMBER = re.compile(r"\d+")


SPREADS = (
    0.1,
    0.01,
    0.001,
    0.0,
)  # [m/s, rad/s] Default: the largest one with which no trial world diverges.
N_TRIAL_WORLDS = 3


@dataclass(frozen=True, eq=False)
class Runs:
    """Parameters of a simulation of several worlds."""

    name: str  # Name of the model in sentences and tables.
    model: Any  # mujoco.MjModel or None: without sleep; None for scenes of other engines.
    worlds: int
    steps: int
    # "random", "zero", "hold", array (any, nu) or callable: see `lavender.io.record`; every world applies an array step
    # by step.
    control: Control = "random"
    seed: int = 0
    # [m/s, rad/s] Standard deviation of the noise that is added to the velocities at the start.
    spread: float = SPREADS[0]
    starts: StartStates | None = None  # States in which the worlds start; default: the model's own.
    # (str, mujoco.MjModel): name and model of the other model that solves the same steps.
    against: tuple[str, Any] | None = None
    notes: tuple[
        str, ...
    ] = ()  # Sentences about the differences from a simulation of the model as it is.
    # Path of the model and value of --controls as they were given, for printed commands; empty if they were objects.
    source: str = ""
    control_name: str = ""

    def __post_init__(self) -> None:
        for name in ("worlds", "steps"):
            check_int(name, getattr(self, name), 1, None)
        object.__setattr__(self, "control", load_controls(self.control))
        check_int("seed", self.seed, high=None)
        check_float("spread", self.spread, low=0.0)

    @classmethod
    def of_model(
        cls,
        source: Any,
        worlds: int,
        steps: int,
        *,
        states: Any = None,
        against: Any = None,
        **more: Any,
    ) -> Runs:
        """Make the runs of a model, without sleep.

        Parameters
        ----------
        source : path of a model (MJCF, .mjb) or mujoco.MjModel
        worlds, steps, more
            See `Runs`.
        states : any source of `read_states`, optional
            States in which the worlds start; default: the model's own.
        against : path or mujoco.MjModel, optional
            Another model that solves the same steps.
        """
        mj, model = load_model(source)
        notes = (SLEEP_NOTE,) if can_sleep(mj, model) else ()
        control = more.get("control", "random")
        runs = cls(
            name_model(source),
            without_sleep(mj, model),
            worlds,
            steps,
            notes=notes,
            source=os.fspath(source) if isinstance(source, (str, os.PathLike)) else "",
            control_name=os.fspath(control) if isinstance(control, (str, os.PathLike)) else "",
            **more,
        )
        make_controller(model, runs.control, runs.seed)
        if states is not None:
            starts = read_states(mj, runs.model, states)
            runs = replace(runs, starts=starts, notes=(*notes, *starts.notes)).with_worlds(worlds)
        if against is None:
            return runs
        _, other = load_model(against)
        sizes = [mj.mj_stateSize(m, mj.mjtState.mjSTATE_INTEGRATION) for m in (model, other)]
        if sizes[0] != sizes[1] or model.nv != other.nv:
            raise InputError(
                f"against names {name_model(against)}, whose state has {sizes[1]} numbers; the state of "
                f"{runs.name} has {sizes[0]}; a model with the same state is needed, such as one with other options"
            )
        return replace(runs, against=(name_model(against), without_sleep(mj, other)))

    def with_worlds(self, worlds: int) -> Runs:
        """Return these runs with another number of worlds, and as many of the start states, evenly spaced."""
        starts = None if self.starts is None else self.starts.select_evenly(worlds)
        return replace(self, worlds=worlds, starts=starts)

    @property
    def mj(self) -> Any:
        """The module mujoco."""
        return import_mujoco()

    def with_ignored_settings(self, engine: str) -> Runs:
        """Return these runs with a note on settings of the model that MJX accepts and does not simulate."""
        model = self.model
        names = {
            "noslip_iterations": model.opt.noslip_iterations > 0,
            "surfacevel of geoms": np.any(getattr(model, "geom_surfacevel", 0.0)),
            "delay of actuators": np.any(getattr(model, "actuator_delay", 0.0)),
        }
        ignored = [name for name, is_used in names.items() if is_used and engine == "mjx"]
        note = f"MJX does not simulate these settings of the model: {', '.join(ignored)}."
        return replace(self, notes=(*self.notes, note)) if ignored else self

    @property
    def n_exact_worlds(self) -> int:
        """Number of worlds that start without noise."""
        return min(self.worlds, 1 if self.starts is None else len(self.starts))

    def choose_spread(self, fixed: float | None, watch: Any = None) -> Runs:
        """Return these runs with a fixed spread, or the largest of `SPREADS` that the first worlds with noise survive.

        A choice that is not the largest is noted. If these worlds diverge without noise, too, the largest is chosen.
        """
        if fixed is not None:
            return replace(self, spread=fixed)
        if watch is not None:
            watch(Event(0, 0, "simulating trial worlds to choose the spread", ""))
        trial = range(self.n_exact_worlds, min(self.worlds, self.n_exact_worlds + N_TRIAL_WORLDS))
        with count_engine_warnings(self.mj):
            for spread in SPREADS:
                runs = replace(self, spread=spread)
                if all(simulate_world(runs, world)[1] is None for world in trial):
                    break
            else:
                return replace(self, spread=SPREADS[0])
        if spread == SPREADS[0]:
            return runs
        note = (
            f"The start velocities of the worlds differ by {spread:g} m/s (rad/s) only, because worlds diverged with "
            f"{SPREADS[SPREADS.index(spread) - 1]:g} m/s and not with {spread:g} m/s (--spread)."
        )
        return replace(runs, notes=(*runs.notes, note))

    def create_start_data(self, world: int) -> Any:
        """Create the MjData with which a world starts."""
        mj, model = self.mj, self.model
        data = mj.MjData(model)
        if self.starts is not None:
            state = self.starts.vectors[world % len(self.starts)]
            mj.mj_setState(model, data, state, mj.mjtState.mjSTATE_INTEGRATION)
        if world >= self.n_exact_worlds:
            data.qvel[:] += self.spread * np.random.default_rng([self.seed, world]).standard_normal(
                model.nv
            )
        return data

    def make_controller(self, world: int) -> Any:
        """Return the function (data, step) -> controls of a world."""
        drive = make_controller(self.model, self.control, self.seed + world)
        if self.starts is None or self.starts.controls is None:
            return drive
        first = self.starts.controls[world % len(self.starts)]
        # Draw the random controls of step 0, too, so that later controls do not depend on the start state.
        return lambda data, step: (drive(data, step), first)[step == 0]


def can_any_geoms_collide(mj: Any, model: Any) -> bool:
    """Whether any two geoms of the model can collide."""
    if model.opt.disableflags & (
        mj.mjtDisableBit.mjDSBL_CONTACT | mj.mjtDisableBit.mjDSBL_CONSTRAINT
    ):
        return False
    if model.npair or model.nflex:
        return True
    bit_masks = np.stack([model.geom_contype, model.geom_conaffinity], axis=1)
    kinds, counts = np.unique(bit_masks, axis=0, return_counts=True)
    matches = kinds[:, :1] & kinds[:, 1]
    matches |= matches.T
    return bool(
        np.any(matches[~np.eye(len(kinds), dtype=bool)]) or np.any(np.diag(matches)[counts > 1])
    )


class Divergence(NamedTuple):
    """The step in which a world diverged: MuJoCo resets the simulation, or raises an error."""

    world: int
    step: int
    cause: str  # The quantity that was not finite or above mjMAXVAL, or MuJoCo's error.
    # Whether the quantity is the state or the unconstrained acceleration, so that the constraint solve of this step is
    # not the cause.
    is_outside: bool


class Frame(NamedTuple):
    """Problems of all worlds before one step, the engine's answers, and the state from which the worlds restart."""

    batch: Batch
    impulse: FloatArray  # [N s]
    state: dict[
        str, FloatArray
    ]  # dict of (worlds, ...): state before the step, by the names of MjData.
    rows: np.ndarray  # (worlds,) int: number of rows that are not padding.
    contacts: np.ndarray  # (worlds,) int: number of contacts with rows that are not padding.
    converged: np.ndarray | None = None  # (worlds,) bool: the engine's claims.
    n_dropped: int = 0  # Number of rows for which the engine had no memory.

    @classmethod
    def of_step(cls, step: EngineStep) -> Frame:
        """Make the frame of a converted step of an engine with claims."""
        batch = step.batch
        contacts = batch.contact_counts
        if contacts is None:
            contacts = np.zeros(len(batch), int)
            for i in range(len(batch)):
                # A world with numbers that are not finite is not judged.
                with contextlib.suppress(InputError):
                    contacts[i] = count_contacts(batch[i])
        dropped = step.claims.residuals.get("dropped_rows", np.zeros(1))
        claims = np.asarray(step.claims.converged, bool), int(np.sum(dropped))
        return cls(batch, step.impulse, step.state or {}, batch.row_counts, contacts, *claims)


@contextlib.contextmanager
def count_engine_warnings(mj: Any) -> Iterator[Counter[str]]:
    """Count MuJoCo's warnings by their first sentence instead of printing them, with N for each number."""
    counts: Counter[str] = Counter()
    handler = mj.get_mju_user_warning()
    mj.set_mju_user_warning(
        lambda text: counts.update([WARNING_NUMBER.sub("N", text.partition(". ")[0])])
    )
    try:
        yield counts
    finally:
        mj.set_mju_user_warning(handler)


def simulate_world(runs: Runs, world: int) -> tuple[FloatArray, Divergence | None, FloatArray]:
    """Simulate a world.

    Returns
    -------
    states : (steps, size)
        Before each step, with controls and warm start (mjSTATE_INTEGRATION); NaN after the step in which the world
        diverged, and in that step if MuJoCo raised an error.
    divergence : Divergence or None
    after : (steps, nv), m/s, rad/s
        Velocities after each step; NaN from the step on in which the world diverged.
    """
    mj = runs.mj
    model = runs.model
    kind = runs.mj.mjtState.mjSTATE_INTEGRATION
    data, drive = runs.create_start_data(world), runs.make_controller(world)
    states = np.empty((runs.steps, mj.mj_stateSize(model, kind)))
    after = np.full((runs.steps, model.nv), np.nan)
    for step in range(runs.steps):
        ctrl = drive(data, step)
        if ctrl is not None:
            data.ctrl[:] = ctrl
        mj.mj_getState(model, data, states[step], kind)
        try:
            mj.mj_step(model, data)
        except mj.FatalError as error:  # MuJoCo is out of memory.
            states[step:] = np.nan
            return states, Divergence(world, step, f"MuJoCo raised an error: {error}", False), after
        if has_diverged(mj, data):
            states[step + 1 :] = np.nan
            return states, _find_cause_of_reset(mj, model, data, states[step], world, step), after
        after[step] = data.qvel
    return states, None, after


def has_diverged(mj: Any, data: Any) -> bool:
    """Whether MuJoCo has reset the simulation because its numbers were not finite or above mjMAXVAL."""
    names = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC")
    return any(data.warning[int(getattr(mj.mjtWarning, name))].number for name in names)


def _find_cause_of_reset(
    mj: Any, model: Any, data: Any, state: FloatArray, world: int, step: int
) -> Divergence:
    """Determine which quantity was too large in a step in which MuJoCo reset the simulation."""
    kinds = mj.mjtWarning
    for kind, name in ((kinds.mjWARN_BADQPOS, "position"), (kinds.mjWARN_BADQVEL, "velocity")):
        if data.warning[int(kind)].number:
            return Divergence(world, step, f"{name} before the step", True)
    repeated = mj.MjData(model)
    mj.mj_setState(model, repeated, state, mj.mjtState.mjSTATE_INTEGRATION)
    try:
        mj.mj_forward(model, repeated)
    except mj.FatalError as error:
        return Divergence(world, step, f"MuJoCo raised an error: {error}", False)
    smooth = np.abs(repeated.qacc_smooth).max(initial=0.0)
    if not smooth <= mj.mjMAXVAL:
        return Divergence(world, step, "acceleration without constraints", True)
    return Divergence(world, step, "acceleration", False)


def iterate_frames(engine: str, runs: Runs, njmax: int | None = None) -> Iterator[Frame]:
    """Step all worlds by MJX or MuJoCo Warp and yield the frame of each step."""
    mj = runs.mj
    model = copy.copy(runs.model)
    model.opt.jacobian = mj.mjtJacobian.mjJAC_DENSE
    starts = [runs.create_start_data(world) for world in range(runs.worlds)]
    drives = [runs.make_controller(world) for world in range(runs.worlds)]
    names = ("qpos", "qvel") if runs.starts is None else START_FIELDS
    start_arrays = {
        name: np.array([getattr(d, name) for d in starts], np.float32) for name in names
    }
    not_accepted = f"engine {engine!r} does not accept {runs.name}"
    try:
        step: Any
        if engine == "mjx":
            step = _make_mjx_stepper(mj, model, start_arrays)
        else:
            step = WarpWorlds(mj, model, start_arrays, njmax)
    except ImportError as error:
        package = {"mjx": "mujoco-mjx", "mujoco_warp": "mujoco-warp"}[engine]
        raise InputError(
            f"engine {engine!r} cannot be imported ({error}): pip install {package}"
        ) from None
    except (NotImplementedError, ValueError) as error:
        raise InputError(f"{not_accepted}: {error}") from None
    for k in range(runs.steps):
        ctrl = np.array([drive(d, k) for drive, d in zip(drives, starts, strict=True)], np.float32)
        try:
            arrays = step(ctrl)
        except (
            NotImplementedError
        ) as error:  # By MJX in the first step, for example for an integrator.
            raise InputError(f"{not_accepted}: {error}") from None
        yield make_frame(mj, model, *arrays)._replace(n_dropped=getattr(step, "n_dropped", 0))


def make_frame(
    mj: Any, model: Any, state: Any, efc: Any, mass: Any, contact: Any, extra: Any
) -> Frame:
    """Build the frame of a step of all worlds from the engine's arrays.

    Parameters
    ----------
    state : dict of (worlds, ...)
    efc : dict
        Arrays of constraint rows, without the prefix `efc_`.
    mass : array
        M, or its lower triangles in compressed rows.
    contact : tuple
        World, first row, dim, friction and geoms of the contacts.
    extra : dict
        Further arguments of `from_efc`.
    """
    world_of, address, dim, friction, _ = contact
    problem_arrays = {f"efc_{name}": x for name, x in efc.items()} | extra
    triangle = mass, model.M_colind, np.append(model.M_rowadr, len(model.M_colind))
    problem_arrays |= {"M": mass if mass.ndim == 3 else triangle, "qvel": state["qvel"]}
    dt = float(model.opt.timestep)
    problems = from_efc(**problem_arrays, timestep=dt, contacts=(world_of, address, dim, friction))
    problems.batch.names_of = _make_block_namer(mj, model, problems.batch, efc["type"], contact)
    assert problems.impulse is not None
    sizes = _count_rows_and_contacts(efc["J"], extra.get("nefc"), world_of, address)
    return Frame(problems.batch, problems.impulse, state, *sizes)


def _count_rows_and_contacts(
    jac: Any, nefc: Any, world_of: Any, address: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Count the rows of each world that are not padding (zeros of J), and the contacts that begin with such a row."""
    is_active = (jac != 0.0).any(axis=2)
    if nefc is not None:
        is_active &= np.arange(is_active.shape[1]) < nefc[:, None]
    has_row = (address >= 0) & (address < is_active.shape[1])
    has_row[has_row] = is_active[world_of[has_row], address[has_row]]
    return is_active.sum(axis=1), np.bincount(world_of[has_row], minlength=len(jac))


def _make_mjx_stepper(mj: Any, model: Any, start_arrays: dict[str, Any]) -> Any:
    """Return the function that steps all worlds with MJX and returns the data of the step."""
    import jax
    from mujoco import mjx

    device_model = mjx.put_model(model)
    # Its Euler's method without the flag eulerdamp, and RK4. MuJoCo Warp uses M qacc with every integrator.
    is_explicit = bool(int(model.opt.disableflags) & int(mj.mjtDisableBit.mjDSBL_EULERDAMP))
    uses_acceleration = int(model.opt.integrator) == int(mj.mjtIntegrator.mjINT_RK4) or (
        int(model.opt.integrator) == int(mj.mjtIntegrator.mjINT_EULER) and is_explicit
    )
    first = mjx.make_data(model)
    data = jax.vmap(lambda own: first.replace(**own))(start_arrays)

    def step_world(d: Any, c: Any) -> Any:
        d = d.replace(ctrl=c)
        return d, mjx.forward(device_model, d), mjx.step(device_model, d)

    step_worlds = jax.jit(jax.vmap(step_world))

    def step(ctrl: Any) -> Any:
        """Step all worlds with these controls; return states, constraint rows, mass matrices and contacts."""
        nonlocal data
        before, now, data = step_worlds(data, ctrl)
        e = now._impl
        n = len(ctrl)
        efc = {
            name: np.asarray(getattr(e, f"efc_{name}"))
            for name in ("J", "D", "aref", "type", "frictionloss", "force")
        }
        c = e.contact
        address = np.broadcast_to(np.asarray(c.efc_address), (n, np.shape(c.dist)[1]))
        size = address.shape[1]
        contact = (
            np.repeat(np.arange(n), size),
            address.ravel(),
            _concatenate_worlds(c.dim, n, size),
            _concatenate_worlds(c.friction, n, size, 5),
            _concatenate_worlds(c.geom, n, size, 2),
        )
        state = {name: np.asarray(getattr(before, name)) for name in STEP_FIELDS}
        extra: dict[str, Any] = {
            name: np.asarray(getattr(now, name)) for name in ACCELERATION_FIELDS
        }
        extra["moved_by"] = "acceleration" if uses_acceleration else "forces"
        return state, efc, np.asarray(e.M), contact, extra

    return step


def _concatenate_worlds(x: Any, n: int, size: int, *each: int) -> Any:
    """Concatenate an array over the contacts of n worlds."""
    return np.broadcast_to(np.asarray(x), (n, size, *each)).reshape(n * size, *each)


class WarpWorlds:
    """Worlds of a model in MuJoCo Warp.

    Parameters
    ----------
    mj : module
        MuJoCo.
    model : mujoco.MjModel
        Model with the option of a dense Jacobian.
    start_arrays : dict of (worlds, ...)
        State in which the worlds start, by the names of MjData.
    njmax : int, optional
        Rows of each world for which memory is allocated. Further rows are dropped by the engine and counted in
        `n_dropped`. Default: memory grows with the rows, and nothing is dropped.
    """

    def __init__(
        self, mj: Any, model: Any, start_arrays: dict[str, Any], njmax: int | None = None
    ) -> None:
        import mujoco_warp as mjw
        import warp as wp

        wp.config.log_level = getattr(wp, "LOG_WARNING", 30)  # Do not print a line for each kernel.
        self.mj = mj
        self.mjw = mjw
        self.wp = wp
        self.model = model
        self.n_dropped = 0
        self.n = len(start_arrays["qpos"])
        self.can_grow = njmax is None
        self.first, start = mj.MjData(model), mj.MjData(model)
        mj.mj_forward(model, start)
        self.rows = njmax or max(MIN_WARP_ROWS, 2 * int(start.nefc))
        # A world has at least one row for each contact.
        self.contacts = max(MIN_WARP_ROWS, self.rows)
        self.device_model = mjw.put_model(model)
        self.is_rk4 = int(model.opt.integrator) == int(mj.mjtIntegrator.mjINT_RK4)
        if hasattr(self.device_model.opt, "warn_overflow"):
            # Do not print a line for each solve that uses up its iterations, or for rows that this class counts.
            self.device_model.opt.warn_overflow = 0
        self._allocate(start_arrays)

    def _allocate(self, state: dict[str, Any]) -> None:
        """Allocate memory for `rows` rows and `contacts` contacts of each world, and set their state."""
        sizes = {"njmax": self.rows, "nconmax": self.contacts}
        self.data = self.mjw.put_data(self.model, self.first, nworld=self.n, **sizes)
        for name, x in state.items():
            if x.size:
                getattr(self.data, name).assign(x)

    def read_state(self, names: Sequence[str]) -> dict[str, Any]:
        """Return copies of some arrays of the state."""
        return {name: getattr(self.data, name).numpy().copy() for name in names}

    def _step(self, state: dict[str, Any]) -> int:
        """Step, with more memory if rows or contacts did not fit; return the number of contacts.

        With RK4 run the first of the four passes only: the step leaves the mean of their accelerations.
        """
        while True:
            # A `forward` before the step would change it: rows of welds contain velocities of the last pass.
            (self.mjw.forward if self.is_rk4 else self.mjw.step)(self.device_model, self.data)
            # The engine counts the rows and contacts that it has no memory for, too.
            needed = int(self.data.nefc.numpy().max())
            contacts = int(self.data.nacon.numpy()[0])
            fits_contacts = contacts <= self.n * self.contacts
            if (needed <= self.rows and fits_contacts) or not self.can_grow:
                excess = np.maximum(self.data.nefc.numpy() - self.rows, 0).sum()
                self.n_dropped = int(excess) + max(contacts - self.n * self.contacts, 0)
                return min(contacts, self.n * self.contacts)
            self.rows = max(self.rows, 2 * needed)
            self.contacts = max(self.contacts, 2 * -(-contacts // self.n))
            self._allocate(state)

    def __call__(self, ctrl: Any) -> Any:
        """Step all worlds with these controls; return states, constraint rows, mass matrices and contacts."""
        self.data.ctrl.assign(ctrl)
        before = self.read_state((*START_FIELDS, "ctrl", "time"))
        k = self._step(before)
        state = {name: before[name] for name in STEP_FIELDS}
        data, rows = self.data, self.rows
        e, c = data.efc, data.contact
        efc = {
            name: getattr(e, name).numpy()[:, :rows].copy()
            for name in ("D", "aref", "type", "frictionloss", "force")
        }
        efc["J"] = e.J.numpy()[:, :rows, : self.model.nv].copy()
        parts = [c.worldid, c.efc_address, c.dim, c.friction, c.geom]
        world_of, address, dim, friction, geom = (x.numpy()[:k].copy() for x in parts)
        # A contact with dropped rows has no address.
        address = np.where((address < rows).all(axis=1), address[:, 0], -1)
        extra = self.read_state((*ACCELERATION_FIELDS, "nefc"))
        extra["nefc"] = np.minimum(extra["nefc"], rows)
        step_data = state, efc, data.M.numpy().copy(), (world_of, address, dim, friction, geom)
        if self.is_rk4:
            self.mjw.step(self.device_model, data)
        return *step_data, extra


def _make_block_namer(mj: Any, model: Any, batch: Batch, row_types: IntArray, contact: Any) -> Any:
    """Return the function that names a world's blocks by the types of its rows and the geoms of its contacts."""
    world_of, address, _, _, geom = contact

    def geom_name(g: Any) -> str:
        """Return the name of a geom, or its index without one."""
        return mj.mj_id2name(model, mj.mjtObj.mjOBJ_GEOM, int(g)) or str(int(g))

    def name_blocks_of_world(i: int) -> list[str]:
        """Return the names of the blocks of world i."""
        types = np.broadcast_to(row_types, (len(batch), row_types.shape[-1]))[i]
        first = {int(address[k]): k for k in np.flatnonzero((world_of == i) & (address >= 0))}
        names = []
        name = "contact"
        first_row = 0
        for row in batch._get_cones_of_world(i).ptr[:-1].tolist():
            if row in first:
                name = f"contact ({', '.join(map(geom_name, geom[first[row]]))})"
                first_row = row
            edge = f", edge {row - first_row}" if int(types[row]) == PYRAMIDAL_CONTACT else ""
            names.append(BLOCK_KINDS.get(int(types[row]), name + edge))
        return names

    return name_blocks_of_world
