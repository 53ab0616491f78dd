"""Truths of phenomena against other ways to the same number: integrators, linear programs, SciPy's functions."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import linprog

import lavender as lv
from lavender.lab.phenomena import PHENOMENA
from lavender.lab.phenomena.analytic_solutions import compute_tipping_time
from lavender.lab.phenomena.joints import (
    compute_flip_period,
    compute_pendulum_period,
    get_initial_spin,
    get_moments_of_inertia,
)

G = 9.81


@pytest.mark.parametrize("angle", [0.1, 1.0, 2.5, 3.0])
def test_a_pendulum_integrated_has_the_period(angle):
    # a rod of 1 m about its end: phi'' = -(3/2) (g/L) sin phi with I = m (1/3 + 0.1^2/12)
    rate = 0.5 * G / (1 / 3 + 0.01 / 12)

    def motion(_, y):
        return [y[1], -rate * math.sin(y[0])]

    def below(_, y):
        return y[0]

    below.terminal, below.direction = True, -1
    found = solve_ivp(motion, (0, 50), [angle, 0.0], events=below, rtol=1e-10, atol=1e-12, method="DOP853")
    assert 4 * found.t_events[0][0] == pytest.approx(compute_pendulum_period({"angle": angle}), rel=1e-8)


@pytest.mark.parametrize("aside", [0.01, 0.05, 0.5])
def test_eulers_equations_integrated_flip_with_the_period(aside):
    p, i = {"spin": 5.0, "aside": aside}, get_moments_of_inertia()

    def motion(_, w):
        x, y, z = w
        return (i[1] - i[2]) * y * z / i[0], (i[2] - i[0]) * z * x / i[1], (i[0] - i[1]) * x * y / i[2]

    def middle(_, w):
        return w[1]

    found = solve_ivp(
        motion, (0, 40), get_initial_spin(p), events=middle, rtol=1e-10, atol=1e-12, method="DOP853"
    )
    assert 2 * np.diff(found.t_events[0]).mean() == pytest.approx(compute_flip_period(p), rel=1e-7)


@pytest.mark.parametrize(("width", "over"), [(0.5, 1.02), (0.5, 1.5), (1.0, 1.1), (0.1, 2.0)])
def test_a_box_tips_in_the_time_that_an_integrator_needs(width, over):
    theta = math.atan(over * width)

    def motion(_, y):
        # torque of the weight about the lower edge of a box turned by phi, over m (w^2 + h^2)/3
        x = 0.5 * math.cos(y[0]) * -width + 0.5 * math.sin(y[0])
        z = 0.5 * math.sin(y[0]) * width + 0.5 * math.cos(y[0])
        torque = G * (math.sin(theta) * z + math.cos(theta) * x)
        return [y[1], 3 * torque / (width**2 + 1)]

    def tipped(_, y):
        return y[0] - 0.5

    tipped.terminal = True
    found = solve_ivp(motion, (0, 20), [0.0, 0.0], events=tipped, rtol=1e-10, atol=1e-13, method="DOP853")
    assert compute_tipping_time(width, 1.0, over * width, 0.5) == pytest.approx(
        found.t_events[0][0], rel=1e-6
    )
    assert compute_tipping_time(width, 1.0, 0.99 * width, 0.5) == math.inf


def stands(name, **case):
    """Whether forces in the cones of the engine's own contacts hold every body at rest: a linear program.

    Cones stand inside squares of their friction; what falls for want of room falls whatever the square.
    """
    scene = PHENOMENA[name].build_scene(case, stepper="impulses")
    p = lv.Simulation(scene).constraint_problem()
    j = p.rows.jacobian(p.cones).toarray()
    moving = [i for i, b in enumerate(scene.bodies) if not b.is_static]
    weight = np.zeros((len(moving), 6))
    weight[:, :3] = [scene.bodies[i].mass * np.array(scene.parameters.gravity) for i in moving]
    n = p.cones.ptr[:-1]
    rows = []
    for first, mu in zip(n, p.cones.mu, strict=True):
        for tangent in (1, 2):
            for sign in (1.0, -1.0):
                row = np.zeros(p.m)
                row[first + tangent], row[first] = sign, -mu
                rows.append(row)
    bounds = [(0, None) if i in set(n.tolist()) else (None, None) for i in range(p.m)]
    found = linprog(
        np.zeros(p.m), A_ub=np.array(rows), b_ub=np.zeros(len(rows)), A_eq=j.T, b_eq=-weight.ravel(),
        bounds=bounds, method="highs",
    )  # fmt: skip
    assert found.status in (0, 2)
    return found.status == 0


@pytest.mark.parametrize("bricks", [2, 5, 8])
def test_the_longest_overhang_is_that_of_the_linear_program(bricks):
    assert stands("overhang", bricks=bricks, reach=0.999)
    assert not stands("overhang", bricks=bricks, reach=1.001)


@pytest.mark.parametrize(("stones", "lean"), [(4, 0.5), (8, 0.5), (8, 0.3), (12, 0.7)])
def test_the_thinnest_arch_is_that_of_limit_analysis(stones, lean):
    assert stands("arch", stones=stones, lean=lean, thickness=1.01)
    assert not stands("arch", stones=stones, lean=lean, thickness=0.99)
