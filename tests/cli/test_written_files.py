"""Files that the package writes: no failure loses what was written, and nothing but a regular file is replaced."""

import contextlib
import errno
import os
import signal
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from worked import python

import lavender as lv
from lavender import io, report
from lavender.io.stored import write_text
from lavender.report.store import Store
from lavender.sim.engine import run
from lavender.sim.engine.picture import Film

resource = pytest.importorskip("resource", reason="limits of files are of POSIX")
needs_hdf5 = pytest.mark.skipif(
    find_spec("h5py") is None, reason="FCLIB's files need h5py (extra: fclib)"
)
BEFORE = b"the content before"


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
    "text": (".txt", lambda results, path: write_text(path, "abc")),
}
each_writer = pytest.mark.parametrize(
    ("suffix", "call"),
    [pytest.param(*case, marks=[needs_hdf5] * (name == "hdf5")) for name, case in WRITERS.items()],
    ids=WRITERS,
)


@contextlib.contextmanager
def file_size_limit(size):
    """Limit the files of this process to so many bytes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@each_writer
def test_write_over_a_pipe_or_a_folder_is_an_error_and_through_a_link_replaces_its_target(
    suffix, call, results, tmp_path
):
    pipe, folder, target, link = (
        tmp_path / f"{name}{suffix}" for name in ("pipe", "folder", "target", "link")
    )
    os.mkfifo(pipe)
    folder.mkdir()
    target.write_bytes(BEFORE)
    link.symlink_to(target.name)
    for path in (pipe, folder):
        with pytest.raises(lv.InputError, match=f"{path}: it is not a regular file"):
            call(results, path)
    call(results, link)
    assert pipe.is_fifo() and link.is_symlink() and target.read_bytes() != BEFORE
    assert len(list(tmp_path.iterdir())) == 4


@each_writer
@pytest.mark.parametrize("is_renamed", [False, True], ids=["writing", "renaming"])
def test_write_on_a_full_disk_keeps_the_old_file(
    is_renamed, suffix, call, results, tmp_path, monkeypatch
):
    path = tmp_path / f"there{suffix}"
    path.write_bytes(BEFORE)

    def raise_full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def write_part(path, data):
        with path.open("wb") as file:
            file.write(data[:1])
        raise_full()

    # The limit also holds for what pytest and imports write, so writers in Python meet a full disk without it.
    is_played = is_renamed or suffix in (".csv", ".txt")
    if is_renamed:
        monkeypatch.setattr(os, "replace", raise_full)
    else:
        monkeypatch.setattr(Path, "write_bytes", write_part)
    limit = contextlib.nullcontext() if is_played else file_size_limit(1)
    with limit, pytest.raises(lv.InputError, match=r"No space left|cannot write"):
        call(results, path)
    assert path.read_bytes() == BEFORE
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_store_on_a_full_disk_raises_and_keeps_the_earlier_rows(tmp_path):
    path = tmp_path / "records.jsonl"
    row = {"kind": "skip", "run": "run", "case": "case", "solver": "pgs", "reason": "reason"}
    with Store(path) as store:
        store.add(row)
        size = path.stat().st_size
        with (
            file_size_limit(size),
            pytest.raises(lv.InputError, match=r"cannot write .* free disk space"),
        ):
            store.add(row)
    assert len(report.read(path)) >= 1  # The second line may be flushed when the file is closed.


def test_folder_of_steps_is_continued_by_its_recording_alone(tmp_path):
    simulation = lv.Simulation("stack")
    assert len(simulation.record(tmp_path, 2)) == 2
    assert len(simulation.record(tmp_path, 2)) == 2  # the next two steps
    with pytest.raises(lv.InputError, match="holds 4 problem files"):
        lv.Simulation("stack").record(tmp_path, 2)


WRITE_AND_DIE = """if True:
    import os, signal
    from pathlib import Path
    from lavender.io.stored import write_atomically

    def write(part):
        Path(part).write_bytes(b"half")
        os.kill(os.getpid(), signal.SIGKILL)

    write_atomically("a.txt", write)"""


def test_killed_writer_leaves_the_old_file(tmp_path):
    (tmp_path / "a.txt").write_bytes(BEFORE)
    python("-c", WRITE_AND_DIE, cwd=tmp_path, status=-signal.SIGKILL)
    assert (tmp_path / "a.txt").read_bytes() == BEFORE
