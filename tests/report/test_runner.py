"""Measurements: judged, timed, written when they are made, and never lost to a backend, a kill or a lost worker."""

import csv
import dataclasses
import json
import math
import sys

import numpy as np
import pytest
from random_problems import spd, touching
from stacks import chain, moving_stack, stack
from worked import python

import lavender as lv
from lavender import report, suite
from lavender.report import case_kinds, cases, machine, runner, store, timing, workers
from lavender.report.store import (
    KEY,
    RUN_COLUMNS,
    make_lines,
    select_cases,
    select_runs,
    select_skips,
)
from lavender.report.sweeps import SweepStudy
from lavender.report.timing import format_call

QUICK = report.Plan(tolerances=(1e-3, 1e-8), budgets=(2, 5), repeats=2, time_limit=60.0)
SEEDED = [f"granular(n=2, seed={i})" for i in range(40)]
NAMES = [
    *(f"random_spd(n=12, condition=100, seed={i})" for i in range(3)),
    *SEEDED[:3],
    "toy_stack",
]
CAMPAIGN = report.CampaignPlan(tolerances=(1e-3, 1e-6), budgets=(4, 8))


def rows_of(lines):
    """The runs of some lines as named tuples."""
    return list(select_runs(lines).itertuples(index=False))


def keys_of(lines):
    return [(*(getattr(r, name) for name in KEY), r.relative) for r in rows_of(lines)]


def skipped(lines):
    return sorted(zip(select_skips(lines)["case"], select_skips(lines)["solver"], strict=True))


def texts(lines):
    """All columns of the runs as texts: nan equals nan, and no digit is lost."""
    return list(map(str, select_runs(lines).drop(columns="started").itertuples(index=False)))


# -- what is measured --------------------------------------------------------------------------------------


def test_run_records_have_the_judged_result_of_each_target_and_its_times():
    p = stack(12)
    lines = report.run([p], ["pgs"], QUICK)
    found = rows_of(lines)
    assert [(r.mode, r.tol, r.max_iter) for r in found] == [
        ("tol", 1e-3, 10_000_000),
        ("tol", 1e-8, 10_000_000),
        ("budget", 0.0, 2),
        ("budget", 0.0, 5),
    ]
    for r in found:
        again = lv.solve(p, "pgs", tol=r.tol, max_iter=r.max_iter)
        error = again.residual
        assert (r.relative, r.error_energy, r.velocity) == (
            error.relative,
            error.energy,
            error.velocity,
        )
        found = r.status, r.worst_row, json.loads(r.work)
        assert found == (again.status.name, error.worst_row, dict(again.work))
        assert r.success == (r.mode == "tol") and 1 <= r.repetitions <= (
            1 if r.mode == "budget" else 2
        )
        assert 0.0 < r.time <= r.time_median and r.setup_time + r.solve_time > 0.0
        assert (r.structure, r.islands, r.rows) == ("stack", 1, 12)


def test_run_timed_call_is_the_printed_line(monkeypatch):
    calls = []
    true = case_kinds.solve

    def solve(problem, solver, **asked):
        if problem.m > 1:  # A call with one row precedes the timed calls.
            calls.append((solver, asked, problem.guess))
        return true(problem, solver, **asked)

    monkeypatch.setattr(case_kinds, "solve", solve)
    monkeypatch.setattr(timing, "LONG_TIME", math.inf)
    plan = report.Plan(tolerances=(1.23456e-6,), budgets=(4,), repeats=2)
    found = report.run([stack(6, guess=np.ones(6))], ["pgs"], plan)
    found = rows_of(found)
    assert len(calls) == sum(r.repetitions for r in found) == 6
    for r in found:
        names = {"lv": lv, "problem": stack(6, guess=np.ones(6)), "dataclasses": dataclasses}
        del calls[: r.repetitions - 1]  # Only the first call of a task has a time limit.
        solver, asked, guess = calls.pop(0)
        exec("\n".join(format_call(r, True)[:-1]), names)
        line = eval(
            format_call(r, True)[-1].replace("lv.solve(problem, ", "dict(solver="), {"dict": dict}
        )
        assert (solver, asked["tol"]) == (line["solver"], line["tol"])
        assert asked["max_iter"] == line.get("max_iter", 10_000_000)
        assert (guess is None) == (names["problem"].guess is None) == (r.start == "cold")
    assert not calls


def test_run_answer_as_guess_is_not_a_start(tmp_path):
    p = stack(12)
    answer = lv.solve(p, "direct", tol=1e-12).impulse
    for early in (False, True):
        guess = (0.99 if early else 1.0) * answer
        p.updated(guess=guess).save(tmp_path / "step.npz", impulse=guess if early else None)
        lines = report.run([tmp_path / "step.npz"], ["pgs"], QUICK)
        found = rows_of(lines)
        assert {r.start for r in found} == {"cold"} and select_cases(lines).loc[
            "step", "guess"
        ] == "answer"
        assert all(r.iterations > 5 for r in found if r.mode == "tol" and r.tol == 1e-8)
    warm = report.run([p.updated(guess=0.99 * answer)], ["pgs"], QUICK)
    assert {r.start for r in rows_of(warm)} == {"cold", "warm"}


def test_run_exact_solvers_run_once_and_hopeless_tolerances_are_left_out():
    assert [(r.tol, r.success) for r in rows_of(report.run([stack(8)], ["direct"], QUICK))] == [
        (1e-8, True)
    ]
    impossible = lv.Problem.lcp(
        np.array([[1.0, -1.0], [-1.0, 1.0]]), np.array([1.0, 1.0]), name="impossible"
    )
    assert [
        r.tol for r in rows_of(report.run([impossible], ["pgs"], QUICK)) if r.mode == "tol"
    ] == [1e-3]


def test_run_solver_that_raises_costs_its_own_record(plug_in):
    def fail(problem, impulse):
        raise RuntimeError("of the backend")

    def lose(problem, impulse):
        impulse[:] = np.nan
        return lv.Claim(lv.Status.NUMERICAL_ERROR, 1)

    plug_in(fail, "fake_raise"), plug_in(lose, "fake_nan")
    plug_in(lambda problem, impulse: lv.Claim(lv.Status.CONVERGED, 1), "fake_lie")
    found = report.run(
        [stack(4, "one"), stack(5, "two")], ["fake_raise", "fake_nan", "fake_lie", "pgs"], QUICK
    )
    found = rows_of(found)
    by = {(r.case, r.solver): r for r in found}
    for case in ("one", "two"):
        failed = by[case, "fake_raise"]
        assert (failed.status, failed.message) == ("ERROR", "RuntimeError: of the backend")
        assert (by[case, "fake_nan"].status, by[case, "fake_nan"].relative) == (
            "NUMERICAL_ERROR",
            1.0,
        )
        assert by[case, "fake_lie"].claim_check == "contradicted"
        assert by[case, "pgs"].status == "MAX_ITERATIONS"  # the last: a budget
    assert (
        sum(r.solver == "fake_raise" for r in found) == 2
    )  # After it, no tolerance can be reached.


def test_run_solver_of_free_rows_is_replaced_by_its_bounded_variant():
    free = lv.Problem.linear(np.diag([2.0, 3.0]), np.ones(2), name="free")
    found = report.run([stack(4), free], ["gauss_seidel"], QUICK)
    assert {(r.case, r.solver) for r in rows_of(found)} == {
        ("stack", "pgs"),
        ("free", "gauss_seidel"),
    }
    (reason,) = select_skips(found)["reason"]
    assert reason.startswith("gauss_seidel → pgs: takes laws linear, not 'lcp'")
    both = report.run([stack(4)], ["gauss_seidel", "pgs"], QUICK)  # measured once if both are named
    assert keys_of(both) == keys_of(report.run([stack(4)], ["pgs"], QUICK))


def test_plan_duplicates_are_removed():
    plan = report.Plan(tolerances=(1e-3, 1e-9, 1e-3, 1e-6), budgets=(8, 4, 4))
    assert (plan.tolerances, plan.budgets) == ((1e-3, 1e-6, 1e-9), (4, 8))


def test_limit_to_one_thread_covers_libraries_loaded_later():
    code = """from lavender.report.timing import limit_to_one_thread
from threadpoolctl import threadpool_info
with limit_to_one_thread():
    import scipy.linalg.lapack
    print({pool['num_threads'] for pool in threadpool_info()})"""
    assert python("-c", code).stdout.strip() == "{1}"


# -- on disk -----------------------------------------------------------------------------------------------


def test_store_has_each_row_when_it_is_made(tmp_path):
    path = tmp_path / "records.jsonl"
    seen = []

    def watch(event):
        if event.row is not None:
            seen.append(
                json.loads(path.read_text().splitlines()[-1]) == store.to_jsonable(event.row)
            )

    found = report.run(
        [stack(6)], ["pgs", "direct"], dataclasses.replace(QUICK, repeats=1), path, watch=watch
    )
    assert seen == [True] * len(rows_of(found)) and texts(report.read(path)) == texts(found)
    # Files of an editor that marks UTF-8, put together: the mark is before each part.
    path.write_bytes(2 * (b"\xef\xbb\xbf" + path.read_bytes()))
    assert texts(report.read(path)) == texts(found)


SEQUENCE = (
    report.make_sequence(moving_stack(5), "load"),
    ["pgs"],
    report.Plan((), budgets=(6,), repeats=1),
)
SOME = (NAMES[3:], ["pgs", "gauss_seidel"], report.CampaignPlan(tolerances=(1e-3,), budgets=(4,)))


@pytest.mark.parametrize(
    ("given", "first", "later"),
    [
        (([stack(6), chain(7)], ["pgs", "direct"], QUICK), 1, 1),
        (SEQUENCE, 1, 1),
        (SOME, 1, 2),
        pytest.param(SOME, 2, 1, marks=pytest.mark.nightly),
    ],
    ids=["problems", "sequence", "campaign", "campaign of two workers"],
)
def test_run_killed_at_any_byte_continues(given, first, later, tmp_path):
    """Cut in the middle of lines; impulses that are carried from step to step are restored, too."""
    path = tmp_path / "records.jsonl"
    events = []

    def measure(n):
        """Measure with n workers; return the records, and the number of records that were made now."""
        events.clear()
        found = report.run(*given, path, workers=n, watch=events.append)
        return found, sum(e.row is not None and not e.reused for e in events)

    whole, made = measure(first)
    content = path.read_bytes()
    for cut in np.random.default_rng(0).integers(len(content) // 8, len(content) - 2, 3):
        path.write_bytes(content[:cut])
        read = report.read(path)
        assert read.attrs["dropped"] == (content[cut - 1 : cut] != b"\n")
        kept = len(rows_of(read))
        again, more = measure(later)
        assert keys_of(again) == keys_of(whole) and skipped(again) == skipped(whole)
        assert (
            kept + more >= len(rows_of(whole)) == len(rows_of(report.read(path))) and more <= made
        )
    again, more = measure(later)
    assert (
        keys_of(again) == keys_of(whole)
        and len(rows_of(report.read(path))) == len(rows_of(whole))
        and more == 0
    )


def test_run_other_version_or_cpu_is_another_run(tmp_path, monkeypatch):
    path = tmp_path / "records.jsonl"
    first = report.run([stack(5)], ["direct"], QUICK, path)
    ids = {r.run for r in rows_of(first)}
    for name, value in (("__version__", "99"), ("get_cpu_name", lambda: "another")):
        monkeypatch.setattr(machine, name, value)
        ids |= {r.run for r in rows_of(report.run([stack(5)], ["direct"], QUICK, path))}
    found = report.Report(report.read(path))
    assert (
        len(ids) == 3
        and len(found.runs) == 3 * len(rows_of(first))
        and len(found.newest) == len(rows_of(first))
    )


def test_run_ctrl_c_keeps_the_records_that_were_made(tmp_path, plug_in):
    def interrupt(problem, impulse):
        raise KeyboardInterrupt

    plug_in(interrupt, "fake_interrupt")
    path = tmp_path / "records.jsonl"
    into = []
    with pytest.raises(KeyboardInterrupt):
        report.run([stack(5)], ["pgs", "fake_interrupt", "direct"], QUICK, path, into=into)
    assert {r.solver for r in rows_of(report.read(path))} == {"pgs"}
    assert texts(make_lines(into)) == texts(report.read(path))
    assert report.Report(report.read(path)).is_stopped
    report.run([stack(5)], ["pgs", "direct"], QUICK, path)
    assert not report.Report(report.read(path)).is_stopped


def test_write_csv_has_a_row_for_each_run(tmp_path):
    found = report.run([stack(6), chain(4, guess=np.ones(4))], ["pgs", "direct"], QUICK)
    report.write(found, tmp_path, figures=False)
    with (tmp_path / "records.csv").open(newline="") as f:
        rows = list(csv.DictReader(f))
    for row, r in zip(rows, rows_of(found), strict=True):
        assert (float(row["relative"]), float(row["time"]), row["cpu"]) == (
            r.relative,
            r.time,
            machine.get_cpu_name(),
        )
        assert json.loads(row["work"]) == json.loads(r.work) and int(row["rows"]) == r.rows > 0
    assert f"numpy {np.__version__}" in rows[0]["versions"]
    with pytest.raises(
        lv.InputError, match="no records of solver 'nncg'; there are records of direct, pgs"
    ):
        store.select_solvers(found, ["nncg"])


def test_read_infinite_and_undefined_numbers_are_kept_to_the_last_bit(tmp_path):
    row = RUN_COLUMNS | {
        "kind": "run",
        "run": "r",
        "case": "stack",
        "tol": 0.1 + 0.2,
        "message": "é\n",
        "max_iter": 10_000_000,
        "worst_name": "a\n",
    }
    case = cases.describe_case(report.resolve_sources([stack(5)])[0], "r")
    with report.Store(tmp_path / "records.jsonl") as opened:
        for entry in ({**machine.describe_run({}), "run": "r"}, case, row):
            opened.add(entry)
    (back,) = rows_of(report.read(tmp_path))
    assert back.relative == math.inf and math.isnan(back.time) and math.isnan(back.roundoff_floor)
    assert (back.message, back.tol, back.max_iter, back.worst_name) == (
        "é\n",
        0.1 + 0.2,
        10_000_000,
        "a\n",
    )


def test_run_marks_impulses_that_gain_energy():
    problem = suite.case("box_stack(n=3)").problem
    exact = lv.solve(problem, "direct").impulse
    plan = report.Plan(tolerances=(1e-8,), budgets=(1,), repeats=1)
    lines = report.run([problem.updated(guess=4.0 * exact)], ["pgs"], plan)
    by = {(r.start, r.mode): r for r in rows_of(lines)}
    answer = lv.solve(problem, "pgs", impulse=4.0 * exact, tol=0.0, max_iter=1).impulse
    target = problem.b + problem.jacobian @ problem.rows.v_free.ravel()
    # 1e-9 is far above the rounding of energies of a few joules.
    expected = problem.energy_change(answer) - answer @ target
    assert by["warm", "budget"].energy_gain == pytest.approx(expected, abs=1e-9) and expected > 0.01
    assert (
        by["cold", "budget"].energy_gain
        == by["cold", "tol"].energy_gain
        == by["warm", "tol"].energy_gain
        == 0.0
    )
    (warning,) = (text for text in report.Report(lines).warnings if text.startswith("gains energy"))
    assert (
        warning
        == f"gains energy: pgs in 1 run, at most {expected:.2g} J ({by['warm', 'budget'].case})"
    )
    driven = lv.Problem.from_jacobian(
        np.eye(2), np.eye(2), [-1.0, -1.0], cones=lv.Cones.bounded([0.5, 0.0], [9.0, 9.0])
    )
    assert all(math.isnan(r.energy_gain) for r in rows_of(report.run([driven], ["pgs"], plan)))


# -- sequences ---------------------------------------------------------------------------------------------


def test_run_sequence_carries_each_solvers_own_impulses():
    problems = moving_stack(5)
    plan = report.Plan(tolerances=(1e-6,), budgets=(6,), repeats=1)
    found = report.run(report.make_sequence(problems, "load"), ["pgs"], plan)
    found = rows_of(found)
    impulse = problems[0].start()
    by = {(r.start, r.mode, r.step): r for r in found}
    for i, p in enumerate(problems):
        carried = lv.solve(p, "pgs", impulse=impulse, tol=0.0, max_iter=6)
        impulse = carried.impulse
        r = by["carried", "budget", i]
        assert r.relative == carried.residual.relative and r.carry_time > 0.0
        assert r.motion_error == lv.motion_error(p, impulse).rows
        cold = lv.solve(p, "pgs", impulse=p.start(), tol=0.0, max_iter=6)
        assert by["cold", "budget", i].relative == cold.residual.relative
    assert len(found) == 5 * 4
    # The load changes by a thousandth: from the second step on, carried impulses are far closer.
    assert by["carried", "budget", 4].relative < 0.2 * by["cold", "budget", 4].relative


def record_warm_engine(folder, sweeps, first=30, steps=90):
    """Record a stack at rest of an engine with warm sweeps from a step on; return its velocity errors."""
    rows = lv.Simulation(lv.Scene("stack", n=4)).constraint_problem().rows
    velocity = 0.0
    last = None
    errors = []
    with lv.io.Recorder(folder, every=1, solver="own loop") as recorder:
        for step in range(steps):
            moved = dataclasses.replace(
                rows, v_free=velocity + rows.v_free
            )  # rows.v_free is that of gravity alone.
            problem = lv.Problem.from_rows(moved, mu=0.5, key=np.arange(rows.n_contacts))
            start = None if last is None else problem.carry(last)
            last = lv.solve(problem, "sequential_impulses", tol=0.0, max_iter=sweeps, impulse=start)
            velocity = problem.velocity(last.impulse)
            if step >= first:
                recorder.add(problem, last.impulse)
                errors.append(last.residual.velocity)
    return errors


@pytest.mark.parametrize("sweeps", [6, 12])
def test_run_recording_from_step_30_of_a_warm_engine_has_its_error_in_the_table(tmp_path, sweeps):
    errors = record_warm_engine(tmp_path, sweeps)
    plan = report.Plan(tolerances=(), budgets=(sweeps,), repeats=1)
    lines = report.run(cases.resolve_sources([str(tmp_path)]), ["sequential_impulses"], plan)
    study = SweepStudy(report.Report(lines))
    # The report starts the second step from the engine's answer to the first; the sweeps are the same.
    assert study.errors.loc["sequential_impulses", sweeps] == pytest.approx(
        max(errors[1:]), rel=1e-6
    )
    assert study.cold.loc["sequential_impulses", sweeps] > 2.0 * max(errors[1:])


def test_run_sequence_pass_ends_at_its_time_limit_with_a_note(tmp_path, monkeypatch):
    items = report.make_sequence(moving_stack(5), "load")
    # No solve takes less than a picosecond: each pass ends after its first step.
    plan = report.Plan(tolerances=(), budgets=(6,), repeats=1, sequence_time_limit=1e-12)
    found = report.run(items, ["pgs"], plan, tmp_path / "records.jsonl")
    assert [(r.step, r.start) for r in rows_of(found)] == [(0, "cold"), (0, "carried")]
    skips = select_skips(found)
    assert list(skips["case"]) == ["load, 6 iterations, cold", "load, 6 iterations, carried"]
    assert all("after 1 of 5 steps" in reason for reason in skips["reason"])
    monkeypatch.setattr(runner, "measure_task", None)  # Nothing is solved again.
    assert texts(report.run(items, ["pgs"], plan, tmp_path / "records.jsonl")) == texts(found)


def test_records_of_two_sequences_with_one_name_are_kept_apart(tmp_path):
    path = tmp_path / "records.jsonl"
    plan = report.Plan(tolerances=(), budgets=(6,), repeats=1)
    report.run(report.make_sequence(moving_stack(5), "load"), ["pgs"], plan, path)
    report.run(report.make_sequence(moving_stack(2, n=11), "load"), ["pgs"], plan, path)
    frame = report.Report(report.read(path)).newest
    assert sorted(frame.loc[frame["start"] == "cold", "step"]) == [0, 1]


# -- workers -----------------------------------------------------------------------------------------------


def test_campaign_one_worker_and_two_give_equal_bits_and_no_times(tmp_path):
    one = report.run(NAMES, ["pgs", "direct"], CAMPAIGN)
    two = report.run(NAMES, ["pgs", "direct"], CAMPAIGN, workers=2)
    assert texts(one) == texts(two) and skipped(one) == skipped(two)
    assert select_cases(one).equals(select_cases(two))
    found = rows_of(one)
    assert all(
        r.repetitions == 0 and math.isnan(r.time) and math.isnan(r.setup_time) for r in found
    )
    (r,) = (r for r in found if (r.case, r.solver, r.max_iter) == (NAMES[0], "pgs", 8))
    again = lv.solve(suite.case(NAMES[0]).problem, "pgs", tol=0.0, max_iter=8)
    assert again.residual.relative == r.relative
    page = report.write(one, tmp_path)
    assert "Error and robustness without times" in page.read_text(encoding="utf-8")
    assert not (tmp_path / "figures").exists()
    with pytest.raises(lv.InputError, match="give a CampaignPlan, or workers=1"):
        report.run(["toy_stack"], ["direct"], report.Plan(), workers=2)


def test_campaign_problems_files_and_local_solvers_are_sent_to_workers(tmp_path, plug_in):
    short = report.CampaignPlan(tolerances=(1e-6,), budgets=())
    p = lv.Problem.lcp(np.array([[2.0, 1.0], [1.0, 2.0]]), np.ones(2), name="mine")
    lv.io.save(p, tmp_path / "file.npz")
    (tmp_path / "bad.npz").write_bytes(b"broken")
    found = report.run(
        [p, tmp_path / "file.npz", tmp_path / "bad.npz"], ["direct"], short, workers=2
    )
    assert [(r.case, r.success) for r in rows_of(found)] == [("mine", True), ("file", True)]
    assert ["did not load" in reason for reason in select_skips(found)["reason"]] == [True]
    for name in ("here_alone", "pgs"):  # also under the name of a solver of lavender
        plug_in(lambda problem, impulse: lv.Claim(lv.Status.MAX_ITERATIONS, 1, {"mine": 1}), name)
    found = report.run(["toy_stack"], ["here_alone", "pgs"], short, workers=2)
    assert [json.loads(r.work) for r in rows_of(found)] == 2 * [{"mine": 1}]


@pytest.mark.parametrize(
    ("backend", "missing", "message"),
    [
        ("nowhere", "", "'loky' runs processes"),
        ("loky=here", "", "'loky' runs processes"),
        ("dask=tcp://127.0.0.1:1", "", "no dask scheduler answers"),
        ("dask", "", "DASK_SCHEDULER_ADDRESS"),
        ("dask", "distributed", r"pip install 'lavender-contact\[cluster\]'"),
    ],
)
def test_campaign_backend_that_cannot_be_used_is_an_input_error(
    backend, missing, message, monkeypatch
):
    if missing:
        monkeypatch.setitem(sys.modules, missing, None)
    elif backend.startswith("dask"):
        pytest.importorskip(
            "distributed", reason="a cluster needs dask.distributed (extra: cluster)"
        )
        monkeypatch.setattr(workers, "CONNECT_TIMEOUT", 0.2)
    with pytest.raises(lv.InputError, match=message):
        report.run(NAMES[:1], ["pgs"], CAMPAIGN, backend=backend)


# -- cases -------------------------------------------------------------------------------------------------


def two_bodies(copies, ratio=1.0):
    """A light ball on the ground, a heavy one on it, each pair touching at `copies` equal contacts."""
    inverse = np.array([1.0, 1.0 / ratio])
    pairs = np.repeat([[-1, 0], [0, 1]], copies, axis=0)
    return touching(pairs, inv_mass=inverse, inv_inertia=inverse[:, None, None] * np.eye(3))


def make_pile_among_separate_rows():
    """Six rows, each coupled to the next two, among a hundred that nothing couples: the six decide."""
    a = np.eye(106)
    a[:6, :6] += np.diag(np.full(5, 0.1), 1) + np.diag(np.full(4, 0.1), 2)
    return lv.Problem.lcp(np.maximum(a, a.T), np.ones(106))


def make_driven_chain(n=6):
    """Bars in a plane; each joint has a hinge, a limit and a motor."""
    position = np.column_stack([np.arange(n) + 0.5, np.zeros(n)])
    builder = lv.RowBuilder(
        np.ones(n), np.full(n, 3.0), np.tile([0.0, -0.1, 0.0], (n, 1)), 1 / 60, position
    )
    for i in range(n):
        builder.hinge(i - 1, i, (float(i), 0.0))
        builder.limit(i - 1, i, value=0.0, lower=-1.0, upper=1.0)
        builder.motor(i - 1, i, speed=0.0, max_torque=1.0)
    return builder.problem()


@pytest.mark.parametrize(
    ("problem", "words"),
    [
        (chain(6), ("chain",)),
        (make_driven_chain(), ("chain", "redundant")),
        (suite.case("boxed_friction(n=2)").problem, ("stack", "redundant")),
        (suite.case("boxed_friction(n=3, scene=granular)").problem, ("pile", "redundant")),
        (lv.Problem.linear(*spd(20)), ("dense",)),
        (stack(6), ("stack",)),
        (lv.Problem.from_rows(two_bodies(1)), ("stack",)),
        (lv.Problem.from_rows(two_bodies(1, 1e4)), ("stack", "large mass ratio")),
        (lv.Problem.from_rows(two_bodies(3)), ("stack", "redundant")),
        (lv.Problem.from_rows(two_bodies(1), mu=0.5, tangents=2), ("stack", "friction")),
        (
            lv.Problem.lcp(lv.Problem.from_rows(two_bodies(3)).dense(), np.zeros(6)),
            ("separate", "redundant"),
        ),
        (
            lv.Problem.linear(np.array([[2.0, 0.01], [0.0, 2.0]]), np.ones(2)),
            ("separate", "asymmetric"),
        ),
        (lv.Problem.linear(np.array([[2.0, 0.5], [0.0, 2.0]]), np.ones(2)), ("asymmetric",)),
        (lv.Problem.contact(np.eye(9), np.ones(9), np.full(3, 0.5)), ("separate", "friction")),
        (make_pile_among_separate_rows(), ("pile",)),
        (lv.Problem.linear(np.zeros((0, 0)), np.zeros(0)), ("empty",)),
    ],
)
def test_classify_structure_names_the_largest_component(problem, words):
    assert report.classify_structure(problem) == words


def test_hash_problem_changes_with_every_number():
    p = stack(5)
    variants = [
        p,
        dataclasses.replace(p, b=p.b + 1e-15),
        dataclasses.replace(p, guess=np.zeros(5)),
        lv.Problem.lcp(p.matrix, p.b, upper=1.0),
        lv.Problem.lcp(2 * p.matrix, p.b),
        lv.Problem.contact(p.matrix, p.b, np.zeros(5)),
    ]
    jac = np.array([[1.0, 0.2], [0.0, 1.0]])
    mass = np.array([[2.0, 0.3], [0.3, 1.0]])
    v = np.array([-1.0, 0.5])
    for s in (1.0, 2.0):  # one A and one b
        cones = lv.Cones.contacts(0.5, 1)
        variants.append(lv.Problem.from_jacobian(s * jac, s * s * mass, v / s, cones=cones))
    variants.append(dataclasses.replace(variants[-1], precision="float32"))
    variants += [dataclasses.replace(p, key=np.arange(5, dtype=np.uint64) + k) for k in (0, 1)]
    hashes = [cases.hash_problem(v) for v in variants]
    assert (
        len(set(hashes)) == len(variants) and cases.hash_problem(stack(5, "renamed")) == hashes[0]
    )


def test_resolve_sources_recorded_steps_are_sequences_and_folders_are_searched(tmp_path):
    p = lv.Problem.contact(np.eye(4), np.ones(4), np.full(2, 0.5), key=np.array([7, 9], np.uint64))
    for folder in ("a/steps", "b/steps", "mixed", "a/my steps", "a/My_steps"):
        (tmp_path / folder).mkdir(parents=True)
        for i in (1, 2):
            lv.io.save(p, tmp_path / folder / f"scene-{i:06d}.npz")
    lv.io.save(p, tmp_path / "mixed" / "other.npz")
    items = report.resolve_sources(
        [tmp_path / "a" / "steps", tmp_path / "b" / "steps", tmp_path / "mixed"]
    )
    assert [(i.sequence, i.step) for i in items] == [
        ("steps", 0),
        ("steps", 1),
        ("b/steps", 0),
        ("b/steps", 1),
        ("", -1),
        ("", -1),
        ("", -1),
    ]
    assert all(
        i.sequence == ""
        for i in report.resolve_sources([tmp_path / "a" / "steps"], sequences=False)
    )
    alike = report.resolve_sources([tmp_path / "a" / name for name in ("my steps", "My_steps")])
    assert {i.sequence for i in alike} == {
        "my steps",
        "a/My_steps",
    }  # Figures are files named after sequences.
    (tmp_path / "mixed" / "back").symlink_to(tmp_path / "mixed")  # is not read again
    assert len(report.resolve_sources([tmp_path / "mixed", "stack(n=2)"])) == 4
    with pytest.raises(lv.InputError, match="no such"):
        report.resolve_sources([tmp_path / "b" / "x"])


def test_resolve_sources_files_of_one_name_are_named_after_the_folders_that_differ(tmp_path):
    files = [tmp_path / folder / "step_01.npz" for folder in ("a", "b/worst", "c/worst")]
    for path in files:
        path.parent.mkdir(parents=True)
        lv.io.save(stack(4), path)
    names = [item.name for item in report.resolve_sources([*files, "stack(n=2)"])]
    assert names == ["a/step_01", "b/worst/step_01", "c/worst/step_01", "stack(n=2)"]
    lv.io.save(stack(4), tmp_path / "step_01.npz")
    names = [
        item.name
        for item in report.resolve_sources([tmp_path / "step_01.npz", *files[:1], *files[:1]])
    ]
    assert names == ["step_01", "a/step_01", "a/step_01 #2"]


@pytest.mark.parametrize("names", [("s_1", "s_2", "s_02"), ("a_1", "a_2", "b_1", "b_2")])
def test_list_steps_two_recordings_in_a_folder_are_rejected(tmp_path, names):
    for name in names:
        lv.io.save(stack(4), tmp_path / f"{name}.npz")
    with pytest.raises(lv.InputError, match="more than one recording"):
        cases.list_steps_in_folder(tmp_path)
    with pytest.raises(lv.InputError, match="is not a folder"):
        cases.list_steps_in_folder(tmp_path / "none")


def test_list_steps_are_in_numeric_order(tmp_path):
    for i in (10, 9, 1):
        lv.io.save(stack(4), tmp_path / f"step_{i}.npz")
    steps = cases.list_steps_in_folder(tmp_path)
    assert [item.source.rpartition("_")[2] for item in steps] == ["1.npz", "9.npz", "10.npz"]
    assert [i.sequence for i in report.resolve_sources([tmp_path])] == [
        "",
        "",
        "",
    ]  # No blocks are named.


def test_records_of_a_plug_in_with_changed_code_are_measured_again(tmp_path, monkeypatch, register):
    path = tmp_path / "edited_solver.py"
    path.write_text("from lavender.solvers.pgs import ProjectedGaussSeidel as Edited\n")
    monkeypatch.syspath_prepend(tmp_path)
    register(
        lv.SolverSpec(
            "edited", "edited_solver:Edited", laws=("lcp",), summary="of a test", max_iter=200
        )
    )
    before = machine.hash_solver_sources()
    assert machine.hash_solver_sources() == before
    path.write_text(path.read_text() + "# changed\n")
    assert machine.hash_solver_sources() != before


@pytest.mark.parametrize(
    ("name", "values"),
    [("tol", (1e-3, 1e-6)), ("max_iter", (10, 20)), ("time_limit", (1.0, 2.0)), ("start", ("cold", "carried")),
     ("mode", ("tol", "budget")), ("solver", ("pgs", "newton"))],
)  # fmt: skip
def test_runs_that_a_plan_can_tell_apart_are_two_runs(name, values):
    from tests.report.synthetic import lines_of, record

    own = {"solver": "pgs"}
    made = [record("case", relative=1e-9, time=1e-3, **own | {name: value}) for value in values]
    again = [record("case", relative=1e-8, time=1e-3, **own | {name: values[1]})]
    found = select_runs(lines_of(*made, *again))
    assert found[name].tolist() == list(values) and found["relative"].tolist() == [1e-9, 1e-8]
