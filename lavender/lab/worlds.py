"""Worlds of one MuJoCo model, stepped by the engine that is asked for, and the constraint problem of every step.

World 0 is what `lavender record` simulates; the others differ from it by their start and by their random controls:

    qvel += spread N(0, 1) [m/s, rad/s], drawn with (seed, world)        controls drawn with seed + world

A problem is that of the engine's own forward pass, from its own warm start, with its own answer beside it. MJX and
MuJoCo Warp step all worlds at once, and hold float32.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray, IntArray, number, whole_number
from lavender.base.errors import CapabilityError, InputError
from lavender.io.efc import from_efc
from lavender.io.recording import Control, control_of, drive_of, model_of
from lavender.problem.batch import Batch

ENGINES = ("mujoco", "mjx", "mujoco_warp")
FIELDS = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart")  # what a step is made of
KIND = {0: "equality", 1: "friction loss", 2: "friction loss", 3: "limit of a joint", 4: "limit of a tendon"}
PYRAMIDAL = 6  # of mjtConstraint, as the keys of KIND
ROOM = 256  # rows of each world that MuJoCo Warp is given at least


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
    """

    model: str
    worlds: int
    steps: int
    control: Control = "random"
    seed: int = 0
    spread: float = 0.1

    def __post_init__(self) -> None:
        for name in ("worlds", "steps"):
            whole_number(name, getattr(self, name), 1, None)
        object.__setattr__(self, "control", control_of(self.control))
        whole_number("seed", self.seed, high=None)
        number("spread", self.spread, low=0.0)

    def load(self) -> tuple[Any, Any]:
        """MuJoCo and the model; InputError where its problems cannot be read."""
        mj, model = model_of(self.model)
        drive_of(model, self.control, self.seed)
        return mj, model

    def start(self, mj: Any, model: Any, world: int) -> Any:
        """MjData as this world begins."""
        data = mj.MjData(model)
        if world:
            data.qvel[:] += self.spread * np.random.default_rng([self.seed, world]).standard_normal(model.nv)
        return data

    def drive(self, model: Any, world: int) -> Any:
        """The controls of a world by (data, step)."""
        return drive_of(model, self.control, self.seed + world)


class Frame(NamedTuple):
    """One step of all worlds, before it is made: problems, the engine's answers, and the state to go back to."""

    batch: Batch
    impulse: FloatArray  # N s
    state: dict[str, FloatArray]  # (worlds, ...) by the names of MjData


def states_of(mj: Any, model: Any, runs: Runs, world: int) -> FloatArray:
    """(steps, size) states before each step of a world, controls and warm start in them (mjSTATE_INTEGRATION).

    NaN from where a world flies apart on: MuJoCo ends in an error, or begins it anew.
    """
    kind = mj.mjtState.mjSTATE_INTEGRATION
    data, drive = runs.start(mj, model, world), runs.drive(model, world)
    states = np.empty((runs.steps, mj.mj_stateSize(model, kind)))
    for step in range(runs.steps):
        data.ctrl[:] = drive(data, step)
        mj.mj_getState(model, data, states[step], kind)
        try:
            mj.mj_step(model, data)
        except mj.FatalError:  # out of memory
            states[step:] = np.nan
            break
        if flew_apart(mj, data):
            states[step + 1 :] = np.nan
            break
    return states


def flew_apart(mj: Any, data: Any) -> bool:
    """Whether MuJoCo has begun the simulation anew, for its numbers were not finite or huge."""
    kinds = mj.mjtWarning
    return any(
        data.warning[int(k)].number
        for k in (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC)
    )


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
    begin = {name: np.array([getattr(d, name) for d in starts], np.float32) for name in ("qpos", "qvel")}
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
        yield Frame(made.batch, made.impulse, state)


def _mjx(mj: Any, model: Any, begin: dict[str, Any]) -> Any:
    import jax
    from mujoco import mjx

    held = mjx.put_model(model)
    first = mjx.make_data(model)
    data = jax.vmap(lambda q, v: first.replace(qpos=q, qvel=v))(begin["qpos"], begin["qvel"])

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
    data.qpos.assign(begin["qpos"])
    data.qvel.assign(begin["qvel"])

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
