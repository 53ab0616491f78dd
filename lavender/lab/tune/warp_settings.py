"""Settings of MuJoCo Warp, which steps all stretches as worlds of one batch, in float32.

A stretch is a part of `horizon` steps of a simulated world (`lavender.lab.tune.measured`). Each setting steps from the
start of each stretch by itself, warm-started from its own answers. The error is measured on the constraint problem
that MuJoCo Warp builds with the setting; if a setting changes the problem, this is the changed problem.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.batch.residuals import residual_many
from lavender.lab.simulated_worlds import START_FIELDS, Runs, WarpWorlds, make_frame
from lavender.lab.tune.measured import Measured, Setting, Stage, make_unmeasured
from lavender.lab.tune.mujoco_settings import CONVERGED_OPTIONS, MujocoSetting, get_option_value

# Relative tolerances to try. MuJoCo Warp raises smaller tolerances to about the round-off of float32.
WARP_TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
WARP_ITERATIONS = {"Newton": (1, 2, 3, 5, 10, 20), "CG": (3, 6, 12, 25, 50)}
WARP_LINE_SEARCHES = (3, 5, 10, 20)


@dataclass(eq=False)
class WarpStage(Stage):
    """Stretches of a MuJoCo model in MuJoCo Warp.

    Parameters
    ----------
    mj, model
        The module mujoco and the model with its own setting and a dense Jacobian.
    worlds : WarpWorlds
        One world for each stretch.
    starts : dict of (n, ...)
        State at the start of each stretch.
    controls : (n, horizon, nu)
    ends : (n, bodies, 3) m
        Positions of the bodies after each stretch of the converged run.
    """

    mj: Any
    model: Any
    worlds: WarpWorlds
    starts: dict[str, Any]
    controls: FloatArray
    ends: FloatArray

    @classmethod
    def from_stretches_of_runs(
        cls, mj: Any, model: Any, runs: Runs, worlds: Iterable[int], horizon: int
    ) -> WarpStage:
        """Cut worlds that run with the model's own setting into stretches."""
        model, chosen = copy.copy(model), list(worlds)
        model.opt.jacobian = mj.mjtJacobian.mjJAC_DENSE
        data = [runs.create_start_data(mj, model, world) for world in chosen]
        drives = [runs.make_controller(model, world) for world in chosen]
        names = [name for name in START_FIELDS if getattr(data[0], name).size]
        arrays = {name: np.array([getattr(d, name) for d in data], np.float32) for name in names}
        own_controls = [[drive(None, k) for k in range(runs.steps)] for drive in drives]
        controls: Any = np.array(own_controls, np.float32).reshape(len(chosen), runs.steps, model.nu)
        try:
            running = WarpWorlds(mj, model, arrays)
        except ImportError as error:
            raise InputError(
                f"engine 'mujoco_warp' cannot be imported ({error}): pip install mujoco-warp"
            ) from None
        except (NotImplementedError, ValueError) as error:
            raise InputError(f"engine 'mujoco_warp' does not accept {runs.model}: {error}") from None
        starts = []
        for k in range(runs.steps):
            if k % horizon == 0:
                starts.append(running.read_state(names))
            running.advance(controls[:, k])
        # Merge the stretches of all worlds: first the first stretch of each world, then the second of each, and so on.
        merged = {name: np.concatenate([start[name] for start in starts]) for name in names}
        count = runs.steps // horizon
        by_stretch = controls.reshape(len(chosen), count, horizon, model.nu).swapaxes(0, 1)
        by_stretch = by_stretch.reshape(len(chosen) * count, horizon, model.nu)
        stage = cls(mj, model, WarpWorlds(mj, model, merged), merged, by_stretch, np.zeros(0))
        converged = MujocoSetting.from_options(mj, model, **CONVERGED_OPTIONS)
        stage._run(converged, stage.worlds.advance)
        stage.ends = stage.worlds.compute_body_positions()
        return stage

    def _run(self, setting: Setting, step: Callable[[Any], Any]) -> list[Any]:
        """Run all stretches with a setting; return the results of `step`, which receives the controls."""
        assert isinstance(setting, MujocoSetting)
        self.worlds.configure(setting.apply_to(self.mj, self.model))
        self.worlds.start(self.starts)
        return [step(self.controls[:, k]) for k in range(self.controls.shape[1])]

    @property
    def own_setting(self) -> Setting:
        """The model's own setting."""
        return MujocoSetting()

    def list_first_settings(self) -> list[Setting]:
        """List each solver with each tolerance and number of iterations, line searches; then another impratio."""
        enough = max(100, int(self.model.opt.iterations))
        tried: list[dict[str, Any]] = [{}]
        for solver, budgets in WARP_ITERATIONS.items():
            tried += [{"solver": solver, "iterations": enough, "tolerance": t} for t in WARP_TOLERANCES]
            tried += [{"solver": solver, "iterations": n} for n in budgets]
        tried += [{"ls_iterations": n} for n in WARP_LINE_SEARCHES]
        tried += [{"impratio": 1.0}, {"impratio": 10.0}]
        return list(dict.fromkeys(MujocoSetting.from_options(self.mj, self.model, **x) for x in tried))

    def list_variants(self, setting: Setting) -> list[Setting]:
        """List variants of a setting with other line searches."""
        options = dict(setting.options)
        return [
            MujocoSetting.from_options(self.mj, self.model, **options | {"ls_iterations": n})
            for n in WARP_LINE_SEARCHES
        ]

    def judge_setting(self, setting: Setting) -> Measured:
        """Judge a setting without timing it."""
        assert isinstance(setting, MujocoSetting)
        configured = setting.apply_to(self.mj, self.model)
        result = make_unmeasured(setting, str(get_option_value(self.mj, configured, "solver")))
        frames = self._run(setting, lambda ctrl: make_frame(self.mj, configured, *self.worlds(ctrl)))
        distance = np.linalg.norm(self.worlds.compute_body_positions() - self.ends, axis=2).max(axis=1)
        errors = [residual_many(f.batch, f.impulse, errors="status").velocity_error for f in frames]
        if not np.isfinite(distance).all():
            return result
        result.error = np.nan_to_num(np.concatenate(errors), nan=np.inf)
        result.motion = distance
        result.rows, result.contacts = (
            np.concatenate([getattr(f, name) for f in frames]) for name in ("rows", "contacts")
        )
        return result

    def prepare_timing(self, setting: Setting) -> Callable[[], FloatArray]:
        """Return a function that runs all stretches and returns the time of each step, per world [s]."""

        def timed(ctrl: Any) -> float:
            begin = perf_counter()
            self.worlds.advance(ctrl)
            return perf_counter() - begin

        return lambda: np.array(self._run(setting, timed)) / self.worlds.n
