"""Problems of few rows take a compiled way: it must not show, but in time."""

import _thread
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
from calls import SHORT, check
from hypothesis import given, settings
from hypothesis import strategies as st
from random_problems import (
    as_matrix,
    random_contact_problem,
    random_generalized_problem,
    random_lcp,
    seeds,
    side_by_side,
)
from scipy.sparse import block_diag, coo_array

import lavender as lv
from benchmarks.core_problems import forms, fresh, stacks
from lavender import registry
from lavender.solvers.costs import RATES, estimate_factorisation_count
from lavender.solvers.small import AUTO, SmallCall, describe_small_call, get_call_time_fraction, make_limits
from lavender_ext.batch.many import solve_new_generalized_problem


def draw(kind, seed):
    rng = np.random.default_rng(seed)
    if kind == "lcp":
        return random_lcp(seed, m=int(rng.integers(1, 64)), rank=None if rng.random() < 0.7 else 3)
    if kind == "linear":
        g = rng.normal(size=(9, 9))
        a = g @ g.T if rng.random() < 0.6 else g
        return lv.Problem.linear(a, rng.normal(size=9))
    if kind == "singular":
        g = rng.normal(size=(9, 9 - seed % 4)) * 10.0 ** rng.uniform(0.0, seed % 3, (9, 1))
        a = g @ g.T
        return lv.Problem.linear(0.5 * (a + a.T), a @ rng.normal(size=9) if seed % 5 else rng.normal(size=9))
    if kind == "one-sided":  # unsymmetric
        return lv.Problem.lcp(
            rng.normal(size=(6, 6)) + 6.0 * np.eye(6),
            rng.normal(size=6),
            friction=["coulomb", "cone"][seed % 2],
        )
    if kind.startswith("rows"):
        return random_contact_problem(
            seed, kind.split()[1], bodies=3, joints=int(rng.integers(0, 3)), contacts=int(rng.integers(0, 5))
        )
    if kind.startswith("matrix"):
        return as_matrix(draw("rows " + kind.split()[1], seed))
    law = kind.split()[1]
    if kind.startswith("hollow"):
        return hollow(random_generalized_problem(seed, law, n=8, compliance=seed % 3 > 0), rng)
    tangents = int(rng.integers(1, 6)) if law == "cone" else int(rng.integers(0, 3))
    return random_generalized_problem(
        seed, law, n=int(rng.integers(2, 12)), compliance=seed % 3 > 0, contacts=4, tangents=tangents
    )


def hollow(problem, rng):
    """Some of its rows of A all zero: rows of J, and the compliance of these."""
    general, soft = problem.generalized, problem.compliance.copy()
    jac = general.jac.toarray()
    rows = rng.random(problem.m) < 0.3
    jac[rows] = soft[rows] = 0.0
    target = np.where(rows, rng.choice([-1.0, -1e-3, 0.0, 0.2], problem.m), problem.b)
    return lv.Problem.from_jacobian(
        jac, general.mass, general.v_free, target=target + jac @ general.v_free, cones=problem.cones,
        compliance=soft, friction=problem.friction,
    )  # fmt: skip


KINDS = (
    "lcp", "linear", "singular", "one-sided", "rows coulomb", "rows cone", "matrix coulomb", "matrix cone",
    "general coulomb", "general cone", "hollow coulomb", "hollow cone",
)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@given(seed=seeds, tol=st.sampled_from([1e-3, 1e-6, 1e-9, 1e-13, 0.9]))
@settings(max_examples=8)
def test_the_short_way_and_the_long_way_are_one(kind, seed, tol):
    problem = draw(kind, seed)
    for solver in SHORT:
        if registry.get(solver).refuses(problem) is not None:
            continue
        first = check(problem, solver, tol=tol)
        check(problem, solver, tol=tol, impulse=first.impulse)
        near = first.impulse * (1.0 + 1e-4 * np.random.default_rng(seed).normal(size=problem.m))
        check(problem, solver, tol=tol, impulse=near)
        check(problem, solver, tol=tol, impulse=np.zeros(problem.m))
        check(replace(problem, guess=near, copy=False), solver, tol=tol)


def test_rows_of_zeros_leave_a_small_problem_to_the_one_call():
    """Bounded rows of a walking robot's plan: the first of each bound hangs on nothing that is to be found."""
    solved = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        jac = np.vstack([np.zeros(6), rng.normal(size=(9, 6))])
        problem = lv.Problem.from_jacobian(
            jac, np.eye(6), rng.normal(size=6), target=np.r_[-0.1, -np.ones(9)],
            cones=lv.Cones.bounded(np.zeros(10), np.full(10, np.inf)),
        )  # fmt: skip
        found = AUTO.solve_and_judge(problem, None, 1e-6)
        solved += found[0] is not None
        assert lv.solve(problem).success
    assert solved == 20


def test_most_of_them_do_take_the_short_way():
    took = 0
    for kind in KINDS:
        for seed in range(6):
            took += registry.get("auto").small.solve_and_judge(draw(kind, seed), None, 1e-6)[0] is not None
    assert took >= 0.6 * 6 * len(KINDS)  # a chain that gives everything up would pass the tests above


@pytest.mark.parametrize("limit", [None, 10.0])
def test_what_rounding_hides_is_no_matter_of_time(limit):
    """Two fixed impulses that cancel in a free row, whose b is 1000 times their rounding 2^-53 A lambda."""
    low, high = [1.5, -1.5, -np.inf], [1.5, -1.5, np.inf]
    held = lv.Problem.lcp(np.full((3, 3), 1e13), [0.0, 0.0, 1.0], low, high)
    solution = lv.solve(held, time_limit=limit)
    assert solution.residual.relative == solution.residual.roundoff_floor > 1e-3
    assert solution.status is lv.Status.DIVERGED and "float64 loses b" in solution.message
    assert lv.solve_many([held], time_limit=limit).status.tolist() == [lv.Status.DIVERGED]


def test_round_cones_are_never_solved_over_rows_of_a():
    problem = random_generalized_problem(0, "cone", n=8, compliance=False, contacts=4, tangents=5)
    with pytest.raises(lv.errors.CapabilityError, match="need form='velocity'"):
        lv.solve(problem, "newton", form="impulse")
    assert "newton over rows" not in {stage.solver for stage in lv.explain(problem).stages}
    # What it cannot take further ends as a result, not in a solver that reads past such a block.
    hard = lv.prepare(problem, "auto").solve(tol=1e-15)
    assert np.isfinite(hard.residual.relative) and hard.claim_check == "confirmed"


@pytest.mark.parametrize("seed", range(16))
def test_the_compiled_gate_is_the_count_of_newton(seed):
    """One cost for the compiled loops, for `explain` and for the tree; at the limits it lets in, above them not."""
    rng = np.random.default_rng(seed)
    friction = ("coulomb", "cone")[seed % 2]
    n, contacts = int(rng.integers(6, 60)), int(rng.integers(0, 60)) if seed % 3 else 0
    problem = random_generalized_problem(seed, friction, n=n, compliance=seed > 8, contacts=contacts)
    state = registry.get("newton").load()().prepare(problem)
    cost = registry.get("newton").load()().cost(problem, state).total
    sizes = np.diff(problem.cones.ptr)
    in_contacts = sizes[sizes > 1].sum()
    step = RATES["entry"] * problem.metric.work + RATES["work"]["velocities"] * state.general.work
    step += RATES["velocity row"] * (problem.m - in_contacts) + RATES["velocity contact row"] * in_contacts
    assert cost == pytest.approx(step * estimate_factorisation_count(problem), rel=1e-12)

    def lets_in(of):
        return solve_new_generalized_problem(problem.metric, None, np.inf, of)[0] is not None

    if (
        make_limits(np.inf).cost(problem.metric, 0.0, state.general.islands)[1] == 0.0
    ):  # more rows than it is asked for
        assert not lets_in(make_limits(np.inf, np.inf))
        return
    assert lets_in(make_limits(np.inf, 1.01 * cost)) and not lets_in(make_limits(np.inf, 0.99 * cost))


def test_velocities_that_all_meet_are_one_call_as_well():
    """L has 239 entries in a row, ten times as many as there is room for at first."""
    rng = np.random.default_rng(0)
    jac, velocity = rng.normal(size=(300, 240)), rng.normal(size=240)
    problem = lv.Problem.from_jacobian(jac, np.eye(240), velocity, cones=lv.Cones.free(300), compliance=300.0)
    found, counts = solve_new_generalized_problem(
        fresh(problem).metric, None, 1e-6, make_limits(np.inf, np.inf)
    )
    assert found is not None and found.relative <= 1e-6 and counts[1] == 1


@pytest.mark.parametrize("friction", ["coulomb", "cone"])
@pytest.mark.parametrize("form", ["bodies", "matrix"])
@pytest.mark.parametrize("equal", [True, False])
@pytest.mark.parametrize("tol, corners", [(1e-3, 1), (1e-6, 1), (1e-10, 1), (1e-6, 4)])
def test_islands_under_friction_are_one_call(friction, form, equal, tol, corners):
    """Cut out of A, and of bodies where these have fewer unknowns: at four corners."""
    problem = forms(stacks(40, 2, 0.4, equal, corners))[form].relaxed(friction)
    found = check(problem, "auto", tol=tol)
    first = "newton on " if corners > 1 and friction == "cone" else "anderson on 40 islands"
    assert found.success and first in found.message and "islands" in found.message
    near = found.impulse * (1.0 + 1e-4 * np.random.default_rng(1).normal(size=problem.m))
    assert check(problem, "auto", tol=tol, impulse=near).success
    assert check(problem, "auto", tol=tol, impulse=found.impulse).work == {}
    each = found.impulse.reshape(40, -1)
    assert np.array_equal(each, np.tile(each[0], (40, 1))) == equal


@pytest.mark.parametrize("law", ["coulomb", "cone"])
@pytest.mark.parametrize("seed", range(4))
def test_islands_of_bodies_with_joints(law, seed):
    """Pairs of bodies, each with a joint or none, in no order; with a wrong number in a cut no call would end."""
    rng = np.random.default_rng(seed)
    drawn = random_contact_problem(seed, law, bodies=20, joints=8, contacts=70, tangents=2, spin=False)

    def pairs(n):
        second = 2 * rng.integers(0, 10, n) + 1
        return np.stack([np.where(rng.random(n) < 0.7, second - 1, -1), second], 1).astype(np.int32)

    rows = replace(drawn.rows, contact_body=pairs(70), joint_body=pairs(8))
    problem = replace(drawn, rows=rows, b=drawn.b)
    assert problem.m > 6 * rows.n_bodies
    found = check(problem, "auto", tol=1e-8)
    assert found.success and "islands" in found.message


def test_an_island_that_does_not_end_leaves_the_whole_to_the_long_way():
    stack = forms(stacks(40, 2, 0.4, False, corners=1))["matrix"].relaxed("cone")
    no_answer = lv.Problem(np.array([1.0, -1.0]), lv.Cones.free(2), np.ones((2, 2)), friction="cone")
    problem = side_by_side([stack, no_answer])
    assert registry.get("auto").small.solve_and_judge(fresh(problem), None, 1e-6)[0] is None
    found = lv.solve(problem)
    assert found.status.name == "INFEASIBLE" and found.certificate is not None


def test_islands_are_no_one_call_where_that_may_take_too_long():
    problem = forms(stacks(40, 2, 0.4, False))["matrix"]
    assert registry.get("auto").small.solve_and_judge(fresh(problem), None, 1e-6)[0] is not None
    assert (
        get_call_time_fraction(problem, 1e-6)
        == 0.0
        < get_call_time_fraction(problem, 10.0)
        < get_call_time_fraction(problem, np.inf)
    )
    pile = stacks(3, 30, 0.4, False)  # few islands, but large ones
    assert registry.get("auto").small.solve_and_judge(pile, None, 1e-6)[0] is None
    assert registry.get("newton").small.solve_and_judge(fresh(problem), None, 1e-6)[0] is None


def test_islands_where_doing_nothing_is_right_from_a_warm_start():
    """Of nine islands one leaves the ground: nothing is to be done for it, and the solution says what was done."""
    rng = np.random.default_rng(3)
    g = rng.normal(size=(12, 6))
    part, n = g @ g.T, 9
    b = np.tile(part @ np.tile([1.0, 0.1, 0.1], 4), n)
    problem = lv.Problem.contact(np.kron(np.eye(n), part), b, np.full(4 * n, 0.5))
    start = lv.solve(problem).impulse
    b[:12], b[:12:3] = 0.0, -0.01
    found = check(problem.updated(b=b), "auto", impulse=start)
    assert found.success and found.residual.relative <= found.tol
    assert not found.impulse[:12].any()


def test_many_islands_that_each_take_a_few_factors_are_one_call():
    rng = np.random.default_rng(0)
    turned = [np.linalg.qr(g)[0] for g in rng.normal(size=(70, 150, 150))]
    parts = [(q * np.logspace(0.0, -6.0, 150)) @ q.T for q in turned]
    whole = block_diag(list(map(coo_array, parts)), format="csr")
    problem = lv.Problem.contact(whole, rng.normal(size=whole.shape[0]), np.full(whole.shape[0] // 3, 0.5))
    solution = lv.solve(problem)
    assert solution.message.startswith("anderson on 70 islands") and solution.work["factorisations"] > 140


def test_ctrl_c_in_the_one_call_of_islands_is_a_result():
    """Somebody looks for it between two of them."""
    rng = np.random.default_rng(0)
    parts = [g @ g.T + 1e-3 * np.eye(90) for g in rng.normal(size=(100, 90, 40))]
    problem = lv.Problem.contact(
        block_diag(list(map(coo_array, parts)), format="csr"), rng.normal(size=9000), np.full(3000, 0.5)
    )
    assert lv.explain(problem).small == describe_small_call(problem) != ""
    main = threading.get_ident()

    def interrupt():
        while sys._current_frames()[main].f_code is not SmallCall.solve_and_judge.__code__:
            pass
        _thread.interrupt_main()

    thread = threading.Thread(target=interrupt)
    thread.start()
    while (found := lv.solve(problem)).status is lv.Status.CONVERGED:
        pass  # until the other thread had its turn in a call
    thread.join()
    assert found.status is lv.Status.INTERRUPTED
    np.testing.assert_array_equal(found.impulse, problem.start())


def test_one_call_has_steps_for_every_island_of_velocities():
    """A hundred arms that touch nothing of each other: steps are told of all of them together."""
    part = random_generalized_problem(3, "cone", n=6, compliance=False, contacts=2)
    many = 100
    whole = lv.Generalized(
        *(block_diag(many * [x], format="csr") for x in (part.generalized.jac, part.generalized.mass)),
        np.tile(part.generalized.v_free, many),
    )
    cones = part.cones
    for _ in range(many - 1):
        cones = cones + part.cones
    problem = lv.Problem(
        np.tile(part.b, many),
        cones,
        generalized=whole,
        compliance=np.tile(part.compliance, many),
        friction=part.friction,
    )
    found = solve_new_generalized_problem(problem.metric, None, 1e-6, AUTO.limits)
    assert found and found[1][0] > many


ATTEMPTED = {
    "few rows": lambda: draw("matrix coulomb", 3),
    "few rows that the call does not solve": lambda: lv.Problem.lcp([[0.0, 1.0], [-1.0, 0.0]], [1.0, 1.0]),
    "J and M, more rows": lambda: random_generalized_problem(1, "cone", n=40, compliance=True, contacts=40),
    "J and M, rigid": lambda: random_generalized_problem(1, "coulomb", n=60, compliance=False, contacts=50),
    "islands": lambda: forms(stacks(40, 2, 0.4, False, 1))["bodies"],
    "islands that the call does not solve": lambda: side_by_side(
        [
            forms(stacks(40, 2, 0.4, False, corners=1))["matrix"].relaxed("cone"),
            lv.Problem(np.array([1.0, -1.0]), lv.Cones.free(2), np.ones((2, 2)), friction="cone"),
        ]
    ),
    "a matrix": lambda: random_lcp(0, m=80),
}


@pytest.mark.parametrize("limit", [None, 60.0])
@pytest.mark.parametrize("call", ["solve", "prepared", "many", "max_iter"])
@pytest.mark.parametrize("name", ATTEMPTED)
def test_the_compiled_call_is_attempted_exactly_once(name, call, limit, monkeypatch):
    problem, attempts = ATTEMPTED[name](), []
    attempt = SmallCall.solve_and_judge

    def count(self, *of):
        attempts.append(self.name)
        return attempt(self, *of)

    monkeypatch.setattr(SmallCall, "solve_and_judge", count)
    if call == "solve":
        lv.solve(problem, time_limit=limit)
    elif call == "prepared":
        lv.prepare(problem).solve(time_limit=limit)
    elif call == "many":
        lv.solve_many([problem], time_limit=limit)
        assert len(attempts) <= 1  # the loop over the worlds makes the same call by itself
        return
    else:
        lv.solve(problem, time_limit=limit, max_iter=10**6)
    bounded_matrix = problem.generalized is None and problem.law in ("lcp", "linear") and problem.m > 64
    assert len(attempts) == (0 if bounded_matrix and limit else 1)


@pytest.mark.parametrize("name", ATTEMPTED)
def test_a_limit_that_does_not_bind_changes_no_bit(name):
    problem = ATTEMPTED[name]()
    without, within = lv.solve(fresh(problem)), lv.solve(fresh(problem), time_limit=60.0)
    assert without.impulse.tobytes() == within.impulse.tobytes() and without.work == within.work
