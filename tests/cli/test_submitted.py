"""Results of others, verified anew: verdicts must agree, problems must be the same, the file stays as it was."""

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

import lavender as lv
from lavender import bench
from lavender.cli.entry import cli

PLAN = bench.Plan(levels=(1e-3, 1e-20), budgets=(4, 16), repeats=2, orders=("reverse",), time_limit=30.0)
SHORT = {"relative": 1e-21, "success": True, "status": "CONVERGED"}
CASES = ("toy_stack", "chain(n=33, tip_mass=1e4)")


@pytest.fixture(scope="module")
def submitted(tmp_path_factory):
    path = tmp_path_factory.mktemp("theirs") / "records.jsonl"
    bench.run(CASES, ["pgs", "direct", "newton"], PLAN, path, isolate=False)
    return path


def lines_of(path, change):
    """The entries of a submission, each changed by a function."""
    return "".join(json.dumps(change(json.loads(line))) + "\n" for line in path.read_text().splitlines())


def test_an_honest_submission_agrees_and_is_left_as_it_was(submitted):
    before = submitted.read_bytes()
    found = bench.verify(bench.read(submitted), isolate=False)
    assert found.ok
    assert found.others == ()
    assert len(found.lines) == len(bench.read(submitted))
    assert all(v.agrees for v in found.lines)
    assert {v.record.mode for v in found.lines} == {"tol", "budget"}
    assert submitted.read_bytes() == before
    # Kernels of ours give the same bits on every machine: residuals, too.
    assert all(v.here.relative == v.record.relative for v in found.lines if v.record.solver == "pgs")


@pytest.mark.parametrize(
    ("solver", "change", "said"),
    [
        ("pgs", SHORT, "solved there, FLOOR here"),
        ("pgs", {"success": True}, "solved there, FLOOR here"),
        ("newton", {"relative": 0.5, "success": False, "status": "STALLED"}, "not solved there, solved here"),
    ],
)
def test_a_verdict_that_was_changed_is_found(submitted, tmp_path, solver, change, said):
    records = bench.read(submitted)
    wanted = not change["success"]
    (which, *_) = (r for r in records if r.solver == solver and r.mode == "tol" and r.success == wanted)
    path = tmp_path / "records.jsonl"

    def forge(entry):
        same = entry["kind"] == "record" and all(
            entry[name] == getattr(which, name) for name in ("case", "solver", "mode", "tol", "start")
        )
        return entry | change if same and entry["options"] == dict(which.options) else entry

    path.write_text(lines_of(submitted, forge))
    done = CliRunner().invoke(cli, ["check", str(path), "--solvers", solver])
    assert done.exit_code == 1, done.output
    assert f"DISAGREES: {solver} on {which.case}, to {bench.level_name(which.tol)}: {said}" in done.output


def test_a_residual_of_a_budget_that_was_changed_is_found(submitted):
    records = bench.read(submitted)
    records.records = [replace(r, relative=0.1 * r.relative) if r.mode == "budget" else r for r in records]
    found = bench.verify(records, solvers=["pgs"], isolate=False)
    assert {v.record.mode for v in found.disagreements} == {"budget"}


def test_what_was_left_out_is_missing(submitted):
    def told(keep):
        records = bench.read(submitted)
        records.records = [r for r in records if keep(r)]
        found = bench.verify(records, solvers=["pgs"], isolate=False)
        assert found.ok == (not found.missing) and str(found).count("MISSING: pgs on") == len(found.missing)
        return {
            (r.case, r.tol if r.mode == "tol" else r.max_iter) for r in found.missing if r.order == "given"
        }

    chain = CASES[1]
    assert told(lambda r: True) == set()
    assert told(lambda r: (r.case, r.max_iter) != (chain, 4)) == {(chain, 4)}
    assert told(lambda r: (r.case, r.tol) != (chain, 1e-20)) == {(chain, 1e-20)}
    assert told(lambda r: r.case != chain) == {(chain, 4), (chain, 16), (chain, 1e-3), (chain, 1e-20)}


def test_a_problem_that_differs_is_told_and_the_others_are_verified(tmp_path):
    mine, theirs = tmp_path / "mine", tmp_path / "theirs"
    for folder, second in ((theirs, 2.0), (mine, 2.5)):
        folder.mkdir()
        for name, x in (("one", 1.0), ("two", second), ("three", 3.0)):
            lv.Problem.lcp(np.diag([2.0, x]), [1.0, x]).save(folder / f"{name}.npz")
    (mine / "three.npz").unlink()
    path = tmp_path / "records.jsonl"
    files = [theirs / f"{name}.npz" for name in ("one", "two", "three")]
    bench.run(files, ["pgs"], PLAN, path, isolate=False)
    before = path.read_bytes()
    done = CliRunner().invoke(cli, ["check", str(path), str(mine)])
    assert done.exit_code == 1
    told = " ".join(done.output.split())
    assert "NOT VERIFIED: two: another problem here, hash " in told
    assert "NOT VERIFIED: three: no such problem here; name its file, folder or case of the suite" in told
    found = bench.verify(bench.read(path), [mine], isolate=False)
    assert {v.record.case for v in found.lines if v.agrees} == {"one"}
    assert {v.record.case for v in found.lines if v.agrees is None} == {"two", "three"}
    assert len(found.lines) == len(bench.read(path))  # none is lost
    assert path.read_bytes() == before


def test_what_cannot_be_verified_is_an_error_or_a_note(submitted, tmp_path):
    empty = tmp_path / "records.jsonl"
    empty.write_text("")
    with pytest.raises(lv.InputError, match="no measurement to verify"):
        bench.verify(bench.read(empty))
    with pytest.raises(lv.InputError, match=r"no records of osqp; it has .*pgs"):
        bench.verify(bench.read(submitted), solvers=["osqp"])
    told = CliRunner().invoke(cli, ["check", str(submitted), "--tol", "1e-3"])
    assert isinstance(told.exception, lv.InputError) or told.exit_code == 2
    records = bench.read(submitted)
    first = records.records[0].solver
    records.records = [replace(r, solver="of_another_world") if r.solver == first else r for r in records]
    found = bench.verify(records)
    assert not found.ok and not found.disagreements and any(v.agrees for v in found.lines)
    assert "NOT VERIFIED: of_another_world\n" in str(found)
    others = {v.note for v in found.lines if v.record.solver == "of_another_world"}
    assert others == {"of_another_world: not registered here"}
    run = next(iter(records.runs.values()))
    records.runs[run.run] = replace(run, plan={"levels": [-1.0]})
    with pytest.raises(lv.InputError, match="level is -1"):
        bench.verify(records)
