"""Small files that would make large arrays: refused before anything is made."""

import contextlib
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

import lavender as lv
import lavender.io
from lavender.io import fclib
from lavender.io.condensed import most_entries

h5py = pytest.importorskip("h5py")
resource = pytest.importorskip("resource")

HUGE = 2**31 - 1
ROOM = 100_000_000  # bytes that refusing a file may take


@contextlib.contextmanager
def room():
    """The address space of this process may grow by ROOM bytes."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)


def npy_start(kind, shape):
    text = repr({"descr": kind, "fortran_order": False, "shape": shape}).encode()
    text += b" " * (63 - (10 + len(text)) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def write_npz(path, method=zipfile.ZIP_DEFLATED, **entries):
    """Arrays, or (kind, shape, byte) of an array of one repeated text of bytes."""
    with zipfile.ZipFile(path, "w", method) as out:
        for name, entry in entries.items():
            with out.open(f"{name}.npy", "w", force_zip64=True) as stream:
                if isinstance(entry, tuple):
                    kind, shape, text = entry
                    stream.write(npy_start(kind, shape))
                    left = int(np.prod(shape)) * np.dtype(kind).itemsize
                    block = text * (2**20 // len(text))
                    while left > 0:
                        stream.write(block[:left])
                        left -= len(block)
                else:
                    np.lib.format.write_array(stream, np.asarray(entry), allow_pickle=False)
    return path


META = {"operator": "dense", "friction": "coulomb", "name": "", "names": None}
OWN = {
    "lavender_format": np.int64(1),
    "meta": np.frombuffer(json.dumps(META).encode(), np.uint8),
    "b": np.zeros(2),
    "cones_ptr": [0, 1, 2],
    "cones_kind": [0, 0],
    "cones_lower": np.zeros(2),
    "cones_upper": np.ones(2),
    "cones_mu": np.zeros(2),
    "cones_patch_radius": np.zeros(2),
    "A": np.eye(2),
}


def hdf5(path, parts):
    """Datasets by path; (shape, kind) is one whose chunks were never written."""
    with h5py.File(path, "w") as out:
        for name, value in parts.items():
            if isinstance(value, tuple):
                out.create_dataset(name, value[0], value[1], chunks=(2**16,))
            else:
                out[name] = np.asarray(value)
    return path


def matrix(name, m, n, nz, p, i, x):
    parts = {"m": [m], "n": [n], "nz": [nz], "nzmax": [max(nz, 0)], "p": p, "i": i, "x": x}
    return {
        f"{name}/{key}": np.array(v, np.int32) if key in ("m", "n", "nz", "nzmax") else v
        for key, v in parts.items()
    }


NO = np.zeros(0)
NONE = np.zeros(0, np.int32)
LOCAL = {"fclib_local/spacedim": np.array([3], np.int32)}
GLOBAL = {"fclib_global/spacedim": np.array([3], np.int32)}


def one_wide_body(path):
    m = 36_000
    h = sp.csr_array(np.ones((2, m)))  # M is no mass matrix, so A is formed
    return hdf5(
        path,
        GLOBAL
        | matrix("fclib_global/H", 2, m, -2, h.indptr, h.indices, h.data)
        | matrix("fclib_global/M", 2, 2, -2, np.array([0, 2, 3]), np.array([0, 1, 1]), np.ones(3))
        | {"fclib_global/vectors/f": np.zeros(2), "fclib_global/vectors/w": np.zeros(m)}
        | {"fclib_global/vectors/mu": np.full(m // 3, 0.5)},
    )


def large_chunk(path):
    with h5py.File(path, "w") as out:
        out.create_dataset(
            "fclib_local/spacedim",
            (1,),
            "i4",
            maxshape=(None,),
            chunks=(2**27,),
            compression="gzip",
            fillvalue=3,
        )
    return path


BOMBS = {
    "pointers that announce rows, bounds that one number fills": (
        lambda path: write_npz(
            path, **OWN | {"cones_ptr": [0, HUGE], "cones_kind": [0], "cones_lower": 0.0, "cones_upper": 1.0}
        ),
        "must end with the number of its rows",
    ),
    "one number for every b": (lambda path: write_npz(path, **OWN | {"b": 0.0}), "one dimension"),
    "a dense matrix of bytes": (
        lambda path: write_npz(path, **OWN | {"A": ("|b1", (17_000, 17_000), b"\0")}),
        "max_bytes=",
    ),
    "an entry before the one that is too much": (
        lambda path: write_npz(
            path, **OWN | {"A": ("|i1", (11_500, 11_500), b"\0"), "guess": ("|i1", (200_000_000,), b"\0")}
        ),
        "max_bytes=",
    ),
    "text that makes many objects": (
        lambda path: write_npz(path, **OWN | {"meta": ("|u1", (60_000_000,), b"[{},{}],")}),
        "max_bytes=",
    ),
    "a packing that chooses its memory": (
        lambda path: write_npz(path, zipfile.ZIP_LZMA, **OWN),
        "packed by method",
    ),
    "one body under many contacts": (one_wide_body, "max_bytes="),
    "triplets of a huge matrix": (
        lambda path: hdf5(
            path,
            LOCAL
            | matrix("fclib_local/W", HUGE, HUGE, 0, NONE, NONE, NO)
            | {"fclib_local/vectors/q": NO, "fclib_local/vectors/mu": NO},
        ),
        "are needed|not a multiple",
    ),
    "triplets of a huge matrix, with vectors that nobody wrote": (
        lambda path: hdf5(
            path,
            LOCAL
            | matrix("fclib_local/W", HUGE // 3 * 3, HUGE // 3 * 3, 0, NONE, NONE, NO)
            | {"fclib_local/vectors/q": ((HUGE // 3 * 3,), "f8"), "fclib_local/vectors/mu": ((HUGE // 3,), "f8")},
        ),
        "max_bytes=",
    ),
    "numbers that nobody wrote, one byte each": (
        lambda path: hdf5(
            path,
            LOCAL
            | matrix("fclib_local/W", 3, 3, -2, [0, 0, 0, 0], ((2**28,), "i1"), ((2**28,), "i1"))
            | {"fclib_local/vectors/q": np.zeros(3), "fclib_local/vectors/mu": [0.5]},
        ),
        "max_bytes=",
    ),
    "compressed columns of a huge number of rows": (
        lambda path: hdf5(
            path,
            GLOBAL
            | matrix("fclib_global/H", HUGE, 3, -1, [0, 0, 0, 0], NONE, NO)
            | matrix("fclib_global/M", HUGE, HUGE, 0, NONE, NONE, NO)
            | {"fclib_global/vectors/f": ((HUGE,), "i1"), "fclib_global/vectors/w": np.zeros(3)}
            | {"fclib_global/vectors/mu": [0.5]},
        ),
        "max_bytes=",
    ),
    "one number in a large chunk": (large_chunk, "in a chunk of"),
}  # fmt: skip


@pytest.mark.slow  # the sanitizers reserve the whole address space
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="/proc is Linux's")
@pytest.mark.parametrize("kind", BOMBS)
def test_a_small_file_that_would_make_large_arrays_is_refused_first(kind, tmp_path):
    make, sign = BOMBS[kind]
    good = tmp_path / "good.hdf5"
    lavender.io.save(lv.Problem.contact(np.eye(3), np.ones(3), [0.5]), good)
    lavender.io.load(good)  # what a first load imports
    path = make(tmp_path / "bomb")
    assert path.stat().st_size < 2_000_000
    with room(), pytest.raises(lv.InputError, match=sign) as told:
        lavender.io.load(path)
    assert str(path) in str(told.value)


def test_max_bytes_is_what_the_arrays_take(tmp_path):
    # A as bytes, 300 x 300: 90 kB to be read, 720 kB to be made.
    m = 300
    path = write_npz(
        tmp_path / "p.npz", b=np.zeros(m), lo=np.zeros(m), hi=np.ones(m), A=np.eye(m, dtype=np.int8)
    )  # fmt: skip
    needed = 8 * (m * m + 3 * m)
    assert lavender.io.load(path, max_bytes=needed).m == m
    with pytest.raises(lv.InputError, match=f"would take {needed} bytes .* more than {needed - 1}"):
        lavender.io.load(path, max_bytes=needed - 1)
    for wrong in (-1, 1e9, "2G", None, True):
        with pytest.raises(lv.InputError, match="max_bytes is"):
            lavender.io.load(path, max_bytes=wrong)


def contents(mass, h):
    m = h.shape[1]
    return fclib.Contents(
        3, np.full(m // 3, 0.5), M=sp.csr_array(mass), H=sp.csr_array(h), f=np.ones(len(h)), w=np.zeros(m)
    )


def test_a_condensed_matrix_is_never_larger_than_expected():
    rng = np.random.default_rng(1)
    for _ in range(20):
        n, m = int(rng.integers(1, 30)), 3 * int(rng.integers(1, 12))
        h = np.where(rng.random((n, m)) < 0.15, rng.standard_normal((n, m)), 0.0)
        mass = np.diag(rng.uniform(1.0, 2.0, n))
        for _ in range(int(rng.integers(0, n))):
            i, j = rng.integers(0, n, 2)
            mass[i, j] = mass[j, i] = mass[i, j] + (1.0 if i == j else 0.1)
        file = contents(mass, h)
        label = connected_components(file.M, directed=False)[1]
        assert file.problem().csr.nnz <= most_entries(label, file.H)


def test_factors_that_would_fill_are_refused_and_narrow_ones_are_not():
    n = 1200
    rng = np.random.default_rng(2)
    h = np.zeros((n, 3))
    h[:3] = np.eye(3)
    chain = sp.diags_array([np.full(n - 1, -1.0), np.full(n, 2.5), np.full(n - 1, -1.0)], offsets=[-1, 0, 1])
    shuffled = rng.permutation(n)
    chain = sp.csr_array(chain)[shuffled][:, shuffled]
    got = contents(chain, h).problem(max_bytes=400_000).csr.toarray()  # 1200^2 entries: 23 MB
    expected = np.linalg.inv(chain.toarray())[:3, :3]
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    wild = sp.csr_array(np.eye(n) * 10.0 + np.where(rng.random((n, n)) < 5e-3, rng.random((n, n)), 0.0))
    with pytest.raises(lv.InputError, match="factors of M"):
        contents(wild, h).problem(max_bytes=10**6)
