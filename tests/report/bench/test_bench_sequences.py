"""Sequences of problems: impulses that travel, steps in their order, passes that end."""

import numpy as np
import pytest
from stacks import moving_stack, stack

import lavender as lv
from lavender import bench
from lavender.report import table_specs
from lavender.report.bench import statistics
from lavender.report.bench.running import runner


def test_a_sequence_carries_each_solvers_own_impulses():
    problems = moving_stack(5)
    plan = bench.Plan(tolerances=(1e-6,), budgets=(6,), repeats=1)
    records = bench.run(bench.make_sequence(problems, "load"), ["pgs"], plan)
    impulse = problems[0].start()
    by = {(r.start, r.mode, r.step): r for r in records}
    for i, p in enumerate(problems):
        carried = lv.solve(p, "pgs", impulse=impulse, tol=0.0, max_iter=6)
        impulse = carried.impulse
        assert by["carried", "budget", i].relative == carried.residual.relative
        cold = lv.solve(p, "pgs", impulse=p.start(), tol=0.0, max_iter=6)
        assert by["cold", "budget", i].relative == cold.residual.relative
    assert len(records) == 5 * 4
    # The load changes by a thousandth: from the second step on carrying is far ahead.
    assert by["carried", "budget", 4].relative < 0.2 * by["cold", "budget", 4].relative


def test_a_pass_that_takes_too_long_ends_and_says_so(tmp_path, monkeypatch):
    items = bench.make_sequence(moving_stack(5), "load")
    # No solve takes less than a picosecond: each pass ends after its first step.
    plan = bench.Plan(tolerances=(), budgets=(6,), repeats=1, sequence_time_limit=1e-12)
    path = tmp_path / "records.jsonl"
    records = bench.run(items, ["pgs"], plan, path)
    assert [(r.step, r.start) for r in records] == [(0, "cold"), (0, "carried")]
    assert [s.case for s in records.skips] == ["load, 6 iterations, cold", "load, 6 iterations, carried"]
    assert all("after 1 of 5 steps" in s.reason for s in records.skips)
    (row,) = table_specs.tabulate_sequence_passes(
        statistics.group_runs_by_pass(records)
    ).cell_texts  # beside solvers that took all five
    assert [cell.endswith(" (1/5)") for cell in row].count(True) == 2
    monkeypatch.setattr(runner, "measure_task", None)  # nothing is solved again
    assert bench.run(items, ["pgs"], plan, path).records == records.records
    (line,) = lv.report.recommend_solvers(records, [1.0])
    assert line.by_time[1.0].best is None  # one of five
    assert line.by_time[1.0].ranking[0].solved == 1
    assert line.by_time[1.0].ranking[0].score > max(
        r.relative for r in records
    )  # four steps count as not done


def test_recorded_steps_are_known_by_themselves_and_kept_apart(tmp_path):
    from lavender import io

    p = lv.Problem.contact(np.eye(4), np.ones(4), np.full(2, 0.5), key=np.array([7, 9], np.uint64))
    for folder in ("a/steps", "b/steps", "mixed", "a/my steps", "a/My_steps"):
        (tmp_path / folder).mkdir(parents=True)
        for i in (1, 2):
            io.save(p, tmp_path / folder / f"scene-{i:06d}.npz")
    io.save(p, tmp_path / "mixed" / "other.npz")
    items = bench.resolve_sources([tmp_path / "a" / "steps", tmp_path / "b" / "steps", tmp_path / "mixed"])
    assert [(i.sequence, i.step) for i in items] == [
        ("steps", 0), ("steps", 1), ("b/steps", 0), ("b/steps", 1), ("", -1), ("", -1), ("", -1),
    ]  # fmt: skip
    assert len({i.name for i in items}) == len(items)
    assert all(i.sequence == "" for i in bench.resolve_sources([tmp_path / "a" / "steps"], sequences=False))
    # Figures and parts of the page are named after sequences: one name of a file for each.
    alike = bench.resolve_sources([tmp_path / "a" / name for name in ("my steps", "My_steps")])
    assert {i.sequence for i in alike} == {"my steps", "a/My_steps"}


def test_folders_in_a_folder_are_taken_too(tmp_path):
    from lavender import io

    for place in ("a.npz", "piles/b.npz", "piles/c.npz", "chains/d.npz", "deep/er/e.npz"):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        io.save(stack(4), tmp_path / place)
    (tmp_path / "notes").mkdir()
    (tmp_path / "piles" / "back").symlink_to(tmp_path)  # is not read again
    assert [i.name for i in bench.resolve_sources([tmp_path, "stack(n=2)"])] == [
        "a",
        "stack(n=2)",
        "d",
        "b",
        "c",
    ]
    (tmp_path / "a.npz").unlink()
    assert [i.name for i in bench.resolve_sources([tmp_path])] == ["d", "b", "c"]
    with pytest.raises(lv.InputError, match="holds no problem file"):
        bench.resolve_sources([tmp_path / "deep" / "er" / "..", tmp_path / "notes"])


def test_a_folder_is_a_sequence_in_numeric_order(tmp_path):
    from lavender import io

    for i in (10, 9, 1):
        io.save(stack(4), tmp_path / f"step_{i}.npz")
    assert [
        item.source[-len("step_10.npz") :].lstrip("/") for item in bench.list_steps_in_folder(tmp_path)
    ] == ["step_1.npz", "step_9.npz", "step_10.npz"]
    # Files that name no blocks may be anything: steps only where that is said.
    assert [(i.name, i.sequence) for i in bench.resolve_sources([tmp_path])] == [
        ("step_1", ""), ("step_9", ""), ("step_10", ""),
    ]  # fmt: skip
    assert [i.step for i in bench.resolve_sources([tmp_path], sequences=True)] == [0, 1, 2]
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(lv.InputError, match="needs two"):
        bench.list_steps_in_folder(empty)


def test_steps_of_two_sequences_are_never_one(tmp_path):
    path, plan = tmp_path / "records.jsonl", bench.Plan(tolerances=(), budgets=(6,), repeats=1)
    bench.run(bench.make_sequence(moving_stack(5), "load"), ["pgs"], plan, path)
    bench.run(bench.make_sequence(moving_stack(2, n=11), "load"), ["pgs"], plan, path)
    (one,) = bench.statistics.group_runs_by_pass(bench.read_records(path).select_latest_run())
    assert (one.steps, len(one.times["cold"])) == (2, 2)


@pytest.mark.parametrize("names", [("s_1", "s_2", "s_02"), ("a_1", "a_2", "b_1", "b_2")])
def test_a_folder_with_two_recordings_is_refused(tmp_path, names):
    for name in names:
        lv.io.save(stack(4), tmp_path / f"{name}.npz")
    with pytest.raises(lv.InputError, match="more than one recording"):
        bench.list_steps_in_folder(tmp_path)


def test_a_level_of_a_sequence_is_solved_to_that_level():
    plan = bench.Plan(tolerances=(1e-3, 1e-6, 1e-9), budgets=(), repeats=1)
    records = bench.run(bench.make_sequence(moving_stack(3), "load"), ["pgs", "direct"], plan)
    assert {r.tol for r in records if r.solver == "pgs"} == set(plan.tolerances)
    (line,) = lv.report.recommend_solvers(records)
    for advice in line.by_tolerance.values():
        assert all(
            float(c.how.removeprefix("to ").partition(",")[0]) <= advice.target for c in advice.ranking
        )
