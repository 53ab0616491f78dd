"""Hostile inputs keep the promises of docs/trust.md; the checks themselves see false claims and hangs."""

import json
import os
import signal
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


# -- the watchdog ------------------------------------------------------------------------------------------------


HANGING = """
import sys
sys.path[:0] = {paths!r}
import checks
checks.watch({{"kind": "solve"}}, {path!r}, 0)
while True:
    pass
"""


def test_a_hang_ends_the_process_and_leaves_its_input(tmp_path):
    paths, path = [str(FUZZ), str(FUZZ.parent), str(FUZZ.parent.parent)], tmp_path / "input.json"
    done = python("-c", HANGING.format(paths=paths, path=str(path)), status=-signal.SIGXCPU)
    assert json.loads(path.read_text()) == {"kind": "solve"}
    assert "most recent call first" in done.stderr


# -- inputs by Hypothesis ----------------------------------------------------------------------------------------


# Some seconds each. Of folders, which take a second each, there is one of everything in found.jsonl.
EXAMPLES = {"solve": 150, "file": 150, "steps": 60, "snapshot": 60, "door": 60, "promise": 60}
WATCHED = os.environ.get("LAVENDER_FUZZ_INPUT")  # .ci/fuzz: the file for the input that is being checked
LIMIT = float(os.environ.get("LAVENDER_FUZZ_LIMIT", "20"))  # s of processor time on one input
if WATCHED:
    EXAMPLES = {**{kind: 5 * count for kind, count in EXAMPLES.items()}, "folder": 60}


@pytest.mark.parametrize("kind", EXAMPLES)
def test_drawn_by_hypothesis_every_promise_holds(kind):
    @settings(max_examples=EXAMPLES[kind], suppress_health_check=list(HealthCheck))
    @given(spec=checks.INPUTS[kind])
    def holds(spec):
        spec = plain(spec)
        if WATCHED:
            checks.watch(spec, WATCHED, LIMIT)
        assert checks.run(spec) == []

    refused = checks.COUNTS["refused"]
    holds()
    if kind not in ("file", "snapshot"):  # of those that are damaged most are refused
        refused = checks.COUNTS["refused"] - refused
        assert refused < 0.95 * EXAMPLES[kind], "nearly every input was refused: nothing is tested"


# -- what was found ---------------------------------------------------------------------------------------------


KEPT = [json.loads(line) for line in (FUZZ / "found.jsonl").read_text(encoding="utf-8").splitlines()]


@pytest.mark.parametrize("kept", KEPT, ids=[kept["name"] for kept in KEPT])
def test_what_was_found_stays_mended(kept):
    assert checks.run(kept["spec"]) == []
