"""Steps of other programs: of LavenderSim's scenes, of robot models, and of predictive control of a walk.

Robot models are read from other packages that are installed; none of their files are copied.
"""

from __future__ import annotations

import dataclasses
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from lavender.base.errors import SolverUnavailable, UnknownName, check_name
from lavender.problem import Problem
from lavender.suite.build import GRAVITY
from lavender.suite.case import Draft, register_family
from lavender.suite.families import check_min_sizes, check_positive, multiply_in_index_order

MODEL_FOLDERS = {"gymnasium": "envs/mujoco/assets", "dm_control": "suite"}
MUJOCO_CONES = {"pyramidal": 0, "elliptic": 1}


@register_family()
def engine_step(scene: str = "pyramid", at: int = 30) -> Draft:
    """The problem of a scene's substep after `at` steps of LavenderSim with default options, without its warm start."""
    from lavender.sim.engine import Simulation
    from lavender.sim.scene import SCENES, Scene

    check_name("scene", scene, SCENES)
    simulation = Simulation(Scene(scene))
    for _ in range(at):
        simulation.step()
    problem = dataclasses.replace(simulation.constraint_problem(), guess=None, key=None)
    return Draft(
        problem,
        f"{scene} in motion: contacts of an engine's collision detection, some of which have just closed",
    )


@register_family()
def walking(
    n: int = 16, dt: float = 0.1, height: float = 0.8, foot: float = 0.1, seed: int = 0
) -> Draft:
    """Predictive control of a walk: n jerks of the centre of mass that keep the centre of pressure inside the feet.

    min 1/2 |z - z_ref|^2 + 1/2 1e-4 |u|^2 over jerks u [m/s^3], z = c - (height/g) c'' the centre of pressure [m], in
    the foot of each instant: 2 n bounded rows over n variables (P.-B. Wieber 2006, Humanoids, 137-142, eqs. 7-10).
    """
    check_min_sizes(1, n=n)
    check_positive(dt=dt, height=height, foot=foot)
    rng = np.random.default_rng([seed, 0x77616C6B])
    transition = np.array([[1.0, dt, dt * dt / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    jerk_effect = np.array([dt**3 / 6, dt * dt / 2, dt])
    pressure = np.array([1.0, 0.0, -height / GRAVITY])
    state = np.array([0.0, rng.normal(scale=0.2), 0.0])
    free = np.empty(n)
    by_jerk = np.zeros((n, n))
    by_each_jerk = np.zeros((3, n))  # Derivative of the state (c, c', c'') by each jerk.
    for k in range(n):
        state = multiply_in_index_order(transition, state)
        by_each_jerk = multiply_in_index_order(transition, by_each_jerk)
        by_each_jerk[:, k] = jerk_effect
        free[k] = multiply_in_index_order(pressure, state)
        by_jerk[k] = multiply_in_index_order(pressure, by_each_jerk)
    foot_centre = 0.2 * ((np.arange(n) + rng.integers(8)) // 8) + rng.normal(scale=0.01, size=n)
    problem = Problem.from_qp(
        multiply_in_index_order(by_jerk.T, by_jerk) + 1e-4 * np.eye(n),
        multiply_in_index_order(by_jerk.T, free - foot_centre),
        G=np.vstack([by_jerk, -by_jerk]),
        h=np.concatenate([foot_centre + 0.5 * foot - free, free - foot_centre + 0.5 * foot]),
    )
    return Draft(
        problem, "a quadratic program of control: dense rows in pairs, few of which are active"
    )


# -- robots -----------------------------------------------------------------------------------------------


@register_family()
def robot(
    package: str = "gymnasium", model: str = "ant", cone: str = "pyramidal", at: int = 200
) -> Draft:
    """A MuJoCo model of gymnasium or dm_control after `at` steps under controls drawn by seed 0.

    The numbers depend on the versions of MuJoCo and of the package.
    """
    check_name("package of models", package, MODEL_FOLDERS)
    spec, message = find_spec(package), explain_missing_packages(package)
    if message or spec is None or not spec.submodule_search_locations:
        raise SolverUnavailable(message)
    folder = Path(spec.submodule_search_locations[0]) / MODEL_FOLDERS[package]
    path = folder / f"{model}.xml"
    if not path.is_file():
        raise UnknownName(
            f"model of {package}", model, sorted(p.stem for p in folder.glob("*.xml"))
        )
    check_name("cone", cone, tuple(MUJOCO_CONES))
    import mujoco

    from lavender.io import from_mujoco

    m = mujoco.MjModel.from_xml_path(str(path))
    m.opt.cone = MUJOCO_CONES[cone]
    d = mujoco.MjData(m)
    rng = np.random.default_rng(0)
    for _ in range(at):
        d.ctrl[:] = rng.uniform(-1.0, 1.0, m.nu)
        mujoco.mj_step(m, d)
    mujoco.mj_forward(m, d)
    problem = dataclasses.replace(from_mujoco(m, d), guess=None)
    return Draft(
        problem, f"{model} of {package} under random controls: few rows that share many velocities"
    )


def explain_missing_packages(package: str) -> str:
    """Return a message about packages that must be installed for the models of `package`; empty if none is missing."""
    absent = " and ".join(
        name for name in ("mujoco", package) if package and find_spec(name) is None
    )
    return (
        f"robots of {package} need {absent}: pip install 'lavender-contact[robots]'"
        if absent
        else ""
    )
