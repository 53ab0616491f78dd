"""The tree of `auto`: what its stages must hold, and the problems that it must solve or prove."""

import json
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sp
from calls import over_velocities
from random_problems import as_matrix, general, random_generalized_problem, random_lcp

import lavender as lv
from benchmarks.random_families import drawn, wild
from lavender import registry, suite
from lavender.solvers import costs
from lavender.solving.stages import DecisionTree, Stage


@pytest.fixture(autouse=True)
def rates(monkeypatch):
    """Fix the rates: which stage comes first depends on them."""
    work = {"bodies": 0.2, "dense": 0.04, "panels": 0.4, "velocities": 0.1}
    fixed = {
        "start": 1e5,
        "row": 300.0,
        "entry": 0.25,
        "work": work,
        "sweep row": 12.0,
        "sweep cone": 2.0,
    }
    for name, rate in (fixed | {"pivot row": 100.0, "pivot work": 0.2}).items():
        monkeypatch.setitem(costs.RATES, name, rate)


def asymmetric():
    """The law of a matrix with a positive definite half, and a large other one."""
    half, other = np.random.default_rng(0).standard_normal((2, 80, 80))
    return lv.Problem.lcp(
        half @ half.T / 80.0 + 0.1 * np.eye(80) + 0.2 * (other - other.T), other[0]
    )


def transport_plan():
    """k^2 velocities couple by 2 k sums: N over velocities is full, and A has a few entries in each row."""
    k = 30
    rng = np.random.default_rng(3)
    sums = sp.vstack([sp.kron(sp.eye(k), np.ones((1, k))), sp.kron(np.ones((1, k)), sp.eye(k))])
    load = np.concatenate([rng.dirichlet(np.ones(k)) for _ in range(2)])
    program = {"A": sums.tocsc(), "b": load, "lb": np.zeros(k * k)}
    return lv.Problem.from_qp(1e-2 * sp.eye(k * k).tocsc(), rng.random(k * k), **program)


def round_cones():
    """Contacts with five components of friction."""
    return random_generalized_problem(0, "cone", n=8, compliance=False, contacts=4, tangents=5)


PROBLEMS = {
    "linear, a matrix": lambda: as_matrix(suite.hang(n=24).problem),
    "linear, bodies": lambda: suite.hang(n=24).problem,
    "linear, J and M": lambda: over_velocities(30, 60, cones=lv.Cones.free(30), compliance=0.1),
    "J and M": lambda: over_velocities(120, 60, compliance=0.1),
    "bounded rows of a narrow band": lambda: as_matrix(suite.stack(n=200).problem),
    "bounded rows of bodies": lambda: suite.stack(n=200).problem,
    "bounded rows of a dense matrix": lambda: random_lcp(0, m=80),
    "bounded rows, not symmetric": asymmetric,
    "bounded rows, few": lambda: random_lcp(1, m=12),
    "the cone law": lambda: suite.granular(n=6, friction="coulomb").problem.relaxed("cone"),
    "the cone law, a matrix": lambda: as_matrix(
        suite.pyramid(k=6, friction="coulomb").problem.relaxed("cone")
    ),
    "the cone law, few rows of J and M": lambda: random_generalized_problem(
        1, "cone", 6, True, contacts=3
    ),
    "a loose pile": lambda: suite.granular(n=4, friction="coulomb").problem,
    "a loose pile, a matrix": lambda: as_matrix(suite.case("granularF(n=6, seed=2)").problem),
    "a loose pile, J and M": lambda: general(suite.case("granularF(n=6, seed=2)").problem),
    "a pile that rolls": lambda: drawn(seed=98103, part="rolling").problem,
    "a pile that rolls, a matrix": lambda: as_matrix(drawn(seed=98103, part="rolling").problem),
    "a wall of bricks": lambda: suite.case("wall(n=6)").problem,
    "a tight pile": lambda: suite.pyramid(k=6, friction="coulomb").problem,
    "a few boxes, a matrix": lambda: as_matrix(suite.pyramid(k=2, friction="coulomb").problem),
}
PLANS = {  # solved elsewhere, or too large
    "round cones, J and M": round_cones,
    "round cones, a matrix": lambda: lv.Problem(
        round_cones().b, round_cones().cones, round_cones().csr, friction="cone"
    ),
    "a transport plan": transport_plan,
    "a large pyramid that slides": lambda: (
        suite.case("pyramidF(k=12, sliding=0.5, mass_ratio=3)").problem
    ),
    "a pyramid that slides": lambda: suite.case("pyramidF(k=6, sliding=0.5)").problem,
}


def list_turns(residuals):
    """Return the number of turns of admm whose residuals after each turn are these."""
    log = SimpleNamespace(best=residuals[0], tol=1e-6)
    tree = DecisionTree(suite.case("pyramidF(k=12, sliding=0.5)").problem, log=log)
    for turn, _ in enumerate(tree.repeat_while_converging(Stage("admm", 1.0, 1.0, ""))):
        log.best = residuals[turn + 1]
    return turn + 1


@pytest.mark.parametrize("name", PROBLEMS | PLANS)
def test_stages_that_auto_plans_accept_the_problem_and_are_several_methods(name):
    """No problem depends on one method, unless one alone accepts it, and a round runs no method twice."""
    problem = (PROBLEMS | PLANS)[name]()
    plan = lv.explain(problem)
    assert all(stage.why and stage.iterations > 0.0 and stage.cost > 0.0 for stage in plan.stages)
    planned = {stage.solver.split()[0] for stage in plan.stages if stage.solver != "certificate"}
    tree = DecisionTree(problem)
    turns = [stage.solver for stage in tree.iterate_one_round(1.0)]
    methods = {turn.split()[0] for turn in turns}
    assert [m for m in planned | methods if registry.get(m).refuses(problem)] == []
    assert len(turns) == len(set(turns))
    general = {"newton", "admm", "anderson"} - methods
    assert len(methods) > 1 or all(registry.get(m).refuses(problem) for m in general)


def test_turns_of_admm_go_on_exactly_while_they_gain():
    assert list_turns([1e-2, 1e-2]) == 1
    for gain in (1.0, 1.1, 1.5):  # The first turn gains, the second does not.
        assert list_turns([1e-2, 9e-5, 9e-5 / gain, 9e-5 / gain]) == 2
    assert list_turns([1e-2, 9e-5, 2e-6, 2e-6]) == 3


@pytest.mark.parametrize("name", PROBLEMS)
def test_auto_solves_a_problem_of_each_kind_also_without_a_small_call(name):
    assert lv.solve(PROBLEMS[name](), tol=1e-6).success
    assert lv.prepare(PROBLEMS[name](), "auto").solve(tol=1e-6).success


def test_explain_is_reproducible_and_rejects_wrong_input():
    problem = suite.granular(n=3, friction="coulomb").problem
    first = lv.explain(problem)
    second = lv.explain(suite.granular(n=3, friction="coulomb").problem)
    assert first == second and json.loads(json.dumps(first.data()))["rows"] == problem.m
    for tol in (0.0, -1.0, np.inf):
        with pytest.raises(lv.InputError, match="tol is"):
            lv.explain(problem, tol=tol)
    with pytest.raises(lv.LavenderError, match="plan"):
        lv.solve(problem, plan=first)


@pytest.mark.parametrize(
    "make",
    [
        partial(wild, 99750),  # newton stalls from what sweeps leave, and not from nothing
        partial(drawn, 99529, part="judged"),  # the second turn brings admm on the way
        partial(drawn, 99860, part="judged"),  # newton gains nothing in hundreds of factorisations
        partial(
            drawn, 102121, part="judged"
        ),  # rows of A after velocities stall, for more than is left as counted
    ],
    ids=lambda make: f"{make.func.__name__}{make.args}",
)
def test_auto_solves_problems_that_only_late_stages_solve(make):
    solution = lv.solve(make().problem, tol=1e-6)
    assert solution.success, solution.stages


def test_auto_continues_over_rows_of_a_if_newton_over_velocities_fails():
    rng = np.random.default_rng(8)
    half = rng.standard_normal((150, 150))
    jac = rng.standard_normal((400, 150))
    moved = rng.standard_normal(150)
    target = jac @ moved - rng.exponential(0.5, 400) * (rng.random(400) < 0.7)
    cones = lv.Cones.bounded(np.zeros(400), np.full(400, np.inf))
    problem = lv.Problem.from_jacobian(
        jac, half @ half.T, np.zeros(150), target=target, cones=cones
    )
    solution = lv.solve(problem, tol=1e-6)
    assert solution.success, solution.stages


@pytest.mark.parametrize("friction", ["cone", "coulomb"])
@pytest.mark.parametrize("contacts", [10, 40])
def test_auto_solves_contacts_whose_rows_have_unlike_units(contacts, friction):
    rng = np.random.default_rng(contacts)
    m = 3 * contacts
    unit = 10.0 ** rng.uniform(-2.0, 2.0, 3 * contacts)
    half = rng.standard_normal((m, 2 * m))
    b = rng.standard_normal(m)
    matrix = unit[:, None] * (half @ half.T) * unit / m
    cones = lv.Cones.contacts(rng.uniform(0.2, 1.0, contacts))
    solution = lv.solve(lv.Problem(unit * b, cones, matrix, friction=friction))
    assert solution.success, solution.message


def test_newton_of_transport_plan_factors_sparse_rows_of_a():
    solution = lv.solve(transport_plan(), "newton", tol=1e-6)
    assert solution.success and solution.solver.form == "impulse", solution


def test_auto_proves_that_squeezed_bodies_have_no_solution_before_it_alternates():
    """Floor and ceiling close in on each body, under Coulomb's law, where no method of ours proves it."""
    down = np.vstack(
        [np.eye(3), np.diag([-1.0, 1.0, 1.0])]
    )  # each contact: normal and two tangents
    a = np.kron(np.eye(20), down @ down.T)
    problem = lv.Problem(np.tile([1.0, 0.1, 0.0], 40), lv.Cones.contacts(np.full(40, 0.5)), a)
    found = lv.solve(problem)
    assert found.status is lv.Status.INFEASIBLE and found.claim_check == "confirmed"


@pytest.mark.parametrize("unit", [1.0, 1e47])
def test_auto_with_a_velocity_moved_by_1e_47_only_proves_the_conflict(unit):
    """Two contacts push apart what cannot part; a third has a tangent of one velocity, and of another by 1e-47.

    With J of 1e47 the problem is stated, as M is as large, and no mass of 1 can stand for that M.
    """
    rng = np.random.default_rng(0)
    jac = np.hstack([rng.standard_normal((9, 6)), np.zeros((9, 1))])
    jac[3] = -jac[0]
    jac[8] = [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1e-47]
    target = rng.standard_normal(9)
    target[::3] = 3.0 * np.abs(target[::3])
    cones = lv.Cones.contacts(0.3, count=3)
    mass = min(unit, 1e40) * np.eye(7)
    found = lv.solve(
        lv.Problem.from_jacobian(unit * jac, mass, np.zeros(7), target=unit * target, cones=cones)
    )
    assert not found.success and found.claim_check == "confirmed"
    assert found.status is lv.Status.INFEASIBLE or unit > 1.0


def test_auto_solves_round_cones_of_a_matrix():
    assert lv.solve(PLANS["round cones, a matrix"](), tol=1e-4).success
