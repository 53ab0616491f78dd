"""Room, start and step: the same method without Python, in any number of turns."""

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
def test_contacts_are_solved_as_newton_solves_them(friction, seed, rolling):
    base = random_contact_problem(seed, friction, rolling=rolling, bodies=5, contacts=6, joints=2)
    for problem in forms(base):
        expected = lv.solve(problem, "newton", tol=1e-9)
        how, done, relative, impulse = driven(problem)
        truth = lv.residual(problem, impulse).relative
        assert relative == pytest.approx(truth, rel=1e-9, abs=1e-300)
        if how == REACHED:
            assert truth <= 1e-9
        if problem.rows is None:  # one method: over bodies other columns may be left out, over rows nothing differs
            assert (how == REACHED) == expected.success
            assert done == pytest.approx(expected.work["factorisations"], abs=2)
