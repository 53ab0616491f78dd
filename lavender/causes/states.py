"""Compare two models of MuJoCo, two sets of options, or stored steps, at one state or several."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lavender.base.errors import CapabilityError, InputError
from lavender.causes.comparison import compare
from lavender.causes.page import Comparisons, StateComparison
from lavender.io.mujoco_memory import import_mujoco
from lavender.io.mujoco_step import step_from_mujoco
from lavender.io.start_states import load_model, read_states
from lavender.io.step_record import StepRecord, load_step

#: Option -> prefix of MuJoCo's enumerators, for options whose values are words.
WORD_OPTIONS = {"integrator": ("mjtIntegrator", "mjINT_"), "cone": ("mjtCone", "mjCONE_"),
                "solver": ("mjtSolver", "mjSOL_")}  # fmt: skip


def is_step_file(source: Any) -> bool:
    """Return whether a source is the path of a stored step."""
    return isinstance(source, str | os.PathLike) and os.fspath(source).lower().endswith(".npz")


def set_options(mj: Any, model: Any, options: Mapping[str, str]) -> None:
    """Set options of a model by their names and values in MJCF.

    Raises
    ------
    InputError
        An option or its value is unknown.
    """
    for name, text in options.items():
        if not hasattr(model.opt, name):
            raise InputError(f"option {name!r} is not one of MuJoCo's <option>")
        if name in WORD_OPTIONS:
            kind, prefix = WORD_OPTIONS[name]
            members = {m.lower(): value for m, value in getattr(mj, kind).__members__.items()}
            value = members.get(f"{prefix}{text}".lower())
            if value is None:
                known = ", ".join(m[len(prefix) :] for m in members)
                raise InputError(f"option {name} is {text!r}; {known} are known")
            setattr(model.opt, name, int(value))
            continue
        try:
            numbers = [float(x) for x in text.split()]
        except ValueError:
            raise InputError(f"option {name} is {text!r}; numbers are needed") from None
        now = getattr(model.opt, name)
        if np.ndim(now):
            if len(numbers) != len(now):
                raise InputError(f"option {name} has {len(numbers)} numbers; {len(now)} are needed")
            now[:] = numbers
        else:
            setattr(model.opt, name, type(now)(numbers[0]))


def compare_at_states(
    a: Any,
    b: Any = None,
    *,
    states: Any = None,
    steps: int = 1,
    options: Mapping[str, str] | None = None,
) -> tuple[Comparisons, tuple[StepRecord, ...]]:
    """Compare two sources at states of the first one; return the comparisons and the records of the first source.

    Parameters
    ----------
    a, b : path of a model, mujoco.MjModel, or path of a stored step
        Without `b`, `a` with the `options` is the second one; without both, `a` is compared with the rigid laws.
    states : path of an .npz, "keyframes", or arrays, optional
        Default: the model's initial state, or the one of the stored step.
    steps : int, default 1
        Steps that the first model does from each state; the last one is compared.
    options : dict of str, optional
        Options of the second model, by their names in MJCF.

    Raises
    ------
    InputError
        The sources have other coordinates, an option is unknown, or a stored step has no position.
    """
    options = dict(options or {})
    pairs: list[tuple[int, StepRecord, StepRecord | None, Any]]
    if is_step_file(a):
        if states is not None or steps != 1:
            raise InputError("a stored step has its own state: leave states and steps out")
        first = load_step(a)
        pairs = [(0, first, _read_second(first, b, options), None)]
    else:
        pairs = list(_iterate_records(a, b, states, steps, options))
    found = tuple(StateComparison(i, compare(x, y, simulation=s)) for i, x, y, s in pairs)
    names = [
        Path(os.fspath(s)).name if isinstance(s, str | os.PathLike) else "model"
        for s in (a, b)
        if s is not None
    ]
    title = " · ".join([*names, *(f"{k}={v}" for k, v in options.items())])
    return Comparisons(found, title), tuple(x for _, x, _, _ in pairs)


def _read_second(first: StepRecord, b: Any, options: Mapping[str, str]) -> StepRecord | None:
    """Return the second record for a stored first one."""
    if b is None:
        if options:
            raise InputError("options need a model: give MODEL.xml as the second argument")
        return None
    if is_step_file(b):
        return load_step(b)
    mj, model = load_model(b)
    set_options(mj, model, options)
    if first.position is None or len(first.position) != model.nq or len(first.velocity) != model.nv:
        raise InputError("the stored step has no position in the coordinates of this model")
    data = mj.MjData(model)
    data.qpos[:], data.qvel[:] = first.position, first.velocity
    for name, target in (("control", data.ctrl), ("activation", data.act)):
        values = np.asarray(first.settings.get(name, ()), float)
        if len(values) == len(target):
            target[:] = values
    return step_from_mujoco(model, data)


def _iterate_records(
    a: Any, b: Any, states: Any, steps: int, options: Mapping[str, str]
) -> Iterator[tuple[int, StepRecord, StepRecord | None, tuple[Any, Any] | None]]:
    """Yield (number of the state, first record, second record or None, model and state without a second record)."""
    mj = import_mujoco()
    _, model = load_model(a)
    second = None
    if b is not None and not is_step_file(b):
        second = load_model(b)[1]
    elif options:
        second = load_model(a)[1]
    if second is not None:
        set_options(mj, second, options)
        if (second.nq, second.nv) != (model.nq, model.nv):
            raise InputError(
                f"the models have {model.nq} and {second.nq} positions, {model.nv} and {second.nv} velocities: both "
                "must have the same joints"
            )
    kind = mj.mjtState.mjSTATE_INTEGRATION
    vectors = [None] if states is None else list(read_states(mj, model, states).vectors)
    for i, vector in enumerate(vectors):
        data = mj.MjData(model)
        if vector is not None:
            mj.mj_setState(model, data, vector, kind)
        for _ in range(steps - 1):
            mj.mj_step(model, data)
        names = [f"MuJoCo {mj.__version__}"] * 2
        if second is not None:
            names = _name_models(a, b, options)
        try:
            first = step_from_mujoco(model, data, engine=names[0])
        except CapabilityError as error:
            raise CapabilityError(f"state {i}: {error}") from None
        other = None
        if second is not None:
            copied = mj.MjData(second)
            copied.qpos[:], copied.qvel[:] = data.qpos, data.qvel
            for name in ("ctrl", "act", "qacc_warmstart", "qfrc_applied", "xfrc_applied"):
                if getattr(copied, name).shape == getattr(data, name).shape:
                    getattr(copied, name)[:] = getattr(data, name)
            copied.time = data.time
            other = step_from_mujoco(second, copied, engine=names[1])
        elif b is not None:
            other = load_step(b)
        yield i, first, other, (model, data) if other is None else None


def _name_models(a: Any, b: Any, options: Mapping[str, str]) -> list[str]:
    """Return short names of two models."""
    if b is None:
        return ["model", "model with " + " ".join(f"{k}={v}" for k, v in options.items())]
    first, second = (
        Path(os.fspath(s)).stem if isinstance(s, str | os.PathLike) else "" for s in (a, b)
    )
    return (
        [first, second] if first and second and first != second else ["first model", "second model"]
    )
