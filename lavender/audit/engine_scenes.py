"""Step scenes of other engines and convert each step: newton (Kamino, MuJoCo Warp) and Genesis.

A scene is a Python file with a function `build`, or the name of a builder in `newton.tests.utils.basics`:

    def build():            # newton: returns a newton.ModelBuilder of one world, or a finalized newton.Model
    def build(worlds):      # genesis: returns a built genesis.Scene with this number of environments

A state is a dict of arrays; the first dimension of each array is the world. The arrays have the engines' names:

    newton      body_q, body_qd, joint_q, joint_qd: poses [m, -] and velocities [m/s, rad/s] of bodies and joints
    genesis     qpos, qvel: the results of `get_qpos` and `get_dofs_velocity`

If a state of newton has only the arrays of bodies, or only the arrays of joints, the engine's kinematics computes the
others. Without states, world 0 starts as the scene was built. The velocities of each other world differ from world 0
by `spread` times a standard normal number, drawn with the seed (seed, world).
"""

from __future__ import annotations

import os
import runpy
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, as_array, check_float, check_int
from lavender.base.errors import CapabilityError, InputError, UnknownName, check_name
from lavender.io.engine_step import EngineStep
from lavender.io.genesis import from_genesis
from lavender.io.kamino import from_kamino
from lavender.io.newton_mujoco import NEWTON_ADVICE, from_newton_mujoco
from lavender.io.start_states import check_array_names
from lavender.io.stored import read_arrays

CLAIM_ENGINES = ("kamino", "newton-mujoco", "genesis")
DEFAULT_TIME_STEP = 0.01  # [s] Scenes of newton do not define a time step.
NEWTON_MISSING = "newton cannot be imported: pip install newton warp-lang"
NEWTON_STATE = ("body_q", "body_qd", "joint_q", "joint_qd")
# A state of newton needs all arrays of at least one of these groups.
NEWTON_GROUPS = (("body_q", "body_qd"), ("joint_q", "joint_qd"))
#: Shape of the entry of one body or coordinate in each array.
NEWTON_ITEM_SIZES = {"body_q": (7,), "body_qd": (6,), "joint_q": (), "joint_qd": ()}
GENESIS_STATE = ("qpos", "qvel")

EngineState = dict[str, FloatArray]


def step_scene(scene: Any, engine: str, *, steps: int = 50, **start: Any) -> Iterator[EngineStep]:
    """Start a scene and return its converted steps, each with the state before it.

    `start` holds the further parameters of `start_scene`, which raises the errors.
    """
    steps = check_int("steps", steps, 1)
    running = start_scene(scene, engine, **start)

    def iterate_steps() -> Iterator[EngineStep]:
        """Step the scene and yield the converted steps."""
        for _ in range(steps):
            state = running.get_state()
            running.step()
            yield running.convert()._replace(state=state or None)

    return iterate_steps()


def start_scene(
    scene: str | os.PathLike[str] | Callable[..., Any],
    engine: str,
    *,
    worlds: int = 8,
    dt: float = DEFAULT_TIME_STEP,
    states: Any = None,
    spread: float = 0.0,
    seed: int = 0,
) -> NewtonScene | GenesisScene:
    """Build a scene and set the start states of its worlds.

    Parameters
    ----------
    scene : path of a Python file, str, or callable
        The file's function `build`, or the callable, makes the scene; a name is a builder of
        `newton.tests.utils.basics`.
    engine : {"kamino", "newton-mujoco", "genesis"}
    worlds : int
    dt : float, default 0.01 s
        Time step of newton's solvers. A scene of Genesis has its own.
    states : path of an .npz, or dict of arrays, optional
        World i starts from state i modulo their number.
    spread : float, default 0 m/s, rad/s
    seed : int, default 0
    """
    check_name("engine", engine, CLAIM_ENGINES)
    worlds = check_int("worlds", worlds, 1)
    dt = check_float("dt", dt, above=0.0)
    spread = check_float("spread", spread, low=0.0)
    seed = check_int("seed", seed, high=None)
    build = scene if callable(scene) else load_build_function(scene, engine)
    names = GENESIS_STATE if engine == "genesis" else NEWTON_STATE
    starts = None if states is None else read_engine_states(states, names)
    running = (
        GenesisScene(build, worlds)
        if engine == "genesis"
        else NewtonScene(build, engine, worlds, dt)
    )
    first_noisy = 1
    if starts is not None:
        running.set_state({name: x[np.arange(running.n) % len(x)] for name, x in starts.items()})
        first_noisy = len(next(iter(starts.values())))
    if spread and running.n > first_noisy:
        running.add_noise(first_noisy, spread, seed)
    return running


def read_engine_states(source: Any, names: tuple[str, ...]) -> EngineState:
    """Read states of an engine from an .npz or a dict of arrays; each array has one entry for each state."""
    label = "states"
    if isinstance(source, (str, os.PathLike)):
        label = f"states {os.fspath(source)}"
        source = read_arrays(source)
    if not isinstance(source, Mapping):
        raise InputError(
            f"states is a {type(source).__name__}; a path of an .npz or a dict of arrays is needed"
        )
    check_array_names(label, source, names)
    arrays = {
        name: as_array(f"{label}: {name}", x, (None,) * np.ndim(x))
        for name, x in source.items()
        if name in names
    }
    counts = {name: len(x) if x.ndim > 1 else 0 for name, x in arrays.items()}
    if not counts or len(set(counts.values())) != 1 or not min(counts.values()):
        sizes = ", ".join(f"{count} of {name}" for name, count in counts.items()) or "no arrays"
        raise InputError(
            f"{label}: {sizes}; {', '.join(names)} must have equally many entries, at least one"
        )
    return arrays


def load_build_function(scene: str | os.PathLike[str], engine: str) -> Any:
    """Return the function that makes a scene."""
    path = Path(scene)
    if path.suffix == ".py":
        if not path.is_file():
            raise InputError(
                f"{path} does not exist; a Python file with a function build() is needed"
            )
        build = runpy.run_path(str(path)).get("build")
        if not callable(build):
            raise InputError(f"{path} has no function build(), which makes the scene")
        return build
    if engine == "genesis":
        raise InputError(
            f"scene is {str(scene)!r}; genesis needs a Python file with a function build(worlds)"
        )
    try:
        from newton.tests.utils import basics
    except ImportError:
        raise InputError(NEWTON_MISSING) from None
    known = sorted(name for name in dir(basics) if name.startswith("build_"))
    name = str(scene) if str(scene).startswith("build_") else f"build_{scene}"
    if name not in known:
        raise UnknownName("scene of newton", str(scene), known)
    return getattr(basics, name)


class NewtonScene:
    """Worlds of a model of newton, stepped by one of its solvers.

    Parameters
    ----------
    build : callable
        Returns a newton.ModelBuilder of one world, or a finalized newton.Model.
    engine : {"kamino", "newton-mujoco"}
    worlds : int
        Number of copies of a ModelBuilder.
    dt : float, s
    """

    def __init__(self, build: Callable[[], Any], engine: str, worlds: int, dt: float) -> None:
        try:
            import newton
        except ImportError:
            raise InputError(NEWTON_MISSING) from None
        self.newton, self.engine, self.dt = newton, engine, dt
        self.solver_type = (
            newton.solvers.SolverKamino if engine == "kamino" else newton.solvers.SolverMuJoCo
        )
        model = build()
        if isinstance(model, newton.ModelBuilder):
            builder = newton.ModelBuilder()
            self.solver_type.register_custom_attributes(builder)
            for _ in range(worlds):
                builder.add_world(model)
            model = builder.finalize()
        if not isinstance(model, newton.Model):
            raise InputError(
                f"build() returned a {type(model).__name__}; a newton.ModelBuilder or newton.Model is needed"
            )
        self.model = model
        self.n = int(model.world_count)
        self.solver = self.solver_type(model)
        self.before, self.after, self.control = model.state(), model.state(), model.control()
        self.pipeline = newton.CollisionPipeline(model)
        self.contacts = self.pipeline.contacts()
        self.velocity: Any = (
            None  # Velocities before the step; SolverMuJoCo overwrites its own copy.
        )

    def step(self) -> None:
        """Detect collisions and step all worlds."""
        if self.engine == "newton-mujoco":
            self.velocity = self.solver.mjw_data.qvel.numpy().copy()
        self.pipeline.collide(self.before, self.contacts)
        self.solver.step(self.before, self.after, self.control, self.contacts, self.dt)
        self.before, self.after = self.after, self.before

    def convert(self) -> EngineStep:
        """Return the problems of the last step, the engine's impulses and claims."""
        if self.engine == "kamino":
            return from_kamino(self.solver)
        return from_newton_mujoco(self.solver, self.velocity)

    def get_state(self) -> EngineState:
        """Return the state of all worlds by the names of newton.State, in arrays (n, ...).

        It is empty if worlds have different numbers of bodies or joints.
        """
        if not self._has_equal_worlds:
            return {}
        return {
            name: np.array(getattr(self.before, name).numpy(), float).reshape(
                self.n, -1, *NEWTON_ITEM_SIZES[name]
            )
            for name in NEWTON_STATE
        }

    @property
    def _has_equal_worlds(self) -> bool:
        """Return whether all worlds have equal numbers of bodies and joints, so that states fit one array per name."""
        return self.n > 0 and all(
            len(getattr(self.before, name)) % self.n == 0 for name in NEWTON_STATE
        )

    def _require_equal_worlds(self, advice: str) -> None:
        if not self._has_equal_worlds:
            raise InputError(
                f"the worlds of this scene have different bodies or joints, so {advice}"
            )

    def set_state(self, state: EngineState) -> None:
        """Set the state of all worlds, arrays (n, ...), and clear the solver's warm start."""
        self._require_equal_worlds(
            "states cannot be set in one array for all worlds: leave states out"
        )
        given = [group for group in NEWTON_GROUPS if all(name in state for name in group)]
        if not given:
            raise InputError(
                f"states have {', '.join(state)}; {' or '.join(' and '.join(g) for g in NEWTON_GROUPS)} are needed"
            )
        if self.engine == "kamino":
            self.solver.reset(self.before)
        for group in given:
            for name in group:
                target = getattr(self.before, name)
                if np.size(state[name]) != np.prod(target.numpy().shape):
                    raise InputError(
                        f"states: {name} has shape {np.shape(state[name])[1:]} for each world; "
                        f"{np.prod(target.numpy().shape) // self.n} numbers are needed, as in this scene"
                    )
                target.assign(np.asarray(state[name], np.float32).reshape(target.numpy().shape))
        if len(given) < len(NEWTON_GROUPS):
            self._complete_state("joint_q" in given[0])
        self._start_mujoco()

    def add_noise(self, first: int, spread: float, seed: int) -> None:
        """Add noise to the velocities of the worlds from number `first`."""
        name = "joint_qd" if len(self.before.joint_qd) else "body_qd"
        velocity = getattr(self.before, name)
        self._require_equal_worlds("noise cannot be added to their velocities: give spread=0")
        values = velocity.numpy().copy()
        by_world = values.reshape(self.n, -1)
        for world in range(first, self.n):
            by_world[world] += spread * np.random.default_rng([seed, world]).standard_normal(
                by_world.shape[1]
            )
        velocity.assign(values)
        self._complete_state(name == "joint_qd")
        self._start_mujoco()

    def _complete_state(self, from_joints: bool) -> None:
        """Compute the state of bodies from the state of joints, or the reverse, by the engine's kinematics."""
        state = self.before
        if from_joints:
            self.newton.eval_fk(self.model, state.joint_q, state.joint_qd, state)
        else:
            self.newton.eval_ik(self.model, state, state.joint_q, state.joint_qd)

    def _start_mujoco(self) -> None:
        """Copy the state to MuJoCo's data, whose velocity the importer reads before a step."""
        if self.engine == "newton-mujoco":
            try:
                self.solver._update_mjc_data(self.solver.mjw_data, self.model, self.before)
            except AttributeError as error:
                raise CapabilityError(
                    f"SolverMuJoCo takes no state: {error}. {NEWTON_ADVICE}"
                ) from None


class GenesisScene:
    """Environments of a scene of Genesis.

    Parameters
    ----------
    build : callable
        Returns a built genesis.Scene with a given number of environments.
    worlds : int
    """

    def __init__(self, build: Callable[[int], Any], worlds: int) -> None:
        self.scene = build(worlds)
        self.n = worlds
        solver = getattr(getattr(self.scene, "sim", None), "rigid_solver", None)
        if solver is None:
            raise InputError(
                f"build(worlds) returned a {type(self.scene).__name__}; a built genesis.Scene with rigid bodies is "
                "needed"
            )
        self.solver = solver

    def step(self) -> None:
        """Step all environments."""
        self.scene.step()

    def convert(self) -> EngineStep:
        """Return the problems of the last step, the engine's impulses and claims."""
        return from_genesis(self.scene)

    def get_state(self) -> EngineState:
        """Return positions and velocities of all environments (n, ...)."""
        arrays = self.solver.get_qpos(), self.solver.get_dofs_velocity()
        return {
            name: np.array(x.cpu().numpy(), float)
            for name, x in zip(GENESIS_STATE, arrays, strict=True)
        }

    def set_state(self, state: EngineState) -> None:
        """Set the state of all environments, arrays (n, ...), and clear the solver's warm start."""
        own = self.get_state()
        for name in GENESIS_STATE:
            shape = state[name].shape if name in state else ()
            if shape != own[name].shape:
                raise InputError(
                    f"states: {name} has shape {shape} for the worlds of this scene; {own[name].shape} is needed"
                )
        self.solver.set_qpos(np.asarray(state["qpos"], np.float32))
        self.solver.set_dofs_velocity(np.asarray(state["qvel"], np.float32))

    def add_noise(self, first: int, spread: float, seed: int) -> None:
        """Add noise to the velocities of the environments from number `first`."""
        state = self.get_state()
        for world in range(first, self.n):
            noise = np.random.default_rng([seed, world]).standard_normal(state["qvel"].shape[1])
            state["qvel"][world] += spread * noise
        self.set_state(state)
