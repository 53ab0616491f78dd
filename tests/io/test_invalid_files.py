"""Invalid files and invalid data of other simulators: rejected by name, within a limit of memory."""

import contextlib
import functools
import io as streams
import json
import re
import warnings
import zipfile
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.sparse as sp
from approved_texts import check_text
from hypothesis import given
from random_problems import random_contact_problem

import lavender as lv
from lavender import io
from lavender.io import fclib

h5py = pytest.importorskip("h5py")
resource = pytest.importorskip("resource")

HUGE = 2**31 - 1
ALLOWED_MEMORY = 100_000_000  # Rejecting a file may need so many bytes.

# -- small files that would make large arrays ---------------------------------------------------------------------


@contextlib.contextmanager
def limited_memory():
    """Let the address space of this process grow by ALLOWED_MEMORY bytes."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + ALLOWED_MEMORY, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)


def npy_header(kind, shape):
    text = repr({"descr": kind, "fortran_order": False, "shape": shape}).encode()
    text += b" " * (63 - (10 + len(text)) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def write_npz(path, method=zipfile.ZIP_DEFLATED, **entries):
    """Write arrays; a tuple (kind, shape, bytes) is an array of these bytes, repeated."""
    with zipfile.ZipFile(path, "w", method) as out:
        for name, entry in entries.items():
            with out.open(f"{name}.npy", "w", force_zip64=True) as stream:
                if isinstance(entry, tuple):
                    kind, shape, text = entry
                    stream.write(npy_header(kind, shape))
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
    "lavender_format": np.int64(1), "meta": np.frombuffer(json.dumps(META).encode(), np.uint8), "b": np.zeros(2),
    "cones_ptr": [0, 1, 2], "cones_kind": [0, 0], "cones_lower": np.zeros(2), "cones_upper": np.ones(2),
    "cones_mu": np.zeros(2), "cones_patch_radius": np.zeros(2), "A": np.eye(2),
}  # fmt: skip


def hdf5(path, parts):
    """Write datasets by path; a tuple (shape, kind) is a dataset whose chunks were never written."""
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
        f"{name}/{key}": np.array(v, np.int32) if key in ("m", "n", "nz", "nzmax") else v for key, v in parts.items()
    }


NO_NUMBERS = np.zeros(0)
NO_INDICES = np.zeros(0, np.int32)
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
            "fclib_local/spacedim", (1,), "i4", maxshape=(None,), chunks=(2**27,), compression="gzip", fillvalue=3
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
        "compressed by method",
    ),
    "one body under many contacts": (one_wide_body, "max_bytes="),
    "triplets of a huge matrix": (
        lambda path: hdf5(
            path,
            LOCAL
            | matrix("fclib_local/W", HUGE, HUGE, 0, NO_INDICES, NO_INDICES, NO_NUMBERS)
            | {"fclib_local/vectors/q": NO_NUMBERS, "fclib_local/vectors/mu": NO_NUMBERS},
        ),
        "are needed|not a multiple",
    ),
    "triplets of a huge matrix, with vectors that nobody wrote": (
        lambda path: hdf5(
            path,
            LOCAL
            | matrix("fclib_local/W", HUGE // 3 * 3, HUGE // 3 * 3, 0, NO_INDICES, NO_INDICES, NO_NUMBERS)
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
            | matrix("fclib_global/H", HUGE, 3, -1, [0, 0, 0, 0], NO_INDICES, NO_NUMBERS)
            | matrix("fclib_global/M", HUGE, HUGE, 0, NO_INDICES, NO_INDICES, NO_NUMBERS)
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
def test_a_small_file_of_large_arrays_is_rejected_before_they_are_allocated(kind, tmp_path):
    make, sign = BOMBS[kind]
    good = tmp_path / "good.hdf5"
    io.save(lv.Problem.contact(np.eye(3), np.ones(3), [0.5]), good)
    io.load(good)  # what a first load imports
    path = make(tmp_path / "bomb")
    assert path.stat().st_size < 2_000_000
    with limited_memory(), pytest.raises(lv.InputError, match=sign) as error:
        io.load(path)
    assert str(path) in str(error.value)


def test_max_bytes_limits_the_size_of_the_arrays(tmp_path):
    # A as bytes, 300 x 300: 90 kB to be read, 720 kB to be made.
    m = 300
    path = write_npz(
        tmp_path / "p.npz", b=np.zeros(m), lo=np.zeros(m), hi=np.ones(m), A=np.eye(m, dtype=np.int8)
    )  # fmt: skip
    needed = 8 * (m * m + 3 * m)
    assert io.load(path, max_bytes=needed).m == m
    with pytest.raises(lv.InputError, match=f"need {needed} bytes .* limit of {needed - 1}"):
        io.load(path, max_bytes=needed - 1)
    for wrong in (-1, 1e9, "2G", None, True):
        with pytest.raises(lv.InputError, match="max_bytes is"):
            io.load(path, max_bytes=wrong)


def contents(mass, h):
    m = h.shape[1]
    parts = {"M": sp.csr_array(mass), "H": sp.csr_array(h), "f": np.ones(len(h)), "w": np.zeros(m)}
    return fclib.Contents("fclib_global", 3, parts | {"mu": np.full(m // 3, 0.5)})


def test_load_of_fclib_with_a_mass_factor_beyond_memory_raises():
    n = 1200
    rng = np.random.default_rng(2)
    h = np.zeros((n, 3))
    h[:3] = np.eye(3)
    chain = sp.diags_array([np.full(n - 1, -1.0), np.full(n, 2.5), np.full(n - 1, -1.0)], offsets=[-1, 0, 1])
    shuffled = rng.permutation(n)
    chain = sp.csr_array(chain)[shuffled][:, shuffled]
    got = contents(chain, h).build_problem(max_bytes=24 * 10**6).csr.toarray()  # 1200^2 entries: 23 MB
    expected = np.linalg.inv(chain.toarray())[:3, :3]
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    with pytest.raises(lv.InputError, match="factors of M"):
        contents(chain, h).build_problem(max_bytes=22 * 10**6)


# -- damaged files -----------------------------------------------------------------------------------------------


def problems(n):
    """Yield one problem of each form, of about n contacts."""
    a, contacts = np.eye(3 * n) + 0.1, lv.Cones.contacts(0.5, count=n)
    yield lv.Problem.lcp(a, np.ones(3 * n), guess=np.ones(3 * n))
    yield lv.Problem(np.ones(3 * n), contacts, sp.csr_array(a), friction="cone")
    yield lv.Problem.from_jacobian(a, np.eye(3 * n), np.ones(3 * n), cones=contacts, compliance=np.ones(3 * n))
    yield random_contact_problem(n, tangents=2, spin=False, bodies=3, joints=0, contacts=n)


@functools.cache
def valid_files(folder):
    """Return (suffix, bytes) of files in every layout."""
    files = []
    for problem in [*problems(2), *problems(3)]:
        for suffix in (".npz", ".hdf5"):
            path = folder / f"p{suffix}"
            try:
                io.save(problem, path, impulse=np.zeros(problem.m))
            except lv.LavenderError:  # This layout has no place for the problem.
                continue
            files.append((suffix, path.read_bytes()))
    three = {"b": np.ones(3), "lo": np.zeros(3), "hi": np.ones(3)}
    sparse = {"A_data": np.ones(3), "A_indices": np.arange(3), "A_indptr": np.arange(4), "A_shape": np.array([3, 3])}
    for arrays in (
        three | {"A": np.eye(3), "l_ref": np.ones(3), "w_ref": np.zeros(3), "compare": "l,w"},
        three | sparse | {"cone_start": np.array([0]), "cone_dim": np.array([3]), "cone_mu": np.array([0.5])},
    ):
        stream = streams.BytesIO()
        np.savez(stream, **arrays)
        files.append((".npz", stream.getvalue()))
    mass, h = sp.csr_array(np.eye(6)), sp.csr_array(np.ones((6, 3)))
    vectors = {"vectors/f": np.ones(6), "vectors/w": np.zeros(3), "vectors/mu": np.array([0.5])}
    path = hdf5(
        folder / "global.hdf5",
        GLOBAL
        | matrix("fclib_global/M", 6, 6, -2, mass.indptr, mass.indices, mass.data)
        | matrix("fclib_global/H", 6, 3, -2, h.indptr, h.indices, h.data)
        | {f"fclib_global/{name}": x for name, x in vectors.items()},
    )
    return [*files, (".hdf5", path.read_bytes())]


KINDS = ("<f8", "<f4", "<f2", "<i4", "<i8", "<u8", "|i1", "|b1", "<c16", "|S3", "<U2", ">f8", ">i4")


@st.composite
def replaced_array(draw, x):
    """Another array in the place of x: other numbers, another shape or another type."""
    x = np.array(x)
    how = draw(st.sampled_from(("number", "number", "number", "shape", "kind", "scalar", "empty", "longer")))
    if how == "number" and x.size and x.dtype.kind in "iuf":
        whole = (-(2**31), -2, -1, 0, 1, 2, 3, 100, 2**31 - 1)
        reals = (np.nan, np.inf, -np.inf, -0.0, 1e-310, 1e308, -1.0, 0.5)
        value = draw(st.sampled_from(reals if x.dtype.kind == "f" else whole))
        x = x.copy()
        with np.errstate(all="ignore"):
            x.reshape(-1)[draw(st.integers(0, x.size - 1))] = np.array(value).astype(x.dtype)
        return x
    if how == "shape":
        return x.reshape(draw(st.sampled_from(((-1,), (1, -1), (-1, 1), (-1, 1, 1)))))
    if how == "kind" and x.dtype.kind in "iufb":
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            return x.astype(draw(st.sampled_from(KINDS)))
    if how == "scalar":
        return np.array(draw(st.sampled_from((0, 1, -1, 0.5, np.nan, 2**31 - 1))))
    if how == "empty":
        return x.reshape(-1)[:0]
    return np.concatenate([x.reshape(-1), x.reshape(-1)[:1]])


def arrays_in(suffix, data):
    """Return the arrays of a file by name."""
    if suffix == ".npz":
        with np.load(streams.BytesIO(data)) as archive:
            return {name: archive[name] for name in archive.files}
    with h5py.File(streams.BytesIO(data)) as file:
        names = []
        file.visititems(lambda name, node: names.append(name) if isinstance(node, h5py.Dataset) else None)
        return {name: file[name][()] for name in names}


def file_of(suffix, arrays, is_chunked):
    """Return the bytes of a file of arrays; HDF5 has no place for texts of NumPy, and may store only chunks."""
    stream = streams.BytesIO()
    if suffix == ".npz":
        write_npz(stream, zipfile.ZIP_DEFLATED if is_chunked else zipfile.ZIP_STORED, **arrays)
        return stream.getvalue()
    with h5py.File(stream, "w") as file:
        for name, x in arrays.items():
            x = np.asarray(x)
            if is_chunked and x.ndim:
                file.create_dataset(name, x.shape, x.dtype, chunks=True, maxshape=(None,) * x.ndim)
            elif x.dtype.kind != "U":
                file[name] = x
    return stream.getvalue()


@st.composite
def damaged_files(draw, folder):
    """A file some of whose bytes or arrays are others, as (suffix, bytes)."""
    suffix, data = draw(st.sampled_from(valid_files(folder)))
    how = draw(st.sampled_from(("bytes", "bytes", "arrays", "arrays", "arrays", "cut", "splice", "same")))
    if how == "bytes":
        changed = bytearray(data)
        for _ in range(draw(st.sampled_from((1, 1, 2, 8)))):
            changed[draw(st.integers(0, len(data) - 1))] = draw(st.integers(0, 255))
        return suffix, bytes(changed)
    if how in ("cut", "splice"):
        end = draw(st.sampled_from(valid_files(folder)))[1] if how == "splice" else b""
        return suffix, data[: draw(st.integers(0, len(data)))] + end[draw(st.integers(0, len(end))) :]
    arrays = arrays_in(suffix, data)
    for _ in range(draw(st.sampled_from((1, 1, 2))) if how == "arrays" else 0):
        name = draw(st.sampled_from(sorted(arrays)))
        if name == "meta" and draw(st.booleans()):
            with contextlib.suppress(ValueError, TypeError):  # It was replaced before.
                meta = json.loads(arrays[name].tobytes())
                values = (None, "", "rows", "csr", "dense", "cone", [], [1], ["a"], {}, 1, True)
                meta[draw(st.sampled_from(sorted(meta)))] = draw(st.sampled_from(values))
                arrays[name] = np.frombuffer(json.dumps(meta).encode(), np.uint8)
            continue
        if draw(st.integers(0, 9)) == 9:
            x = arrays.pop(name)
            arrays |= draw(st.sampled_from(({}, {"extra": x}, {"b": x}, {"A": x}, {"guess": x})))
        else:
            arrays[name] = draw(replaced_array(arrays[name]))
    return suffix, file_of(suffix, arrays, draw(st.integers(0, 9)) == 9)


#: Words for an entry in messages, if they are not its name.
WORDS = {
    "data": "values|A|J|M", "indices": "indices|M", "indptr": "pointers", "i": "indices", "p": "pointers",
    "x": "values", "m": "rows|x|f", "n": "columns|x|w|rows", "lo": "lower", "hi": "upper", "b": "lo",
    "nz": "compressed", "inv_mass": "inv_inertia", "v_free": "compressed", "A": "A_shape", "start": "cone_dim",
}  # fmt: skip


def list_replacements(x):
    """Yield (description, array) in place of x; None: the entry is left out."""
    flat = x.reshape(-1)
    yield from {"missing": None, "longer": np.concatenate([flat, flat[:1]]), "shorter": flat[:-1],
                "a column": x.reshape(-1, 1, 1), "a scalar": np.array(2.5)}.items()  # fmt: skip
    if x.dtype.kind in "iuf":
        yield from {"text": np.full(x.shape, "a"), "complex": x.astype(complex)}.items()
        above = int(np.max(x, initial=0)) + 1 if x.dtype.kind in "iu" else 0  # the first number out of range
        for value in (-1, above, 2**31 - 1) if above else (np.nan, np.inf, -1.0):
            with np.errstate(all="ignore"):
                y = x.astype(x.dtype)
                y.reshape(-1)[-1:] = np.array(value).astype(x.dtype)
            yield "last one too large" if value == above else f"last {value}", y
    if x.dtype.kind in "iu":
        yield from {"floats": x.astype(float), "reversed": flat[::-1]}.items()


def read_replaced(path, suffix, arrays, name, x):
    """Read a file in which one array is replaced; return the error's message, or an empty string."""
    path.write_bytes(file_of(suffix, {k: v for k, v in (arrays | {name: x}).items() if v is not None}, False))
    try:
        io.read(path, max_bytes=10**7)
    except lv.LavenderError as error:
        return str(error)
    return ""


@pytest.mark.filterwarnings("error")
def test_file_with_an_array_replaced_names_it_or_is_read_as_approved(tmp_path):
    unnamed, accepted = [], {}
    for suffix, data in valid_files(tmp_path):
        arrays, path = arrays_in(suffix, data), tmp_path / f"replaced{suffix}"
        kind = f"{suffix}, {', '.join(sorted({name.partition('_')[0].partition('/')[0] for name in arrays}))}"
        if kind in accepted:
            continue  # a larger problem in the same layout
        accepted[kind] = []
        for name, x in arrays.items():
            last = name.rpartition("/")[2]
            words = [re.escape(w) for w in (last, last.replace("_", "."), last.partition("_")[2]) if w]
            words += [WORDS[key] for key in (last, last.rpartition("_")[2], last.partition("_")[2]) if key in WORDS]
            pattern, read = re.compile(rf"{re.escape(str(path))}.*\b(?:{'|'.join(words)})\b", re.DOTALL), []
            for how, value in list_replacements(np.array(x)):
                if suffix == ".hdf5" and how == "text":
                    continue  # HDF5 has no texts of NumPy.
                message = read_replaced(path, suffix, arrays, name, value)
                read += [how] * (not message)
                unnamed += [f"{name}, {how}: {message}"] * bool(message and not pattern.search(message))
            accepted[kind] += [f"{name}: {', '.join(read) or 'none'}"]
    assert not unnamed, "\n".join(unnamed)
    for kind, names in accepted.items():
        check_text("accepted_arrays.txt", kind, "\n".join(names))


@pytest.mark.fuzz
@pytest.mark.filterwarnings("error")
@given(data=st.data())
def test_a_damaged_file_is_rejected_by_its_path_or_holds_a_valid_problem(data, tmp_path_factory):
    folder = tmp_path_factory.getbasetemp()
    suffix, content = data.draw(damaged_files(folder))
    path = folder / f"damaged{suffix}"
    path.write_bytes(content)
    try:
        stored = io.read(path, max_bytes=10**7)
    except lv.LavenderError:
        with pytest.raises(lv.LavenderError, match=str(path)):
            io.read(path, max_bytes=10**7)
        return
    problem = stored.problem
    assert all(np.isfinite(x).all() for x in (problem.b, problem.cones.mu, *stored.guesses))
    assert stored.impulse is None or len(stored.impulse) == problem.m
    for solver in ("auto", "pgs") if problem.m <= 200 else ():
        if lv.get(solver).refuses(problem) is None:
            lv.solve(problem, solver, max_iter=20)
