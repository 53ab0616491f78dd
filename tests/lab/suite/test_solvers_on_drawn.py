"""Solvers on problems of structures drawn by lot (`random_families`)."""

import re
from dataclasses import replace

import numpy as np
import pytest
from calls import REACHED, check, driven
from random_families import drawn, wild
from random_problems import as_matrix, good

import lavender as lv
from lavender import registry
from lavender.problem.rows import Rows
from lavender.solvers.certify import certify_infeasibility
from lavender.solvers.newton_systems import general
from lavender.solvers.newton_systems.systems import make_system
from lavender.solvers.small import AUTO
from lavender.solvers.solve_log import SolveLog
from lavender_ext.batch.many import solve_new_generalized_problem


def test_under_a_limit_nothing_long_is_begun_in_setting_up():
    """A of J and M is not formed, and a matrix of many entries not analysed, where that would end too late."""
    problem = wild(seed=109, rows=3000).problem
    assert problem.operator == "generalized"
    late = lv.solve(problem, "admm", time_limit=1e-4)
    assert late.status is lv.Status.TIME_LIMIT and late.iterations == 0 and not late.work
    assert not {"csr", "csr_data"} & set(problem.__dict__)
    assert late.impulse.tobytes() == problem.start().tobytes()
    prepared = lv.prepare(problem, "admm")
    assert prepared.solve(time_limit=1e-4).status is lv.Status.TIME_LIMIT
    after, whole = prepared.solve(max_iter=5), lv.solve(problem, "admm", max_iter=5)
    assert after.work == whole.work and after.impulse.tobytes() == whole.impulse.tobytes()


@pytest.mark.parametrize(
    ("seed", "law", "first"),
    [
        (67, "coulomb", "anderson"),  # 667 spheres in one heap: a dense factor of N costs seconds
        (57, "cone", "newton"),  # 36 rows on 60 velocities
    ],
)
def test_islands_of_generalized_velocities_go_to_newton_where_they_are_small(seed, law, first):
    problem = wild(seed=seed).problem.relaxed(law)
    assert problem.generalized is not None
    solution = lv.solve(problem, tol=1e-6)
    assert good(solution, 1e-6)
    assert solution.message.startswith(first)


def test_a_step_that_would_end_after_the_deadline_is_refused(monkeypatch):
    problem = wild(seed=7).problem
    kernel = general.prepare_islands(problem)
    monkeypatch.setattr(general, "FLOP_TIME", 1e-6)  # a machine ten thousand times slower: 40 s a step
    claim = general.run_newton_steps(problem, kernel, problem.start(), 100, 1e-9, 1.0)
    assert claim.status is lv.Status.TIME_LIMIT
    assert claim.iterations == 0


def test_cheap_first_steps_promise_nothing_of_those_that_follow(monkeypatch):
    problem = wild(seed=7).problem  # a step of it: 0.4 s at 1e-8 s a multiply-add
    clock, asked = [0.0], []

    class Kernel:
        islands, work, counts = 1, general.prepare_islands(problem).work, (0, 0, 0, 0)

        def start(self, impulse, tol, budget):
            pass

        def step(self, steps, impulse):
            asked.append(steps)
            clock[0] += 1e-3 if len(asked) == 1 else 0.4 * steps
            self.counts = (sum(asked), 0, 0, 0)
            return general.OUTCOMES["more"]

    monkeypatch.setattr(general, "FLOP_TIME", 1e-8)
    monkeypatch.setattr(general, "SPARSE_FLOP_TIME", 2e-7)
    monkeypatch.setattr("lavender.base.deadline.perf_counter", lambda: clock[0])
    claim = general.run_newton_steps(problem, Kernel(), problem.start(), 1000, 1e-9, 1.0)
    assert claim.status is lv.Status.TIME_LIMIT
    assert set(asked) == {1} and clock[0] <= 1.0 + 0.4


def test_an_island_without_a_solution_is_proof_enough():
    """Bounds above elsewhere are in nobody's way; what the linear program finds is proven for the whole."""
    a = np.zeros((4, 4))
    a[:2, :2] = [[1.0, -1.0], [-1.0, 1.0]]  # y = (1, 1): A^T y = 0, b.y = 2
    a[2:, 2:] = [[2.0, 0.5], [0.1, 2.0]]
    problem = lv.Problem.lcp(a, [1.0, 1.0, -1.0, 3.0], 0.0, [np.inf, np.inf, 1.0, 1.0])
    log = SolveLog(problem, 1e-6, 100)
    log.judge_and_store_best(problem.start())
    certify_infeasibility(log)
    assert log.certificate is not None
    assert not log.certificate[2:].any()
    assert [stage.solver for stage in log.stages] == ["linear program"] and log.work == {"certificates": 1}
    large = lv.solve(wild(seed=141, rows=600).problem, tol=1e-6)  # 360 asymmetric rows in many islands
    assert large.status is lv.Status.INFEASIBLE and large.claim_check == "confirmed"


def test_more_sweeps_guess_the_free_rows_where_a_factor_costs_as_much():
    narrow = lv.solve(wild(seed=3131).problem, "direct", tol=1e-6)
    assert narrow.solver.form == "band" and narrow.work["sweeps"] == 4
    sparse = lv.solve(wild(seed=3170).problem, "direct", tol=1e-6)  # 480 rows
    assert sparse.solver.form == "sparse" and sparse.work["sweeps"] == 48
    assert sparse.work["factorisations"] <= 3  # 6 after 4 sweeps


def test_generalised_coordinates_are_driven_by_the_same_names():
    for seed in (44017, 44027, 44030):
        problem = wild(seed=seed).problem
        assert problem.generalized is not None
        how, done, _, impulse = driven(problem, 1e-8)
        assert how == REACHED and done > 0
        assert lv.residual(problem, impulse).relative <= 1e-8


def test_many_bodies_on_one_leave_half_of_the_rows():
    # 26 % of A is nonzero; of 228 rows, half of them of bodies that touch nothing else, elimination leaves a quarter of
    # the entries of a full factor and an eighth of its work. Bounded rows as full as that stay full.
    bounded = wild(seed=7566).problem
    assert bounded.law == "lcp" and make_system(bounded, "impulse").dense
    problem = wild(seed=7012).problem
    assert problem.matrix is not None
    system = make_system(problem, "impulse")
    assert not system.dense
    assert system.work < 0.2 * problem.m**3 / 3.0
    sparse_one = lv.solve(problem, "newton", tol=1e-9)
    assert good(sparse_one, 1e-9)


@pytest.mark.parametrize(
    ("seed", "sweeps", "most", "words"),
    [
        # From swept impulses exchanges take few; from nothing 8 to 18.
        *((seed, 60, 4, ()) for seed in (6, 70, 239, 3146)),
        # Joints that nearly depend on each other; interior points take 23 to 35.
        *((seed, 0, 2, ()) for seed in (5080, 5229, 177, 5122)),
        (242, 0, 1, ()),
        # Rows that depend on each other: exchanges that go in circles are given up.
        (3, 0, 28, ("exchanges", "interior point steps")),
        # An asymmetric matrix; from a start that leads nowhere it begins from nothing in the end: 170, else 6.
        (807, 0, 39, ()),
        (807, 64, 399, ()),
    ],
)
def test_newton_takes_few_factorisations_of_what_is_drawn(seed, sweeps, most, words):
    problem, start = wild(seed=seed, rows=120 if seed == 807 else 3000).problem, None
    if sweeps:
        problem = as_matrix(problem)
        start = lv.solve(problem, "anderson", tol=0.0, max_iter=sweeps).impulse
    solution = lv.solve(problem, "newton", impulse=start, tol=1e-6)
    assert good(solution, 1e-6) and solution.work["factorisations"] <= most, solution
    assert all(word in solution.message for word in words)
    assert seed == 807 or not (sweeps and "sweeps" in solution.work)


def test_spheres_turned_by_rounding_alone_have_three_unknowns_each():
    problem = wild(seed=239).problem
    rows = problem.rows
    assert rows is not None and rows.inv_inertia.any()
    system = make_system(problem, "velocity")
    solution = lv.solve(problem, "newton", tol=1e-10)
    assert system.layout.s == 3
    assert good(solution, 1e-10), solution


@pytest.mark.parametrize("solver", ["auto", "direct"])
@pytest.mark.parametrize("seed", [5793, 6452, 7592])
def test_small_bounded_rows_that_depend_on_each_other_are_one_shift(solver, seed):
    problem = wild(seed=seed).problem
    found = check(problem, solver, tol=1e-9)
    assert found.success
    assert found.work["shifts"] == 1 and found.work["factorisations"] <= 6
    assert registry.get(solver).small.solve_and_judge(problem, None, 1e-9)[0] is not None


@pytest.mark.parametrize("tol", [1e-3, 1e-9])
@pytest.mark.parametrize("seed", [7530, 7845, 4691, 7514])  # asymmetric, long, with joints, symmetric
def test_where_exchanges_of_few_rows_are_stuck_auto_follows_lemkes_path(seed, tol):
    problem = wild(seed=seed).problem
    found = check(problem, "auto", tol=tol)
    assert found.success
    said = re.fullmatch(
        r"direct 4 sweeps, \d+ factorisations, (\d+) pivots -> lemke (\d+) pivots", found.message
    )
    assert said, found.message
    assert found.work["pivots"] == int(said[1]) + int(said[2])
    assert found.iterations > int(said[2])
    assert (
        registry.get("direct").small.solve_and_judge(problem, None, tol)[0] is None
    )  # which is exchanges alone


def test_small_bounded_rows_that_are_nearly_singular_end_where_that_meets_the_tolerance():
    problem = wild(seed=7375).problem
    found = check(problem, "auto", tol=1e-6)
    assert found.success and found.residual.relative > 1e-13
    assert found.message.startswith("direct") and "->" not in found.message


@pytest.mark.parametrize("seed", [6662, 7021, 7597])
def test_what_newton_leaves_of_few_velocities_goes_on_the_same_way_everywhere(seed):
    """Forests under Coulomb's law that the one call ends, that sweeps end after it, that is not asked of it first."""
    problem = wild(seed=seed).problem
    assert problem.generalized is not None
    short = check(problem, "auto", tol=1e-6)
    assert short.success and "newton" in short.message
    told = sum(int(count) for count in re.findall(r"(\d+) sweeps", short.message))
    assert told == short.work.get("sweeps", 0), "sweeps that go on are counted once"


@pytest.mark.parametrize("seed", [1224])  # of 48 rows, where newton is stuck
def test_steps_over_few_velocities_that_were_in_vain_are_not_taken_twice_in_one_call(seed):
    problem = wild(seed=seed).problem
    found, counts = solve_new_generalized_problem(
        replace(problem, copy=False).metric, None, 1e-6, AUTO.limits
    )
    assert found is None and counts[0] > 0
    fresh = replace(problem, copy=False)
    assert registry.get("auto").small.solve_and_judge(fresh, None, 1e-6)[0] is None
    solution = check(problem, "auto", tol=1e-6)
    first = solution.stages[0]
    assert first.solver == "newton" and first.before == first.after == 1.0, "the call that failed is told"
    assert first.work["factorisations"] == counts[1]


def test_what_a_line_needs_is_not_made_where_the_one_before_has_solved_it():
    """Newton's method over rows of A follows where that over velocities fails; A is not formed before."""
    problem = drawn(seed=7338, part="tuned").problem
    assert problem.generalized is not None
    solution = lv.solve(problem, tol=1e-3)
    assert solution.success and solution.stages[-1].solver == "newton"
    assert not {"csr", "csr_data"} & set(problem.__dict__)


def test_rows_of_zeros_that_ask_nothing_cost_nothing(monkeypatch):
    """J and M^-1 of bodies are not formed to look at rolling rows of points, which have no inertia."""
    problem = drawn(seed=7027, part="rolling").problem
    assert len(problem.metric.empty)
    lv.residual(problem, problem.start())
    monkeypatch.delitem(problem.__dict__, "vanished_rows", raising=False)
    monkeypatch.setattr(Rows, "jacobian", None)
    assert lv.solve(problem, tol=1e-3).success
