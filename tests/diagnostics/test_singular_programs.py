"""Quadratic programs with a singular P: comparison of solvers."""

import numpy as np

import lavender as lv

SINGULAR = lv.Problem.from_qp(np.diag([1.0, 0.0]), [1.0, 1.0], G=[[1.0, 1.0]], h=[1.0], lb=[-4.0, -4.0])


def test_solvers_of_a_singular_program_agree():
    checked = lv.cross_check(SINGULAR, tol=1e-6)
    assert checked.reference is not None and {row.solver for row in checked} == set(lv.available(SINGULAR))
    assert not checked.contradicted and len(checked.agreed) >= 3
    for row in checked.agreed:
        assert abs(row.objective) <= 1e-5 and row.distance <= row.allowed
    refused = lv.cross_check(SINGULAR, ["newton"])
    assert refused["newton"].verdict == "refused" and "osqp" in refused["newton"].note
