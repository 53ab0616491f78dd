"""Steps that others ask for: substeps of LavenderSim's scenes, and predictive control of a walking robot."""

from __future__ import annotations

import dataclasses

import numpy as np

from lavender.base.errors import UnknownName
from lavender.lab.suite.case import Draft, family
from lavender.lab.suite.families import at_least, positive, product
from lavender.problem import Problem

GRAVITY = 9.81  # m/s^2


@family()
def engine_step(scene: str = "pyramid", at: int = 30) -> Draft:
    """The problem of a scene's substep after `at` steps of LavenderSim at its defaults, without its warm start."""
    from lavender.sim.engine import Simulation
    from lavender.sim.scene import SCENES, Scene

    if scene not in SCENES:
        raise UnknownName("scene", scene, SCENES)
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
