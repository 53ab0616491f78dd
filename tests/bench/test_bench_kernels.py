"""The kernel suite: bare loops do the same work, figures are consistent, the command prints and writes them."""

import json
import shutil
import time

import numpy as np
import pytest
from click.testing import CliRunner

import lavender as lv
from benchmarks import kernels
from benchmarks.kernels import limits, microbenchmarks


@pytest.mark.parametrize("shuffle", [False, True])
def test_the_bare_contact_sweep_is_sequential_impulses(shuffle):
    problem = kernels.lattice_pile(200, shuffle=shuffle)
    contacts, bodies = kernels.bare_contacts(problem)
    microbenchmarks.contact(contacts.view(np.uint8).reshape(-1), bodies.view(np.uint8).reshape(-1), 20)
    impulse = lv.solve(problem, "sequential_impulses", tol=0.0, max_iter=20).impulse
    # The same sweep with I^-1 applied on the way: rounding of 20 sweeps.
    np.testing.assert_allclose(contacts["lam"].ravel(), impulse, rtol=0, atol=1e-12 * np.abs(impulse).max())
    slip = np.hypot(impulse[1::3], impulse[2::3]) > 0.499 * impulse[::3]
    assert slip.any() and not slip.all()  # both branches of the disk were taken
    velocity = problem.velocity(impulse) - problem.rows.v_free
    np.testing.assert_allclose(bodies["v"][1:], velocity, rtol=0, atol=1e-12 * np.abs(velocity).max())
    assert not bodies["v"][0].any()


def test_the_bare_row_sweep_is_pgs():
    problem = kernels.tridiagonal(50)
    a, lam = problem.csr, problem.start()
    microbenchmarks.csr(a.indptr, a.indices, a.data, problem.b, problem.data.step.copy(), lam, 30)
    impulse = lv.solve(problem, "pgs", tol=0.0, max_iter=30).impulse
    np.testing.assert_allclose(lam, impulse, rtol=0, atol=1e-13 * np.abs(impulse).max())


def test_the_pile_stands_where_it_says():
    for contacts in (1, 50, 3_000):
        problem = kernels.lattice_pile(contacts)
        assert 0.5 * contacts <= problem.n_blocks <= 1.5 * contacts + 3
        assert (problem.rows.contact_body < 0).any()
    given, shuffled = kernels.lattice_pile(300), kernels.lattice_pile(300, shuffle=True)
    assert given.n_blocks == shuffled.n_blocks
    assert not np.array_equal(given.rows.contact_body, shuffled.rows.contact_body)
    with pytest.raises(lv.InputError, match="at least 1"):
        kernels.lattice_pile(0)


def test_limits_are_times_of_this_machine():
    found = kernels.measure_limits(0.002)
    assert all(x.value > 0.0 for x in found)
    assert sum(x.name == "chase" for x in found) == len(limits.FOOTPRINTS)
    assert kernels.stream_time(2e9) > kernels.stream_time(1e9) > 0.0


def test_least_is_the_least_of_many():
    clock = iter([0, 5_000, 0, 3_000, 0, 9_000])  # ns; a call of 2 ms is a batch of its own
    found = kernels.least(lambda: time.sleep(0.002), seconds=0.0, clock=lambda: next(clock))
    assert found == [pytest.approx(3e-6)]


@pytest.mark.parametrize("case", ["impulses", "pgs-tridiagonal", "jacobi", "block", "solve-1", "engine-box"])
def test_cases_give_time_work_and_residual(case):
    rows = list(kernels.run([case], seconds=0.01))
    for row in rows:
        assert row.seconds > 0.0 and row.work > 0
        assert row.per_unit == pytest.approx(1e9 * row.seconds / row.work)
    assert any(np.isfinite(r.residual) for r in rows)
    text = kernels.table(rows)
    assert all(r.case in text for r in rows)


def test_a_wrong_case_is_named():
    with pytest.raises(lv.InputError, match="'nosuch'"):
        list(kernels.run(["nosuch"]))


def test_growing_piles_are_built_and_solved():
    (row,) = kernels.scaling([200], seconds=0.01)
    assert row["contacts"] > 100 and row["sweep"] > 0.0 and row["residual"] < 0.5
    assert "| ns / contact and sweep |" in kernels.scaling_table([row])


def test_bytes_are_those_of_the_arrays():
    problem = kernels.lattice_pile(60)
    c, m = problem.n_blocks, problem.m
    per_row = 8 * (6 + 1 + 1 + 1 + 2)  # swing, compliance, b, step, impulse twice
    per_contact = 8 * (12 + 1 + 5 + 1) + 4 * 3  # axes, arms, bodies, coupling, mu; order, start, kind
    assert kernels.contact_bytes(problem) == pytest.approx((m * per_row + c * per_contact) / c)


def test_command_prints_and_writes(tmp_path):
    out = tmp_path / "kernels.json"
    done = CliRunner().invoke(kernels.command, ["solve-1", "--seconds", "0.01", "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "lv.solve" in done.output and "dependent load" in done.output
    record = json.loads(out.read_text())
    assert record["lines"][0]["ns_per_unit"] > 0.0
    assert {x["name"] for x in record["limits"]} == {"read", "triad", "chase", "chain"}


def test_counting_says_what_is_missing(monkeypatch):
    with pytest.raises(lv.InputError, match="not counted"):
        kernels.instructions("build")
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(lv.SolverUnavailable, match="valgrind"):
        kernels.instructions("pgs")


@pytest.mark.parametrize("name", kernels.COUNTED)
def test_what_is_counted_runs(name):
    call, work = kernels.counted(name)
    call()
    assert work >= 1.0
