"""Explain the slip of contacts at states of a MuJoCo model, and simulate settings that can reduce it."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lavender.audit.settings import MujocoSetting, get_option_value
from lavender.audit.slip import (
    MIN_EXPLAINED_SLIP,
    REMEDY_STEPS,
    Remedy,
    SlipExplanation,
    average_slip,
    compute_slip,
    explain_slip,
    find_surface_velocity,
    get_geoms,
)
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.io import mujoco as adapter
from lavender.io.mujoco_memory import import_mujoco
from lavender.io.start_states import read_states, without_sleep
from lavender.problem import Problem

MAX_REMEDY_STATES = 8  # Settings are simulated from up to this many states, those with the largest slip.
FRICTION_FACTOR = 2.0  # The friction coefficient is multiplied by this in one of the settings.


def explain_slip_of_states(
    model: Any, states: Any = None, *, contacts: Sequence[str] | str | None = None, steps: int = 1
) -> list[SlipExplanation]:
    """Explain the slip of contacts of a MuJoCo model at given states.

    Parameters
    ----------
    model : mujoco.MjModel
    states : path of an .npz, "keyframes", or arrays, optional
        As for `lavender.audit`: `states.npz` of an audit or a recording. Default: the model's initial state.
    contacts : names or a part of names, optional
        Geoms of the contacts to explain; default: all. States in which these geoms touch nothing are skipped.
    steps : int, default 1
        Steps that are simulated from each state, with its controls and without sleep; the last one is explained.

    Returns
    -------
    list of SlipExplanation
        One for each state that has a contact with friction. The one with the fastest contact has `remedies`: settings
        of MuJoCo, each simulated from up to 8 states, those in which this contact slides fastest.

    Raises
    ------
    InputError
        No geom has one of the names.
    """
    mj = import_mujoco()
    model = without_sleep(mj, model)
    entries = [contacts] if isinstance(contacts, str) else list(contacts or ())
    geoms = [mj.mj_id2name(model, mj.mjtObj.mjOBJ_GEOM, i) or str(i) for i in range(model.ngeom)]
    for entry in entries:
        if model.nflex == 0 and not any(entry in name for name in geoms):
            known = ", ".join(geoms[:8])
            raise InputError(
                f"contacts names {entry!r}, but no geom's name contains it; the geoms are {known}"
            )
    data, before = mj.MjData(model), np.empty(mj.mj_stateSize(model, mj.mjtState.mjSTATE_INTEGRATION))
    vectors = [None] if states is None else list(read_states(mj, model, states).vectors)
    explanations: list[SlipExplanation] = []
    starts = []  # State vector of each explanation.
    for i, vector in enumerate(vectors):
        mj.mj_resetData(model, data)
        if vector is not None:
            mj.mj_setState(model, data, vector, mj.mjtState.mjSTATE_INTEGRATION)
        for _ in range(steps - 1):
            mj.mj_step(model, data)
        mj.mj_forward(model, data)
        mj.mj_getState(model, data, before, mj.mjtState.mjSTATE_INTEGRATION)
        problem, disk, surface = _read_step(mj, model, data)
        measured = problem if disk is None else disk
        blocks = np.flatnonzero(measured.cones.n_tangents > 0).tolist()
        names = [measured.block_name(k) for k in blocks]
        touching = [entry for entry in entries if any(entry in name for name in names)]
        if touching or (names and not entries):
            answer = adapter.impulse(model, data)
            explanation = explain_slip(
                problem, answer, contacts=touching or None, disk=disk, surface_velocity=surface
            )
            chosen = [blocks[names.index(name)] for name in explanation.contacts]
            slips = compute_slip(measured, chosen, data.qvel, surface)
            use = [_compute_friction_use(mj, model, data, name) for name in explanation.contacts]
            speeds = np.array([np.linalg.norm(v) for v in slips])
            explanations.append(
                replace(explanation, speeds_before=speeds, friction_use=np.array(use), state=i)
            )
            starts.append(before.copy())
    fastest = max(range(len(explanations)), key=lambda k: _find_fastest(explanations[k])[0], default=-1)
    if fastest >= 0 and _find_fastest(explanations[fastest])[0] > MIN_EXPLAINED_SLIP:
        pair = _find_fastest(explanations[fastest])[1]
        sliding = [
            (a.speed, k) for k, e in enumerate(explanations) for a in average_slip([e]) if a.contact == pair
        ]
        chosen_starts = [starts[k] for _, k in sorted(sliding, reverse=True)[:MAX_REMEDY_STATES]]
        remedies = tuple(
            Remedy(text, *np.mean([_simulate_slip(mj, changed, x, pair) for x in chosen_starts], axis=0))
            for text, changed in _change_settings(mj, model, pair)
        )
        explanations[fastest] = replace(explanations[fastest], remedies=remedies, n_states=len(chosen_starts))
    return explanations


def _find_fastest(explanation: SlipExplanation) -> tuple[float, str]:
    """Return the sliding speed of the fastest contact [m/s] and the names of its geoms."""
    return max((slip.speed, get_geoms(slip.contact)) for slip in explanation.slips)


def _compute_friction_use(mj: Any, model: Any, data: Any, name: str) -> float:
    """Return the friction force of a contact divided by mu times its normal force; nan without a normal force."""
    k, force = int(name.split()[1]), np.empty(6)
    mj.mj_contactForce(model, data, k, force)
    return (
        float(np.hypot(*(force[1:3] / data.contact[k].friction[:2]))) / force[0] if force[0] > 0.0 else np.nan
    )


def _read_step(mj: Any, model: Any, data: Any) -> tuple[Problem, Problem | None, FloatArray]:
    """Return a step's problem, the one with disks if cones are pyramids, and velocities of the surfaces."""
    problem, disk, final = adapter.from_mujoco(model, data), None, data
    if model.opt.cone == mj.mjtCone.mjCONE_PYRAMIDAL:
        round_model = copy.deepcopy(model)
        round_model.opt.cone = mj.mjtCone.mjCONE_ELLIPTIC
        final = mj.MjData(round_model)
        state = np.empty(mj.mj_stateSize(model, mj.mjtState.mjSTATE_INTEGRATION))
        mj.mj_getState(model, data, state, mj.mjtState.mjSTATE_INTEGRATION)
        mj.mj_setState(round_model, final, state, mj.mjtState.mjSTATE_INTEGRATION)
        mj.mj_forward(round_model, final)
        disk = adapter.from_mujoco(round_model, final)
    measured = problem if disk is None else disk
    if not getattr(model, "flg_surfacevel", False):
        return problem, disk, find_surface_velocity(measured)
    # MuJoCo subtracts the surfaces' velocities from J v.
    return problem, disk, measured.jacobian @ data.qvel - final.efc_vel


def _change_settings(mj: Any, model: Any, geoms: str) -> Iterator[tuple[str, Any]]:
    """Yield the text of each setting that can reduce the slip of two geoms, with the changed model.

    The first is the model itself.
    """
    yield "as it is", model
    options: list[dict[str, Any]] = [
        {"iterations": 10 * int(model.opt.iterations), "tolerance": 1e-12},
        {"impratio": 10.0 * float(model.opt.impratio)},
        {"noslip_iterations": 20},
    ]
    if get_option_value(mj, model, "cone") == "pyramidal":
        options += [{"cone": "elliptic", **x} for x in ({}, *options[1:])]
    settings = [MujocoSetting.from_options(mj, model, **x) for x in options]
    yield from ((s.option_line, s.apply_to(mj, model)) for s in settings if s.options)
    shortest = 2.0 * model.opt.timestep  # MuJoCo uses no shorter time constant.
    if model.geom_solref[:, 0].max(initial=0.0) > shortest:  # Negative values are stiffnesses.
        changed = copy.deepcopy(model)
        for solref in (changed.geom_solref, changed.pair_solref):
            solref[solref[:, 0] > shortest] = shortest, 1.0
        yield f'solref="{shortest:g} 1" of all geoms', changed

    numbers = [mj.mj_name2id(model, mj.mjtObj.mjOBJ_GEOM, name) for name in geoms.split(", ")]
    if len(numbers) == 2 and min(numbers) >= 0:
        changed = copy.deepcopy(model)
        friction = FRICTION_FACTOR * float(model.geom_friction[numbers, 0].max())
        changed.geom_friction[numbers, 0] = friction
        is_own_pair = np.isin(model.pair_geom1, numbers) & np.isin(model.pair_geom2, numbers)
        changed.pair_friction[is_own_pair, :2] *= FRICTION_FACTOR
        yield f'friction="{friction:g}" of {" and ".join(geoms.split(", "))}', changed


def _simulate_slip(mj: Any, model: Any, state: FloatArray, geoms: str) -> tuple[float, float]:
    """Return the sliding speed [m/s] of two geoms in the step from a state, and its mean in the next `REMEDY_STEPS`.

    Steps in which the geoms do not touch do not count. The first speed is nan if the geoms do not touch in its step,
    the second one if they do not touch in the last step.
    """
    data, means = mj.MjData(model), []
    mj.mj_setState(model, data, state, mj.mjtState.mjSTATE_INTEGRATION)
    for _ in range(REMEDY_STEPS + 1):
        mj.mj_forward(model, data)
        problem, disk, surface = _read_step(mj, model, data)
        measured = problem if disk is None else disk
        sliding = np.flatnonzero(measured.cones.n_tangents > 0).tolist()
        blocks = [k for k in sliding if get_geoms(measured.block_name(k)) == geoms]
        mj.mj_step(model, data)
        speeds = [np.linalg.norm(v) for v in compute_slip(measured, blocks, data.qvel, surface)]
        means.append(float(np.mean(speeds)) if speeds else np.nan)
    return means[0], np.nan if np.isnan(means[-1]) else float(np.nanmean(means[1:]))
