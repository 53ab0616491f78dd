"""Kernels and steps timed: bare loops do the same work, figures are consistent, commands print and write them."""

import numpy as np
import pytest

import lavender as lv
from benchmarks import core_problems
from benchmarks.kernels import microbenchmarks, problems
from benchmarks.kernels.cases import job, run
from benchmarks.kernels.command import table
from benchmarks.kernels.instructions import COUNTED


@pytest.mark.parametrize("shuffle", [False, True])
def test_bench_kernels_contact_sweep_is_sequential_impulses(shuffle):
    problem = core_problems.lattice_pile(200, shuffle=shuffle)
    contacts, bodies = problems.bare_contacts(problem)
    microbenchmarks.contact(contacts.view(np.uint8).reshape(-1), bodies.view(np.uint8).reshape(-1), 20)
    impulse = lv.solve(problem, "sequential_impulses", tol=0.0, max_iter=20).impulse
    # The same sweep with I^-1 applied on the way: rounding of 20 sweeps.
    np.testing.assert_allclose(contacts["lam"].ravel(), impulse, rtol=0, atol=1e-12 * np.abs(impulse).max())
    slip = np.hypot(impulse[1::3], impulse[2::3]) > 0.499 * impulse[::3]
    assert slip.any() and not slip.all()  # both branches of the disk were taken
    velocity = problem.velocity(impulse) - problem.rows.v_free
    np.testing.assert_allclose(bodies["v"][1:], velocity, rtol=0, atol=1e-12 * np.abs(velocity).max())
    assert not bodies["v"][0].any()


def test_bench_kernels_row_sweep_is_pgs():
    problem = problems.tridiagonal(50)
    a, lam = problem.csr, problem.start()
    microbenchmarks.csr(a.indptr, a.indices, a.data, problem.b, problem.data.step.copy(), lam, 30)
    impulse = lv.solve(problem, "pgs", tol=0.0, max_iter=30).impulse
    np.testing.assert_allclose(lam, impulse, rtol=0, atol=1e-13 * np.abs(impulse).max())


def test_bench_pile_has_its_documented_overlap():
    for contacts in (1, 50, 3_000):
        problem = core_problems.lattice_pile(contacts)
        assert 0.5 * contacts <= problem.n_blocks <= 1.5 * contacts + 3
        assert (problem.rows.contact_body < 0).any()
    given, shuffled = core_problems.lattice_pile(300), core_problems.lattice_pile(300, shuffle=True)
    assert given.n_blocks == shuffled.n_blocks
    assert not np.array_equal(given.rows.contact_body, shuffled.rows.contact_body)
    with pytest.raises(lv.InputError, match="at least 1"):
        core_problems.lattice_pile(0)


@pytest.mark.parametrize("case", ["impulses", "pgs-tridiagonal", "block", "solve-8", "engine-box"])
def test_bench_kernels_cases_give_time_work_and_residual(case):
    rows = list(run([case], seconds=0.01))
    for row in rows:
        assert row.seconds > 0.0 and row.work > 0
        assert row.per_unit == pytest.approx(1e9 * row.seconds / row.work)
    assert any(np.isfinite(r.residual) for r in rows)
    text = table(rows)
    assert all(r.case in text for r in rows)


@pytest.mark.parametrize("name", COUNTED)
def test_bench_kernel_cases_run_the_counted_work(name):
    made = job(name)
    made.call()
    assert made.work >= 1.0
