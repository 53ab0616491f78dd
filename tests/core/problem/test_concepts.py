"""What the fields of a row mean, held to equations of motion: springs, motors, limits, gaps, belts."""

import numpy as np
import pytest

import lavender as lv


def moved(mass, v, *, target=0.0, compliance=0.0, lower=-np.inf, upper=np.inf):
    """Velocity after a step of what moves along one row: a row of docs/c.md's table of fields."""
    cones = lv.Cones.bounded(np.array([lower]), np.array([upper]))
    problem = lv.Problem.from_jacobian(
        [[1.0]], [[mass]], [v], target=target, cones=cones, compliance=compliance
    )
    return problem.generalized.velocity_of(
        problem.velocity(lv.solve(problem, tol=1e-12).impulse)
    ).item()


def test_fields_of_springs_motors_limits_and_gaps_have_their_documented_effect():
    """Each against the equation of motion, solved by hand."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        m = rng.uniform(0.1, 10.0)
        h = 10.0 ** rng.uniform(-4, -1)
        v = rng.normal()
        k = 10.0 ** rng.uniform(-1, 6)
        c = 10.0 ** rng.uniform(-2, 3)
        error = rng.normal()
        force = rng.uniform(0, 30)
        spring = moved(m, v, compliance=1.0 / (h * (h * k + c)), target=-k * error / (h * k + c))
        # m (v+ - v) = -h (k (C + h v+) + c v+)
        assert spring == pytest.approx(
            (m * v - h * k * error) / (m + h * (h * k + c)), rel=1e-9, abs=1e-9
        )
        motor = moved(m, v, target=2.0, lower=-h * force, upper=h * force)
        assert motor == pytest.approx(v + np.clip(2.0 - v, -h * force / m, h * force / m), abs=1e-9)
        dry = moved(m, v, lower=-h * force, upper=h * force)
        assert dry == pytest.approx(np.sign(v) * max(0.0, abs(v) - h * force / m), abs=1e-9)
        assert moved(m, v, target=-0.3 * error / h) == pytest.approx(
            -0.3 * error / h
        )  # a joint, beta 0.3
        gap = abs(error) * h
        assert gap + h * moved(m, v, target=-gap / h, lower=0.0) == pytest.approx(
            max(0.0, gap + h * v), abs=1e-9
        )


@pytest.mark.parametrize("belt_is_a", [True, False])
def test_target_of_a_belt_moves_the_body_on_it(belt_is_a):
    """The belt runs on the world, once as the first body of the contact and once as the second."""
    v = np.array([[0.0, 0.0, -0.1, 0.0, 0.0, 0.0]])
    side = 1.0 if belt_is_a else -1.0
    rows = lv.Rows(
        np.ones(1),
        np.zeros((1, 3, 3)),
        v,
        normal=[[0.0, 0.0, side]],
        tangent=[[1.0, 0.0, 0.0]],
        contact_body=[[-1, 0] if belt_is_a else [0, -1]],
        arm_a=np.zeros((1, 3)),
        arm_b=np.zeros((1, 3)),
    )
    problem = lv.Problem.from_rows(rows, mu=5.0, target=[0.0, side * 0.3, 0.0])
    after = problem.velocity(lv.solve(problem, tol=1e-12).impulse)
    np.testing.assert_allclose(after.ravel()[:3], [0.3, 0.0, 0.0], atol=1e-9)
