"""Settings of MuJoCo, and stretches of simulated worlds on which they are measured.

A stretch is `horizon` steps of a simulated world (`lavender.audit.tune.measured`). Each setting steps from the
start of each stretch by itself, warm-started from its own answers. A setting with another cone, impratio or number of
noslip iterations than the model defines another constraint problem: its error is measured on that problem, its motion
shows how far it deviates, and it is not recommended.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from time import perf_counter
from types import SimpleNamespace
from typing import Any

import numpy as np

from lavender.audit.audit import MAX_PROBLEMS_IN_MEMORY
from lavender.audit.settings import OPTIONS, MujocoSetting, Setting, get_option_value
from lavender.audit.simulated_worlds import Runs, has_diverged, simulate_world
from lavender.audit.tune.measured import Measured, Stage, make_unmeasured
from lavender.audit.tune.tables import MUJOCO, list_options
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.batch.residuals import residual_many
from lavender.io.efc import from_mujoco_many

CONVERGED_OPTIONS = {
    "solver": "Newton",
    "iterations": 300,
    "tolerance": 0.0,
    "ls_iterations": 100,
    "ls_tolerance": 1e-4,
}


def get_default_options(mj: Any) -> dict[str, Any]:
    """Return MuJoCo's default values of `OPTIONS`."""
    default = SimpleNamespace(opt=mj.MjOption())
    return {name: get_option_value(mj, default, name) for name in OPTIONS}


@dataclass(eq=False)
class MujocoStage(Stage):
    """Worlds of a MuJoCo model on which settings are measured.

    Parameters
    ----------
    mj, model
        The module mujoco and the model with its own setting.
    starts : (n, size)
        State at the start of each stretch.
    controls : (n, horizon, nu)
    ends : (n, bodies, 3) m
        Positions of the bodies after each stretch of the converged run.
    """

    mj: Any
    model: Any
    starts: FloatArray
    controls: FloatArray
    ends: FloatArray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def from_stretches_of_runs(
        cls, mj: Any, model: Any, runs: Runs, worlds: Iterable[int], horizon: int
    ) -> MujocoStage:
        """Cut worlds that run with the model's own setting into stretches."""
        starts, controls = [], []
        for world in worlds:
            drive = runs.make_controller(model, world)
            world_controls = np.array([drive(None, step) for step in range(runs.steps)])
            ctrl = world_controls.reshape(runs.steps // horizon, horizon, model.nu)
            starts.append(simulate_world(mj, model, runs, world)[0][::horizon])
            controls.append(ctrl)
        configured = cls(mj, model, np.concatenate(starts), np.concatenate(controls))
        try:
            configured.ends = configured.run_stretches(
                MujocoSetting.from_options(mj, model, **CONVERGED_OPTIONS).apply_to(mj, model)
            )[1]
        except mj.FatalError as error:
            raise InputError(f"{runs.model}: MuJoCo raised an error, {error}") from None
        return configured

    def run_stretches(self, model: Any, states: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Run all stretches.

        Returns (seconds of each step, positions of bodies after each stretch (n, bodies, 3) [m]), and stores the state
        before each step in `states`.
        """
        mj, kind = self.mj, self.mj.mjtState.mjSTATE_INTEGRATION
        data = mj.MjData(model)
        n, horizon, _ = self.controls.shape
        step_times = np.empty(n * horizon)
        ends = np.empty((n, model.nbody, 3))
        for i in range(n):
            mj.mj_setState(model, data, self.starts[i], kind)
            for k in range(horizon):
                data.ctrl[:] = self.controls[i, k]
                if states is not None:
                    mj.mj_getState(model, data, states[horizon * i + k], kind)
                begin = perf_counter()
                mj.mj_step(model, data)
                step_times[horizon * i + k] = perf_counter() - begin
            mj.mj_kinematics(model, data)
            ends[i] = np.nan if has_diverged(mj, data) else data.xpos
        return step_times, ends

    def judge_setting(self, setting: Setting) -> Measured:
        """Judge a setting without timing it; its errors are infinite if a world diverges."""
        assert isinstance(setting, MujocoSetting)
        mj, model = self.mj, setting.apply_to(self.mj, self.model)
        result = make_unmeasured(setting, str(get_option_value(mj, model, "solver")))
        states = np.empty((self.controls.shape[0] * self.controls.shape[1], self.starts.shape[1]))
        judge = copy.copy(model)
        judge.opt.noslip_iterations = 0
        errors: list[FloatArray] = []
        rows: list[Any] = []
        contacts: list[Any] = []
        try:
            ends = self.run_stretches(model, states)[1]
            for i in range(0, len(states), MAX_PROBLEMS_IN_MEMORY):
                batch, impulse = from_mujoco_many(
                    judge, states[i : i + MAX_PROBLEMS_IN_MEMORY], errors="status"
                )
                errors.append(residual_many(batch, impulse, errors="status").velocity_error)
                rows.append(batch.row_counts)
                contacts.append(batch.contact_counts)
        except (mj.FatalError, InputError):  # A step or a forward pass failed.
            return result
        distance = np.linalg.norm(ends - self.ends, axis=2).max(axis=1)
        if np.isnan(distance).any():
            return result
        sizes: dict[str, Any] = {"rows": np.concatenate(rows), "contacts": np.concatenate(contacts)}
        return replace(
            result, error=np.nan_to_num(np.concatenate(errors), nan=np.inf), motion=distance, **sizes
        )

    @property
    def own_setting(self) -> Setting:
        """The model's own setting."""
        return MujocoSetting()

    def list_first_settings(self) -> list[Setting]:
        """List the first settings."""
        return [*list_first_settings(self.mj, self.model)]

    def list_variants(self, setting: Setting) -> list[Setting]:
        """List variants of a setting."""
        return [*list_variants(self.mj, self.model, setting)]

    def prepare_timing(self, setting: Setting) -> Callable[[], FloatArray]:
        """Return a function that runs all stretches and returns the time of each step."""
        assert isinstance(setting, MujocoSetting)
        model = setting.apply_to(self.mj, self.model)
        return lambda: self.run_stretches(model)[0]


def list_first_settings(mj: Any, model: Any) -> list[MujocoSetting]:
    """List the first settings: the own one, MuJoCo's defaults, and each solver with each tolerance and budget.

    Settings that change the problem are last.
    """
    enough = {"iterations": max(100, int(model.opt.iterations))}
    tried = [enough | x if "tolerance" in x else x for x in list_options(MUJOCO)]
    own = MujocoSetting.from_options(mj, model)
    default = replace(MujocoSetting.from_options(mj, model, **get_default_options(mj)), is_default=True)
    return list(dict.fromkeys([own, default, *(MujocoSetting.from_options(mj, model, **x) for x in tried)]))


def list_variants(mj: Any, model: Any, setting: Setting) -> list[MujocoSetting]:
    """List variants of a setting: other line searches, and dense instead of sparse J or the reverse."""
    options = dict(setting.options)
    stored = "dense" if mj.mj_isSparse(model) else "sparse"
    tried: list[dict[str, Any]] = [{"jacobian": stored}]
    if options.get("solver", get_option_value(mj, model, "solver")) != "PGS":
        tried += [{"ls_tolerance": x} for x in (0.1, 1e-3)] + [{"ls_iterations": n} for n in (5, 15, 50)]
        tried += [{"jacobian": stored, "ls_tolerance": x} for x in (0.1, 1e-3)]
    return [MujocoSetting.from_options(mj, model, **options | x) for x in tried]
