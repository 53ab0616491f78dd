"""Settings of newton's SolverKamino (PADMM), which steps all stretches as worlds of one model, in float32.

A stretch is a part of `horizon` steps of a simulated world (`lavender.lab.tune.measured`). Each setting steps from the
start of each stretch by itself. Its first step has no warm start, because a state of newton does not contain impulses.
No setting that is tried changes the constraint problem.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any, ClassVar

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.batch.residuals import residual_many
from lavender.lab.engine_scenes import EngineState, NewtonScene, load_build_function, start_scene
from lavender.lab.tune.measured import Measured, Setting, Stage, make_unmeasured

KAMINO_TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
KAMINO_ITERATIONS = (10, 25, 50, 100, 200, 400)
KAMINO_PENALTIES = (0.01, 0.1, 1.0, 10.0, 100.0)  # Initial penalty rho of ADMM.
KAMINO_CONVERGED = {"max_iterations": 2000, "tolerance": 1e-8}
TOLERANCE_NAMES = ("primal_tolerance", "dual_tolerance", "compl_tolerance")


@dataclass(frozen=True)
class KaminoSetting(Setting):
    """Fields of PADMMSolverConfig that differ from the present configuration.

    "tolerance" sets all three tolerances.
    """

    merge_note: ClassVar[str] = (
        "The lines change a configuration before the solver is built: config = SolverKamino.Config.from_model(model), "
        "then the line, then SolverKamino(model, config=config)."
    )

    @property
    def fields(self) -> dict[str, Any]:
        """Values of the configuration's fields."""
        fields = dict(self.options)
        if "tolerance" in fields:
            fields |= dict.fromkeys(TOLERANCE_NAMES, fields.pop("tolerance"))
        return fields

    @property
    def option_line(self) -> str:
        """Python statement to copy; empty if no option differs."""
        return "; ".join(f"config.padmm.{name} = {x!r}" for name, x in self.fields.items())


@dataclass(eq=False)
class KaminoStage(Stage):
    """Stretches of a scene of newton, stepped by SolverKamino.

    Parameters
    ----------
    scene : NewtonScene
        One world for each stretch.
    starts : dict of (n, ...)
        State at the start of each stretch.
    horizon : int
    ends : (n, bodies, 3) m
        Positions of the bodies after each stretch of the converged run.
    """

    scene: NewtonScene
    starts: EngineState
    horizon: int
    ends: FloatArray

    @classmethod
    def split_worlds(
        cls, scene: str, worlds: int, steps: int, horizon: int, **start: Any
    ) -> tuple[KaminoStage, KaminoStage]:
        """Run worlds with the present setting and cut them into stretches.

        Return the stage of the worlds with even numbers, and the stage of the worlds with odd numbers.
        """
        build = load_build_function(scene, "kamino")
        running = start_scene(build, "kamino", worlds=worlds, **start)
        assert isinstance(running, NewtonScene)
        if running.n != worlds:
            raise InputError(
                f"build() of {scene} returns a finalized model; a ModelBuilder of one world is needed"
            )
        starts: list[EngineState] = []
        for k in range(steps):
            if k % horizon == 0:
                starts.append(running.get_state())
            running.step()
        even, odd = (
            cls.from_starts(
                build,
                {name: np.concatenate([start[name][first::2] for start in starts]) for name in starts[0]},
                horizon,
            )
            for first in (0, 1)
        )
        return even, odd

    @classmethod
    def from_starts(cls, build: Any, starts: EngineState, horizon: int) -> KaminoStage:
        """Create the stage of stretches with these start states."""
        scene = start_scene(build, "kamino", worlds=len(starts["body_q"]))
        assert isinstance(scene, NewtonScene)
        stage = cls(scene, starts, horizon, np.zeros(0))
        stage._run(stage._make_setting(**KAMINO_CONVERGED))
        stage.ends = stage._get_body_positions()
        return stage

    def _get_body_positions(self) -> FloatArray:
        return self.scene.get_state()["body_q"][:, :, :3]

    def _make_setting(self, **options: Any) -> KaminoSetting:
        """Return the setting of the options that differ from the present ones."""
        own = self._make_config(KaminoSetting()).padmm
        has = {name: getattr(own, TOLERANCE_NAMES[0] if name == "tolerance" else name) for name in options}
        return KaminoSetting(tuple((name, x) for name, x in options.items() if x != has[name]))

    def _make_config(self, setting: KaminoSetting) -> Any:
        config = self.scene.solver_type.Config.from_model(self.scene.model)
        for name, x in setting.fields.items():
            setattr(config.padmm, name, x)
        config.validate()
        return config

    def _run(self, setting: Setting, after_step: Callable[[], Any] | None = None) -> FloatArray:
        """Step all worlds from their start states with a setting; return each step's time divided by the worlds [s].

        `after_step` is called after each step, outside of the measured time.
        """
        assert isinstance(setting, KaminoSetting)
        scene = self.scene
        scene.solver = scene.solver_type(scene.model, config=self._make_config(setting))
        scene.set_state(self.starts)
        times = np.empty(self.horizon)
        for k in range(self.horizon):
            begin = perf_counter()
            scene.step()
            scene.synchronize()
            times[k] = perf_counter() - begin
            if after_step is not None:
                after_step()
        return times / scene.n

    @property
    def own_setting(self) -> Setting:
        """The setting of the model or of the engine."""
        return KaminoSetting()

    def list_first_settings(self) -> list[Setting]:
        """List tolerances, numbers of iterations and penalties."""
        tried: list[dict[str, Any]] = [{}]
        tried += [{"max_iterations": n} for n in KAMINO_ITERATIONS]
        tried += [{"tolerance": t} for t in KAMINO_TOLERANCES]
        tried += [{"rho_0": rho} for rho in KAMINO_PENALTIES]
        return list(dict.fromkeys(self._make_setting(**x) for x in tried))

    def list_variants(self, setting: Setting) -> list[Setting]:
        """List variants of a setting: other penalties, and no acceleration."""
        options = dict(setting.options)
        tried = [options | {"rho_0": rho} for rho in KAMINO_PENALTIES] + [
            options | {"use_acceleration": False}
        ]
        return [self._make_setting(**x) for x in tried]

    def judge_setting(self, setting: Setting) -> Measured:
        """Judge a setting without timing it."""
        errors: list[FloatArray] = []
        rows: list[Any] = []
        contacts: list[Any] = []

        def judge() -> None:
            step = self.scene.convert()
            errors.append(residual_many(step.batch, step.impulse, errors="status").velocity_error)
            rows.append(step.batch.row_counts)
            contacts.append(step.batch.contact_counts)

        result = make_unmeasured(setting, "padmm")
        self._run(setting, judge)
        distance = np.linalg.norm(self._get_body_positions() - self.ends, axis=2).max(axis=1)
        if not np.isfinite(distance).all():
            return result
        result.error = np.nan_to_num(np.concatenate(errors), nan=np.inf)
        result.motion = distance
        result.rows, result.contacts = np.concatenate(rows), np.concatenate(contacts)
        return result

    def prepare_timing(self, setting: Setting) -> Callable[[], FloatArray]:
        """Return a function that runs all stretches and returns the time of each step, per world [s]."""
        return lambda: self._run(setting)
