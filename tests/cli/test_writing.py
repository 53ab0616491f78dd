"""Whoever writes a file writes a regular one, whole, behind its links; what is no file is left as it is."""

import contextlib
import errno
import os
import signal
import stat
import subprocess
import sys
from ast import literal_eval
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from worked import python

import lavender as lv
import lavender.cli
from lavender import bench, io
from lavender.io.stored import FOLDER_LOCK, PART, folder_for_steps, write_atomically, write_text
from lavender.lab.bench.record import Skip
from lavender.lab.bench.store import Records, Store
from lavender.sim.engine import run
from lavender.sim.engine.picture import save_picture

resource = pytest.importorskip("resource", reason="limits, pipes and devices with names are of POSIX")
pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes and devices with names are of POSIX")


@pytest.fixture(scope="module")
def made():
    """What is written: a problem, a film, a trace and a snapshot."""
    simulation = lv.Simulation("stack")
    return {
        "problem": lv.Problem.contact(np.eye(3), [1.0, 0.0, 0.0], 0.5),
        "film": lv.Simulation(lv.Scene("stack", n=1)).film(1),
        "trace": run(simulation, 3),
        "state": simulation.snapshot(),
    }


def store(made, path):
    Store(path).close()


WRITERS = {
    "npz": (".npz", lambda made, path: io.save(made["problem"], path)),
    "hdf5": (".hdf5", lambda made, path: io.save(made["problem"], path)),
    "film": (".film", lambda made, path: made["film"].save(path)),
    "strip": (".png", lambda made, path: save_picture(made["film"], path, frames=1)),
    "animation": (".gif", lambda made, path: save_picture(made["film"], path)),
    "trace": (".csv", lambda made, path: made["trace"].save(path)),
    "figure": (".svg", lambda made, path: made["trace"].plot(path)),
    "snapshot": (".snap", lambda made, path: made["state"].save(path)),
    "records": (".jsonl", store),
    "records as CSV": (".csv", lambda made, path: bench.write_csv(Records(), path)),
    "records as JSON": (".json", lambda made, path: bench.write_json(Records(), path)),
    "text": (".txt", lambda made, path: write_text(path, "abc")),
}
needs_hdf5 = pytest.mark.skipif(find_spec("h5py") is None, reason="FCLIB's files need h5py (extra: fclib)")
everybody = pytest.mark.parametrize(
    ("suffix", "write"),
    [pytest.param(*how, marks=[needs_hdf5] if name == "hdf5" else []) for name, how in WRITERS.items()],
    ids=WRITERS,
)

BEFORE = b"what stood there"


@contextlib.contextmanager
def room(size):
    """Files of this process may have so many bytes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@everybody
def test_a_link_stays_and_the_file_behind_it_is_replaced(suffix, write, made, tmp_path):
    (tmp_path / "far").mkdir()
    target, link, second = (
        tmp_path / name for name in (f"far/target{suffix}", f"link{suffix}", f"second{suffix}")
    )
    link.symlink_to(target)
    second.symlink_to(f"link{suffix}")
    for _ in range(2):  # first where the links lead to nothing yet
        write(made, second)
        assert link.is_symlink() and second.is_symlink()
        assert target.is_file() and not target.is_symlink()
        if suffix != ".jsonl":  # which is added to
            assert target.stat().st_size
            target.write_bytes(BEFORE)
    assert [p.name for p in (tmp_path / "far").iterdir()] == [target.name]  # nothing left lying


def special(kind, path):
    """Something that is no file, at `path`; its mode."""
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
    return os.lstat(path)


@pytest.mark.parametrize("kind", ["pipe", "folder", "device", "link to a pipe", "link to itself"])
@everybody
def test_what_is_no_file_is_refused_and_left_as_it_is(kind, suffix, write, made, tmp_path):
    path = tmp_path / f"there{suffix}"
    before = special(kind, path)
    with pytest.raises(lv.InputError, match="cannot write"):
        write(made, path)
    after = os.lstat(path)
    assert (after.st_mode, after.st_ino, after.st_rdev) == (before.st_mode, before.st_ino, before.st_rdev)
    assert {p.name for p in tmp_path.iterdir()} <= {path.name, "pipe"}


@everybody
def test_what_names_no_file_is_refused_and_leaves_nothing(suffix, write, made, tmp_path):
    (tmp_path / "file").write_text("")
    wrong = [7, True, None, 1.5, b"p.npz", open, f"a\0{suffix}", tmp_path / "file" / f"p{suffix}"]
    for path in wrong + [tmp_path / "missing" / f"p{suffix}"] * (suffix != ".jsonl"):  # whose folder is made
        with pytest.raises(lv.InputError, match=r"path is|NUL|cannot write"):
            write(made, path)
    assert os.listdir(tmp_path) == ["file"]


@everybody
@pytest.mark.parametrize("where", ["in the middle of the file", "where it is renamed"])
def test_a_full_disk_leaves_the_file_of_before(where, suffix, write, made, tmp_path, monkeypatch):
    path = tmp_path / f"there{suffix}"
    if suffix == ".jsonl":
        pytest.skip("records are added to")
    path.write_bytes(BEFORE)

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    renamed = where == "where it is renamed"
    if renamed:
        monkeypatch.setattr(os, "replace", full)
    with (
        contextlib.nullcontext() if renamed else room(1),  # a second byte is one too many
        pytest.raises(lv.InputError, match=r"No space left|cannot write"),
    ):
        write(made, path)
    assert path.read_bytes() == BEFORE
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@needs_hdf5
@pytest.mark.parametrize("size", [1, 4096, 16384, 24576])
def test_an_fclib_file_beyond_the_room_is_an_error(tmp_path, size):
    """HDF5 itself ends the process by a signal where a write fails that is not its first."""
    path = tmp_path / "p.hdf5"
    lv.Problem.contact(np.eye(3), [1.0, 0.0, 0.0], 0.5).save(path)
    before = path.read_bytes()
    a = np.random.default_rng(0).normal(size=(60, 60))
    with room(size), pytest.raises(lv.InputError, match="cannot write"):
        lv.Problem.contact(a @ a.T, np.ones(60), np.full(20, 0.5)).save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["p.hdf5"]


def test_records_without_room_say_so_and_let_go_of_their_file(tmp_path):
    path = tmp_path / "records.jsonl"
    with Store(path) as store, room(0), pytest.raises(lv.InputError, match=r"cannot write .* make room"):
        store.add(Skip("run", "case", "pgs", "reason"))
    Store(path).close()
    assert list(tmp_path.iterdir()) == [path]


def test_a_name_as_long_as_any_may_be_is_written_and_who_may_read_a_file_stays(made, tmp_path):
    for name in ("n" * 251 + ".npz", "\N{GREEK SMALL LETTER LAMDA}" * 125 + ".npz"):
        io.save(made["problem"], tmp_path / name)
        (tmp_path / name).chmod(0o640)
        io.save(made["problem"], tmp_path / name)
        assert io.load(tmp_path / name) == made["problem"]
        assert stat.S_IMODE((tmp_path / name).stat().st_mode) == 0o640


def test_what_an_engine_said_of_a_recording_goes_with_it(tmp_path):
    for name in ("engine.jsonl", "step_1.npz"):
        (tmp_path / name).write_text("of before")
    with folder_for_steps(tmp_path, replace=True) as folder:
        assert folder == tmp_path
        assert [p.name for p in tmp_path.iterdir()] == [FOLDER_LOCK]
    assert not list(tmp_path.iterdir())


def test_the_path_of_an_open_descriptor_is_no_name(tmp_path):
    with open(tmp_path / "gone", "wb") as stream:
        path = f"/proc/self/fd/{stream.fileno()}"
        if not os.path.exists(path):
            pytest.skip("descriptors have no paths here")
        os.unlink(tmp_path / "gone")
        with pytest.raises(lv.InputError, match="cannot write"):
            write_text(path, "a")
    assert list(tmp_path.iterdir()) == []


def test_threads_that_write_one_path_do_not_share_their_parts(tmp_path):
    from threading import Barrier, Thread

    both, parts = Barrier(2), []

    def write(part):
        parts.append(part)
        both.wait(timeout=600.0)
        part.write_text(str(part))
        both.wait(timeout=600.0)

    threads = [Thread(target=write_atomically, args=(tmp_path / "a", write)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(parts)) == 2
    assert (tmp_path / "a").read_text() in map(str, parts)


COMMANDS = [
    ("report", "stack(n=2)", "--solvers", "pgs,direct", "--levels", "1e-3", "--budgets", "4", "--repeats", "1",
     "--out", "report", "--paper"),
    ("run", "stack", "--steps", "3", "--record", "steps", "--trace", "t.csv", "--plot", "t.svg", "--film", "t.gif"),
    ("solve", "stack(n=2)", "--output", "solution.npz"),
    ("phenomena", "slide", "--steppers", "impulses", "--engines", "none", "--out", "phenomena.json"),
    ("export", "c", "c", "--for", "report"),
    ("web", "page", "page"),
    ("problems", "@hard", "--page", "set.md"),
]  # fmt: skip
INTO_FOLDERS = [
    ("report", "stack(n=2)", "--solvers", "pgs", "--out"),
    ("run", "stack", "--steps", "3", "--record"),
    ("export", "c"),
    ("web", "page"),
    ("problems", "@hard", "--out"),
]


@pytest.mark.parametrize("words", INTO_FOLDERS, ids=lambda words: words[0])
def test_a_folder_that_cannot_be_made_is_named_in_words(words, lavender, tmp_path, monkeypatch):
    """Some file systems tell only when they are asked: /proc is writable to root, and makes nothing."""
    if words[0] == "export":
        pytest.importorskip("Cython", reason="the export translates the kernels (extra: test)")
    make, folder = Path.mkdir, tmp_path / "new"

    def mkdir(path, *more, **others):
        if path == folder:
            raise OSError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
        make(path, *more, **others)

    monkeypatch.setattr(Path, "mkdir", mkdir)
    code, _, said = lavender(*words, folder)
    assert code == 2
    why = f"cannot make the folder {folder}: {os.strerror(errno.ENOENT)}; give another path"
    assert said.splitlines()[-1] == f"lavender: {why}"


def test_every_command_writes_files_under_other_names_first(tmp_path):
    """A reader, or what a full disk or a signal leaves, is the old file or the new one; records are added to."""
    pytest.importorskip("Cython", reason="the export translates the kernels (extra: test)")
    script = """if True:
        import os, sys
        from lavender import cli
        from lavender.io.stored import PART
        from lavender.lab.bench.running import alternating
        from lavender.sim.web import pages
        alternating.MAX_REPETITIONS = 1
        pages.module = lambda say, name: b"a module"
        here, opened = os.getcwd(), set()

        def watch(event, given):
            if event == "open" and isinstance(given[0], (str, os.PathLike)) and given[2] & (os.O_WRONLY | os.O_RDWR):
                path = os.path.abspath(given[0])
                if path.startswith(here) and not (os.path.isdir(path) or PART.fullmatch(os.path.basename(path))):
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
    assert files >= {"report", "steps", "t.csv", "t.gif", "c", "page", "phenomena.json", "set.md"}
    locks = [f"{name}/{FOLDER_LOCK}" for name in ("c", "page", "report", "steps")]
    assert literal_eval(done.stdout.splitlines()[-1].removeprefix("OPENED ")) == sorted(
        [*locks, "report/records.jsonl", "report/records.jsonl.lock"]
    )


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
        compile.put(Path("a.txt"), b"half")
    write_atomically("a.txt", write)"""


@pytest.mark.parametrize("kind", ["file", "module"])
def test_what_a_killed_writer_leaves_is_no_file_of_ours_and_goes_in_time(kind, tmp_path):
    (tmp_path / "a.txt").write_bytes(BEFORE)
    python("-c", WRITE_AND_DIE, kind, cwd=tmp_path, status=-signal.SIGKILL)
    assert (tmp_path / "a.txt").read_bytes() == BEFORE
    (left,) = (p for p in tmp_path.iterdir() if p.name != "a.txt")
    assert PART.fullmatch(left.name)
    write_text(tmp_path / "a.txt", "of another")
    assert left.exists()  # its writer may live, on another machine
    os.utime(left, (0.0, 0.0))
    again = "from lavender.io.stored import write_text; write_text('a.txt', 'of another')"
    python("-c", again, cwd=tmp_path)  # a process looks through a folder once
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_two_recordings_are_not_written_into_one_folder_at_a_time(tmp_path):
    with folder_for_steps(tmp_path):
        for replace in (False, True):
            with pytest.raises(lv.InputError, match="is being written by another command"):
                run(lv.Simulation("stack"), 3, record=tmp_path, replace=replace)
        with pytest.raises(lv.InputError, match="is being written by another command"):
            lv.Simulation("stack").record(tmp_path, 3)
    holder = "import os, signal, lavender.io.stored as s; s.folder_for_steps('.').__enter__(); os.kill(os.getpid(), 9)"
    python("-c", holder, cwd=tmp_path, status=-signal.SIGKILL)
    simulation = lv.Simulation("stack")
    assert len(simulation.record(tmp_path, 2)) == 2
    assert len(simulation.record(tmp_path, 2)) == 2  # which goes on
    with pytest.raises(lv.InputError, match="holds 4 problem files"):
        lv.Simulation("stack").record(tmp_path, 2)


@pytest.mark.skipif(os.name != "posix", reason="Windows keeps files that are open")
def test_a_clock_that_jumps_takes_no_part_from_a_writer_that_runs(tmp_path):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    own, dead = (tmp_path / f".x.npz.{pid}.1.part" for pid in (os.getpid(), ended.pid))
    for part in (own, dead):
        part.write_bytes(b"half")
        os.utime(part, (0, 0))  # as after a clock that was decades late
    write_text(tmp_path / "y", "")
    assert own.exists() and not dead.exists()
