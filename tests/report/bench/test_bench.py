"""Records: judged, timed apart, written when they are made, and never lost to a backend."""

import dataclasses
import io
import json
import math
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from random_problems import spd, touching
from rich.console import Console
from stacks import chain, moving_stack, stack
from worked import python

import lavender as lv
from lavender import bench
from lavender.report.bench import cases as bench_cases
from lavender.report.bench import machine, store
from lavender.report.bench.record import Record, from_json, to_json
from lavender.report.bench.running import timing
from lavender.report.bench.timed_call import format_call
from lavender.report.findings import Report
from lavender.report.terminal import print_report
from lavender.report.write import write

QUICK = bench.Plan(tolerances=(1e-3, 1e-8), budgets=(2, 5), repeats=2, time_limit=60.0, orders=("reverse",))


def broken(problem, impulse):
    raise RuntimeError("of the backend")


def interrupted(problem, impulse):
    raise KeyboardInterrupt


def lost(problem, impulse):
    impulse[:] = np.nan
    return lv.Claim(lv.Status.NUMERICAL_ERROR, 1)


def test_a_record_holds_what_the_judge_says_and_what_it_cost():
    p = stack(12)
    records = bench.run([p], ["pgs"], QUICK)
    assert [(r.mode, r.tol, r.max_iter, r.order) for r in records] == [
        ("tol", 1e-3, 10_000_000, "given"),
        ("tol", 1e-8, 10_000_000, "given"),
        ("budget", 0.0, 2, "given"),
        ("budget", 0.0, 5, "given"),
        ("budget", 0.0, 5, "reverse"),
    ]
    for r in records:
        again = lv.solve(p, "pgs", tol=r.tol, max_iter=r.max_iter, order=r.order)
        assert (r.relative, r.energy, r.velocity, r.roundoff_floor, r.worst_row) == (
            again.residual.relative,
            again.residual.energy,
            again.residual.velocity,
            again.residual.roundoff_floor,
            again.residual.worst_row,
        )
        assert r.status == again.status.name
        assert dict(r.work) == dict(again.work)
        assert r.success == (r.mode == "tol")
        assert 1 <= r.repeats <= 2
        assert 0.0 < r.setup_min <= r.setup_median
        assert 0.0 < r.solve_min <= r.solve_median
        # The smallest sum is at least the sum of the smallest.
        assert r.setup_min + r.solve_min <= r.time_min <= r.time_median
    assert records.cases["stack"].structure == ("stack",)


def test_one_case_and_one_solver_need_no_list():
    plan = bench.Plan(tolerances=(1e-3,), budgets=(), repeats=1, orders=())
    one = bench.run("stack(n=3)", "pgs", plan)
    assert {(r.case, r.solver) for r in one} == {("stack(n=3)", "pgs")}
    case = lv.suite.case("stack(n=3)")
    assert [item.name for item in bench.resolve_sources(case)] == ["stack(n=3)"]
    with pytest.raises(lv.InputError, match=r"give its \.problem"):
        lv.solve(case)
    with pytest.raises(lv.InputError, match="source is a list; Records"):
        lv.report.write(list(one), "nowhere")


def test_a_budget_is_exact_and_warm_starts_from_the_guess():
    p = stack(12)
    exact = lv.solve(p, "direct", tol=1e-12).impulse
    records = bench.run([dataclasses.replace(p, guess=0.99 * exact)], ["pgs"], QUICK)
    for r in records:
        if r.mode == "budget":
            assert r.iterations == r.work["sweeps"] == r.max_iter
    cold, warm = ([r for r in records if r.start == s and r.mode == "tol"][-1] for s in ("cold", "warm"))
    assert cold.iterations > 5
    assert 0 < warm.iterations < cold.iterations


@pytest.mark.parametrize("early", [False, True], ids=["solved", "stopped early"])
def test_an_answer_is_no_start(tmp_path, early):
    """Neither a guess at which a solve ends, nor an engine's own answer, however good."""
    p = stack(12)
    answer = (0.99 if early else 1.0) * lv.solve(p, "direct", tol=1e-12).impulse
    path = tmp_path / "step.npz"
    p.updated(guess=answer).save(path, impulse=answer if early else None)
    records = bench.run([path], ["pgs"], QUICK)
    assert {r.start for r in records} == {"cold"}
    assert records.cases["step"].guess == "answer"
    call_specs = [bench.CallSpec("pgs", "tol", 1e-6), bench.CallSpec("pgs", "tol", 1e-6, timing_mode="batch")]
    made = bench.time_alternately([path], call_specs, records, QUICK).records
    assert all(r.iterations > 5 for r in made if r.mode == "tol" and r.tol <= 1e-6)
    steps = bench.make_sequence([p.updated(guess=answer), p.updated(guess=answer)], "steps")
    records = bench.run(steps, ["pgs"], QUICK)
    made = bench.time_alternately(
        steps, [bench.CallSpec("pgs", "tol", 1e-6, timing_mode="steps")], records, QUICK
    ).records
    assert all(r.iterations > 5 for r in made if r.start == "cold" and r.mode == "tol" and r.tol <= 1e-6)
    assert all(r.iterations > 5 for r in made if r.start == "carried" and r.step == 0 and r.tol == 1e-8)
    assert lv.cross_check(lv.load(path), ["pgs"])["pgs"].solution.iterations > 5


def test_exact_solvers_run_once_and_hopeless_levels_are_left_out():
    records = bench.run([stack(8)], ["direct"], QUICK)
    assert [(r.tol, r.success) for r in records] == [(1e-8, True)]
    # A row that nothing can meet: projected Gauss-Seidel misses the loosest tolerance, so tighter ones are not tried.
    impossible = lv.Problem.lcp(np.array([[1.0, -1.0], [-1.0, 1.0]]), np.array([1.0, 1.0]), name="impossible")
    records = bench.run([impossible], ["pgs"], QUICK)
    assert [r.tol for r in records if r.mode == "tol"] == [1e-3]


def test_a_solver_that_raises_costs_its_own_record(plug_in):
    plug_in(broken, "fake_raise"), plug_in(lost, "fake_nan")
    plug_in(lambda problem, impulse: lv.Claim(lv.Status.CONVERGED, 1), "fake_lie")
    plug_in(lambda problem, impulse: sys.exit(3), "fake_exit")
    fakes = ["fake_raise", "fake_nan", "fake_lie", "fake_exit"]
    records = bench.run([stack(4, "one"), stack(5, "two")], [*fakes, "pgs"], QUICK)
    by = {(r.case, r.solver): r for r in records}
    for case in ("one", "two"):
        assert by[case, "fake_raise"].status == "ERROR"
        assert by[case, "fake_raise"].message == "RuntimeError: of the backend"
        assert by[case, "fake_nan"].status == "NUMERICAL_ERROR"
        assert by[case, "fake_nan"].relative == 1.0  # the start stands in for what is not finite
        assert by[case, "fake_lie"].claim_check == "contradicted"
        assert not by[case, "fake_exit"].success
        assert by[case, "pgs"].status == "MAX_ITERATIONS"  # the last: a budget
    assert (
        sum(r.solver == "fake_raise" for r in records) == 2
    )  # one each: no tolerance after it can be better


def test_a_solver_that_is_registered_here_alone_is_measured_here_whatever_it_requires(plug_in):
    name = plug_in(lambda problem, impulse: lv.Claim(lv.Status.CONVERGED, 1), requires=("numpy",))
    assert {r.status for r in bench.run([stack(4)], [name], QUICK)} == {"CONVERGED"}


def test_a_plug_in_that_tests_nothing_is_timed_with_its_own_budget(register):
    class Untested:
        def prepare(self, problem):
            return lv.prepare(problem, "pgs")

        def run(self, state, impulse, n, tol, time_limit=None):
            assert n < 1000, "it would never end"
            impulse[:] = state.solve(impulse=impulse, tol=0.0, max_iter=n).impulse
            return lv.Claim(lv.Status.MAX_ITERATIONS, n)

    laws = {"coulomb", "lcp", "linear", "cone"}
    register(lv.SolverSpec("untested", Untested, laws=laws, summary="of a test", max_iter=200))
    (record,) = bench.run(
        [stack(2)], ["untested"], dataclasses.replace(QUICK, tolerances=(1e-3,), budgets=())
    )
    assert (record.status, record.iterations) == ("CONVERGED", 200) and record.times
    assert format_call(record) == ('lv.solve(problem, "untested", tol=1e-3)',)


def test_a_method_of_free_rows_is_measured_as_its_method_with_bounds_and_a_note_says_so(capsys):
    free = lv.Problem.linear(np.diag([2.0, 3.0]), np.ones(2), name="free")
    records = bench.run([stack(4), free], ["gauss_seidel"], QUICK)
    assert {(r.case, r.solver) for r in records} == {("stack", "pgs"), ("free", "gauss_seidel")}
    (moved,) = records.skips
    assert (moved.case, moved.solver) == ("stack", "gauss_seidel")
    assert moved.reason.startswith("gauss_seidel → pgs: takes laws linear, not 'lcp'")
    print_report(Report(records), Console(width=100))
    assert "gauss_seidel → pgs on 1 case with bounds" in capsys.readouterr().out
    both = bench.run([stack(4)], ["gauss_seidel", "pgs"], QUICK)  # once, where both are named
    assert [r.key for r in both] == [r.key for r in bench.run([stack(4)], ["pgs"], QUICK)]
    assert "→" not in both.skips[0].reason
    steps = bench.run(
        bench.make_sequence(moving_stack(2), "load"),
        ["gauss_seidel"],
        bench.Plan((), budgets=(4,), repeats=1),
    )
    assert {r.solver for r in steps} == {"pgs"} and steps.skips[0].solver == "gauss_seidel"


def test_each_record_is_on_disk_when_it_is_made(tmp_path):
    path = tmp_path / "records.jsonl"
    seen = []

    def watch(event):
        if event.record is not None:
            last = json.loads(path.read_text().splitlines()[-1])
            seen.append(from_json(last) == event.record)

    records = bench.run([stack(6)], ["pgs", "direct"], QUICK, path, watch=watch)
    assert seen == [True] * len(records)
    assert bench.read_records(path).records == records.records
    # Of an editor that marks UTF-8; put together, the mark stands before each part.
    path.write_bytes(2 * (b"\xef\xbb\xbf" + path.read_bytes()))
    assert bench.read_records(path).records == records.records


CAMPAIGN = (
    [*(f"granular(n=2, seed={i})" for i in range(3)), "toy_stack"],
    ["pgs", "gauss_seidel"],
    bench.CampaignPlan(tolerances=(1e-3,), budgets=(4,), orders=()),
)
COMMANDS = {
    "problems": (([stack(6), chain(7)], ["pgs", "direct"], QUICK), 1, 1),
    "a sequence": (
        (bench.make_sequence(moving_stack(5), "load"), ["pgs"], bench.Plan((), budgets=(6,), repeats=1)), 1, 1
    ),
    "a campaign": (CAMPAIGN, 1, 1),
    "a campaign of two workers": (CAMPAIGN, 2, 2),
    "a campaign that two workers go on with": (CAMPAIGN, 1, 2),
    "a campaign of two workers that one goes on with": (CAMPAIGN, 2, 1),
}  # fmt: skip


@pytest.mark.parametrize(
    ("given", "workers", "later"),
    [
        pytest.param(*x, marks=[pytest.mark.nightly] * (x[1:] not in ((1, 1), (1, 2))))
        for x in COMMANDS.values()
    ],
    ids=COMMANDS,
)
def test_the_same_command_goes_on_where_it_was_killed(given, workers, later, tmp_path):
    """Cut in the middle of a line; impulses that are carried from step to step come back, too."""
    path, events = tmp_path / "records.jsonl", []

    def command(workers):
        """Records, and the number of those that were measured now."""
        events.clear()
        records = bench.run(*given, path, workers=workers, watch=events.append)
        return records, sum(e.record is not None and not e.reused for e in events)

    whole, most = command(workers)
    content = path.read_bytes()
    path.write_bytes(content[: content.rindex(b'"kind": "record"')])
    kept = len(bench.read_records(path))
    again, made = command(later)
    assert [(r.key, r.relative) for r in again] == [(r.key, r.relative) for r in whole]
    assert {(s.case, s.solver) for s in again.skips} == {(s.case, s.solver) for s in whole.skips}
    assert 0 < kept < len(whole) == len(bench.read_records(path)) and 0 < made < most
    # And nothing is left to do the third time.
    again, made = command(later)
    assert len(again) == len(whole) == len(bench.read_records(path)) and made == 0
    for line in path.read_bytes().splitlines():
        json.loads(line)


def test_another_version_or_cpu_is_another_run(tmp_path, monkeypatch):
    path = tmp_path / "records.jsonl"
    first = bench.run([stack(5)], ["direct"], QUICK, path)
    ids = {r.run for r in first}
    for name, value in (("__version__", "99"), ("get_cpu_name", lambda: "another")):
        monkeypatch.setattr(machine, name, value)
        ids |= {r.run for r in bench.run([stack(5)], ["direct"], QUICK, path)}
    assert len(ids) == 3
    assert len(bench.read_records(path)) == 3 * len(first)
    assert len(bench.read_records(path).select_latest_run()) == len(first)


def shown(records, folder):
    """The first lines of all that a report says of records, where each of them has them."""
    page = write(records, folder / "report", figures=False).read_text()
    out = io.StringIO()
    print_report(Report(records), Console(file=out, width=200))
    said = [page, (folder / "report" / "summary.md").read_text(), out.getvalue()]
    assert len({"Stopped" in text for text in said}) == 1
    return page


def test_ctrl_c_keeps_what_there_is(tmp_path, plug_in):
    plug_in(interrupted, "fake_interrupt")
    path, into = tmp_path / "records.jsonl", []
    with pytest.raises(KeyboardInterrupt):
        bench.run([stack(5)], ["pgs", "fake_interrupt", "direct"], QUICK, path, into=into)
    kept = bench.read_records(path).records
    assert {r.solver for r in kept} == {"pgs"}
    assert into[0].records == kept
    for records in (into[0], bench.read_records(path)):
        assert Report(records).stopped_warning and Report(records).stopped_warning in shown(records, tmp_path)
    whole = bench.run([stack(5)], ["pgs", "direct"], QUICK, path)
    for records in (whole, bench.read_records(path)):
        assert not Report(records).stopped_warning and "Stopped" not in shown(records, tmp_path)


@pytest.mark.skipif(sys.platform == "win32", reason="an open file cannot be removed there")
def test_a_file_that_is_removed_meanwhile_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "SYNC_INTERVAL", -1.0)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sub").mkdir()
    with bench.Store("sub/records.jsonl") as opened:

        def watch(event):
            if event.solver == "direct" and event.record is None:
                (tmp_path / "sub" / "records.jsonl").unlink()

        monkeypatch.chdir("/")  # a relative name is of the folder where it was given
        with pytest.raises(lv.InputError, match="was removed"):
            bench.run([stack(5)], ["pgs", "direct"], QUICK, opened, watch=watch)


def test_json_and_csv_hold_every_number(tmp_path):
    records = bench.run([stack(6), chain(4, guess=np.ones(4))], ["pgs", "direct"], QUICK)
    store.write_json(records, tmp_path / "r.json")
    store.write_csv(records, tmp_path / "r.csv")
    content = json.loads((tmp_path / "r.json").read_text())
    again = [from_json({"kind": "record", **r}) for r in content["records"]]
    assert again == records.records
    import csv

    with (tmp_path / "r.csv").open(newline="") as f:
        rows = list(csv.DictReader(f))
    assert len(rows) == len(records)
    for row, r in zip(rows, records, strict=True):
        assert float(row["relative"]) == r.relative
        assert float(row["time_min"]) == r.time_min
        assert json.loads(row["work"]) == dict(r.work)
        assert tuple(json.loads(row["times"])) == r.times
        assert row["cpu"] == bench.get_cpu_name()
        assert json.loads(row["versions"])["numpy"] == np.__version__


def test_infinite_and_undefined_numbers_survive_json():
    r = Record(
        run="r", case="c", sha="s", solver="x", options={"seed": np.int64(3)}, start="cold", mode="tol", tol=1e-3,
        max_iter=1, time_limit=1.0, order="given", seed=3, status="ERROR", message="é\n",
    )  # fmt: skip
    back = from_json(json.loads(json.dumps(to_json(r), allow_nan=False)))
    assert back.relative == math.inf
    assert math.isnan(back.time_min)
    assert back.options == {"seed": 3}
    assert back.message == "é\n"
    assert back.key == r.key


@pytest.mark.parametrize(
    ("change", "sign"),
    [
        ({"tolerances": (), "budgets": ()}, "nothing to run"),
        ({"repeats": 0}, "repeats is 0"),
        ({"time_limit": 0.0}, "time_limit is 0"),
        ({"sequence_time_limit": 0.0}, "sequence_time_limit is 0"),
    ],
)
def test_a_senseless_plan_is_refused(change, sign):
    with pytest.raises(lv.InputError, match=sign):
        bench.Plan(**change)


def test_what_a_plan_names_twice_is_run_once_and_moves_no_middle():
    plan = bench.Plan(
        tolerances=(1e-3, 1e-9, 1e-3, 1e-6), budgets=(8, 4, 4), sweeps=(4, 4), orders=("reverse",) * 2
    )
    assert plan.tolerances == (1e-3, 1e-6, 1e-9)
    assert (plan.budgets, plan.sweeps, plan.orders) == ((4, 8), (4,), ("reverse",))


def test_unknown_and_missing_names_are_refused_before_loading(tmp_path):
    with pytest.raises(lv.UnknownName, match="pgs"):
        bench.run([stack(3)], ["pgz"])
    with pytest.raises(lv.InputError, match="no such file"):
        bench.resolve_sources([tmp_path / "nothing.npz"])
    with pytest.raises(lv.InputError, match="holds no problem file"):
        bench.resolve_sources([tmp_path])


@pytest.mark.parametrize(
    ("tolerance", "name"), [(1e-3, "1e-3"), (1e-10, "1e-10"), (2.5e-6, "2.5e-6"), (0.5, "5e-1"), (1.0, "1e0")]
)
def test_levels_are_written_as_people_do(tolerance, name):
    assert bench.format_tolerance(tolerance) == name


def two_bodies(copies, ratio=1.0):
    """A light ball on the ground, a heavy one on it, each pair touching at `copies` equal contacts."""
    inverse = np.array([1.0, 1.0 / ratio])
    pairs = np.repeat([[-1, 0], [0, 1]], copies, axis=0)
    return touching(pairs, inv_mass=inverse, inv_inertia=inverse[:, None, None] * np.eye(3))


def a_pile_among_separate_rows():
    """Six rows, each coupled to the next two, among a hundred that nothing couples: the six decide."""
    a = np.eye(106)
    a[:6, :6] += np.diag(np.full(5, 0.1), 1) + np.diag(np.full(4, 0.1), 2)
    return lv.Problem.lcp(np.maximum(a, a.T), np.ones(106))


def each_coupled_to_a_few():
    rng = np.random.default_rng(3)
    graph = np.zeros((30, 30))
    for i in range(30):
        for j in rng.choice(30, 4):
            graph[i, j] = graph[j, i] = -0.1
    np.fill_diagonal(graph, 2.0)
    return lv.Problem.lcp(graph, np.ones(30))


@pytest.mark.parametrize(
    ("problem", "words"),
    [
        (chain(6), ("chain",)),
        (lv.Problem.linear(*spd(20)), ("dense",)),
        (each_coupled_to_a_few(), ("pile",)),
        (stack(6), ("stack",)),
        (lv.Problem.from_rows(two_bodies(1)), ("stack",)),
        (lv.Problem.from_rows(two_bodies(1, 1e4)), ("stack", "large mass ratio")),
        (lv.Problem.from_rows(two_bodies(3)), ("stack", "redundant")),
        (lv.Problem.from_rows(two_bodies(1), mu=0.5, tangents=2), ("stack", "friction")),
        (lv.Problem.lcp(lv.Problem.from_rows(two_bodies(3)).dense(), np.zeros(6)), ("separate", "redundant")),
        (lv.Problem.linear(np.array([[2.0, 0.01], [0.0, 2.0]]), np.ones(2)), ("separate", "asymmetric")),
        (lv.Problem.linear(np.array([[2.0, 0.5], [0.0, 2.0]]), np.ones(2)), ("asymmetric",)),
        (lv.Problem.contact(np.eye(9), np.ones(9), np.full(3, 0.5)), ("separate", "friction")),
        (a_pile_among_separate_rows(), ("pile",)),
        (lv.Problem.linear(np.zeros((0, 0)), np.zeros(0)), ("empty",)),
    ],
)
def test_structure_is_recognised(problem, words):
    assert bench.classify_structure(problem) == words


def test_a_fingerprint_sees_every_number():
    p = stack(5)
    variants = [
        p,
        dataclasses.replace(p, b=p.b + 1e-15),
        dataclasses.replace(p, guess=np.zeros(5)),
        lv.Problem.lcp(p.matrix, p.b, upper=1.0),
        lv.Problem.lcp(2 * p.matrix, p.b),
        lv.Problem.contact(p.matrix, p.b, np.zeros(5)),
    ]
    jac, mass, v = (
        np.array([[1.0, 0.2], [0.0, 1.0]]),
        np.array([[2.0, 0.3], [0.3, 1.0]]),
        np.array([-1.0, 0.5]),
    )
    cones = lv.Cones.contacts(0.5, 1)
    for s in (1.0, 2.0):  # one A and one b
        variants.append(lv.Problem.from_jacobian(s * jac, s * s * mass, v / s, cones=cones))
    variants.append(dataclasses.replace(variants[-1], precision="float32"))
    variants += [dataclasses.replace(p, key=np.arange(5, dtype=np.uint64) + k) for k in (0, 1)]
    prints = [bench_cases.hash_problem(v) for v in variants]
    assert len(set(prints)) == len(variants)
    assert bench_cases.hash_problem(stack(5, "renamed")) == prints[0]


# -- what is timed --------------------------------------------------------------------------------


@pytest.fixture
def timed(monkeypatch):
    """What each call that is timed is given; every one takes a second more, by a clock that is put forward."""
    calls = []
    true, clock = timing.solve, time.perf_counter

    def slow(problem, solver, **asked):
        calls.append((solver, asked, problem.guess))
        return true(problem, solver, **asked)

    monkeypatch.setattr(timing, "solve", slow)
    monkeypatch.setattr(timing, "perf_counter", lambda: clock() + len(calls))
    return calls


def said(record, problem):
    """What the line that is printed of a record passes to `lv.solve`; of a loop its first pass."""
    calls = []

    def solve(problem, solver, **asked):
        calls.append((solver, asked, problem.guess is None))
        return SimpleNamespace(impulse=None)

    names = {"lv": SimpleNamespace(solve=solve, bench=bench), "problem": problem, "problems": [problem]}
    names["dataclasses"] = dataclasses
    exec("\n".join(format_call(record, problem.guess is not None)), names)
    return calls[0]


def plainly(solver, asked, unguessed):
    return solver, {name: x.tolist() if name == "impulse" else x for name, x in asked.items()}, unguessed


TOLERANCE = 1.23456e-6  # whose short form is another number


def test_what_is_timed_is_the_line_that_is_printed(timed):
    """Whatever the front door of `lv.solve` costs is in the time, and nothing but the line is asked for."""
    plan = bench.Plan(tolerances=(TOLERANCE,), budgets=(4,), repeats=2, orders=())
    problem = stack(6, guess=np.ones(6))
    records = bench.run([problem], ["pgs"], plan)
    assert len(timed) == len(records) == 4
    for r, (solver, asked, guess) in zip(records, timed, strict=True):
        assert (solver, asked, guess is None) == said(r, problem)
        assert (guess is None) == (r.start == "cold")
        assert r.timing_mode == "call"
        assert len(r.times) == 1
        assert r.time_min >= 1.0 + r.setup_min + r.solve_min
    timed.clear()
    steps = moving_stack(2)
    records = bench.run(
        bench.make_sequence(steps, "load"), ["pgs"], dataclasses.replace(plan, budgets=(), repeats=1)
    )
    assert ["impulse" in asked for _, asked, _ in timed] == [r.start == "carried" for r in records]
    for r, (solver, asked, guess) in zip(records, timed, strict=True):
        if r.step == 0:
            assert plainly(solver, asked, guess is None) == plainly(*said(r, steps[0]))


def test_lines_in_turns_are_those_that_are_printed_and_c_asks_for_the_same(timed):
    call_specs = [
        bench.CallSpec("pgs", "tol", TOLERANCE),
        bench.CallSpec("pgs", "tol", TOLERANCE, 20_000),
        bench.CallSpec("pgs", "budget", 0.0, 4),
        bench.CallSpec("pgs", "time", TOLERANCE, time_limit=1.23456e-3),
    ]
    problem, plan = (
        stack(6, guess=np.ones(6)),
        bench.Plan(tolerances=(1e-3,), budgets=(), repeats=1, orders=()),
    )
    known = bench.run([problem], ["pgs"], plan)
    n = len(known)
    timed.clear()
    made = bench.time_alternately([problem], call_specs, known, plan).records[n:]
    for r in made:
        line = said(r, problem)
        assert [asked for solver, asked, guess in timed if (solver, asked, guess is None) == line]
    assert all(guess is None for *_, guess in timed)  # as the line says: cold


def test_lines_are_timed_in_turns_and_kept(tmp_path):
    call_specs = [
        bench.CallSpec("pgs", "tol", 1e-6),
        bench.CallSpec("pgs", "budget", 0.0, 4),
        bench.CallSpec("pgs", "time", 1e-6, time_limit=1e-3),
        bench.CallSpec("pgs", "tol", 1e-6, timing_mode="batch"),
    ]
    problems, plan = (
        [stack(6), stack(8, "other")],
        bench.Plan(tolerances=(1e-6,), budgets=(), repeats=1, orders=()),
    )
    path = tmp_path / "records.jsonl"
    known = bench.run(problems, ["pgs"], plan, path)
    before = len(known)
    made = bench.time_alternately(problems, call_specs, known, plan, path).records[before:]
    assert len(made) == len(problems) * len(call_specs)
    for r in made:
        assert len(r.times) == r.repeats >= 3
        assert r.time_min == min(r.times)
        assert r.success == (r.mode == "tol")
        assert len(r.residual_per_repeat) == (r.repeats if r.mode == "time" else 0)
    assert bench.read_records(path).records == known.records
    again = bench.time_alternately(problems, call_specs, bench.run(problems, ["pgs"], plan, path), plan, path)
    assert again.records == known.records


def test_scipys_own_blas_has_one_thread_while_something_is_timed_though_it_is_loaded_late():
    said = python(
        "-c",
        "from lavender.report.bench.running.timing import limit_to_one_thread\n"
        "from threadpoolctl import threadpool_info\n"
        "with limit_to_one_thread():\n"
        "    import scipy.linalg.lapack\n"
        "    print({pool['num_threads'] for pool in threadpool_info()})",
    ).stdout
    assert said.strip() == "{1}"


def test_things_show_themselves_shortly_and_in_notebooks():
    problem = lv.Problem.lcp(np.eye(1), np.ones(1), name="<b>")
    assert repr(problem) == "<Problem '<b>', lcp, 1 row in 1 block, dense>"
    solution = lv.solve(problem, "pgs", history=True)
    records = bench.run([problem], ["pgs"], bench.Plan(tolerances=(1e-3,), budgets=(2, 4), repeats=1))
    for thing in (problem, solution, records):
        assert len(repr(thing)) < 400
        html = thing._repr_html_()
        assert html.startswith("<table>")
        assert "<b>" not in html
    assert "CONVERGED" in solution._repr_html_()
    axes = (
        lv.solve(lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, 2.0]), "pgs", history=True)
        .history.plot()
        .axes[0]
    )
    assert axes.get_ylabel() == "relative residual [-]"
    with pytest.raises(lv.InputError, match="'iterations' or 'time'"):
        solution.history.plot("x")
