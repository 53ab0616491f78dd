"""The path of one solve: which files it runs, and what it computes once."""

import os
import sys

import numpy as np
import pytest

import lavender as lv

ROOT = os.path.dirname(lv.__file__)


def make_problem():
    return lv.Problem.lcp(np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([1.0, -1.0]))


def record_frames(problem, name, **arguments):
    """Return (file, function) of each Python frame of the package in one solve."""
    return record_frames_of(lambda: lv.solve(problem, name, **arguments))


def record_frames_of(call):
    """Return (file, function) of each Python frame of the package in a call."""
    frames = []

    def record(frame, event, _):
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(ROOT):
            frames.append((os.path.relpath(code.co_filename, ROOT), code.co_name))

    before = sys.getprofile()
    sys.setprofile(record)
    try:
        call()
    finally:
        sys.setprofile(before)
    return frames


@pytest.mark.parametrize("name", ["pgs", "newton", "auto"])
def test_solve_without_limit_runs_no_code_of_deadlines(name):
    lv.solve(make_problem(), name)
    late_files = {os.path.join("base", "deadline.py"), os.path.join("solving", "limits.py")}
    without = {file for file, _ in record_frames(make_problem(), name)}
    # The compiled call of `auto` reads no clock under a limit of at least 0.1 s.
    with_limit = {file for file, _ in record_frames(make_problem(), name, time_limit=0.09)}
    assert not without & late_files
    assert with_limit & late_files  # The names of these files are right.


@pytest.mark.parametrize("name", ["pgs", "newton"])
def test_solve_of_new_problem_computes_each_check_and_array_once(name):
    lv.solve(make_problem(), name)
    calls = [function for _, function in record_frames(make_problem(), name)]
    once = ("check_accepted", "check_arguments", "get_zero_impulse_reference", "_compressed", "finish")
    assert {function: calls.count(function) for function in once} == dict.fromkeys(once, 1)


def step_engine():
    scene = lv.Scene(solver="block_gauss_seidel")
    scene.add_plane()
    scene.add_box(position=(0.0, 0.0, 0.5))
    lv.Simulation(scene).step()


def solve_program():
    rows = np.array([[1.0, 1.0]])
    program = lv.Problem.from_qp(np.eye(2), np.array([-1.0, -1.0]), G=rows, h=np.array([1.0]))
    assert lv.solve_qp(program, "admm", tol=1e-6).found


# Each caller, with a solver that has no compiled call for the problem.
HOSTS = {
    "solve": lambda: lv.solve(make_problem(), "pgs"),
    "prepare": lambda: lv.prepare(make_problem(), "pgs").solve(),
    "solve_many": lambda: lv.solve_many([make_problem(), make_problem()], "pgs"),
    "solve_qp": solve_program,
    "engine": step_engine,
}


@pytest.mark.parametrize("host", HOSTS)
def test_host_solves_by_the_one_sequence_of_prepare_step_and_finish(host):
    files = [file for file, _ in record_frames_of(HOSTS[host])]
    sequence = [os.path.join("solving", name) for name in ("prepared.py", "loop.py", "finish.py")]
    first = [files.index(file) for file in sequence]
    assert first == sorted(first)
