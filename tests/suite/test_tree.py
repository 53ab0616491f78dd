"""The tree of `auto`: each line is reached and named, counts are what Newton does, the best of all goes back."""

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
from lavender.solvers import costs, decisions
from lavender.solving.stages import DecisionTree, Stage
from lavender.solving.steps import METHODS, starts_relaxed


@pytest.fixture(autouse=True)
def rates(monkeypatch):
    """Fix the rates: which stage comes first depends on them, how stages follow each other does not."""
    work = {"bodies": 0.2, "dense": 0.04, "panels": 0.4, "velocities": 0.1}
    fixed = {"start": 1e5, "row": 300.0, "entry": 0.25, "work": work, "sweep row": 12.0, "sweep cone": 2.0}
    monkeypatch.setattr(costs, "RATES", costs.RATES | fixed | {"pivot row": 100.0, "pivot work": 0.2})


def asymmetric():
    """The law of a matrix with a positive definite half, and a large other one."""
    half, other = np.random.default_rng(0).standard_normal((2, 80, 80))
    return lv.Problem.lcp(half @ half.T / 80.0 + 0.1 * np.eye(80) + 0.2 * (other - other.T), other[0])


SWEPT = ["anderson", "anderson"]
RELAXED = ["anderson", "anderson", "newton on the relaxation", "admm", "newton"]
# The first stages of `auto` for a problem of each kind.
FIRST = {
    "linear, a matrix": (lambda: as_matrix(suite.hang(n=24).problem), ["direct"]),
    "linear, bodies": (lambda: suite.hang(n=24).problem, ["direct", "newton"]),
    "linear, J and M": (lambda: over_velocities(30, 60, cones=lv.Cones.free(30), compliance=0.1), ["newton"]),
    "J and M": (lambda: over_velocities(120, 60, compliance=0.1), ["anderson", "newton"]),
    "bounded rows of a narrow band": (lambda: as_matrix(suite.stack(n=200).problem), ["direct"]),
    "bounded rows of bodies": (lambda: suite.stack(n=200).problem, ["direct"]),
    "bounded rows of a dense matrix": (lambda: random_lcp(0, m=80), ["anderson", "newton", "direct"]),
    "bounded rows, not symmetric": (lambda: asymmetric(), ["anderson", "newton", "direct"]),
    "the cone law": (lambda: suite.granular(n=6, friction="coulomb").problem.relaxed("cone"), [*SWEPT, "newton"]),
    "the cone law, a matrix": (
        lambda: as_matrix(suite.pyramid(k=6, friction="coulomb").problem.relaxed("cone")),
        [*SWEPT, "newton"],
    ),
    "a loose pile": (lambda: suite.granular(n=4, friction="coulomb").problem, [*SWEPT, "newton"]),
    "a loose pile, a matrix": (lambda: as_matrix(suite.case("granularF(n=6, seed=2)").problem), RELAXED),
    "a loose pile, J and M": (lambda: general(suite.case("granularF(n=6, seed=2)").problem), RELAXED),
    "a pile that rolls": (lambda: drawn(seed=98103, part="rolling").problem, RELAXED),
    "a pile that rolls, a matrix": (lambda: as_matrix(drawn(seed=98103, part="rolling").problem), RELAXED),
    "a wall of bricks": (lambda: suite.case("wall(n=6)").problem, RELAXED[2:]),
    "a tight pile": (lambda: suite.pyramid(k=6, friction="coulomb").problem, [*SWEPT, "newton"]),
}  # fmt: skip


@pytest.mark.parametrize("name", FIRST)
def test_explain_reaches_each_branch_of_auto(name):
    make, expected = FIRST[name]
    problem = make()
    stages = lv.explain(problem).stages
    assert [stage.solver for stage in stages[: len(expected)]] == expected
    assert all(stage.why and stage.iterations > 0.0 and stage.cost > 0.0 for stage in stages)
    methods = {METHODS[stage.solver] for stage in stages if stage.solver != "certificate"}
    assert [name for name in methods if registry.get(name).refuses(problem)] == []
    found = lv.prepare(make(), "auto").solve(tol=1e-6)
    assert found.success
    compiled = {"lemke", "direct", "anderson", "newton"} if problem.m <= decisions.SMALL_ROWS else set()
    searched = {"least"} if "newton" in expected and problem.generalized is not None else set()  # least violation
    assert {stage.solver.partition(" ")[0] for stage in found.stages} <= {
        name.partition(" ")[0] for name in (*expected, *compiled, *searched)
    }


def test_explain_is_reproducible_and_rejects_wrong_input():
    problem = suite.granular(n=3, friction="coulomb").problem
    first, second = lv.explain(problem), lv.explain(suite.granular(n=3, friction="coulomb").problem)
    assert first == second and json.loads(json.dumps(first.data()))["rows"] == problem.m
    with pytest.raises(lv.InputError, match="no rows"):
        lv.explain(lv.Problem.lcp(np.zeros((0, 0)), np.zeros(0)))
    for tol in (0.0, -1.0, np.inf):
        with pytest.raises(lv.InputError, match="tol is"):
            lv.explain(problem, tol=tol)
    with pytest.raises(lv.LavenderError, match="plan"):
        lv.solve(problem, plan=first)


@pytest.mark.parametrize(
    ("make", "names"),
    [
        (lambda: random_lcp(1, m=12), ("direct", "lemke")),
        (lambda: as_matrix(suite.pyramid(k=2, friction="coulomb").problem), ("anderson", "newton")),
        (lambda: random_generalized_problem(1, "cone", n=6, compliance=True, contacts=3), ("newton",)),
    ],
)
def test_explain_of_a_small_problem_names_its_solver(make, names):
    problem = make()
    told = lv.explain(problem).small
    assert told and all(name in told for name in names), told
    solution = lv.solve(problem)
    assert solution.success and all(stage.solver.partition(" ")[0] in names for stage in solution.stages)


@pytest.mark.parametrize(
    "make",
    [
        partial(wild, 99750),  # newton stalls from what sweeps leave, and not from nothing
        partial(drawn, 99529, part="judged"),  # the second turn brings admm on the way
        partial(drawn, 99860, part="judged"),  # newton gains nothing in hundreds of factorisations
        partial(drawn, 102121, part="judged"),  # rows of A after velocities stall, for more than is left as counted
    ],
    ids=lambda make: f"{make.func.__name__}{make.args}",
)
def test_auto_solves_problems_that_only_late_stages_solve(make):
    solution = lv.solve(make().problem, tol=1e-6)
    assert solution.success, solution.stages


def test_auto_continues_over_rows_of_a_if_newton_over_velocities_fails():
    rng = np.random.default_rng(8)
    half, jac, moved = (rng.standard_normal((150, 150)), rng.standard_normal((400, 150)), rng.standard_normal(150))
    target = jac @ moved - rng.exponential(0.5, 400) * (rng.random(400) < 0.7)
    cones = lv.Cones.bounded(np.zeros(400), np.full(400, np.inf))
    problem = lv.Problem.from_jacobian(jac, half @ half.T, np.zeros(150), target=target, cones=cones)
    solution = lv.solve(problem, tol=1e-6)
    assert solution.success and solution.stages[-1].solver == "newton", solution.stages


@pytest.mark.parametrize("friction", ["cone", "coulomb"])
@pytest.mark.parametrize("contacts", [10, 40])
def test_sweeps_alone_solve_contacts_whose_rows_have_unlike_units(contacts, friction):
    """Each block is solved exactly: one step along its rows would be as short as the largest unit asks for."""
    rng = np.random.default_rng(contacts)
    m, unit = 3 * contacts, 10.0 ** rng.uniform(-2.0, 2.0, 3 * contacts)
    half, b = rng.standard_normal((m, 2 * m)), rng.standard_normal(m)
    matrix, cones = (unit[:, None] * (half @ half.T) * unit / m, lv.Cones.contacts(rng.uniform(0.2, 1.0, contacts)))
    solution = lv.solve(lv.Problem(unit * b, cones, matrix, friction=friction))
    assert solution.success and set(solution.work) <= {"sweeps", "restarts"}, solution.message


def test_newton_of_transport_plan_factors_sparse_rows_of_a():
    """k^2 velocities couple by 2 k sums: N over velocities is full, and A has a few entries in each row."""
    k, rng = 30, np.random.default_rng(3)
    sums = sp.vstack([sp.kron(sp.eye(k), np.ones((1, k))), sp.kron(np.ones((1, k)), sp.eye(k))])
    load = np.concatenate([rng.dirichlet(np.ones(k)) for _ in range(2)])
    program = {"A": sums.tocsc(), "b": load, "lb": np.zeros(k * k)}
    problem = lv.Problem.from_qp(1e-2 * sp.eye(k * k).tocsc(), rng.random(k * k), **program)
    plan, solution = lv.explain(problem), lv.solve(problem, "newton", tol=1e-6)
    assert solution.success and solution.solver.form == "impulse", solution
    names = [stage.solver for stage in plan.stages]
    assert names[names.index("certificate") - 1] == "newton"
    assert plan.newton < 2e7  # [ns] Over velocities it is estimated at 1.4 s.


def test_auto_proves_that_squeezed_bodies_have_no_solution_before_it_alternates():
    """Floor and ceiling close in on each body, under Coulomb's law, where no method of ours proves it."""
    down = np.vstack([np.eye(3), np.diag([-1.0, 1.0, 1.0])])  # each contact: normal and two tangents
    a = np.kron(np.eye(20), down @ down.T)
    problem = lv.Problem(np.tile([1.0, 0.1, 0.0], 40), lv.Cones.contacts(np.full(40, 0.5)), a)
    found = lv.solve(problem)
    assert found.status is lv.Status.INFEASIBLE and found.claim_check == "confirmed"
    assert [stage.solver for stage in found.stages][-2:] == ["newton", "linear program"]


@pytest.mark.parametrize("unit", [1.0, 1e47])
def test_auto_with_a_velocity_moved_by_1e_47_only_proves_the_conflict(unit):
    """Two contacts push apart what cannot part; a third has a tangent of one velocity, and of another by 1e-47.

    With J of 1e47 the problem is stated, as M is as large, and no mass of 1 can stand for that M.
    """
    rng = np.random.default_rng(0)
    jac = np.hstack([rng.standard_normal((9, 6)), np.zeros((9, 1))])
    jac[3], jac[8] = -jac[0], [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1e-47]
    target = rng.standard_normal(9)
    target[::3] = 3.0 * np.abs(target[::3])
    cones = lv.Cones.contacts(0.3, count=3)
    mass = min(unit, 1e40) * np.eye(7)
    found = lv.solve(lv.Problem.from_jacobian(unit * jac, mass, np.zeros(7), target=unit * target, cones=cones))
    assert not found.success and found.claim_check == "confirmed"
    assert found.status is lv.Status.INFEASIBLE or unit > 1.0


def test_auto_on_round_cones_runs_newton_or_admm():
    general = random_generalized_problem(0, "cone", n=8, compliance=False, contacts=4, tangents=5)
    assert {stage.solver for stage in lv.explain(general).stages} <= {"newton", "admm", "certificate"}
    matrix = lv.Problem(general.b, general.cones, general.csr, friction="cone")
    assert {stage.solver for stage in lv.explain(matrix).stages} == {"admm"}
    assert lv.solve(matrix, tol=1e-4).solver.name == "auto"


def test_direct_gets_its_budget_on_a_narrow_band_once():
    stages = [stage for stage in lv.explain(suite.stack(n=200).problem).stages if "in turn" not in stage.why]
    assert [stage.solver for stage in stages] == ["direct", "newton"]


def test_round_of_large_problem_with_friction_has_a_shorter_turn_of_admm_and_no_sweeps():
    problem = suite.case("pyramidF(k=12, sliding=0.5, mass_ratio=3)").problem
    assert starts_relaxed(problem)
    stages = list(DecisionTree(problem).iterate_one_round(1.0))
    assert [stage.solver for stage in stages] == ["newton", "admm"]
    assert 0.0 < stages[1].cost < 0.5 * stages[0].cost
    small = suite.case("pyramidF(k=6, sliding=0.5)").problem
    names = [stage.solver for stage in DecisionTree(small).iterate_one_round(1.0)]
    assert names[0] == "newton" and names[-1] == "anderson"


@pytest.mark.parametrize(
    ("residuals", "turns"),
    [
        ([1e-2, 1e-2], 1),  # no gain
        ([1e-2, 1e-3], 1),  # three more turns of the same gain
        ([1e-2, 0.9e-4, 3e-5], 2),  # one more turn, which gains too little
        ([1e-2, 0.9e-4, 2e-6, 2e-6], 3),
    ],
)
def test_admm_turn_repeats_while_one_more_is_predicted_to_solve(residuals, turns):
    log = SimpleNamespace(best=residuals[0], tol=1e-6)
    tree = DecisionTree(suite.case("pyramidF(k=12, sliding=0.5)").problem, log=log)
    stages = tree.repeat_while_converging(Stage("admm", 1.0, 1.0, ""))
    done = 0
    for _ in stages:
        done += 1
        log.best = residuals[done]
    assert done == turns
