"""A report survives what it finds: names, records, backends and other reports that mean it harm."""

import contextlib
import dataclasses
import io as text_io
import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

import lavender as lv
from lavender import bench, cli, io, registry, report
from lavender.bench import cases as bench_cases
from lavender.bench import machine
from lavender.bench.line import c_of, code_of
from lavender.bench.lock import Lock
from lavender.bench.record import KINDS, file_name, printable, to_json
from lavender.bench.running import timing
from lavender.bench.running.worker import Worker, outcome_in
from lavender.report.terminal import print_report

POSIX = pytest.mark.skipif(os.name != "posix", reason="processes and file names of POSIX")
QUICK = ("--solvers", "pgs", "--levels", "1e-3", "--budgets", "4", "--repeats", "1", "--orders", "reverse")


def stack(n=6, **more):
    a = np.diag(np.full(n, 2.0)) - np.diag(np.ones(n - 1), 1) - np.diag(np.ones(n - 1), -1)
    return lv.Problem.lcp(a, np.linspace(1.0, -0.2, n), **more)


@pytest.fixture
def lavender(capsys, tmp_path, monkeypatch):
    """`lavender ARGS` in an empty folder: (exit status, standard output, standard error)."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        with pytest.raises(SystemExit) as exit_:
            cli.main(list(map(str, words)))
        out, err = capsys.readouterr()
        return exit_.value.code, out, err

    return run


# -- names ----------------------------------------------------------------------------------------

NAMES = {
    "markup of a terminal": b"[x][bold]{y}[.npz",
    "not UTF-8": b"caf\xe9\xff.npz",
    "a superscript": "²1.npz".encode(),
    "a formula": rb"a$\frac$b.npz",
    "an open formula": b"a$b.npz",
    "a hidden label": b"_hidden.npz",
    "HTML": b"<img src=x onerror=alert(1)>.npz",
    "lines": b"two\nlines\r\x1b[31m.npz",
    "turned round": "\u202egnp.npz".encode(),
    "Markdown": b"a|b`c`[d](e)*f*.npz",
    "long": b"n" * 200 + b".npz",
}


@POSIX
def test_files_of_any_name_are_reported(lavender, tmp_path):
    folder = tmp_path / "problems"
    folder.mkdir()
    for name in NAMES.values():
        io.save(stack(names=[f"[/row]{i}" for i in range(6)]), tmp_path / "plain.npz")
        with contextlib.suppress(OSError):  # a file system that takes no such name has none to report
            os.rename(tmp_path / "plain.npz", os.path.join(os.fsencode(folder), name))
    assert os.listdir(folder)
    for _ in range(2):  # measured, and read again
        code, out, err = lavender("report", folder, "--out", "out", *QUICK)
        assert (code, err.strip()) == (0, "")
        assert "Traceback" not in out
        out.encode("utf-8")
        assert "\x1b" not in out
        assert len(list((tmp_path / "out" / "figures").glob("work-precision*.png"))) == len(
            os.listdir(folder)
        )
        page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
        assert "<img src" not in page
        summary = (tmp_path / "out" / "summary.md").read_text(encoding="utf-8")
        assert "<img" not in summary
        rows = [line for line in summary.splitlines() if "| pgs |" in line]
        assert len(rows) >= len(os.listdir(folder))
        for row in rows:
            assert len([c for i, c in enumerate(row) if c == "|" and row[i - 1] != "\\"]) == 7, row
    code, out, err = lavender("report", "--campaign", folder, "--out", "many", *QUICK[:6], "--workers", 1)
    assert (code, err.strip()) == (0, "")


def test_an_archive_with_members_of_any_name_is_named(lavender, tmp_path):
    (tmp_path / "problems").mkdir()
    for i, member in enumerate(("[/x]", "a\nb", "\x1b[31m")):
        np.savez(tmp_path / "problems" / f"odd{i}.npz", **{member: np.ones(2)})
    io.save(stack(), tmp_path / "problems" / "good.npz")
    for _ in range(2):
        code, out, _ = lavender("report", "problems", *QUICK)
        assert code in (0, 1)
        assert "[/x]" in out
        assert "\x1b" not in out


@pytest.mark.parametrize("name", ["half \ud800 of a pair", "[/x]", "a$\\frac$b", "\x1b]0;title\x07"])
def test_names_within_a_file_are_shown_and_change_nothing(lavender, tmp_path, name):
    problem = stack(name=name, names=[f"{name} {i}" for i in range(6)])
    records = bench.run([problem], ["pgs"], bench.Plan(levels=(1e-3,), budgets=(4,), repeats=1))
    report.write(records, tmp_path / "out")
    shown = text_io.StringIO()
    from rich.console import Console

    print_report(records, Console(file=shown, width=140))
    assert printable(name)[:20] in shown.getvalue()


def test_what_cannot_be_shown_is_written_as_its_code():
    assert printable("a\udce9\ud800\n\x1b\u202eé²") == "a\\xe9\\ud800\\n\\x1b\\u202eé²"
    assert printable("a\nb\r", lines=True) == "a\nb\\r"


def test_long_names_that_differ_at_the_end_keep_files_of_their_own():
    names = ["n" * 300 + str(i) for i in range(3)]
    assert len({file_name(name) for name in names}) == 3
    items = bench.resolve([stack(name=n) for n in [*names, names[0], "x", "x", "x #2"]])
    assert len({file_name(item.name).lower() for item in items}) == len(items)


def test_what_a_reader_raises_costs_its_own_case(lavender, tmp_path, monkeypatch):
    for name in ("bad", "good"):
        io.save(stack(), tmp_path / f"{name}.npz")
    load = io.load

    def broken(path, **more):
        if "bad" in str(path):
            raise RecursionError("[/x]")
        return load(path, **more)

    monkeypatch.setattr(io, "load", broken)
    records = bench.run([tmp_path], ["pgs"], bench.Plan(levels=(1e-3,), budgets=(), repeats=1))
    assert {r.case for r in records} == {"good"}
    assert ["RecursionError: [/x]" in s.reason for s in records.skips] == [True]


@POSIX
def test_a_pipe_among_the_problems_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.npz")
    io.save(stack(), tmp_path / "good.npz")
    records = bench.run([tmp_path], ["pgs"], bench.Plan(levels=(1e-3,), budgets=(), repeats=1))
    assert {r.case for r in records} == {"good"}
    assert ["is no file" in s.reason for s in records.skips] == [True]
    os.mkfifo(tmp_path / "records.jsonl")
    with pytest.raises(lv.InputError, match="is no file"):
        bench.read(tmp_path)


def test_a_campaign_takes_files_and_folders(lavender, tmp_path):
    (tmp_path / "problems").mkdir()
    for name in ("x", "y"):
        io.save(stack(), tmp_path / "problems" / f"{name}.npz")
    io.save(stack(), tmp_path / "z.npz")
    more = (*QUICK[:6], "--workers", 1, "--seeds", "2")
    code, _, err = lavender("report", "--campaign", "problems/", "z.npz", "./z.npz", "random_spd(n=4)", *more)
    assert (code, err.strip()) == (0, "")
    cases = {r.case for r in bench.read("lavender-report")}
    assert cases == {"x", "y", "z", "z #2", "random_spd(n=4, seed=0)", "random_spd(n=4, seed=1)"}
    code, _, err = lavender("report", "--campaign", "nothing.npz", *more)
    assert code == 2
    assert "no such file" in err


# -- records --------------------------------------------------------------------------------------

HOSTILE = [
    None, True, -1, 2**70, 1e400, -1e300, float("nan"), "", "x", "inf", "[/x]", "\ud800", "a$\\frac$b", "<b>",
    [], [1], [[]], ["a", 2], ["\x1b"], {}, {"levels": 3}, {"levels": [0]}, {"levels": ["x"]}, {"a": {"b": 1}},
    {"x": 1.5},
]  # fmt: skip


@pytest.fixture(scope="module")
def lines():
    """The entries of a small report with a sequence, a skip and a campaign's mark."""
    plan = bench.Plan(levels=(1e-3,), budgets=(2, 4), repeats=1, orders=("reverse",))
    cases = [stack(name="one"), *bench.sequence([stack(), stack()], "walk")]
    records = bench.run(cases, ["pgs", "direct", "gauss_seidel"], plan)
    entries = [*records.runs.values(), *records.cases.values(), *records.skips, *records.records]
    done = bench.record.Done("r", "one", "pgs")
    return [to_json(e) for e in [*entries, done]]


def show_all(records, figure=True):
    """Everything that is made of records but the files of figures, in memory; `figure`: one by matplotlib, too."""
    from rich.console import Console

    from lavender.report.curves import figures
    from lavender.report.draw import matplotlib_figure
    from lavender.report.markdown import summary
    from lavender.report.page import page
    from lavender.report.style import looks

    print_report(records, Console(file=text_io.StringIO(), width=140), old=records)
    shown = records.latest()
    for record in shown.records:  # whichever is the fastest, and so shown, differs from run to run
        assert code_of(record)
        c_of(record)
    drawn = figures(shown)
    page(shown, drawn, old=shown).encode("utf-8")
    summary(shown).encode("utf-8")
    drawn = list(drawn) if figure else []
    return matplotlib_figure(drawn[0], looks({r.solver for r in records})) if drawn else None


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_records_of_any_content_are_shown_or_refused(tmp_path, lines, kind):
    """What a field takes is shown with what all others take at once: a page takes longer than a look at a file."""
    path, place = tmp_path / "records.jsonl", next(i for i, e in enumerate(lines) if e["kind"] == kind)

    def read(changes):
        changed = [{**e, **changes} if i == place else e for i, e in enumerate(lines)]
        path.write_text("".join(json.dumps(e) + "\n" for e in changed))
        try:
            return bench.read(path)
        except lv.InputError:
            return None

    names = [f.name for f in dataclasses.fields(KINDS[kind])]
    taken = {name: [value for value in HOSTILE if read({name: value}) is not None] for name in names}
    assert any(len(values) < len(HOSTILE) for values in taken.values())
    shown = 0
    for turn in range(max(map(len, taken.values()))):
        some = {name: values[turn % len(values)] for name, values in taken.items() if values}
        records = read(some)
        if records is not None:
            show_all(records, figure=shown % 8 == 0)
            shown += 1
    assert shown > 0


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000 + "\n",
        '{"kind": ' * 5000 + "\n",
        "1" * 5000 + "\n",
        '{"kind": ["run"]}\n',
        '{"kind": {}}\n',
        "null\n",
        '"run"\n',
        "\x00\x00\n",
        "\ufffe\n",
        '{"kind": "case"}\n',
        '{"kind": "done", "run": 1, "case": [], "solver": {}}\n',
    ],
)
def test_a_file_of_anything_is_an_input_error(tmp_path, text):
    (tmp_path / "records.jsonl").write_text(text)
    with pytest.raises(lv.InputError, match="line 1"):
        bench.read(tmp_path)


def test_a_record_of_a_case_that_nobody_described_is_refused(tmp_path, lines):
    kept = [e for e in lines if e["kind"] != "case"]
    (tmp_path / "records.jsonl").write_text("".join(json.dumps(e) + "\n" for e in kept))
    with pytest.raises(lv.InputError, match="record of a case that no line before it describes"):
        bench.read(tmp_path)


def test_the_newest_run_shows_its_own_cases_and_only_as_they_are_now(tmp_path, monkeypatch):
    plan = bench.Plan(levels=(1e-3,), budgets=(), repeats=1)
    path = tmp_path / "records.jsonl"
    bench.run([stack(name="a"), stack(name="b")], ["pgs"], plan, path)
    monkeypatch.setattr(machine, "cpu_name", lambda: "another")
    bench.run([stack(name="a")], ["pgs"], plan, path)
    monkeypatch.undo()
    bench.run([stack(8, name="b")], ["pgs"], plan, path)  # the first run again; b has changed
    newest = bench.read(path).latest()
    assert sorted((r.case, newest.cases[r.case].rows) for r in newest) == [("a", 6), ("b", 8)]
    show_all(newest)


# -- two reports in one folder --------------------------------------------------------------------

HOLD = """
import sys, time
from lavender import bench
store = bench.Store(sys.argv[1])
print("held", flush=True)
time.sleep(600)
"""


@pytest.fixture
def holder(tmp_path):
    """A process that writes the records of a folder."""
    path = tmp_path / "out" / "records.jsonl"
    process = subprocess.Popen([sys.executable, "-c", HOLD, path], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    yield process, path
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_second_report_in_a_folder_is_refused_and_names_the_first(lavender, tmp_path, holder):
    process, path = holder
    io.save(stack(), tmp_path / "a.npz")
    code, _, err = lavender("report", "a.npz", "--out", "out", *QUICK)
    assert code == 2
    assert f"process {process.pid} on {socket.gethostname()}" in err
    assert path.read_text() == ""
    process.kill()
    process.wait()
    code, _, err = lavender("report", "a.npz", "--out", "out", *QUICK)  # a dead holder holds nothing
    assert (code, err.strip()) == (0, "")
    assert not path.with_name("records.jsonl.lock").exists()


def test_a_lock_of_another_host_is_believed_and_one_process_locks_against_itself(tmp_path):
    path = tmp_path / "records.jsonl"
    lock = Lock(path)
    with pytest.raises(lv.InputError, match=f"process {os.getpid()} on"):
        bench.Store(path)
    with pytest.raises(lv.InputError):  # and the refusal took nothing away
        bench.Store(path)
    text = lock.path.read_bytes()
    lock.release()
    lock.release()
    lock.path.write_bytes(text.replace(socket.gethostname().encode(), b"elsewhere"))
    with pytest.raises(lv.InputError, match=f"process {os.getpid()} on elsewhere.*remove"):
        bench.Store(path)
    lock.path.write_bytes(b"torn")
    bench.Store(path).close()
    assert list(tmp_path.iterdir()) == [path]


# -- backends -------------------------------------------------------------------------------------

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
    globals()[n.upper()] = lv.SolverSpec("x_" + n, "hostile_backends:" + n, laws={"linear", "lcp"}, summary="test",
                                         resumable=False, requires=("hostile_backends",))
"""
HARM = ("hang", "segfault", "leave", "talk", "fork", "escape", "eat", "forge", "flood", "lie")


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
    registry.load.cache_clear()
    yield tmp_path / "note"
    registry.load.cache_clear()


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
    sha = bench_cases.fingerprint(problem)
    return bench.Task("run", "case", sha, solver, "tol", 1e-6, 0, time_limit, **more)


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


@PROC
def test_a_backend_that_forks_and_hangs_ends_with_its_child(hostile, watchdog):
    p = stack()
    with Worker(grace=0.5) as worker:
        assert worker.measure(p, task(p, "x_fork", time_limit=1.5)).status == "KILLED"
        pids = list(map(int, hostile.read_text().split()))
        assert len(pids) == 2
        assert wait_until(lambda: not any(map(runs, pids)))
        assert worker.measure(p, task(p, "pgs")).status == "CONVERGED"  # and another worker goes on


@PROC
def test_a_child_that_left_the_group_and_keeps_the_pipe_keeps_nobody_waiting(hostile, watchdog):
    p = stack()
    with Worker(grace=0.5) as worker:
        assert worker.measure(p, task(p, "x_escape", time_limit=1.5)).status == "KILLED"
        assert worker.measure(p, task(p, "pgs")).status == "CONVERGED"
    os.kill(int(hostile.read_text()), signal.SIGKILL)


HANGS = """
import sys
from lavender import bench
from lavender.bench.running.worker import Worker, outcome_in
sys.path[:0] = [sys.argv[1]]
from test_hostile_folder import stack, task
p = stack()
Worker().measure(p, task(p, "x_fork", time_limit=600.0))
"""


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


LONG = """
import sys, numpy as np, lavender as lv
from lavender import bench
def hard(i):
    a = np.kron(np.eye(200), [[1.0, -1.0], [-1.0, 1.0]]) + 1e-9 * np.eye(400)
    return lv.Problem.lcp(a, np.random.default_rng(i).standard_normal(400), name=f"hard {i}")
plan = bench.CampaignPlan(levels=(1e-9,), budgets=(), cap=10_000_000)
bench.campaign([hard(i) for i in range(4)], ["pgs"], plan, workers=2)
"""


def children(pid):
    try:
        with open(f"/proc/{pid}/task/{pid}/children") as f:
            found = list(map(int, f.read().split()))
    except FileNotFoundError:
        return []
    return [c for child in found for c in (child, *children(child))]


@pytest.mark.skipif(
    not os.path.exists(f"/proc/self/task/{os.getpid()}/children"), reason="children are seen in Linux's /proc"
)
def test_workers_of_a_campaign_end_when_it_is_killed():
    parent = subprocess.Popen([sys.executable, "-c", LONG], stderr=subprocess.DEVNULL)

    def busy():
        return [p for p in children(parent.pid) if cpu(p) > 1.5]

    def cpu(pid):
        with contextlib.suppress(OSError), open(f"/proc/{pid}/stat") as f:
            words = f.read().rpartition(")")[2].split()
            return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
        return 0.0

    assert wait_until(lambda: len(busy()) >= 1)
    family = children(parent.pid)
    parent.kill()
    parent.wait()
    assert wait_until(lambda: not any(map(runs, family)))


def test_a_whole_run_survives_its_backends(hostile, watchdog, monkeypatch):
    monkeypatch.setattr("lavender.bench.running.worker.GRACE", 0.5)
    plan = bench.Plan(levels=(1e-3,), budgets=(), repeats=1, time_limit=1.0)  # a hundred times what they take
    records = bench.run([stack(4)], ["x_talk", "x_hang", "x_segfault", "x_leave", "pgs"], plan)
    said = [r.status for r in records]
    assert said == ["CONVERGED", "KILLED", "CRASHED (SIGSEGV)", "CRASHED (exit status 3)", "CONVERGED"]
    assert records.records[0].contradicted  # its diagonal step does not solve a stack, and it says so
    assert int(records.records[0].message) != os.getpid()


def test_memory_is_limited_without_asking(hostile, watchdog):
    p = stack()
    with Worker() as worker:  # 320 GB, untouched: nothing but a limit refuses it
        record = worker.measure(p, task(p, "x_eat"))
    assert record.status in ("ERROR", "NUMERICAL_ERROR")
    assert "MemoryError" in record.message
    assert worker.memory == machine.memory_share() == max(2**31, machine.memory() // 2)
    assert machine.memory_share(10**9) == 2**31


@POSIX
@pytest.mark.parametrize("how", ["forge", "flood"])
def test_what_a_backend_writes_into_the_pipe_is_data_and_bounded(hostile, watchdog, how):
    p = stack()
    with Worker(grace=1.0) as worker:
        record = worker.measure(p, task(p, f"x_{how}"))
        assert record.status in ("CRASHED (no answer)", "KILLED")
        assert worker.measure(p, task(p, "pgs")).status == "CONVERGED"
    assert not hostile.exists()


def test_the_verdict_is_of_a_problem_that_the_backend_never_held(hostile, watchdog):
    p = stack()
    with Worker() as worker:
        record = worker.measure(p, task(p, "x_lie"))
    assert record.relative == lv.residual(p, np.zeros(p.m)).relative == 1.0
    assert "says CONVERGED" in record.contradicted


def test_what_a_worker_says_is_what_this_process_says():
    p = stack()
    start = np.linspace(0.0, 1.0, p.m)
    with Worker() as worker:
        for solver, more in (("pgs", {}), ("direct", {}), ("pgs", {"start": "carried"})):
            asked = task(p, solver, **more)
            far, there = worker.measure_impulse(p, asked, start)
            near, here = timing.measure_impulse(p, asked, start)
            np.testing.assert_array_equal(here, there)
            times = {n: 0.0 for n in vars(near) if n.startswith(("time_m", "setup_", "solve_", "pace"))}
            assert dataclasses.replace(far, **times) == dataclasses.replace(near, **times)


@pytest.mark.parametrize(
    "said",
    [
        {},
        {"status": "GREAT"},
        {"iterations": -1},
        {"iterations": True},
        {"work": {"sweeps": "many"}},
        {"message": 3},
        {"setups": []},
        {"setups": [0.0, 0.0]},
        {"solves": [1e9]},
        {"solves": [float("nan")]},
        {"times": [1e9]},
        {"times": None},
        {"pace": "fast"},
        {"certificate": True},
    ],
)
def test_an_answer_that_is_none_is_refused(said):
    good = {
        "status": "CONVERGED", "iterations": 3, "work": {"sweeps": 3}, "message": "", "form": "",
        "setups": [0.01], "solves": [0.02], "times": [0.04], "pace": 1e-4, "certificate": False,
    }  # fmt: skip
    numbers = np.ones(4).tobytes()
    assert outcome_in((json.dumps(good).encode(), numbers), 4, 1.0).iterations == 3
    wrong = {} if not said else good | said
    with pytest.raises(ValueError, match=r".+"):
        outcome_in((json.dumps(wrong).encode(), numbers), 4, 1.0)
    with pytest.raises(ValueError, match=r".+"):
        outcome_in((pickle.dumps(good), numbers), 4, 1.0)
