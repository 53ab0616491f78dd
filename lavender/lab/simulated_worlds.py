"""Worlds of one MuJoCo model, stepped by the engine that is asked for, and the constraint problem of every step.

World 0 is what `lavender record` simulates; the others differ from it by their start and by their random controls:

    qvel += spread N(0, 1) [m/s, rad/s], drawn with (seed, world)        controls drawn with seed + world

With start states, world i starts from state i without that noise; further worlds start from the same states with it.
The first step uses the controls of the state, if it has any.

A problem is that of the engine's own forward pass, from its own warm start, with its own answer beside it. MJX and
MuJoCo Warp step all worlds at once, and hold float32.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray, IntArray, check_float, check_int
from lavender.base.errors import CapabilityError, InputError
from lavender.batch.data import Batch
from lavender.io.efc import from_efc
from lavender.io.recording import Control, load_controls, load_model, make_controller
from lavender.io.states import StartStates, read_states
from lavender.lab.report.table import Table
from lavender.lab.report.text import format_percent

ENGINES = ("mujoco", "mjx", "mujoco_warp")
BEGIN = ("qpos", "qvel", "act", "qacc_warmstart", "mocap_pos", "mocap_quat")  # what MJX and Warp start from
FIELDS = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart")  # what a step is made of
KIND = {0: "equality", 1: "friction loss", 2: "friction loss", 3: "limit of a joint", 4: "limit of a tendon"}
PYRAMIDAL = 6  # of mjtConstraint, as the keys of KIND
ROOM = 256  # rows of each world that MuJoCo Warp is given at least
# Below this share of judged steps with contact no setting is recommended and an audit says that it tells little about
# contact. Mean times and the error that 1 % of the steps exceed are then those of steps without contact: 6 % of the
# steps of dm_control's finger have contact, none of its stacker's.
MIN_CONTACT_SHARE = 0.2


@dataclass(frozen=True)
class Runs:
    """What is simulated.

    Parameters
    ----------
    model : path of a model (MJCF)
    worlds, steps : int
    control : "random", "zero", or an array (any, nu), played by every world
    seed : int
    spread : float, m/s, rad/s
        Standard deviation of what is added to the velocities that a world starts with.
    starts : StartStates, optional
        States in which the worlds start; default: the model's own.
    """

    model: str
    worlds: int
    steps: int
    control: Control = "random"
    seed: int = 0
    spread: float = 0.1
    starts: StartStates | None = None

    def __post_init__(self) -> None:
        for name in ("worlds", "steps"):
            check_int(name, getattr(self, name), 1, None)
        object.__setattr__(self, "control", load_controls(self.control))
        check_int("seed", self.seed, high=None)
        check_float("spread", self.spread, low=0.0)

    def load(self) -> tuple[Any, Any]:
        """MuJoCo and the model; InputError where its problems cannot be read."""
        mj, model = load_model(self.model)
        make_controller(model, self.control, self.seed)
        return mj, model

    def start_from(self, states: Any) -> Runs:
        """Return these runs with start states of any source that `read_states` takes; None leaves the model's own."""
        if states is None:
            return self
        return replace(self, starts=read_states(*self.load(), states).subset(self.worlds))

    def start(self, mj: Any, model: Any, world: int) -> Any:
        """MjData as this world begins."""
        data, exact = mj.MjData(model), 1
        if self.starts is not None:
            exact = len(self.starts)
            state = self.starts.vectors[world % exact]
            mj.mj_setState(model, data, state, mj.mjtState.mjSTATE_INTEGRATION)
        if world >= exact:
            data.qvel[:] += self.spread * np.random.default_rng([self.seed, world]).standard_normal(model.nv)
        return data

    def drive(self, model: Any, world: int) -> Any:
        """The controls of a world by (data, step)."""
        drive = make_controller(model, self.control, self.seed + world)
        if self.starts is None or self.starts.controls is None:
            return drive
        first = self.starts.controls[world % len(self.starts)]
        # The random controls of later steps do not depend on whether the state has controls.
        return lambda data, step: (drive(data, step), first)[step == 0]


@dataclass(frozen=True, eq=False)
class StepSizes:
    """Rows and contacts of each judged step.

    Parameters
    ----------
    rows, contacts : (steps,) int
        Contacts that have rows.
    can_touch : bool
        Whether the model has geoms that can collide. Without, the share of steps with rows decides.
    """

    rows: np.ndarray
    contacts: np.ndarray
    can_touch: bool

    @property
    def is_enough(self) -> bool:
        """Whether enough of the steps have contact to recommend a setting."""
        return self._with_any >= MIN_CONTACT_SHARE * len(self.rows)

    @property
    def _with_any(self) -> int:
        return int(np.count_nonzero(self.contacts if self.can_touch else self.rows))

    @property
    def sentence(self) -> str:
        """How many steps have contact, and how many are needed."""
        n, what = len(self.rows), "contact" if self.can_touch else "a constraint"
        share = f" ({format_percent(self._with_any, n, min(1, self._with_any))})" if n else ""
        needed = f"{100.0 * MIN_CONTACT_SHARE:g} %"
        return f"{self._with_any} of {n} steps judged have {what}{share}, fewer than {needed}"

    @property
    def table(self) -> Table:
        """Median and maximum of rows and contacts, and how many steps have any."""
        rows = []
        for name, counts in (("rows", self.rows), ("contacts", self.contacts)):
            if len(counts):
                some = format_percent(int(np.count_nonzero(counts)), len(counts), 1)
                rows.append([name, f"{np.median(counts):g}", str(counts.max()), some])
        heads = ["in a step", "median", "maximum", "steps with any"]
        return Table(heads, rows, words=frozenset(heads[:1]))

    @property
    def numbers(self) -> dict[str, Any]:
        """The same for numbers.json."""
        found: dict[str, Any] = {"can_touch": self.can_touch, "min_contact_share": MIN_CONTACT_SHARE}
        for name, counts in (("rows", self.rows), ("contacts", self.contacts)):
            some = len(counts) > 0
            found[name] = {
                "median": float(np.median(counts)) if some else None,
                "maximum": int(counts.max()) if some else None,
                "share": float(np.mean(counts > 0)) if some else None,
            }
        return found


def can_touch(mj: Any, model: Any) -> bool:
    """Whether any two geoms of the model can collide."""
    if model.opt.disableflags & (mj.mjtDisableBit.mjDSBL_CONTACT | mj.mjtDisableBit.mjDSBL_CONSTRAINT):
        return False
    if model.npair or model.nflex:
        return True
    words = np.stack([model.geom_contype, model.geom_conaffinity], axis=1)
    kinds, counts = np.unique(words, axis=0, return_counts=True)
    return any(
        (a[0] & b[1] or b[0] & a[1]) and (i != j or counts[i] > 1)
        for i, a in enumerate(kinds.tolist())
        for j, b in enumerate(kinds.tolist())
    )


class Divergence(NamedTuple):
    """The step in which a world diverged: MuJoCo starts the simulation again, or ends in an error."""

    world: int
    step: int
    cause: str  # what was not finite or above mjMAXVAL, or MuJoCo's error
    is_outside: (
        bool  # The state or the unconstrained acceleration was, so this step's solve is not the cause.
    )


class Frame(NamedTuple):
    """One step of all worlds, before it is made: problems, the engine's answers, and the state to go back to."""

    batch: Batch
    impulse: FloatArray  # N s
    state: dict[str, FloatArray]  # (worlds, ...) by the names of MjData
    rows: np.ndarray  # (worlds,) rows that are not padding
    contacts: np.ndarray  # (worlds,) contacts that have such rows


def simulate_world(mj: Any, model: Any, runs: Runs, world: int) -> tuple[FloatArray, Divergence | None]:
    """Simulate a world.

    Returns
    -------
    states : (steps, size)
        Before each step, with controls and warm start (mjSTATE_INTEGRATION); NaN after the step in which the world
        diverged, and in it if MuJoCo ended in an error.
    divergence : Divergence or None
    """
    kind = mj.mjtState.mjSTATE_INTEGRATION
    data, drive = runs.start(mj, model, world), runs.drive(model, world)
    states = np.empty((runs.steps, mj.mj_stateSize(model, kind)))
    for step in range(runs.steps):
        data.ctrl[:] = drive(data, step)
        mj.mj_getState(model, data, states[step], kind)
        try:
            mj.mj_step(model, data)
        except mj.FatalError as error:  # out of memory
            states[step:] = np.nan
            return states, Divergence(world, step, f"MuJoCo ended in an error: {error}", False)
        if has_diverged(mj, data):
            states[step + 1 :] = np.nan
            return states, _divergence_of(mj, model, data, states[step], world, step)
    return states, None


def has_diverged(mj: Any, data: Any) -> bool:
    """Whether MuJoCo has started the simulation again because its numbers were not finite or above mjMAXVAL."""
    kinds = mj.mjtWarning
    return any(
        data.warning[int(k)].number
        for k in (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)
    )


def _divergence_of(mj: Any, model: Any, data: Any, state: FloatArray, world: int, step: int) -> Divergence:
    """Find out what was too large in a step in which MuJoCo started again."""
    kinds = mj.mjtWarning
    for kind, name in ((kinds.mjWARN_BADQPOS, "position"), (kinds.mjWARN_BADQVEL, "velocity")):
        if data.warning[int(kind)].number:
            return Divergence(world, step, f"{name} before the step", True)
    again = mj.MjData(model)
    mj.mj_setState(model, again, state, mj.mjtState.mjSTATE_INTEGRATION)
    try:
        mj.mj_forward(model, again)
    except mj.FatalError as error:
        return Divergence(world, step, f"MuJoCo ended in an error: {error}", False)
    smooth = np.abs(again.qacc_smooth).max(initial=0.0)
    if not smooth <= mj.mjMAXVAL:
        return Divergence(world, step, "acceleration without constraints", True)
    return Divergence(world, step, "acceleration", False)


def fields_of(mj: Any, model: Any, state: FloatArray) -> dict[str, FloatArray]:
    """A state by the names of MjData."""
    data = mj.MjData(model)
    mj.mj_setState(model, data, state, mj.mjtState.mjSTATE_INTEGRATION)
    return {name: np.array(getattr(data, name)) for name in FIELDS}


def frames(engine: str, runs: Runs) -> Iterator[Frame]:
    """Every step of all worlds by MJX or MuJoCo Warp.

    Raises
    ------
    InputError
        The package is not installed, or does not take the model.
    CapabilityError
        MuJoCo Warp has no room for the rows of a world.
    """
    mj, model = runs.load()
    model = copy.copy(model)
    model.opt.jacobian = mj.mjtJacobian.mjJAC_DENSE
    starts = [runs.start(mj, model, world) for world in range(runs.worlds)]
    drives = [runs.drive(model, world) for world in range(runs.worlds)]
    names = ("qpos", "qvel") if runs.starts is None else BEGIN
    begin = {name: np.array([getattr(d, name) for d in starts], np.float32) for name in names}
    try:
        step = {"mjx": _mjx, "mujoco_warp": _warp}[engine](mj, model, begin)
    except ImportError as error:
        package = {"mjx": "mujoco-mjx", "mujoco_warp": "mujoco-warp"}[engine]
        raise InputError(f"engine {engine!r} cannot be imported ({error}): pip install {package}") from None
    except (NotImplementedError, ValueError) as error:
        raise InputError(f"engine {engine!r} does not take {runs.model}: {error}") from None
    dt = float(model.opt.timestep)
    for k in range(runs.steps):
        ctrl = np.array([drive(d, k) for drive, d in zip(drives, starts, strict=True)], np.float32)
        state, efc, mass, contact, rest = step(ctrl)
        where, address, dim, rub, _ = contact
        given = {f"efc_{name}": x for name, x in efc.items()} | rest
        triangle = mass, model.M_colind, np.append(model.M_rowadr, len(model.M_colind))
        given |= {"M": mass if mass.ndim == 3 else triangle, "qvel": state["qvel"]}
        made = from_efc(**given, timestep=dt, contacts=(where, address, dim, rub))
        made.batch.names_of = _namer(mj, model, made.batch, efc["type"], contact)
        assert made.impulse is not None
        yield Frame(made.batch, made.impulse, state, *_sizes_of(efc["J"], rest.get("nefc"), where, address))


def _sizes_of(jac: Any, nefc: Any, where: Any, address: Any) -> tuple[np.ndarray, np.ndarray]:
    """Count the rows of each world that are not padding (zeros of J), and the contacts that begin with one."""
    acts = (jac != 0.0).any(axis=2)
    if nefc is not None:
        acts &= np.arange(acts.shape[1]) < nefc[:, None]
    has_row = (address >= 0) & (address < acts.shape[1])
    has_row[has_row] = acts[where[has_row], address[has_row]]
    return acts.sum(axis=1), np.bincount(where[has_row], minlength=len(jac))


def _mjx(mj: Any, model: Any, begin: dict[str, Any]) -> Any:
    import jax
    from mujoco import mjx

    held = mjx.put_model(model)
    first = mjx.make_data(model)
    data = jax.vmap(lambda own: first.replace(**own))(begin)

    def one(d: Any, c: Any) -> Any:
        d = d.replace(ctrl=c)
        return d, mjx.forward(held, d), mjx.step(held, d)

    both = jax.jit(jax.vmap(one))

    def step(ctrl: Any) -> Any:
        nonlocal data
        before, now, data = both(data, ctrl)
        e, n = now._impl, len(ctrl)
        efc = {name: np.asarray(getattr(e, f"efc_{name}")) for name in
               ("J", "D", "aref", "type", "frictionloss", "force")}  # fmt: skip
        c = e.contact
        address = np.broadcast_to(np.asarray(c.efc_address), (n, np.shape(c.dist)[1]))
        size = address.shape[1]
        contact = (
            np.repeat(np.arange(n), size), address.ravel(), _flat(c.dim, n, size), _flat(c.friction, n, size, 5),
            _flat(c.geom, n, size, 2),
        )  # fmt: skip
        state = {name: np.asarray(getattr(before, name)) for name in FIELDS}
        rest = {"qacc_smooth": np.asarray(now.qacc_smooth), "qfrc_smooth": np.asarray(now.qfrc_smooth)}
        return state, efc, np.asarray(e.M), contact, rest

    return step


def _flat(x: Any, n: int, size: int, *each: int) -> Any:
    """Of all contacts of n worlds, one after the other."""
    return np.broadcast_to(np.asarray(x), (n, size, *each)).reshape(n * size, *each)


def _warp(mj: Any, model: Any, begin: dict[str, Any]) -> Any:
    import mujoco_warp as mjw
    import warp as wp

    wp.config.log_level = getattr(wp, "LOG_WARNING", 30)  # not a line for each kernel
    first = mj.MjData(model)
    mj.mj_forward(model, first)
    rows = max(ROOM, 2 * int(first.nefc))
    held, n = mjw.put_model(model), len(begin["qpos"])
    data = mjw.put_data(model, first, nworld=n, njmax=rows, nconmax=rows)
    for name, x in begin.items():
        if x.size:
            getattr(data, name).assign(x)

    def step(ctrl: Any) -> Any:
        data.ctrl.assign(ctrl)
        state = {name: getattr(data, name).numpy().copy() for name in FIELDS}
        mjw.forward(held, data)
        if int(data.nefc.numpy().max()) > rows or int(data.nacon.numpy()[0]) > n * rows:
            raise CapabilityError(f"a world has more than {rows} rows or contacts, for which room was made")
        e, c, nv = data.efc, data.contact, model.nv
        efc = {name: getattr(e, name).numpy()[:, :rows].copy() for name in
               ("D", "aref", "type", "frictionloss", "force")}  # fmt: skip
        efc["J"] = e.J.numpy()[:, :rows, :nv].copy()
        k = int(data.nacon.numpy()[0])
        parts = [c.worldid, c.efc_address, c.dim, c.friction, c.geom]
        where, address, dim, rub, geom = (x.numpy()[:k].copy() for x in parts)
        rest = {name: getattr(data, name).numpy().copy() for name in ("qacc_smooth", "qfrc_smooth")}
        made = state, efc, data.M.numpy().copy(), (where, address[:, 0], dim, rub, geom)
        rest["nefc"] = data.nefc.numpy().copy()
        mjw.step(held, data)
        return *made, rest

    return step


def _namer(mj: Any, model: Any, batch: Batch, of: IntArray, contact: Any) -> Any:
    """Names of the blocks of a world, by the type of its rows and the geoms of its contacts."""
    where, address, _, _, geom = contact

    def geom_name(g: Any) -> str:
        return mj.mj_id2name(model, mj.mjtObj.mjOBJ_GEOM, int(g)) or str(int(g))

    def names_of(i: int) -> list[str]:
        types = np.broadcast_to(of, (len(batch), of.shape[-1]))[i]
        first = {int(address[k]): k for k in np.flatnonzero((where == i) & (address >= 0))}
        names, word, begun = [], "contact", 0
        for row in batch._cones_of(i).ptr[:-1].tolist():
            if row in first:
                word, begun = f"contact ({', '.join(map(geom_name, geom[first[row]]))})", row
            edge = f", edge {row - begun}" if int(types[row]) == PYRAMIDAL else ""
            names.append(KIND.get(int(types[row]), word + edge))
        return names

    return names_of
