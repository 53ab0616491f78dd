"""Room, start and step: the same method without Python, in any number of turns."""

import numpy as np
import pytest
from calls import REACHED, driven
from hypothesis import given
from hypothesis import strategies as st
from random_problems import as_matrix, random_contact_problem, seeds

import lavender as lv


def forms(problem):
    """A problem of bodies, and the same as a matrix."""
    return problem, as_matrix(problem)


@pytest.mark.parametrize("friction", ["coulomb", "cone"])
@given(seed=seeds, rolling=st.booleans())
def test_driver_on_contacts_has_the_bits_of_newton(friction, seed, rolling):
    base = random_contact_problem(seed, friction, rolling=rolling, bodies=5, contacts=6, joints=2)
    for problem in forms(base):
        expected = lv.solve(problem, "newton", tol=1e-9)
        how, done, relative, impulse = driven(problem)
        truth = lv.residual(problem, impulse).relative
        assert relative == pytest.approx(truth, rel=1e-9, abs=1e-300)
        if how == REACHED:
            assert truth <= 1e-9
        if (
            problem.rows is None
        ):  # one method: over bodies other columns may be left out, over rows nothing differs
            assert (how == REACHED) == expected.success
            assert done == pytest.approx(expected.work["factorisations"], abs=2)


@pytest.mark.parametrize("seed", range(4))
def test_driver_of_an_asymmetric_matrix_converges_quadratically(seed):
    """With a factor of another matrix, the last step would leave an error just below the tolerance."""
    rng = np.random.default_rng(seed)
    m = 12
    half, skew = rng.normal(size=(m, m)), rng.normal(size=(m, m))
    a = half @ half.T / m + 0.3 * np.eye(m) + 0.3 * (skew - skew.T)
    problem = lv.Problem.lcp(a, 3.0 * rng.normal(size=m), -0.2, 0.5)
    how, _, relative, _ = driven(problem)
    assert how == REACHED and relative <= 1e-13
