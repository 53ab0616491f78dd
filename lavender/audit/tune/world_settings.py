"""Settings of engines that step all stretches as worlds of one batch, in float32: MuJoCo Warp, and newton's Kamino.

A stretch is `horizon` steps of a simulated world (`lavender.audit.tune.measured`). Each setting steps from the
start of each stretch by itself. MuJoCo Warp starts warm from its own answers; the first step of Kamino (PADMM) has no
warm start, because a state of newton does not contain impulses. The error is measured on the constraint problem that
the engine builds with the setting; if a setting changes the problem, this is the changed problem.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any, ClassVar

import numpy as np

from lavender.audit.engine_scenes import load_build_function, start_scene
from lavender.audit.settings import MujocoSetting, Setting, get_option_value
from lavender.audit.simulated_worlds import START_FIELDS, Runs, WarpWorlds, make_frame
from lavender.audit.tune.measured import Measured, Stage, make_unmeasured
from lavender.audit.tune.mujoco_settings import CONVERGED_OPTIONS
from lavender.audit.tune.tables import KAMINO, MUJOCO_WARP, list_options
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.batch.residuals import residual_many

Arrays = dict[str, Any]
PADMM_TOLERANCES = ("primal_tolerance", "dual_tolerance", "compl_tolerance")


@dataclass(frozen=True)
class KaminoSetting(Setting):
    """Fields of PADMMSolverConfig that differ from the present configuration."""

    merge_note: ClassVar[str] = (
        "The lines change a configuration before the solver is built: config = SolverKamino.Config.from_model(model), "
        "then the line, then SolverKamino(model, config=config)."
    )

    @property
    def fields(self) -> dict[str, Any]:
        """Values of the configuration's fields; "tolerance" means all three tolerances."""
        names = ((PADMM_TOLERANCES if name == "tolerance" else (name,), x) for name, x in self.options)
        return {field: x for fields, x in names for field in fields}

    @property
    def option_line(self) -> str:
        """Python statement to copy; empty if no option differs."""
        return "; ".join(f"config.padmm.{name} = {x!r}" for name, x in self.fields.items())


class WarpEngine:
    """MuJoCo Warp with the worlds of a MuJoCo model."""

    table, converged = MUJOCO_WARP, CONVERGED_OPTIONS

    def __init__(self, mj: Any, model: Any, starts: Arrays, controls: FloatArray) -> None:
        self.mj, self.model, self.controls = mj, model, controls  # (n, steps, nu)
        self.worlds = WarpWorlds(mj, model, starts)
        self.start, self.get_positions = self.worlds.start, self.worlds.compute_body_positions

    def make_setting(self, options: Arrays) -> Setting:
        """Return the setting of the options that differ from the model's."""
        if "tolerance" in options:
            options = {"iterations": max(100, int(self.model.opt.iterations)), **options}
        return MujocoSetting.from_options(self.mj, self.model, **options)

    def configure(self, setting: Any) -> str:
        """Use a setting from the next step on; return the name of its solver."""
        self.configured = setting.apply_to(self.mj, self.model)
        self.worlds.configure(self.configured)
        return str(get_option_value(self.mj, self.configured, "solver"))

    def step(self, k: int) -> None:
        """Do step k of all worlds, and wait until it is complete."""
        self.worlds.advance(self.controls[:, k])

    def step_and_convert(self, k: int) -> tuple[Any, FloatArray, Any, Any]:
        """Do step k of all worlds; return problems, impulses, rows and contacts by world."""
        frame = make_frame(self.mj, self.configured, *self.worlds(self.controls[:, k]))
        return frame.batch, frame.impulse, frame.rows, frame.contacts


class KaminoEngine:
    """newton's SolverKamino with the worlds of a scene."""

    table, converged = KAMINO, {"max_iterations": 2000, "tolerance": 1e-8}

    def __init__(self, build: Any, starts: Arrays) -> None:
        self.scene: Any = start_scene(build, "kamino", worlds=len(starts["body_q"]))

    def make_setting(self, options: Arrays) -> Setting:
        """Return the setting of the options that differ from the present ones."""
        own = self.make_config(KaminoSetting()).padmm
        has = {name: getattr(own, PADMM_TOLERANCES[0] if name == "tolerance" else name) for name in options}
        return KaminoSetting(tuple((name, x) for name, x in options.items() if x != has[name]))

    def make_config(self, setting: KaminoSetting) -> Any:
        """Return the solver's configuration with a setting."""
        config = self.scene.solver_type.Config.from_model(self.scene.model)
        for name, x in setting.fields.items():
            setattr(config.padmm, name, x)
        config.validate()
        return config

    def configure(self, setting: Any) -> str:
        """Use a setting from the next step on; return the name of its solver."""
        self.scene.solver = self.scene.solver_type(self.scene.model, config=self.make_config(setting))
        return "padmm"

    def start(self, starts: Arrays) -> None:
        """Set the state of all worlds."""
        self.scene.set_state(starts)

    def get_positions(self) -> FloatArray:
        """Return the positions of all bodies (n, bodies, 3) [m]."""
        positions: FloatArray = self.scene.get_state()["body_q"][:, :, :3]
        return positions

    def step(self, k: int) -> None:
        """Do the next step of all worlds, and wait until it is complete."""
        self.scene.step()
        self.scene.synchronize()

    def step_and_convert(self, k: int) -> tuple[Any, FloatArray, Any, Any]:
        """Do the next step of all worlds; return problems, impulses, rows and contacts by world."""
        self.scene.step()
        step = self.scene.convert()
        return step.batch, step.impulse, step.batch.row_counts, step.batch.contact_counts


class WorldStage(Stage):
    """Stretches of simulated worlds, which an engine steps as one batch.

    Parameters
    ----------
    engine : WarpEngine or KaminoEngine
    starts : dict of (n, ...)
        State at the start of each stretch.
    horizon : int
    """

    def __init__(self, engine: Any, starts: Arrays, horizon: int) -> None:
        self.engine, self.starts, self.horizon = engine, starts, horizon
        self.n = len(next(iter(starts.values())))
        self._start(engine.make_setting(engine.converged))
        for k in range(horizon):
            engine.step(k)
        self.ends = engine.get_positions()  # (n, bodies, 3) m, of the converged run

    def _start(self, setting: Setting) -> str:
        """Start all stretches with a setting; return the name of its solver."""
        solver: str = self.engine.configure(setting)
        self.engine.start(self.starts)
        return solver

    @property
    def own_setting(self) -> Setting:
        """The setting of the model or of the engine."""
        own: Setting = self.engine.make_setting({})
        return own

    def list_first_settings(self) -> list[Setting]:
        """List the present setting and the lines of the engine's table."""
        options = [{}, *list_options(self.engine.table)]
        return list(dict.fromkeys(map(self.engine.make_setting, options)))

    def list_variants(self, setting: Setting) -> list[Setting]:
        """List variants of a setting."""
        own = dict(setting.options)
        return [self.engine.make_setting(own | x) for x in list_options(self.engine.table, near=True)]

    def judge_setting(self, setting: Setting) -> Measured:
        """Judge a setting without timing it; its errors are infinite if a world diverges."""
        result = make_unmeasured(setting, self._start(setting))
        steps = [self.engine.step_and_convert(k) for k in range(self.horizon)]
        distance = np.linalg.norm(self.engine.get_positions() - self.ends, axis=2).max(axis=1)
        if np.isfinite(distance).all():
            errors = [residual_many(batch, x, errors="status").velocity_error for batch, x, _, _ in steps]
            result.error, result.motion = np.nan_to_num(np.concatenate(errors), nan=np.inf), distance
            result.rows, result.contacts = (np.concatenate([step[i] for step in steps]) for i in (2, 3))
        return result

    def prepare_timing(self, setting: Setting) -> Callable[[], FloatArray]:
        """Return a function that runs all stretches and returns the time of each step, per world [s]."""

        def run() -> FloatArray:
            self._start(setting)
            times = [perf_counter()]
            for k in range(self.horizon):
                self.engine.step(k)
                times.append(perf_counter())
            return np.diff(times) / self.n

        return run


def make_warp_stages(mj: Any, model: Any, runs: Runs, horizon: int) -> list[WorldStage]:
    """Cut worlds of a MuJoCo model that run with its own setting into stretches: of even, and of odd worlds.

    Raises
    ------
    InputError
        MuJoCo Warp cannot be imported, or does not accept the model.
    """
    model = copy.copy(model)
    model.opt.jacobian = mj.mjtJacobian.mjJAC_DENSE
    data = [runs.create_start_data(mj, model, world) for world in range(runs.worlds)]
    drives = [runs.make_controller(model, world) for world in range(runs.worlds)]
    names = [name for name in START_FIELDS if getattr(data[0], name).size]
    arrays = {name: np.array([getattr(d, name) for d in data], np.float32) for name in names}
    controls: Any = np.array([[drive(None, k) for k in range(runs.steps)] for drive in drives], np.float32)
    controls = controls.reshape(runs.worlds, runs.steps, model.nu)
    try:
        running = WarpWorlds(mj, model, arrays)
    except ImportError as error:
        raise InputError(
            f"engine 'mujoco_warp' cannot be imported ({error}): pip install mujoco-warp"
        ) from None
    except (NotImplementedError, ValueError) as error:
        raise InputError(f"engine 'mujoco_warp' does not accept {runs.model}: {error}") from None

    def advance(k: int) -> None:
        running.advance(controls[:, k])

    stages = []
    for starts, first in _cut_into_stretches(lambda: running.read_state(names), advance, runs.steps, horizon):
        own = controls[first::2].reshape(-1, runs.steps // horizon, horizon, model.nu).swapaxes(0, 1)
        engine = WarpEngine(mj, model, starts, own.reshape(-1, horizon, model.nu))
        stages.append(WorldStage(engine, starts, horizon))
    return stages


def make_kamino_stages(scene: str, worlds: int, steps: int, horizon: int, **start: Any) -> list[WorldStage]:
    """Cut worlds of a scene of newton that run with the present setting into stretches: of even, and of odd worlds."""
    build = load_build_function(scene, "kamino")
    running: Any = start_scene(build, "kamino", worlds=worlds, **start)
    if running.n != worlds:
        raise InputError(
            f"build() of {scene} returns a finalized model; a ModelBuilder of one world is needed"
        )
    parts = _cut_into_stretches(running.get_state, lambda k: running.step(), steps, horizon)
    return [WorldStage(KaminoEngine(build, starts), starts, horizon) for starts, _ in parts]


def _cut_into_stretches(
    get_state: Callable[[], Arrays], advance: Callable[[int], None], steps: int, horizon: int
) -> list[tuple[Arrays, int]]:
    """Run all worlds; return the states at the starts of stretches, of worlds 0, 2, ... and of worlds 1, 3, ...

    The first stretch of each world comes first, then the second of each, and so on.
    """
    states = []
    for k in range(steps):
        if k % horizon == 0:
            states.append(get_state())
        advance(k)
    return [
        ({name: np.concatenate([state[name][first::2] for state in states]) for name in states[0]}, first)
        for first in (0, 1)
    ]
