"""Whoever reads a file opens a regular one of a sensible size; what is none is refused at once, by name."""

import os
from importlib.util import find_spec

import pytest

import lavender as lv
from lavender import bench, io
from lavender.lab import collection

READERS = {
    "npz": (".npz", lv.load),
    "hdf5": (".hdf5", lv.load),
    "a stored answer": (".npz", io.load_solution),
    "film": (".film", lv.engine.Film.load),
    "snapshot": (".snap", lv.Snapshot.load),
    "state": (".snap", lambda path: lv.Simulation("stack").load(path)),
    "records": (".jsonl", bench.read),
    "manifest": (".json", collection.load),
}
needs_hdf5 = pytest.mark.skipif(find_spec("h5py") is None, reason="FCLIB's files need h5py (extra: fclib)")
everybody = pytest.mark.parametrize(
    ("suffix", "read"),
    [pytest.param(*how, marks=[needs_hdf5] if name == "hdf5" else []) for name, how in READERS.items()],
    ids=READERS,
)


def long_file(path):
    """Ten gigabytes that take no room."""
    with path.open("wb") as stream:
        stream.truncate(10**10)
    return path


@everybody
def test_what_is_no_file_is_refused_and_not_waited_for(suffix, read, tmp_path):
    loop = tmp_path / f"loop{suffix}"
    loop.symlink_to(loop.name)
    (tmp_path / f"folder{suffix}").mkdir()
    paths = [
        loop,
        tmp_path / f"none{suffix}",
        tmp_path / "no folder" / f"none{suffix}",
        tmp_path / f"folder{suffix}",
    ]
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / f"pipe{suffix}")
        paths += [tmp_path / f"pipe{suffix}", "/dev/zero"]
    for path in paths:
        with pytest.raises(lv.InputError, match=str(path)):
            read(path)


@everybody
def test_what_names_no_file_is_refused(suffix, read, tmp_path):
    """A number is not taken for an open file: it is neither read nor closed."""
    path = tmp_path / "p.npz"
    lv.Problem.lcp([[2.0]], [1.0]).save(path)
    with open(path, "rb") as stream:
        for wrong in (0, 1, True, stream.fileno(), None, 1.5, b"p.npz", path.open, ["p.npz"], f"a\0{suffix}"):
            with pytest.raises(lv.InputError, match="path"):
                read(wrong)
        assert stream.read(2) == b"PK"


@everybody
def test_ten_gigabytes_are_refused_before_they_are_read(suffix, read, tmp_path):
    with pytest.raises(
        lv.InputError, match="starts with" if suffix in (".npz", ".hdf5") else "10000000000 bytes"
    ):
        read(long_file(tmp_path / f"long{suffix}"))
