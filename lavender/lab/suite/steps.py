"""Steps that others ask for: of LavenderSim's scenes, of robots, and predictive control of a walk.

Models of robots are those that other packages install; nothing of theirs is copied.
"""

from __future__ import annotations

import dataclasses
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from lavender.base.errors import SolverUnavailable, UnknownName, check_name
from lavender.lab.suite.case import Draft, family, parse
from lavender.lab.suite.families import at_least, positive, product
from lavender.problem import Problem

GRAVITY = 9.81  # m/s^2
#: Licence of each package's models.
LICENCES = {"gymnasium": "MIT", "dm_control": "Apache-2.0"}
FOLDERS = {"gymnasium": "envs/mujoco/assets", "dm_control": "suite"}
CONES = {"pyramidal": 0, "elliptic": 1}


@family()
def engine_step(scene: str = "pyramid", at: int = 30) -> Draft:
    """The problem of a scene's substep after `at` steps of LavenderSim at its defaults, without its warm start."""
    from lavender.sim.engine import Simulation
    from lavender.sim.scene import SCENES, Scene

    check_name("scene", scene, SCENES)
    simulation = Simulation(Scene(scene))
    for _ in range(at):
        simulation.step()
    problem = dataclasses.replace(simulation.constraint_problem(), guess=None, key=None)
    return Draft(
        problem, f"{scene} in motion: contacts as an engine finds them, some of which have just closed"
    )


@family()
def walking(n: int = 16, dt: float = 0.1, height: float = 0.8, foot: float = 0.1, seed: int = 0) -> Draft:
    """Predictive control of a walk: n jerks of the centre of mass that keep the pressure inside of the feet.

    min 1/2 |z - z_ref|^2 + 1/2 1e-4 |u|^2 over jerks u [m/s^3], z = c - (height/g) c'' the centre of pressure [m], in
    the foot of each instant: 2 n bounded rows over n variables (P.-B. Wieber 2006, Humanoids, 137-142, eqs. 7-10).
    """
    at_least(1, n=n)
    positive(dt=dt, height=height, foot=foot)
    rng = np.random.default_rng([seed, 0x77616C6B])
    move = np.array([[1.0, dt, dt * dt / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    push, pressure = np.array([dt**3 / 6, dt * dt / 2, dt]), np.array([1.0, 0.0, -height / GRAVITY])
    state = np.array([0.0, rng.normal(scale=0.2), 0.0])
    free, by_jerk = np.empty(n), np.zeros((n, n))
    ways = np.zeros((3, n))  # of the state by each jerk
    for k in range(n):
        state, ways = product(move, state), product(move, ways)
        ways[:, k] = push
        free[k], by_jerk[k] = product(pressure, state), product(pressure, ways)
    middle = 0.2 * ((np.arange(n) + rng.integers(8)) // 8) + rng.normal(scale=0.01, size=n)
    problem = Problem.from_qp(
        product(by_jerk.T, by_jerk) + 1e-4 * np.eye(n),
        product(by_jerk.T, free - middle),
        G=np.vstack([by_jerk, -by_jerk]),
        h=np.concatenate([middle + 0.5 * foot - free, free - middle + 0.5 * foot]),
    )
    return Draft(problem, "a quadratic program of control: dense rows that come in pairs, few of which bind")


# -- robots -----------------------------------------------------------------------------------------------


@family()
def robot(package: str = "gymnasium", model: str = "ant", cone: str = "pyramidal", at: int = 200) -> Draft:
    """A MuJoCo model of gymnasium or dm_control after `at` steps under controls drawn by seed 0.

    The numbers are those of one version of MuJoCo and of the package (`versions`).
    """
    path, known = _find(package, model), tuple(CONES)
    check_name("cone", cone, known)
    import mujoco

    from lavender.io import from_mujoco

    m = mujoco.MjModel.from_xml_path(str(path))
    m.opt.cone = CONES[cone]
    d, rng = mujoco.MjData(m), np.random.default_rng(0)
    for _ in range(at):
        d.ctrl[:] = rng.uniform(-1.0, 1.0, m.nu)
        mujoco.mj_step(m, d)
    mujoco.mj_forward(m, d)
    problem = dataclasses.replace(from_mujoco(m, d), guess=None)
    return Draft(problem, f"{model} of {package}, thrown about: few rows that share many velocities")


def package_of(name: str) -> str:
    """The package that the model of a case's name is in; empty where the name alone makes it."""
    if name.partition("(")[0] != "robot":
        return ""
    return str(parse(name)[1].get("package", "gymnasium"))


def missing(package: str) -> str:
    """What has to be installed for the models of a package; empty where all is there."""
    absent = [name for name in ("mujoco", package) if package and find_spec(name) is None]
    return (
        f"robots of {package} need {' and '.join(absent)}: pip install 'lavender-contact[robots]'"
        if absent
        else ""
    )


def versions(package: str) -> str:
    """Versions of MuJoCo and of a package of models; empty for none."""
    from importlib.metadata import version

    return ", ".join(f"{name} {version(name)}" for name in ("mujoco", package)) if package else ""


def _find(package: str, model: str) -> Path:
    check_name("package of models", package, FOLDERS)
    spec, told = find_spec(package), missing(package)
    if told or spec is None or not spec.submodule_search_locations:
        raise SolverUnavailable(told)
    folder = Path(spec.submodule_search_locations[0]) / FOLDERS[package]
    path = folder / f"{model}.xml"
    if not path.is_file():
        raise UnknownName(f"model of {package}", model, sorted(p.stem for p in folder.glob("*.xml")))
    return path
