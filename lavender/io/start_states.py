"""Read models, start states and controls of MuJoCo simulations.

`read_states` reads a file with `state`, which has a vector of mjSTATE_INTEGRATION in each row, or arrays with the names
of MjData, of which qpos and qvel are required. Only the vector contains all that a step depends on (warm start,
controls, mocap bodies, applied forces, the state of plug-ins), except which trees sleep: MuJoCo wakes all trees when a
state is set. Quantities without an array have the values of a new MjData.
"""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import os
import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, as_array, check_int
from lavender.base.errors import InputError
from lavender.io.mujoco_memory import import_mujoco
from lavender.io.stored import SUFFIXES, as_path, read_arrays, read_bytes

CONTROLS = ("zero", "random", "hold")
Control = str | Callable[[Any, Any, int], Any] | Any
KEYFRAMES = "keyframes"
MODEL_SUFFIXES = (".xml", ".mjb")  # Suffixes of files with a model of MuJoCo.
VECTOR = "state"
NEEDED = ("qpos", "qvel")
OPTIONAL = (
    "act",
    "ctrl",
    "qacc_warmstart",
    "time",
    "mocap_pos",
    "mocap_quat",
    "userdata",
    "eq_active",
    "qfrc_applied",
    "xfrc_applied",
)
# Additional arrays in the files of `lavender audit`: the origin of each state.
LABELS = ("world", "step", "model", "mujoco")
# Arrays of a model with these prefixes determine the motion; together with a state they define a step's problem.
MODEL_ARRAYS = (
    "body_",
    "jnt_",
    "dof_",
    "geom_",
    "eq_",
    "tendon_",
    "wrap_",
    "actuator_",
    "pair_",
    "flex_",
    "qpos",
)
APPEARANCE = ("rgba", "matid", "user", "group", "plugin")  # Arrays with these words do not.


def load_model(source: Any) -> tuple[Any, Any]:
    """Return the module mujoco and a model: of a file (MJCF, .mjb), or a mujoco.MjModel as it is."""
    mj = import_mujoco()
    if isinstance(source, mj.MjModel):
        return mj, source
    if not isinstance(source, (str, os.PathLike)):
        raise InputError(
            f"model is a {type(source).__name__}; the path of a model (MJCF, .mjb) or a mujoco.MjModel is needed"
        )
    path = str(as_path(source))
    if Path(path).suffix.lower() in SUFFIXES:
        raise InputError(
            f"{path} has the suffix of a problem file; a model of MuJoCo (MJCF) is needed"
        )
    is_binary = Path(path).suffix.lower() == ".mjb"
    try:
        read = mj.MjModel.from_binary_path if is_binary else mj.MjModel.from_xml_path
        return mj, read(path)
    except ValueError as error:  # MuJoCo raises it for a file that it cannot read.
        raise InputError(f"{path}: {error}") from None


def name_model(source: Any) -> str:
    """Return the name of a model: of its file, or in its MJCF."""
    if isinstance(source, (str, os.PathLike)):
        return Path(source).name
    return bytes(source.names).split(b"\0", 1)[0].decode(errors="replace") or "model"


def hash_model(model: Any, options: bool = False) -> str:
    """Return a hash of the arrays of a model that determine its motion; with `options`, also of its options."""
    digest = hashlib.sha256()
    for name in dir(model):
        if name.startswith(MODEL_ARRAYS) and not any(word in name for word in APPEARANCE):
            values = getattr(model, name)
            if isinstance(values, np.ndarray):
                digest.update(name.encode() + np.ascontiguousarray(values).tobytes())
    if options:
        values = [getattr(model.opt, name) for name in dir(model.opt) if not name.startswith("_")]
        digest.update(repr([x for x in values if not callable(x)]).encode())
    return digest.hexdigest()


def load_controls(control: Control) -> Control:
    """Return controls for `record`: the array of a file (.npy), or `control` unchanged."""
    if not isinstance(control, str) or control in CONTROLS:
        return control
    needed = f"one of {', '.join(CONTROLS)}, or a .npy file of one array, is needed"
    try:
        read_bytes(control, count=8)  # Raises an error if `control` is not a regular file.
        # A memory map cannot be longer than the file, whatever size the header declares.
        result = np.load(control, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"controls {control} cannot be read ({error}); {needed}") from None
    if not isinstance(result, np.ndarray):
        result.close()
        raise InputError(f"controls {control}: it is an archive of several arrays; {needed}")
    return result


def make_controller(
    model: Any, control: Control, seed: int
) -> Callable[[Any, int], FloatArray | None]:
    """Return a function (data, step) -> controls (nu,) or None; see `record`."""
    n = int(model.nu)
    if callable(control):
        call: Callable[[Any, Any, int], Any] = control

        def called(data: Any, step: int) -> FloatArray | None:
            values = call(model, data, step)
            return None if values is None else as_array(f"control of step {step}", values, (n,))

        return called
    if isinstance(control, str):
        if control not in CONTROLS:
            raise InputError(
                f"control is {control!r}; {', '.join(CONTROLS)}, an array or function is needed"
            )
        if control == "zero":
            return lambda data, step: np.zeros(n)
        if control == "hold":
            return lambda data, step: None
        rng = np.random.default_rng(check_int("seed", seed, high=None))
        limited = np.array(model.actuator_ctrllimited, bool)[:, None]
        low, high = np.where(limited, np.array(model.actuator_ctrlrange), [-1.0, 1.0]).T
        return lambda data, step: rng.uniform(low, high)
    rows = as_array("control", control, (None, n))
    if len(rows) == 0:
        raise InputError(
            f"control has shape {rows.shape}; (any, {n}) with at least one row is needed"
        )
    return lambda data, step: rows[step % len(rows)]


@dataclass(frozen=True, eq=False)
class StartStates:
    """States in which simulations start."""

    vectors: FloatArray  # (n, size): state vectors of mjSTATE_INTEGRATION, as `mj_getState` returns them.
    controls: FloatArray | None = (
        None  # (n, nu): controls of the first step; None if the source has none.
    )
    # Quantities on which a step depends and that arrays of states lack: "warm start", "controls".
    missing: tuple[str, ...] = ()
    misfit: str = ""  # Sentence on states that do not fit the model; else empty.

    @property
    def notes(self) -> list[str]:
        """Sentences about quantities that the states lack, and about states that do not fit the model."""
        consequences = {
            "warm start": "the first solve of each world starts cold",
            "controls": "the first step uses the controls of --controls",
        }
        notes = [self.misfit] if self.misfit else []
        if self.missing:
            changes = " and ".join(consequences[name] for name in self.missing)
            notes.append(
                f"The start states have no {' and no '.join(self.missing)}: {changes}. The first step therefore has "
                "other errors than in the original simulation. Only the array `state` (mjSTATE_INTEGRATION) has both."
            )
        return notes

    def __len__(self) -> int:
        return len(self.vectors)

    def select_evenly(self, count: int) -> StartStates:
        """Return at most `count` of the states, evenly spaced."""
        if len(self) <= count:
            return self
        chosen = np.arange(count) * len(self) // count
        controls = None if self.controls is None else self.controls[chosen]
        return dataclasses.replace(self, vectors=self.vectors[chosen], controls=controls)


def can_sleep(mj: Any, model: Any) -> bool:
    """Return whether the model has <flag sleep="enable"/>."""
    flag = getattr(mj.mjtEnableBit, "mjENBL_SLEEP", 0)
    return bool(model.opt.enableflags & int(flag))


def without_sleep(mj: Any, model: Any) -> Any:
    """Return a copy of the model with <flag sleep="disable"/>, or the model itself if it has this flag.

    A state does not contain which trees sleep. Steps that are repeated from states must not use sleep.
    """
    if not can_sleep(mj, model):
        return model
    awake = copy.copy(model)
    awake.opt.enableflags &= ~int(mj.mjtEnableBit.mjENBL_SLEEP)
    return awake


def read_states(mj: Any, model: Any, source: Any) -> StartStates:
    """Read start states: path of an .npz, "keyframes", mapping of arrays, array (n, size), or StartStates."""
    if isinstance(source, StartStates):
        return source
    if isinstance(source, str) and source == KEYFRAMES:
        if not model.nkey:
            raise InputError("states are 'keyframes', and the model has none; a keyframe is needed")
        data = mj.MjData(model)
        vectors = []
        for key in range(model.nkey):
            mj.mj_resetDataKeyframe(model, data, key)
            vectors.append(_read_state_vector(mj, model, data))
        controls = np.array(model.key_ctrl, float).reshape(model.nkey, model.nu)
        return StartStates(np.array(vectors), controls)
    arrays: Mapping[str, Any] = source if isinstance(source, Mapping) else {VECTOR: source}
    label = "states"
    if isinstance(source, (str, os.PathLike)):
        label = f"states {os.fspath(source)}"
        arrays = read_arrays(source)
    misfit = ""
    versions = {*np.atleast_1d(arrays.get("mujoco", mj.__version__)).tolist()} - {mj.__version__}
    if versions:
        misfit = (
            f"The start states are of MuJoCo {', '.join(sorted(versions))}, and {mj.__version__} is installed: "
            "versions differ in inertias of meshes, in defaults and in the contents of a state, so that errors differ."
        )
    try:
        states = _read_arrays(mj, model, arrays, label)
    except InputError as error:
        raise InputError(f"{error}. {misfit}" if misfit else str(error)) from None
    models = {*np.atleast_1d(arrays["model"]).tolist()} if "model" in arrays else set()
    if models and not misfit and models != {hash_model(model)}:
        misfit = (
            "The start states are of a model with other bodies, geoms, joints or equalities: if it was changed after "
            "loading, give the changed model as a mujoco.MjModel or as .mjb (mujoco.mj_saveModel)."
        )
    return dataclasses.replace(states, misfit=misfit)


def check_array_names(source: str, names: Iterable[str], valid: Iterable[str]) -> None:
    """Raise InputError at the first name that is neither valid nor one of `LABELS`; `source` begins the message."""
    valid = tuple(valid)
    for name in names:
        if name not in (*valid, *LABELS):
            raise InputError(
                f"{source} has an array {name!r}; the arrays of a state are {', '.join(valid)}"
            )


def _read_arrays(mj: Any, model: Any, arrays: Mapping[str, Any], source: str) -> StartStates:
    """Build states from arrays by name; `source` begins the error messages."""
    check_array_names(source, arrays, (VECTOR, *NEEDED, *OPTIONAL))
    if VECTOR in arrays:
        return _read_vectors(mj, model, arrays[VECTOR], source)
    missing = [name for name in NEEDED if name not in arrays]
    if missing:
        raise InputError(
            f"{source} has no {' and no '.join(missing)}; {VECTOR!r}, or qpos and qvel, is needed"
        )
    data = mj.MjData(model)
    parts: dict[str, FloatArray] = {}
    for name in (*NEEDED, *OPTIONAL):
        if name in arrays:
            shape = np.shape(getattr(data, name))
            values = np.asarray(arrays[name])
            values = values[None] if values.ndim == len(shape) else values
            parts[name] = as_array(f"{source}: {name}", values, (None, *shape))
    counts = {name: len(x) for name, x in parts.items()}
    n = counts["qpos"]
    if n == 0 or set(counts.values()) != {n}:
        sizes = ", ".join(f"{count} of {name}" for name, count in counts.items())
        raise InputError(
            f"{source} holds unequal or no states: {sizes}; one number above 0 is needed"
        )
    vectors = []
    for i in range(n):
        data = mj.MjData(model)
        for name, x in parts.items():
            if name == "time":
                data.time = float(x[i])
            else:
                getattr(data, name)[:] = x[i]
        vectors.append(_read_state_vector(mj, model, data))
    has = {"warm start": "qacc_warmstart" in parts, "controls": "ctrl" in parts or not model.nu}
    absent = tuple(name for name, is_present in has.items() if not is_present)
    return StartStates(np.array(vectors), parts.get("ctrl"), absent)


def _read_vectors(mj: Any, model: Any, states: Any, source: str) -> StartStates:
    """Build states from vectors (n, size) of mjSTATE_PHYSICS, mjSTATE_FULLPHYSICS or mjSTATE_INTEGRATION."""
    integration = mj.mjtState.mjSTATE_INTEGRATION
    kinds = {
        mj.mj_stateSize(model, kind): kind
        for kind in (mj.mjtState.mjSTATE_PHYSICS, mj.mjtState.mjSTATE_FULLPHYSICS, integration)
    }
    states = np.asarray(states)
    states = as_array(
        f"{source}: {VECTOR}", states[None] if states.ndim == 1 else states, (None, None)
    )
    n, size = states.shape
    if size not in kinds or n == 0:
        raise InputError(
            f"{source}: {VECTOR} has shape {states.shape}; (n, {mj.mj_stateSize(model, integration)}) of "
            "mjSTATE_INTEGRATION, n at least 1, is needed for this model"
        )
    vectors, controls = [], []
    for state in states:
        data = mj.MjData(model)
        mj.mj_setState(model, data, state, kinds[size])
        vectors.append(_read_state_vector(mj, model, data))
        controls.append(np.array(data.ctrl))
    if kinds[size] == integration:
        return StartStates(np.array(vectors), np.array(controls))
    return StartStates(
        np.array(vectors), missing=("warm start", *(("controls",) if model.nu else ()))
    )


def _read_state_vector(mj: Any, model: Any, data: Any) -> FloatArray:
    kind = mj.mjtState.mjSTATE_INTEGRATION
    vector = np.empty(mj.mj_stateSize(model, kind))
    mj.mj_getState(model, data, vector, kind)
    return vector
