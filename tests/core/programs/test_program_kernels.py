"""Kernels of programs for backends, against dense arithmetic, and the limits of steps and calls."""

import numpy as np
import pytest
import scipy.sparse as sp

from lavender import Problem
from lavender.base.deadline import Deadline
from lavender.programs.forms import get_program
from lavender.programs.qp_solver import ProgramJudge
from lavender_ext.program.rows import NewtonStep, make_columns, make_dense


def draw_program(seed, n=9):
    """Return a program with equations, inequalities, lower, upper and equal bounds, in mixed units."""
    rng = np.random.default_rng(seed)
    half = sp.random(n, n, 0.4, random_state=rng).toarray()
    unit = 2.0 ** rng.integers(-6, 7, n)
    P = unit[:, None] * (half @ half.T + np.eye(n)) * unit
    A = rng.normal(size=(2, n)) * unit
    G = sp.random(5, n, 0.5, random_state=rng).toarray() * unit
    low = np.full(n, -np.inf)
    high = np.full(n, np.inf)
    low[:4], high[2:6] = -0.5, 0.5
    low[7] = high[7] = 0.25
    qp = Problem.from_qp(
        P, rng.normal(size=n) * unit, G, np.ones(5), A, np.zeros(2), low / unit, high / unit
    ).qp
    return get_program(qp)


@pytest.mark.parametrize("seed", range(5))
def test_newton_step_solves_the_equations_of_active_rows(seed):
    program = draw_program(seed)
    rng = np.random.default_rng(seed)
    m = len(program.t)
    active = rng.random(m) < 0.3
    active[: program.free] = True
    for i, j in enumerate(program.variable):  # A variable is at one of its bounds.
        active[i] &= j < 0 or not (active[:i] & (program.variable[:i] == j)).any()
    x = rng.normal(size=9)
    lam = rng.normal(size=m)
    scaled = program.scaled
    step = NewtonStep(
        scaled.P, scaled.q, scaled.J, scaled.t, program.variable, program.scales, active, x, lam
    )
    dense = step.make_dense(0.125)
    columns = sp.csc_array(step.make_columns(0.125), (step.size, step.size))
    np.testing.assert_array_equal(columns.toarray(), dense)
    np.testing.assert_array_equal(dense, dense.T)
    assert columns.has_sorted_indices
    point = program.polish(x, lam, active, 100)
    # Equations of the program itself: active rows hold, and the gradient is a combination of them.
    P, J = make_dense(program.P, 9), make_dense(program.J, 9)
    size = np.abs(J) @ np.abs(point[0]) + np.abs(program.t)
    assert (np.abs(J @ point[0] - program.t)[active] <= 1e-12 * size[active]).all()
    terms = np.abs(P) @ np.abs(point[0]) + np.abs(program.q) + np.abs(J.T) @ np.abs(point[1])
    assert (np.abs(P @ point[0] + program.q - J.T @ point[1]) <= 1e-12 * terms).all()
    assert not point[1][~active].any()


def test_columns_are_the_transposed_selected_rows():
    program = draw_program(3)
    J = make_dense(program.J, 9)
    rows = np.array([0, 4, 2], np.int32)
    np.testing.assert_array_equal(make_dense(program.J, 9, rows, -1.0), -J[rows])
    np.testing.assert_array_equal(
        sp.csc_array(make_columns(program.J, 9, rows, 2.0), (3, 9)).toarray(), 2.0 * J[rows]
    )
    upper = sp.csc_array(make_columns(program.P, 9, None, 1.0, True), (9, 9)).toarray()
    np.testing.assert_array_equal(upper, np.triu(make_dense(program.P, 9)))


@pytest.mark.parametrize(("seconds", "largest"), [(None, 20_000), (1e4, 20_000), (0.04, 300)])
def test_no_long_step_begins_shortly_before_the_deadline(monkeypatch, seconds, largest):
    program = draw_program(0)
    sizes = []
    judge = ProgramJudge(program, 1e-6, Deadline(seconds))
    monkeypatch.setattr(
        type(program), "polish", lambda self, x, lam, active, size: sizes.append(size)
    )
    judge.accepts(np.zeros(9), np.zeros(len(program.t)))
    assert set(sizes) <= {largest}
    assert sizes or seconds is not None
