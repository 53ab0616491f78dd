"""A worker outlives the backends that mean it harm, and believes none of them."""

import json
import os
import pickle
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from stacks import stack

import lavender as lv
from lavender import registry, report
from lavender.base.subprocesses import unpack_answer
from lavender.report import cases, machine, runner, timing
from lavender.report import workers as worker_module
from lavender.report.timing import Task
from lavender.report.workers import DIED_MESSAGE, Worker, parse_outcome

POSIX = pytest.mark.skipif(os.name != "posix", reason="processes and file names of POSIX")
BACKENDS = """
import json, os, pickle, signal, struct, sys, time
import numpy as np
import lavender as lv

class Backend:
    def __init__(self, what): self.what = what
    def prepare(self, problem): return problem
    def update(self, state, problem): return problem
    def run(self, state, impulse, n, tol, time_limit=None):
        note = os.environ.get("FAKE_NOTE", "")
        if self.what == "hang":
            while True: time.sleep(1)
        if self.what == "segfault": os.kill(os.getpid(), signal.SIGSEGV)
        if self.what == "leave": os._exit(3)
        if self.what == "talk":
            print("noise" * 10000, flush=True); os.write(1, b"more noise"); print("noise", file=sys.stderr)
            impulse[:] = state.b / state.matrix.diagonal()
        if self.what == "fork":
            child = os.fork()
            if child:
                open(note, "w").write(f"{os.getpid()} {child}")
            while True: time.sleep(1)
        if self.what == "escape":
            if os.fork() == 0:
                os.setsid()
                open(note, "w").write(str(os.getpid()))
                time.sleep(600)
                os._exit(0)
            while True: time.sleep(1)
        if self.what == "eat": self.all = [np.empty(4 * 10**7) for _ in range(1000)]
        if self.what == "forge":
            class Trap:
                def __reduce__(self): return os.system, (f"touch {note}",)
            data = pickle.dumps(Trap())
            frames = [struct.pack("<Q", len(data)) + data, struct.pack("<QQ", len(data), 0) + data]
            for fd in range(3, 20):
                for frame in frames:
                    try: os.write(fd, frame)
                    except OSError: pass
        if self.what == "flood":
            for fd in range(3, 20):
                try: os.write(fd, struct.pack("<QQ", 2**60, 2**60) + b"x" * 1000)
                except OSError: pass
        if self.what == "quit": raise KeyboardInterrupt
        if self.what == "lie":
            import ctypes  # read-only or not: the problem that it holds is its own, and convinces nobody
            ctypes.memset(state.b.ctypes.data, 0, 8 * state.m)
            impulse[:] = 0.0
        return lv.Claim(lv.Status.CONVERGED, 1, {"calls": 1}, str(os.getpid()))

def make(what):
    def factory(): return Backend(what)
    return factory

for n in NAMES:
    globals()[n] = make(n)
    # As a name with what it requires, or as docs/plugin.md has it.
    how = ("hostile_backends:" + n, ("hostile_backends",)) if n in NAMES[::2] else (globals()[n], ())
    globals()[n.upper()] = lv.SolverSpec("x_" + n, how[0], laws={"linear", "lcp"}, summary="test",
                                         resumable=False, requires=how[1])
"""


HARM = ("hang", "segfault", "leave", "talk", "fork", "escape", "eat", "forge", "flood", "lie", "quit")


@pytest.fixture
def hostile(tmp_path, monkeypatch):
    """Backends of a plug-in that mean harm, and the file where they note what they did."""
    folder = tmp_path / "site"
    info = folder / "hostile_backends-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / "hostile_backends.py").write_text(f"NAMES = {HARM}\n{BACKENDS}")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: hostile-backends\nVersion: 1.0\n")
    points = [f"x_{n} = hostile_backends:{n.upper()}" for n in HARM]
    (info / "entry_points.txt").write_text("[lavender.solvers]\n" + "\n".join(points) + "\n")
    monkeypatch.setattr(registry, "registered", dict(registry.specs()))
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("FAKE_NOTE", str(tmp_path / "note"))
    registry.register_all_solvers.cache_clear()
    yield tmp_path / "note"
    registry.register_all_solvers.cache_clear()


@pytest.fixture
def watchdog():
    """An exception after ten minutes, where something waits for ever."""

    def bark(*_):
        raise TimeoutError("it hangs")

    before = signal.signal(signal.SIGALRM, bark)
    signal.alarm(600)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def task(problem, solver, time_limit=100.0, **more):
    # Minutes, for machines that are busy with something else; what hangs asks for less.
    sha = cases.hash_problem(problem)
    return Task("run", "case", sha, solver, "tol", 1e-6, 0, time_limit, **more)


def wait_until(true):
    """Whether it comes true, soon or on a busy machine some time later."""
    until = time.monotonic() + 600.0
    while time.monotonic() < until:
        if true():
            return True
        time.sleep(0.02)
    return bool(true())


def runs(pid):
    """A process that is more than a number that nobody has fetched."""
    try:
        with open(f"/proc/{pid}/stat") as f:
            return f.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


PROC = pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="processes are seen in Linux's /proc")


@pytest.mark.slow
@PROC
@pytest.mark.parametrize("how", ["fork", pytest.param("escape", marks=pytest.mark.nightly)])
def test_worker_with_a_backend_that_forks_and_hangs_is_killed_at_its_limit(hostile, watchdog, monkeypatch, how):
    """Its child ends with it, or has left the group and keeps the pipe; `watchdog` ends a test that waits."""
    monkeypatch.setattr(worker_module, "GRACE_TIME", 0.5)
    p = stack()
    with Worker() as worker:
        worker.measure_task(p, task(p, "pgs"))  # starts the process
        assert worker.measure_task(p, task(p, f"x_{how}", time_limit=1.5))[0]["status"] == "KILLED"
        pids = list(map(int, hostile.read_text().split()))
        assert how == "escape" or (len(pids) == 2 and wait_until(lambda: not any(map(runs, pids))))
        assert worker.measure_task(p, task(p, "pgs"))[0]["status"] == "CONVERGED"  # and another worker goes on
    if how == "escape":
        os.kill(pids[0], signal.SIGKILL)


HANGS = """
import sys
from lavender import report
from lavender.report.workers import Worker
sys.path[:0] = [sys.argv[1]]
from test_hostile_backends import stack, task
p = stack()
Worker().measure_task(p, task(p, "x_fork", time_limit=600.0))
"""


def test_worker_record_of_an_exception_has_its_type_and_text(hostile, watchdog):
    p = stack()
    with Worker() as worker:
        record, _ = worker.measure_task(p, task(p, "x_quit"))
        assert (record["status"], record["message"]) == ("ERROR", "KeyboardInterrupt")
        record, _ = worker.measure_task(p, task(p, "direct", options={"nonsense": 1}))
    assert record["status"] == "ERROR" and record["message"].startswith("UnknownName: unknown option 'nonsense'")


@pytest.mark.slow
@PROC
def test_a_worker_ends_when_its_parent_is_killed(hostile):
    root = os.path.dirname(__file__)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([root, *filter(None, sys.path)])}
    parent = subprocess.Popen([sys.executable, "-c", HANGS, root], env=environment)
    assert wait_until(lambda: hostile.exists() and len(hostile.read_text().split()) == 2)
    pids = list(map(int, hostile.read_text().split()))
    assert all(map(runs, pids))
    parent.kill()
    parent.wait()
    assert wait_until(lambda: not any(map(runs, pids)))


def test_report_run_with_harmful_backends_records_each_crash(hostile, watchdog, monkeypatch):
    monkeypatch.setattr("lavender.report.workers.GRACE_TIME", 0.5)
    plan = report.Plan(tolerances=(1e-3,), budgets=(), repeats=1, time_limit=1.0)  # a hundred times what they take
    runs = report.select_runs(report.run([stack(4)], ["x_talk", "x_hang", "x_segfault", "x_leave", "pgs"], plan))
    died = ["KILLED", "CRASHED (SIGSEGV)", "CRASHED (exit status 3)"]
    assert list(runs["status"]) == ["CONVERGED", *died, "CONVERGED"]
    # Its diagonal step does not solve a stack, and it says so.
    assert runs["claim_check"][0] == "contradicted" and int(runs["message"][0]) != os.getpid()


def test_cross_check_with_solvers_that_end_the_process_reports_their_crash(hostile, watchdog, monkeypatch):
    died = ["CRASHED (exit status 3)", "CRASHED (SIGSEGV)", "CONVERGED"]
    table = lv.cross_check(stack(4), ["x_leave", "x_segfault", "pgs"], "x_leave")
    assert [row.status for row in table] == died
    assert table["x_leave"].note == DIED_MESSAGE and table.reference_note.endswith(
        f"(x_leave: TaskFailed: {died[0]}: {DIED_MESSAGE})"
    )
    monkeypatch.setattr("lavender.report.workers.GRACE_TIME", 0.5)
    (row,) = lv.cross_check(stack(4), "x_hang", time_limit=0.1)
    assert row.status == "KILLED"


def test_command_with_a_solver_that_ends_the_process_reports_its_crash(hostile, tmp_path, capsys):
    cli = pytest.importorskip("lavender.cli", reason="the floor above is not here")
    stack(4).save(tmp_path / "stack.npz")
    with pytest.raises(SystemExit) as end:
        cli.main(["solve", str(tmp_path / "stack.npz"), "--solver", "x_leave"])
    assert end.value.code == cli.EXIT_UNMET and "CRASHED (exit status 3)" in capsys.readouterr().err
    with pytest.raises(SystemExit) as end:
        cli.main(["check", str(tmp_path / "stack.npz"), "--solvers", "x_leave,pgs"])
    assert end.value.code == cli.EXIT_UNMET and "CRASHED (exit status 3)" in capsys.readouterr().out


def test_worker_limits_memory_by_default(hostile, watchdog):
    p = stack()
    with Worker() as worker:  # 320 GB, untouched: nothing but a limit refuses it
        record, _ = worker.measure_task(p, task(p, "x_eat"))
    assert record["status"] in ("ERROR", "NUMERICAL_ERROR")
    assert "MemoryError" in record["message"]
    assert worker.memory == machine.get_memory_per_process() == max(2**31, machine.get_total_memory() // 2)
    assert machine.get_memory_per_process(10**9) == 2**31


@POSIX
@pytest.mark.parametrize("how", ["forge", "flood"])
def test_worker_reads_forged_pipe_data_as_a_crash(hostile, watchdog, monkeypatch, how):
    monkeypatch.setattr(worker_module, "GRACE_TIME", 1.0)
    p = stack()
    with Worker() as worker:
        record, _ = worker.measure_task(p, task(p, f"x_{how}"))
        assert record["status"] in ("CRASHED (no answer)", "KILLED")
        assert worker.measure_task(p, task(p, "pgs"))[0]["status"] == "CONVERGED"
    assert not hostile.exists()


def test_worker_measures_the_numbers_of_this_process_and_judges_an_unchanged_problem(hostile, watchdog):
    p = stack()
    start = np.linspace(0.0, 1.0, p.m)
    with Worker() as worker:
        record, _ = worker.measure_task(p, task(p, "x_lie"))
        assert record["relative"] == lv.residual(p, np.zeros(p.m)).relative == 1.0
        assert "says CONVERGED" in record["status_conflict"]
        for solver, more in (("pgs", {}), ("direct", {}), ("pgs", {"start": "carried"})):
            asked = task(p, solver, **more)
            far, there = worker.measure_task(p, asked, start)
            near, here = timing.measure_task(p, asked, start)
            np.testing.assert_array_equal(here, there)
            assert str(runner.remove_times(far, 1.0)) == str(runner.remove_times(near, 1.0))


@pytest.mark.parametrize(
    "said",
    [
        {}, {"status": "GREAT"}, {"iterations": -1}, {"iterations": True}, {"work": {"sweeps": "many"}}, {"message": 3},
        {"setup_time": -1.0}, {"solve_time": 1e9}, {"solve_time": float("nan")}, {"times": []}, {"times": [0.6, 0.6]},
        {"times": [1e9]}, {"times": [float("nan")]}, {"times": None}, {"calibration_time": "fast"}, {"sizes": [4, 4]},
        {"sizes": [2, 2]}, {"sizes": [None, 4]}, {"sizes": [4]}, {"sizes": 4},
    ],
)  # fmt: skip
def test_parse_outcome_of_an_invalid_answer_raises(said):
    good = {
        "status": "CONVERGED", "iterations": 3, "work": {"sweeps": 3}, "message": "", "form": "",
        "setup_time": 0.01, "solve_time": 0.02, "times": [0.04], "calibration_time": 1e-4, "status_conflict": "",
        "sizes": [4, None],
    }  # fmt: skip
    numbers = np.ones(4).tobytes()
    assert parse_outcome(*unpack_answer(json.dumps(good).encode(), numbers), 4, 1.0)["iterations"] == 3
    wrong = {} if not said else good | said
    with pytest.raises(ValueError, match=r".+"):
        parse_outcome(*unpack_answer(json.dumps(wrong).encode(), numbers), 4, 1.0)
    with pytest.raises(ValueError, match=r".+"):
        unpack_answer(pickle.dumps(good), numbers)
