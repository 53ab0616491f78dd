"""Invalid paths, files, folders and numbers at the commands: refused in words, and what stood there stays."""

import contextlib
import errno
import io as streams
import json
import os
import re
import signal
import stat
from ast import literal_eval
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from mujoco_scene import scene
from stacks import stack
from worked import python

import lavender as lv
from lavender import io, report
from lavender.io.stored import FOLDER_LOCK, lock_output, lock_step_folder, write_text
from lavender.report.findings import Report, print_report, render_report, summarise
from lavender.report.store import KINDS, Store, to_jsonable
from lavender.report.text import make_file_name
from lavender.report.timing import format_call
from lavender.sim.engine import run
from lavender.sim.engine.picture import Film

TEMPORARY_NAME = re.compile(r"\..*\.\d+\.\d+\.part(\.\w+)?")  # names of files that are not complete yet

resource = pytest.importorskip("resource", reason="limits, pipes and devices with names are of POSIX")
pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes and devices with names are of POSIX")

# -- every reader and every writer ----------------------------------------------------------------------------------

READERS = {
    "load npz": (".npz", lambda results, path: lv.load(path)),
    "load hdf5": (".hdf5", lambda results, path: lv.load(path)),
    "load solution": (".npz", lambda results, path: io.load_solution(path)),
    "load snapshot": (".snap", lambda results, path: lv.Snapshot.load(path)),
    "load state": (".snap", lambda results, path: lv.Simulation("stack").load(path)),
    "read records": (".jsonl", lambda results, path: report.read(path)),
}


@pytest.fixture(scope="module")
def results():
    """What is written: a problem, a film, a trace and a snapshot."""
    simulation = lv.Simulation("stack")
    return {
        "problem": lv.Problem.contact(np.eye(3), [1.0, 0.0, 0.0], 0.5),
        "film": Film(lv.Simulation(lv.Scene("stack", n=1))),
        "trace": run(simulation, 3),
        "state": simulation.snapshot(),
    }


WRITERS = {
    "npz": (".npz", lambda results, path: io.save(results["problem"], path)),
    "hdf5": (".hdf5", lambda results, path: io.save(results["problem"], path)),
    "film": (".gif", lambda results, path: results["film"].save(path)),
    "trace": (".csv", lambda results, path: results["trace"].save(path)),
    "figure": (".svg", lambda results, path: results["trace"].plot(path)),
    "snapshot": (".snap", lambda results, path: results["state"].save(path)),
    "records": (".jsonl", lambda results, path: Store(path).close()),
    "text": (".txt", lambda results, path: write_text(path, "abc")),
}
needs_hdf5 = pytest.mark.skipif(find_spec("h5py") is None, reason="FCLIB's files need h5py (extra: fclib)")


def each_of(table):
    """Parametrize a test by the suffix of a file and the call that reads or writes it."""
    cases = [pytest.param(*case, marks=[needs_hdf5] if "hdf5" in name else []) for name, case in table.items()]
    return pytest.mark.parametrize(("suffix", "call"), cases, ids=table)


each_reader, each_writer, each_call = each_of(READERS), each_of(WRITERS), each_of(READERS | WRITERS)
BEFORE = b"the content before"
SPECIAL = ("pipe", "folder", "device", "link to a pipe", "link to itself")


def make_special(kind, path):
    """Make something that is no regular file at `path`; return its mode, inode and device."""
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "link to a pipe":
        os.mkfifo(path.with_name("pipe"))
        path.symlink_to("pipe")
    elif kind == "link to itself":
        path.symlink_to(path.name)
    else:
        try:
            os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, 7))  # as /dev/full
        except PermissionError:
            pytest.skip("a device needs its privileges")
    return facts(path)


def facts(path):
    s = os.lstat(path)
    return s.st_mode, s.st_ino, s.st_rdev


@contextlib.contextmanager
def file_size_limit(size):
    """Limit the files of this process to so many bytes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.parametrize("kind", SPECIAL)
@each_call
def test_only_regular_files_are_read_or_replaced(kind, suffix, call, results, tmp_path):
    path = tmp_path / f"there{suffix}"
    before = make_special(kind, path)
    with pytest.raises(lv.InputError, match=str(path)):
        call(results, path)
    assert facts(path) == before
    assert {p.name for p in tmp_path.iterdir()} <= {path.name, "pipe"}


@each_call
def test_file_call_with_a_value_that_is_not_a_path_raises_and_writes_nothing(suffix, call, results, tmp_path):
    """A number is not the descriptor of an open file, which is neither read nor closed."""
    path = tmp_path / "p.npz"
    lv.Problem.lcp([[2.0]], [1.0]).save(path)
    wrong = [0, 1, True, None, 1.5, b"p.npz", open, path.open, ["p.npz"], f"a\0{suffix}", path / f"p{suffix}"]
    if suffix != ".jsonl":  # The folder of records is made.
        wrong.append(tmp_path / "missing" / f"p{suffix}")
    with open(path, "rb") as stream:
        for value in [*wrong, stream.fileno()]:
            with pytest.raises(lv.InputError, match=r"path is|NUL|cannot (read|write)"):
                call(results, value)
        assert stream.read(2) == b"PK"
    assert os.listdir(tmp_path) == ["p.npz"]


@each_reader
def test_file_of_ten_gigabytes_is_rejected_before_it_is_read(suffix, call, results, tmp_path):
    path = tmp_path / f"long{suffix}"
    with path.open("wb") as stream:
        stream.truncate(10**10)  # which takes no space
    message = "starts with" if suffix in (".npz", ".hdf5") else "10000000000 bytes"
    with pytest.raises(lv.InputError, match=message):
        call(results, path)


@each_writer
def test_write_through_a_link_replaces_its_target(suffix, call, results, tmp_path):
    (tmp_path / "far").mkdir()
    names = (f"far/target{suffix}", f"link{suffix}", f"second{suffix}")
    target, link, second = (tmp_path / name for name in names)
    link.symlink_to(target)
    second.symlink_to(f"link{suffix}")
    for _ in range(2):  # The links lead to nothing at first.
        call(results, second)
        assert link.is_symlink() and second.is_symlink()
        assert target.is_file() and not target.is_symlink()
        if suffix != ".jsonl":  # Records are added to the file.
            assert target.stat().st_size
            target.write_bytes(BEFORE)
    assert [p.name for p in (tmp_path / "far").iterdir()] == [target.name]


@each_writer
@pytest.mark.parametrize("is_renamed", [False, True], ids=["writing", "renaming"])
def test_write_on_a_full_disk_keeps_the_old_file(is_renamed, suffix, call, results, tmp_path, monkeypatch):
    if suffix == ".jsonl":
        pytest.skip("records are added to the file")
    path = tmp_path / f"there{suffix}"
    path.write_bytes(BEFORE)

    def raise_full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    if is_renamed:
        monkeypatch.setattr(os, "replace", raise_full)
    limit = contextlib.nullcontext() if is_renamed else file_size_limit(1)
    with limit, pytest.raises(lv.InputError, match=r"No space left|cannot write"):
        call(results, path)
    assert path.read_bytes() == BEFORE
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@needs_hdf5
@pytest.mark.parametrize("size", [1, 4096, 16384, 24576])
def test_a_full_disk_while_fclib_writes_is_an_error(tmp_path, size):
    """HDF5 itself ends the process by a signal if a write fails that is not its first."""
    path = tmp_path / "p.hdf5"
    lv.Problem.contact(np.eye(3), [1.0, 0.0, 0.0], 0.5).save(path)
    before = path.read_bytes()
    a = np.random.default_rng(0).normal(size=(60, 60))
    with file_size_limit(size), pytest.raises(lv.InputError, match="cannot write"):
        lv.Problem.contact(a @ a.T, np.ones(60), np.full(20, 0.5)).save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["p.hdf5"]


def test_a_full_disk_while_records_are_added_is_an_error_and_releases_the_file(tmp_path):
    path = tmp_path / "records.jsonl"
    with (
        Store(path) as store,
        file_size_limit(0),
        pytest.raises(lv.InputError, match=r"cannot write .* free disk space"),
    ):
        store.add({"kind": "skip", "run": "run", "case": "case", "solver": "pgs", "reason": "reason"})
    Store(path).close()
    assert list(tmp_path.iterdir()) == [path]


# -- writers that are killed, and writers of one path ----------------------------------------------------------------


WRITE_AND_DIE = """if True:
    import os, signal, sys
    from pathlib import Path
    from lavender.io.stored import write_atomically
    from lavender.sim.web import compile

    def write(part):
        Path(part).write_bytes(b"half")
        os.kill(os.getpid(), signal.SIGKILL)

    if sys.argv[1] == "module":
        Path.replace = lambda part, target: os.kill(os.getpid(), signal.SIGKILL)
        compile.write_atomically(Path("a.txt"), b"half")
    write_atomically("a.txt", write)"""


@pytest.mark.parametrize("kind", ["file", "module"])
def test_killed_writer_leaves_the_old_file_and_a_temporary_one(kind, tmp_path):
    (tmp_path / "a.txt").write_bytes(BEFORE)
    python("-c", WRITE_AND_DIE, kind, cwd=tmp_path, status=-signal.SIGKILL)
    assert (tmp_path / "a.txt").read_bytes() == BEFORE
    (part,) = (p for p in tmp_path.iterdir() if p.name != "a.txt")
    assert TEMPORARY_NAME.fullmatch(part.name)


def test_store_is_written_by_one_process_and_released_by_a_dead_one(tmp_path):
    path = tmp_path / "records.jsonl"
    with report.Store(path) as store:
        for _ in range(2):  # The first refusal releases nothing.
            with pytest.raises(lv.InputError, match="is being written by another command"):
                report.Store(path)
        other = python("-c", f"from lavender import report; report.Store({str(path)!r})", status=1)
        assert "is being written by another command" in other.stderr
        store.close()
        report.Store(path).close()
    killed = f"import os; from lavender import report; s = report.Store({str(path)!r}); os.kill(os.getpid(), 9)"
    python("-c", killed, status=-9)
    report.Store(path).close()
    assert list(tmp_path.iterdir()) == [path]


def test_folder_of_steps_is_written_by_one_recording_at_a_time(tmp_path):
    with lock_step_folder(tmp_path):
        for replace in (False, True):
            with pytest.raises(lv.InputError, match="is being written by another command"):
                run(lv.Simulation("stack"), 3, record=tmp_path, replace=replace)
        with pytest.raises(lv.InputError, match="is being written by another command"):
            lv.Simulation("stack").record(tmp_path, 3)
    holder = "import os, signal, lavender.io.stored as s; s.lock_step_folder('.').__enter__(); os.kill(os.getpid(), 9)"
    python("-c", holder, cwd=tmp_path, status=-signal.SIGKILL)
    simulation = lv.Simulation("stack")
    assert len(simulation.record(tmp_path, 2)) == 2
    assert len(simulation.record(tmp_path, 2)) == 2  # the next two steps
    with pytest.raises(lv.InputError, match="holds 4 problem files"):
        lv.Simulation("stack").record(tmp_path, 2)


# -- commands that write -----------------------------------------------------------------------------------------

QUICK = (
    "--solvers", "pgs", "--tolerances", "1e-3", "--budgets", "4", "--repeats", "1", "--orders", "reverse",
)  # fmt: skip


@pytest.fixture
def lavender(lavender, tmp_path, monkeypatch):
    """The command, in the folder of what it reads."""
    monkeypatch.chdir(tmp_path)
    return lavender


#: Each command that writes a folder, and its words.
WRITE_A_FOLDER = {
    "audit": ("audit", "MODEL", "--worlds", 1, "--steps", 1, "--out", "OUT"),
    "tune": ("tune", "MODEL", "--worlds", 1, "--steps", 1, "--out", "OUT"),
    "record": ("record", "MODEL", "--steps", 1, "--out", "OUT"),
    "report": ("report", "stack(n=2)", *QUICK, "--out", "OUT"),
    "records shown again": ("report", "records.jsonl", "--out", "OUT"),
    "report with workers": ("report", "--workers", "1", "stack(n=2)", *QUICK[:6], "--out", "OUT"),
    "run": ("run", "stack", "--steps", 1, "--record", "OUT"),
    "export": ("export", "c", "OUT"),
    "web": ("web", "page", "OUT"),
}


def words_of(name, folder):
    """Write what a command of WRITE_A_FOLDER reads; return its words, and the folder that it writes."""
    (folder / "model.xml").write_text(scene())
    (folder / "records.jsonl").touch()
    out = folder / "out"
    return [{"MODEL": folder / "model.xml", "OUT": out}.get(word, word) for word in WRITE_A_FOLDER[name]], out


@pytest.mark.parametrize("name", WRITE_A_FOLDER)
def test_a_folder_that_another_command_writes_is_refused_before_the_work(lavender, tmp_path, name):
    words, out = words_of(name, tmp_path)
    with lock_output(out, folder=True):
        before = list(out.iterdir())
        code, _, err = lavender(*words)
        assert code == 2 and "is being written by another command" in err
        assert list(out.iterdir()) == before
    assert not out.exists()  # It was made for the lock alone.


@pytest.mark.parametrize("name", ["report", "run", "export", "web"])
def test_a_folder_that_cannot_be_made_is_named(name, lavender, tmp_path, monkeypatch):
    """Some file systems refuse only when they are asked: /proc is writable to root, and makes nothing."""
    if name == "export":
        pytest.importorskip("Cython", reason="the export translates the kernels (extra: test)")
    words, out = words_of(name, tmp_path)
    make = Path.mkdir

    def mkdir(path, *more, **others):
        if path == out:
            raise OSError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
        make(path, *more, **others)

    monkeypatch.setattr(Path, "mkdir", mkdir)
    code, _, err = lavender(*words)
    why = f"cannot create the folder {out}: {os.strerror(errno.ENOENT)}; give another path"
    assert (code, err.splitlines()[-1]) == (2, f"lavender: {why}")


COMMANDS = [
    ("report", "stack(n=2)", "--solvers", "sequential_impulses", "--tolerances", "1e-3", "--budgets", "4",
     "--repeats", "1", "--out", "report"),
    ("run", "stack", "--steps", "3", "--record", "steps", "--trace", "t.csv", "--plot", "t.svg", "--film", "t.gif"),
    ("solve", "stack(n=2)", "--output", "solution.npz"),
    ("export", "c", "c"),
    ("web", "page", "page"),
]  # fmt: skip


def test_every_command_writes_files_under_temporary_names_first(tmp_path):
    """A reader, a full disk or a signal finds the old file or the new one; records are added to their file."""
    pytest.importorskip("Cython", reason="the export translates the kernels (extra: test)")
    script = """if True:
        import os, sys
        from lavender import cli
        from lavender.sim.web import pages
        pages.get_or_build_module = lambda say, name: b"a module"
        here, opened = os.getcwd(), set()

        def watch(event, given):
            if event == "open" and isinstance(given[0], (str, os.PathLike)) and given[2] & (os.O_WRONLY | os.O_RDWR):
                path = os.path.abspath(given[0])
                temporary = os.path.isdir(path) or ".part" in os.path.basename(path)
                if path.startswith(here) and not temporary:
                    opened.add(os.path.relpath(path, here))

        sys.addaudithook(watch)
        for words in COMMANDS:
            try:
                cli.main(list(words))
            except SystemExit as end:
                assert not end.code, (words, end.code)
        print("OPENED", sorted(opened))"""
    done = python("-c", script.replace("COMMANDS", repr(COMMANDS)), cwd=tmp_path)
    files = {p.relative_to(tmp_path).parts[0] for p in tmp_path.rglob("*") if p.is_file()}
    assert files >= {"report", "steps", "t.csv", "t.gif", "c", "page"}
    locks = [f"{name}/{FOLDER_LOCK}" for name in ("c", "page", "report", "steps")]
    assert literal_eval(done.stdout.splitlines()[-1].removeprefix("OPENED ")) == sorted(
        [*locks, "report/records.jsonl", "report/records.jsonl.lock"]
    )


def check_command(code, text, statuses=(0, 1, 2, 3)):
    """Require a documented status, with a message if it is 2, no traceback and no code of the terminal."""
    assert code in statuses, text
    assert "Traceback (most recent call last)" not in text
    assert "\x1b" not in text
    assert code != 2 or text.strip()


# -- folders that a report or a check reads ----------------------------------------------------------------------

HTML = "<img src=x onerror=alert(1)>"


@pytest.mark.parametrize("command", ["report", "check"])
def test_command_on_a_folder_of_hostile_names_escapes_them_and_reads_the_rest(lavender, tmp_path, command):
    folder = tmp_path / "problems"
    folder.mkdir()
    hostile = lv.Problem.lcp(
        np.eye(2), [1.0, 1.0], names=["[/x]", "<script>alert(1)</script>"], name=f"[bold]{HTML}\ud800"
    )
    for name in (
        f"[b]{HTML}|`c`.npz",
        "two\nlines\r\x1b[31m.npz",
        "a$\\frac$b.npz",
        "--out.npz",
        os.fsdecode(b"caf\xe9\xff.npz"),
    ):
        io.save(hostile, tmp_path / "complete.npz")
        os.replace(tmp_path / "complete.npz", folder / name)
    os.mkfifo(folder / "pipe.npz")
    (folder / "loop").symlink_to(folder)
    (folder / "garbage.npz").write_bytes(b"PK\x03\x04")
    more = (*QUICK[:6], "--budgets", "4", "--out", tmp_path / "out") if command == "report" else ("--solvers", "pgs")
    code, out, err = lavender(command, folder, *more)
    check_command(code, out + err, (1,))
    for page in (tmp_path / "out").glob("*.html"):
        assert "<img src=x" not in page.read_text("utf-8") and "<script>alert" not in page.read_text("utf-8")
    for page in (tmp_path / "out").glob("*.md"):
        for table in re.split(r"\n\n+", page.read_text("utf-8")):
            rows = [row for row in table.splitlines() if row.startswith("|")]
            assert len({len(re.findall(r"(?<!\\)\|", row)) for row in rows}) <= 1, "rows with unequal cells"


# -- records ------------------------------------------------------------------------------------------------------

HOSTILE = [
    None, True, -1, 2**70, 1e400, float("nan"), "", "[/x]", "\ud800", "a$\\frac$b", "<b>", [], [[]], ["a", 2],
    ["\x1b"], {}, {"tolerances": ["x"]}, {"a": {"b": 1}}, {"x": 1.5},
]  # fmt: skip


@pytest.fixture(scope="module")
def entries():
    """The rows of a small report with a sequence and a skip."""
    plan, rows = report.Plan(tolerances=(1e-3,), budgets=(2, 4), repeats=1, orders=("reverse",)), []
    cases = [stack(name="one"), *report.make_sequence([stack(), stack()], "walk")]
    report.run(cases, ["pgs", "direct", "gauss_seidel"], plan, into=rows)
    return list(map(to_jsonable, rows))


def write_entries(path, entries):
    path.write_text("".join(json.dumps(e) + "\n" for e in entries))


def show_all(lines):
    """Make everything that is shown of lines, but the files of figures, in memory."""
    from rich.console import Console

    shown = Report(lines, lines)
    for complete in (False, True):
        print_report(shown, Console(file=streams.StringIO(), width=140), complete=complete)
    for row in shown.runs.itertuples():  # The fastest, which is shown, differs from run to run.
        assert format_call(row)
    render_report(shown).encode("utf-8")
    summarise(shown).encode("utf-8")


@pytest.mark.parametrize("kind", KINDS)
def test_records_of_any_content_are_shown_or_rejected(tmp_path, entries, kind):
    """The values that columns accept are shown together: a page takes longer than reading a file."""
    path = tmp_path / "records.jsonl"
    first = next(i for i, e in enumerate(entries) if e["kind"] == kind)

    def read(changes):
        write_entries(path, [e | changes if i == first else e for i, e in enumerate(entries)])
        try:
            return report.read(path)
        except lv.InputError:
            return None

    names = [name for name in entries[first] if name not in ("kind", "run", "case", "sha")]
    tried = {name: np.random.default_rng(i).permutation(len(HOSTILE))[:4] for i, name in enumerate(names)}
    accepted = {n: [v for v in (HOSTILE[i] for i in tried[n]) if read({n: v}) is not None] for n in names}
    assert any(len(accepted[name]) < len(tried[name]) for name in names)
    lines = read({name: values[-1] for name, values in accepted.items() if values})
    if lines is not None:
        with contextlib.suppress(lv.InputError):
            show_all(lines)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 100_000, '{"kind": ' * 5000, "1" * 5000, '{"kind": ["run"]}', '{"kind": {}}', "null", '"run"', "\x00\x00",
        "\ufffe",
    ],
)  # fmt: skip
def test_read_records_of_a_malformed_line_names_its_number(tmp_path, text):
    (tmp_path / "records.jsonl").write_text(f"{text}\n")
    with pytest.raises(lv.InputError, match="line 1"):
        report.read(tmp_path)


def test_a_record_of_an_undescribed_case_is_rejected(tmp_path, entries):
    write_entries(tmp_path / "records.jsonl", [e for e in entries if e["kind"] != "case"])
    with pytest.raises(lv.InputError, match="a record belongs to a case that no line describes"):
        report.read(tmp_path)


def test_file_names_of_long_names_differ():
    names = ["n" * 300 + str(i) for i in range(3)]
    assert len({make_file_name(name) for name in names}) == 3
    items = report.resolve_sources([stack(name=n) for n in [*names, names[0], "x", "x", "x #2"]])
    assert len({make_file_name(item.name).lower() for item in items}) == len(items)
