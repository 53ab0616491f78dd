"""De Saxce's interior point and the augmented system: against dense algebra."""

import dataclasses

import numpy as np
import pytest
from calls import block_diagonal, dense_h, system_in
from hypothesis import given
from random_problems import random_contact_problem, seeds


def problem_of(seed, compliant, friction="coulomb"):
    problem = random_contact_problem(seed, friction=friction, bodies=5, contacts=8)
    return problem if compliant else dataclasses.replace(problem, compliance=np.zeros(problem.m))


@given(seed=seeds)
def test_slip_is_de_saxces_term_and_psi_its_derivative(seed):
    solve = system_in(problem_of(seed, True), "velocity").solve
    sc = solve.view_arrays()
    rng = np.random.default_rng(seed)
    s, ds = rng.normal(size=sc.m), rng.normal(size=sc.m)
    phi, psi = solve.normal_shift(s)
    for i in range(len(sc.ptr) - 1):
        j = sc.ptr[i]
        end = sc.ptr[i + 1]
        reach = sc.reach[sc.part[i] : sc.part[i + 1]]
        spin = len(reach) == 2
        expected = 0.0
        if len(reach):
            expected = reach[0] * np.linalg.norm(s[j + 1 : end - spin])
            expected += reach[1] * abs(s[end - 1]) if spin else 0.0
        assert phi[j] == pytest.approx(expected, rel=1e-14, abs=1e-300)
        assert psi[j] == 0.0
    step = 1e-6
    difference = (solve.normal_shift(s + step * ds)[0] - solve.normal_shift(s - step * ds)[0]) / (
        2.0 * step
    )
    # The third derivative of |s_t| grows like 1/|s_t|^2, and spin has a kink: only where nothing is near 0.
    smooth = [
        i
        for i in range(len(sc.ptr) - 1)
        if sc.part[i] == sc.part[i + 1]
        or np.abs(s[sc.ptr[i] + 1 : sc.ptr[i + 1]]).min(initial=1.0) > 1e-2
    ]
    along = np.add.reduceat(psi * ds, sc.ptr[:-1])
    np.testing.assert_allclose(difference[sc.ptr[:-1]][smooth], along[smooth], rtol=0, atol=1e-6)


@pytest.mark.parametrize("compliant", [True, False])
@pytest.mark.parametrize("form", ["velocity", "impulse", "sparse", "augmented"])
@given(seed=seeds)
def test_de_saxce_step_solves_its_linear_system(form, compliant, seed):
    problem = problem_of(seed, compliant)
    system = system_in(problem, "velocity" if form == "augmented" else form)
    solve = system.solve
    sc = system.solve.view_arrays()
    h = dense_h(problem)[np.ix_(sc.keep, sc.keep)]
    first = np.repeat(sc.ptr[:-1], np.diff(sc.ptr))
    solve.begin_interior(1e-10, 0.9)
    for _ in range(3):
        solve.scale_interior(1e-10)
        w = np.linalg.inv(block_diagonal(system, sc.v)) - np.diag(sc.theta)
        c = np.eye(sc.m)
        np.subtract.at(c, (first, np.arange(sc.m)), solve.form_de_saxce_matrices(0.9))
        assert solve.factor("pair", augmented=form == "augmented")
        r = np.random.default_rng(seed).normal(size=sc.m)
        x = solve.solve("pair", r)
        expected = np.linalg.solve(h + c @ w, r)
        # W holds entries up to 1e10 of delta's reciprocal beside 1: what the dense inverse keeps of 16 digits.
        np.testing.assert_allclose(x, expected, rtol=0, atol=2e-5 * np.abs(expected).max())
        assert solve.step_interior()
