"""Room, start and step: the same method without Python, in any number of turns, and in WebAssembly."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_problems import as_matrix, random_contact_problem, random_lcp, seeds

import lavender as lv
from lavender.judge.certificates import check_certificate
from lavender_ext.driver.driver import Driver

MORE, REACHED, STUCK, CERTIFICATE, SPENT = 0, 1, 3, 4, 5


def driven(problem, tol=1e-9, budget=1500, work=10**6):
    """(how it ended, factorisations, residual as the driver has it, impulse); None where it is not taken."""
    lv.residual(problem, problem.start())  # d, nu and J M^-1 J^T of a problem are known once it is judged
    driver, impulse = Driver(problem.metric, tol, budget), problem.start().copy()
    if not driver.start(impulse):
        return None
    how = MORE
    while how in (MORE, CERTIFICATE):
        how, done, relative, proof = driver.step(work, impulse)
        if proof is not None and check_certificate(problem, proof) is None:
            driver.prove()
    return how, done, relative, impulse


def forms(problem):
    """A problem of bodies, and the same as a matrix."""
    return problem, as_matrix(problem)


@pytest.mark.parametrize("friction", ["coulomb", "cone"])
@given(seed=seeds, rolling=st.booleans())
@settings(max_examples=20)
def test_contacts_are_solved_as_newton_solves_them(friction, seed, rolling):
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


@given(seed=seeds)
@settings(max_examples=20)
def test_turns_of_any_length_give_the_same_bits(seed):
    for problem in (random_lcp(seed, m=9), *forms(random_contact_problem(seed, bodies=4, contacts=5))):
        found = driven(problem)
        if found is not None:
            short = driven(problem, work=1)
            assert short[:2] == found[:2]
            assert short[3].tobytes() == found[3].tobytes()


def test_rows_that_cannot_move_stay_and_push_the_others():
    a = np.array([[2.0, 0.5, 0.0], [0.5, 2.0, 0.1], [0.0, 0.1, 3.0]])
    problem = lv.Problem.lcp(a, [1.0, 1.0, 1.0], lower=[0.5, 0.0, 0.0], upper=[0.5, 0.0, np.inf])
    how, _, _, impulse = driven(problem, 1e-12)
    assert how == REACHED
    np.testing.assert_allclose(impulse, [0.5, 0.0, 1.0 / 3.0], rtol=0, atol=1e-14)
    for base in forms(random_contact_problem(3, friction="cone", bodies=4, contacts=6, joints=2)):
        c = base.cones
        held = np.arange(base.m) == 1
        still = replace(
            base,
            cones=replace(
                c,
                mu=np.where(np.arange(base.n_blocks) % 2, c.mu, 0.0),
                lower=np.where(held, 0.2, c.lower),
                upper=np.where(held, 0.2, c.upper),
            ),
        )
        how, _, _, impulse = driven(still)
        assert how == REACHED and impulse[1] == 0.2
        assert lv.residual(still, impulse).relative <= 1e-9
