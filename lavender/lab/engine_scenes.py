"""Step scenes of other engines and convert each step: newton (Kamino, MuJoCo Warp) and Genesis.

A scene is a Python file with a function `build`, or the name of a builder in `newton.tests.utils.basics`:

    def build():            # newton: returns a newton.ModelBuilder of one world, or a finalized newton.Model
    def build(worlds):      # genesis: returns a built genesis.Scene with this number of environments
"""

from __future__ import annotations

import os
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lavender.base.arrays import check_float, check_int
from lavender.base.errors import InputError, UnknownName, check_name
from lavender.io.engine_step import EngineStep
from lavender.io.genesis import from_genesis
from lavender.io.kamino import from_kamino
from lavender.io.newton_mujoco import from_newton_mujoco

CLAIM_ENGINES = ("kamino", "newton-mujoco", "genesis")
DEFAULT_TIME_STEP = 0.01  # [s] of scenes of newton, which do not state one


def step_scene(
    scene: str | os.PathLike[str],
    engine: str,
    *,
    worlds: int = 8,
    steps: int = 50,
    dt: float = DEFAULT_TIME_STEP,
) -> Iterator[EngineStep]:
    """Step a scene and yield the converted steps.

    Parameters
    ----------
    scene : path of a Python file, or str
        The file's function `build` makes the scene; a name is a builder of `newton.tests.utils.basics`.
    engine : {"kamino", "newton-mujoco", "genesis"}
    worlds, steps : int
    dt : float, default 0.01 s
        Time step of newton's solvers. A scene of Genesis has its own.

    Yields
    ------
    EngineStep

    Raises
    ------
    InputError
        The engine is not installed, the file has no function `build`, or `build` returns another object.
    UnknownName
        The engine or the builder is unknown.
    CapabilityError
        As the importers.
    """
    check_name("engine", engine, CLAIM_ENGINES)
    worlds, steps = check_int("worlds", worlds, 1), check_int("steps", steps, 1)
    dt = check_float("dt", dt, above=0.0)
    if engine == "genesis":
        return _step_genesis(_build_function(scene, engine), worlds, steps)
    return _step_newton(_build_function(scene, engine), engine, worlds, steps, dt)


def _build_function(scene: str | os.PathLike[str], engine: str) -> Any:
    """Return the function that makes a scene."""
    path = Path(scene)
    if path.suffix == ".py":
        if not path.is_file():
            raise InputError(f"{path} does not exist; a Python file with a function build() is needed")
        build = runpy.run_path(str(path)).get("build")
        if not callable(build):
            raise InputError(f"{path} has no function build(), which makes the scene")
        return build
    if engine == "genesis":
        raise InputError(
            f"scene is {str(scene)!r}; a Python file with a function build(worlds) is needed for genesis"
        )
    try:
        from newton.tests.utils import basics
    except ImportError:
        raise InputError("newton cannot be imported: pip install newton warp-lang") from None
    known = sorted(name for name in dir(basics) if name.startswith("build_"))
    name = str(scene) if str(scene).startswith("build_") else f"build_{scene}"
    if name not in known:
        raise UnknownName("scene of newton", str(scene), known)
    return getattr(basics, name)


def _step_newton(build: Any, engine: str, worlds: int, steps: int, dt: float) -> Iterator[EngineStep]:
    """Step a model of newton with one of its solvers."""
    try:
        import newton
    except ImportError:
        raise InputError("newton cannot be imported: pip install newton warp-lang") from None
    solver_type = newton.solvers.SolverKamino if engine == "kamino" else newton.solvers.SolverMuJoCo
    model = build()
    if isinstance(model, newton.ModelBuilder):
        builder = newton.ModelBuilder()
        solver_type.register_custom_attributes(builder)
        for _ in range(worlds):
            builder.add_world(model)
        model = builder.finalize()
    if not isinstance(model, newton.Model):
        raise InputError(
            f"build() returned a {type(model).__name__}; a newton.ModelBuilder or newton.Model is needed"
        )
    solver = solver_type(model)
    before, after, control = model.state(), model.state(), model.control()
    pipeline = newton.CollisionPipeline(model)
    contacts = pipeline.contacts()
    for _ in range(steps):
        velocity = None if engine == "kamino" else solver.mjw_data.qvel.numpy().copy()
        pipeline.collide(before, contacts)
        solver.step(before, after, control, contacts, dt)
        before, after = after, before
        yield from_kamino(solver) if engine == "kamino" else from_newton_mujoco(solver, velocity)


def _step_genesis(build: Any, worlds: int, steps: int) -> Iterator[EngineStep]:
    """Step a scene of Genesis."""
    scene = build(worlds)
    for _ in range(steps):
        scene.step()
        yield from_genesis(scene)
