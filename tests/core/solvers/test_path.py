"""Length of the path of one solve, in Python frames and files of the package."""

import os
import sys

import numpy as np
import pytest

import lavender as lv

ROOT = os.path.dirname(lv.__file__)
MAX_FILES = 10


def make_problem():
    return lv.Problem.lcp(np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([1.0, -1.0]))


def record_frames(problem, name, **arguments):
    """Return (file, function) of each Python frame of the package in one solve."""
    frames = []

    def record(frame, event, _):
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(ROOT):
            frames.append((os.path.relpath(code.co_filename, ROOT), code.co_name))

    before = sys.getprofile()
    sys.setprofile(record)
    try:
        lv.solve(problem, name, **arguments)
    finally:
        sys.setprofile(before)
    return frames


# A first solve of `pgs` took 109 frames in 20 files, of `newton` 143 in 22, before both used one sequence.
@pytest.mark.parametrize(("name", "most"), [("pgs", 45), ("newton", 60), ("auto", 30)])
def test_solve_of_new_problem_stays_within_budget_of_frames_and_files(name, most):
    lv.solve(make_problem(), name)  # Import what is imported at the first use.
    frames = record_frames(make_problem(), name)
    files = {file for file, _ in frames}
    assert len(frames) <= most, frames
    assert len(files) <= MAX_FILES, sorted(files)


@pytest.mark.parametrize("name", ["pgs", "newton", "auto"])
def test_solve_without_limit_runs_no_code_of_deadlines(name):
    lv.solve(make_problem(), name)
    late_files = {os.path.join("base", "deadline.py"), os.path.join("solving", "limits.py")}
    without = {file for file, _ in record_frames(make_problem(), name)}
    with_limit = {file for file, _ in record_frames(make_problem(), name, time_limit=60.0)}
    assert not without & late_files
    assert with_limit & late_files  # The names of these files are right.


@pytest.mark.parametrize("name", ["pgs", "newton"])
def test_solve_of_new_problem_computes_each_check_and_array_once(name):
    lv.solve(make_problem(), name)
    calls = [function for _, function in record_frames(make_problem(), name)]
    once = ("check_accepted", "check_arguments", "get_zero_impulse_reference", "_compressed", "finish")
    assert {function: calls.count(function) for function in once} == dict.fromkeys(once, 1)
