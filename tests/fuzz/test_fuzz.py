"""The fuzzer sees what it is there to see: its judge, its watchdog, its findings; and what it found stays mended."""

import json
import sys
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from random_problems import random_lcp
from worked import python

import lavender as lv

FUZZ = Path(__file__).resolve().parent.parent / "fuzz"
sys.path.insert(0, str(FUZZ))

import checks
import crowds
import fuzz
import problems
from judge_twin import Problem, spec_of
from strategies import plain


@settings(max_examples=15, suppress_health_check=list(HealthCheck))
@given(parts=st.lists(problems.parts(6), min_size=1, max_size=12), seed=st.integers(0, 2**32))
def test_a_crowd_is_its_parts_side_by_side(parts, seed):
    parts = [part for part in parts if problems.kind_of(part) == problems.kind_of(parts[0])]
    try:
        built = [problems.build(part) for part in parts]
        crowd = problems.build(crowds.joined(parts, np.random.default_rng(seed)))
    except lv.LavenderError:
        return  # one of them is refused
    assert crowd.m == sum(p.m for p in built)
    assert sorted(crowd.b) == sorted(np.concatenate([p.b for p in built]))
    if crowd.rows is not None:  # bodies of several parts meet nowhere, and every joint has its rows
        assert crowd.csr.nnz == sum(p.csr.nnz for p in built)
    if crowd.generalized is None:  # of J and M, sums in another order
        diagonal = np.concatenate([p.csr.diagonal() for p in built])  # a body of infinite numbers has NaN
        np.testing.assert_array_equal(np.sort(crowd.csr.diagonal()), np.sort(diagonal))
    assert crowd.n_blocks == sum(p.n_blocks for p in built)


# -- the judge in long double ------------------------------------------------------------------------------------


def test_the_judge_sees_a_false_claim():
    problem = random_lcp(3)
    spec = {"problem": spec_of(problem), "solver": "direct", "options": {"tol": 1e-9}, "again": False}
    good = lv.solve(problem, "direct", tol=1e-9)
    assert list(checks.claims(spec, problem, good)) == []

    def changed(**fields):
        made = object.__new__(lv.Solution)
        object.__setattr__(made, "__dict__", {**good.__dict__, **fields})
        return made

    off = good.impulse * (1.0 + 1e-6)
    assert any(what == "false claim" for what, _ in checks.claims(spec, problem, changed(impulse=off)))
    lost = changed(impulse=np.full(problem.m, np.nan))
    assert any(what == "false claim" for what, _ in checks.claims(spec, problem, lost))
    proof = changed(status=lv.Status.INFEASIBLE, certificate=np.ones(problem.m))
    details = [detail for what, detail in checks.claims(spec, problem, proof) if what == "false claim"]
    assert any("INFEASIBLE and success" in d for d in details)
    assert any("INFEASIBLE, " in d for d in details)
    assert any(what == "overrun" for what, _ in checks.claims(spec, problem, changed(iterations=10**9)))


def test_a_certificate_that_proves_is_taken():
    problem = lv.Problem.lcp(-np.eye(2), [1.0, 1.0])
    twin = Problem(spec_of(problem))
    assert twin.refutes(np.array([1.0, 0.0])) is None
    assert twin.refutes(np.array([-1.0, 0.0])) is not None
    assert Problem(spec_of(lv.Problem.lcp(np.eye(2), [1.0, 1.0]))).refutes(np.ones(2)) is not None


# -- the harness -------------------------------------------------------------------------------------------------


BROKEN = """
import os, sys
sys.path[:0] = {paths!r}
import checks, fuzz
def broken(spec):
    if spec["tol"] == 1e-6:
        return ()
    with open({turns!r}, "a") as file:
        file.write("x")
        turn = file.tell()
    if turn == 1:
        os.abort()
    while turn == 2:
        pass
    raise ZeroDivisionError("in a kernel")
checks.CHECKS["promise"] = broken
sys.argv[0] = "fuzz.py"
sys.exit(fuzz.main())
"""


def test_crashes_hangs_and_raw_exceptions_are_found_and_kept(tmp_path, monkeypatch):
    script = tmp_path / "broken.py"
    paths = [str(FUZZ), str(FUZZ.parent), str(FUZZ.parent.parent)]
    script.write_text(BROKEN.format(paths=paths, turns=str(tmp_path / "turns")))
    monkeypatch.setenv("LAVENDER_FUZZ_FOUND", str(tmp_path / "found.jsonl"))
    monkeypatch.setenv("LAVENDER_FUZZ_SCRIPT", str(script))
    done = python(script, "30", "--seed", "1", "--kinds", "promise", "--most", "12", "--limit", "1", status=1)
    assert (tmp_path / "found.jsonl").exists(), done.stdout + done.stderr
    found = [json.loads(line) for line in (tmp_path / "found.jsonl").read_text().splitlines()]
    assert {finding["name"].split("-")[1] for finding in found} == {"crash", "hang", "raw"}
    assert all(finding["spec"]["tol"] != 1e-6 for finding in found)


# -- what the fuzzer draws for hours, for some seconds --------------------------------------------------------------


# Some seconds each. Of folders, which take a second each, there is one of everything in found.jsonl.
EXAMPLES = {"solve": 150, "file": 150, "steps": 60, "snapshot": 60, "door": 60, "promise": 60}


@pytest.mark.parametrize("kind", EXAMPLES)
def test_drawn_by_hypothesis_every_promise_holds(kind):
    @settings(max_examples=EXAMPLES[kind], suppress_health_check=list(HealthCheck))
    @given(spec=checks.INPUTS[kind])
    def holds(spec):
        assert checks.run(plain(spec)) == []

    refused = checks.COUNTS["refused"]
    holds()
    if kind not in ("file", "snapshot"):  # of those that are damaged most are refused
        refused = checks.COUNTS["refused"] - refused
        assert refused < 0.95 * EXAMPLES[kind], "nearly every input was refused: nothing is tested"


# -- what was found ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "line"), fuzz.kept().items(), ids=fuzz.kept())
def test_what_was_found_stays_mended(name, line):
    assert checks.run(json.loads(line)["spec"]) == [], name
