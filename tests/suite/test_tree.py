"""The tree of `auto`: each line is reached and named, counts are what Newton does, the best of all goes back."""

import json
from functools import partial
from itertools import islice

import numpy as np
import pytest
import scipy.sparse as sp
from calls import over_velocities
from random_families import drawn, wild
from random_problems import as_matrix, general, random_generalized_problem, random_lcp

import lavender as lv
from lavender import registry, suite
from lavender.base.deadline import Deadline
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.solvers import costs
from lavender.solvers.auto import DecisionTree, has_time_to_factorise_after, solve
from lavender.solvers.certify import certify_infeasibility
from lavender.solvers.solve_log import SolveLog
from lavender.solvers.steps import METHODS, Newton, Step, Sweeps


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
RELAXED = ["anderson", "anderson", "newton on the relaxation", "anderson", "newton"]
RELAXED_OVER_A = [*SWEPT, "admm from zero", *RELAXED[2:]]
# The first stages of `auto` for a problem of each kind.
FIRST = {
    "linear, a matrix": (lambda: as_matrix(suite.hang(n=24).problem), ["direct"]),
    "linear, bodies": (lambda: suite.hang(n=24).problem, ["direct", "newton"]),
    "linear, J and M": (lambda: over_velocities(30, 60, cones=lv.Cones.free(30), compliance=0.1), ["newton"]),
    "J and M": (lambda: over_velocities(120, 60, compliance=0.1), [*SWEPT, "newton over rows"]),
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
    "a loose pile, a matrix": (lambda: as_matrix(suite.case("granularF(n=6, seed=2)").problem), RELAXED_OVER_A),
    "a loose pile, J and M": (lambda: general(suite.case("granularF(n=6, seed=2)").problem), RELAXED),
    "a pile that rolls": (lambda: drawn(seed=98103, part="rolling").problem, RELAXED),
    "a pile that rolls, a matrix": (lambda: as_matrix(drawn(seed=98103, part="rolling").problem), RELAXED),
    "a tight pile": (lambda: suite.pyramid(k=6, friction="coulomb").problem, [*SWEPT, "newton"]),
}  # fmt: skip


@pytest.mark.parametrize("name", FIRST)
def test_each_line_is_reached_and_named(name):
    make, expected = FIRST[name]
    problem = make()
    stages = lv.explain(problem).stages
    assert [stage.solver for stage in stages[: len(expected)]] == expected
    assert all(stage.why and stage.iterations > 0.0 and stage.cost > 0.0 for stage in stages)
    methods = {METHODS[stage.solver][0] for stage in stages if stage.solver != "certificate"}
    assert [name for name in methods if registry.get(name).refuses(problem)] == []
    found = lv.prepare(make(), "auto").solve(tol=1e-6)
    assert found.success
    compiled = {"lemke", "direct", "anderson", "newton"} if problem.m <= registry.SMALL_ROWS else set()
    searched = (
        {"least"}
        if set(expected) & {"newton", "newton over rows"} and problem.generalized is not None
        else set()
    )  # least violation
    assert {stage.solver.partition(" ")[0] for stage in found.stages} <= {
        name.partition(" ")[0] for name in (*expected, *compiled, *searched)
    }


@pytest.mark.parametrize("name", FIRST)
def test_the_tail_doubles(name):
    tree = DecisionTree(FIRST[name][0]())
    get_zero_impulse_reference(tree.problem)
    stages = list(tree)
    first = next(i for i, stage in enumerate(stages) if stage.why.startswith("in turn"))
    in_turn = stages[first:]
    last = {}
    for stage in in_turn[:-1]:  # the last has what is left
        if stage.solver in last:
            assert stage.iterations == pytest.approx(2.0 * last[stage.solver])
        last[stage.solver] = stage.iterations
    # Over J and M, `admm` runs in the first round that pays for a factor of A.
    expected = {"anderson", "newton", "nncg"} | ({"admm"} if tree.problem.generalized is None else set())
    assert expected <= set(last)
    plan = lv.explain(FIRST[name][0]())
    assert expected <= set(plan.in_turn) and "nncg" in str(plan).splitlines()[-1]


def test_sweeps_use_up_a_limit_where_who_factors_had_no_time_and_not_where_they_ended():
    problem = suite.pyramid(k=4, friction="coulomb").problem
    get_zero_impulse_reference(problem)
    tree = DecisionTree(problem, Deadline(60.0))
    steps = {name: Newton(name, SolveLog(problem, 1e-6, 10)) for name in tree.states}
    assert steps and has_time_to_factorise_after(tree, steps, 1.0)
    for step in steps.values():
        step.over = True
    assert has_time_to_factorise_after(tree, steps, 1.0)
    for step in steps.values():
        step.late = True
    assert not has_time_to_factorise_after(tree, steps, 1.0)


def test_turns_end_where_nobody_gains():
    problem = suite.granular(n=4, friction="coulomb").problem
    get_zero_impulse_reference(problem)
    tree = DecisionTree(problem)
    tree.best = 0.5
    turns = [stage.solver for stage in tree if stage.why.startswith("in turn")]
    assert turns == ["newton", "admm", "nncg", "anderson", "newton", "admm", "nncg"], "twice, sweeps once"


def test_explain_counts_nothing_anew_and_refuses_what_is_none():
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
def test_a_small_problem_is_told_by_who_solves_it(make, names):
    problem = make()
    told = lv.explain(problem).small
    assert told and all(name in told for name in names), told
    solution = lv.solve(problem)
    assert solution.success and all(stage.solver.partition(" ")[0] in names for stage in solution.stages)


class Made(Step):
    """A step that is told what to find."""

    def advance(self, n):
        self.impulse = self.log.problem.start() + self.found.pop(0)
        self.asked.append(n)
        self.store_iterate_in_log()
        return lv.Claim(lv.Status.MAX_ITERATIONS, n)


def test_every_step_goes_on_and_the_best_of_all_is_returned(monkeypatch):
    problem = suite.stack(n=200).problem
    solved = lv.solve(problem, tol=1e-9).impulse
    found = [0.5, 0.99, 0.9, 0.7, 0.999, 1.0 - 1e-9]
    get_zero_impulse_reference(problem)
    log = SolveLog(problem, 1e-7, 10**6)
    log.judge_and_store_best(problem.start())
    made, tree = {}, DecisionTree(problem)
    Made.found, Made.asked = [share * solved for share in found], []
    monkeypatch.setattr(
        "lavender.solvers.auto.create_solver_step",
        lambda name, log, tree: made.setdefault(name, Made(name, log)),
    )
    solve(log, tree)
    assert not Made.found and set(made) <= {"anderson", "direct", "newton", "admm", "nncg"}, (
        "one of each, asked again and again"
    )
    np.testing.assert_array_equal(log.impulse, found[-1] * solved + problem.start())
    after = [stage.after for stage in log.stages]
    assert (np.diff(after) <= 0.0).all() and len(after) == len(found)


def test_newton_under_friction_starts_from_the_sweeps_and_then_from_zero(monkeypatch):
    problem = suite.pyramid(k=4, friction="coulomb").problem
    get_zero_impulse_reference(problem)
    log = SolveLog(problem, 1e-13, 10**6)
    log.judge_and_store_best(lv.solve(problem, "anderson", max_iter=20, tol=1e-13).impulse)
    step = Newton("newton", log)
    step.state = DecisionTree(problem).states["newton"]
    starts, advance = [], type(step.solver).advance

    def stall(solver, state, impulse, *of):
        starts.append(impulse.copy())
        return lv.Claim(lv.Status.STALLED, 1)

    monkeypatch.setattr(type(step.solver), "advance", stall)
    step.run(4)
    np.testing.assert_array_equal(starts, [log.impulse, problem.start()])
    assert advance is not stall


def test_sweeps_that_promise_little_give_way():
    problem = suite.case("pyramidF(k=8, mass_ratio=1e6)").problem
    get_zero_impulse_reference(problem)
    log = SolveLog(problem, 1e-12, 10**6)
    log.judge_and_store_best(problem.start())
    sweeps = Sweeps("anderson", log)
    sweeps.least = 10.0
    sweeps.run(1e5)
    assert not sweeps.over and log.iterations < 1000


@pytest.mark.parametrize(
    "make",
    [*(partial(wild, seed) for seed in (12, 24, 3)), partial(suite.granular, n=9, friction="coulomb")],
    ids=lambda make: f"{make.func.__name__}{make.args}",
)
def test_what_would_not_end_in_time_is_neither_counted_nor_begun(make):
    """With the least of time sweeps have all of it."""
    problem = make().problem
    get_zero_impulse_reference(problem)
    tree = DecisionTree(problem, Deadline(1e-4))
    assert tree.is_late and not tree.states
    log = SolveLog(problem, 1e-12, 10**6, tree.deadline)
    log.judge_and_store_best(problem.start())
    solve(log, tree)
    assert log.iterations > 0
    assert {stage.solver for stage in log.stages} <= {"anderson", "anderson on the relaxation"}


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
def test_what_only_late_turns_solve_is_solved(make):
    solution = lv.solve(make().problem, tol=1e-6)
    assert solution.success, solution.stages


def test_rows_of_a_follow_where_newton_over_velocities_ends_in_vain():
    rng = np.random.default_rng(8)
    half, jac, moved = (
        rng.standard_normal((150, 150)),
        rng.standard_normal((400, 150)),
        rng.standard_normal(150),
    )
    target = jac @ moved - rng.exponential(0.5, 400) * (rng.random(400) < 0.7)
    cones = lv.Cones.bounded(np.zeros(400), np.full(400, np.inf))
    problem = lv.Problem.from_jacobian(jac, half @ half.T, np.zeros(150), target=target, cones=cones)
    solution = lv.solve(problem, tol=1e-6)
    assert solution.success and solution.stages[-1].solver == "newton over rows", solution.stages


@pytest.mark.parametrize("friction", ["cone", "coulomb"])
@pytest.mark.parametrize("contacts", [10, 40])
def test_sweeps_alone_solve_contacts_whose_rows_have_unlike_units(contacts, friction):
    """Each block is solved exactly: one step along its rows would be as short as the largest unit asks for."""
    rng = np.random.default_rng(contacts)
    m, unit = 3 * contacts, 10.0 ** rng.uniform(-2.0, 2.0, 3 * contacts)
    half, b = rng.standard_normal((m, 2 * m)), rng.standard_normal(m)
    matrix, cones = (
        unit[:, None] * (half @ half.T) * unit / m,
        lv.Cones.contacts(rng.uniform(0.2, 1.0, contacts)),
    )
    solution = lv.solve(lv.Problem(unit * b, cones, matrix, friction=friction))
    assert solution.success and set(solution.work) <= {"sweeps", "restarts"}, solution.message


def test_a_certificate_that_costs_more_than_ten_times_newton_comes_after_these():
    """Of a transport plan between k places: 2 k rows of sums, and k^2 bounds of as many velocities."""
    k, rng = 30, np.random.default_rng(3)
    sums = sp.vstack([sp.kron(sp.eye(k), np.ones((1, k))), sp.kron(np.ones((1, k)), sp.eye(k))])
    load = np.concatenate([rng.dirichlet(np.ones(k)) for _ in range(2)])
    program = {"A": sums.tocsc(), "b": load, "lb": np.zeros(k * k)}
    problem = lv.Problem.from_qp(1e-2 * sp.eye(k * k).tocsc(), rng.random(k * k), **program)
    plan = lv.explain(problem)
    at = [stage.solver for stage in plan.stages].index("certificate")
    certificate, before = plan.stages[at], plan.stages[at - 1]
    assert before.solver == "newton over rows"  # A is sparse where N over velocities is full
    assert certificate.cost > before.cost >= 4.0 * plan.newton


def test_what_a_turn_of_many_rows_on_few_velocities_cannot_pay_is_left_out_or_comes_last():
    """A factor of A for `admm` would cost all stages; newton over rows of A runs after the cheaper solvers."""
    rng, n, each = np.random.default_rng(0), 100, 30
    row = np.arange((n - 1) * each)
    column = np.stack([row // each, row // each + 1], axis=1)
    jac = sp.csr_array(
        (rng.normal(size=column.size), (np.repeat(row, 2), column.ravel())), shape=(len(row), n)
    )
    cones = lv.Cones.bounded(np.zeros(len(row)), np.full(len(row), np.inf))
    tree = DecisionTree(
        lv.Problem.from_jacobian(jac, sp.eye_array(n).tocsr(), rng.normal(size=n), cones=cones)
    )
    ran = []
    for stage in tree:
        tree.best = 1.0  # nobody gains
        ran.append(stage.solver)
    assert "admm" not in ran
    assert ran[:4] == ["newton", "certificate", "newton", "direct"] and ran[4:].count("newton over rows") > 1


def test_squeezed_bodies_are_proved_to_have_no_solution_before_all_go_in_turn():
    """Floor and ceiling close in on each body, under Coulomb's law, where no method of ours proves it."""
    down = np.vstack([np.eye(3), np.diag([-1.0, 1.0, 1.0])])  # each contact: normal and two tangents
    a = np.kron(np.eye(20), down @ down.T)
    problem = lv.Problem(np.tile([1.0, 0.1, 0.0], 40), lv.Cones.contacts(np.full(40, 0.5)), a)
    found = lv.solve(problem)
    assert found.status is lv.Status.INFEASIBLE and found.claim_check == "confirmed"
    assert [stage.solver for stage in found.stages][-2:] == ["newton", "linear program"]


@pytest.mark.parametrize("n", [3, 5, 8])
def test_lines_are_those_of_the_data_whatever_is_known_of_it(n, monkeypatch):
    """A of J and M is formed by who needs it first: solved again, the problem has the same lines, and bits."""
    monkeypatch.setattr(costs, "RATES", costs.RATES | {"start": 0.0, "row": 0.0})  # less than A takes
    rng = np.random.default_rng(n)
    cones = lv.Cones.contacts([0.5, 0.5], tangents=3)
    problem = lv.Problem.from_jacobian(
        rng.standard_normal((8, n)), np.eye(n), rng.standard_normal(n), cones=cones, friction="cone"
    )
    lines = [(stage.solver, stage.iterations) for stage in islice(DecisionTree(problem), 30)]
    assert problem.csr.shape == (8, 8)  # which is kept
    assert [(stage.solver, stage.iterations) for stage in islice(DecisionTree(problem), 30)] == lines


@pytest.mark.parametrize("unit", [1.0, 1e47])
def test_a_velocity_that_rows_move_by_dust_alone_is_in_no_ones_way(unit):
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
    found = lv.solve(
        lv.Problem.from_jacobian(unit * jac, mass, np.zeros(7), target=unit * target, cones=cones)
    )
    assert not found.success and found.claim_check == "confirmed"
    assert found.status is lv.Status.INFEASIBLE or unit > 1.0


def test_no_certificate_is_begun_that_would_end_late(monkeypatch):
    problem = suite.case("infeasible").problem
    log = SolveLog(problem, 1e-6, 10**6, deadline=Deadline(1e-3))
    log.judge_and_store_best(problem.start())
    monkeypatch.setattr("lavender.solvers.certify.find_certificate_by_linear_program", lambda *asked: 1 / 0)
    certify_infeasibility(log)
    assert not log.stages


def test_cones_that_sweeps_do_not_take_have_steps_that_do():
    general = random_generalized_problem(0, "cone", n=8, compliance=False, contacts=4, tangents=5)
    assert {stage.solver for stage in lv.explain(general).stages} <= {"newton", "admm", "nncg", "certificate"}
    matrix = lv.Problem(general.b, general.cones, general.csr, friction="cone")
    assert {stage.solver for stage in lv.explain(matrix).stages} == {"admm", "nncg"}
    assert lv.solve(matrix, tol=1e-4).solver.name == "auto"


def test_auto_sweeps_start_worse_than_zero_impulses_begin_at_zero_impulses():
    """From a better start they go on from it."""
    problem = suite.granular(n=5, friction="coulomb").problem
    solved = lv.solve(problem, tol=1e-9).impulse
    rng = np.random.default_rng(1)
    direction = rng.standard_normal(problem.m) * np.abs(solved).mean()
    sizes = [
        s for s in 10.0 ** np.arange(0.0, 9.0) if lv.residual(problem, solved + s * direction).relative > 1
    ]
    near, far = solved + sizes[0] * direction, solved + 1e9 * sizes[0] * direction
    begun = []
    original = Sweeps.prepare_and_set_start

    def prepare_and_set_start(self):
        original(self)
        begun.append(self.impulse.copy())

    better = solved + 0.01 * direction
    assert lv.residual(problem, better).relative < 1.0
    for guess, start in ((better, better), (near, problem.start()), (far, problem.start())):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Sweeps, "prepare_and_set_start", prepare_and_set_start)
            found = lv.solve(problem, impulse=guess, tol=1e-6, max_iter=20)
        assert np.array_equal(begun[-1], start)
        assert found.residual.relative <= 1.0


def test_direct_gets_its_budget_on_a_narrow_band_once():
    stages = [stage for stage in lv.explain(suite.stack(n=200).problem).stages if "in turn" not in stage.why]
    assert [stage.solver for stage in stages] == ["direct", "newton"]


@pytest.mark.parametrize(
    "make", [lambda: suite.stack(n=200).problem, lambda: as_matrix(suite.stack(n=200).problem)]
)
def test_a_limit_that_does_not_bind_adds_no_analysis(make, monkeypatch):
    """Newton's method was analysed before `direct` ran, to look up the cost of `direct`."""
    newton, prepared = registry.get("newton").load(), []
    prepare = newton.prepare
    monkeypatch.setattr(newton, "prepare", lambda self, problem: prepared.append(1) or prepare(self, problem))
    solution = lv.solve(make(), time_limit=10.0)
    assert solution.success and [stage.solver for stage in solution.stages] == ["direct"]
    assert not prepared
    assert solution.impulse.tobytes() == lv.solve(make()).impulse.tobytes()
