"""Invalid and damaged files: rejected by path and name of the entry, or read as a valid problem."""

import contextlib
import io as streams
import re

import numpy as np
import pytest
import scipy.sparse as sp
from approved_texts import check_text
from random_problems import random_contact_problem

import lavender as lv
from lavender import io
from lavender.io import fclib

h5py = pytest.importorskip("h5py")


def matrix(name, m, n, nz, p, i, x):
    parts = {"m": [m], "n": [n], "nz": [nz], "nzmax": [max(nz, 0)], "p": p, "i": i, "x": x}
    return {
        f"{name}/{key}": np.array(v, np.int32) if key in ("m", "n", "nz", "nzmax") else v
        for key, v in parts.items()
    }


def contents(mass, h):
    m = h.shape[1]
    parts = {"M": sp.csr_array(mass), "H": sp.csr_array(h), "f": np.ones(len(h)), "w": np.zeros(m)}
    return fclib.Contents("fclib_global", 3, parts | {"mu": np.full(m // 3, 0.5)})


def test_load_of_fclib_with_a_mass_factor_beyond_memory_raises(monkeypatch):
    n = 1200
    rng = np.random.default_rng(2)
    h = np.zeros((n, 3))
    h[:3] = np.eye(3)
    chain = sp.diags_array(
        [np.full(n - 1, -1.0), np.full(n, 2.5), np.full(n - 1, -1.0)], offsets=[-1, 0, 1]
    )
    shuffled = rng.permutation(n)
    chain = sp.csr_array(chain)[shuffled][:, shuffled]
    monkeypatch.setattr(fclib, "MAX_MASS_FACTOR_ENTRIES", n * n)
    got = contents(chain, h).build_problem().csr.toarray()
    expected = np.linalg.inv(chain.toarray())[:3, :3]
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    monkeypatch.setattr(fclib, "MAX_MASS_FACTOR_ENTRIES", n * n - 1)
    with pytest.raises(lv.InputError, match="factors of M"):
        contents(chain, h).build_problem()


def valid_files(folder):
    """Return (suffix, bytes) of a file in every layout."""
    files = []
    a = np.eye(6) + 0.1
    contacts = lv.Cones.contacts(0.5, count=2)
    for problem in (
        lv.Problem.lcp(a, np.ones(6), guess=np.ones(6)),
        lv.Problem(np.ones(6), contacts, sp.csr_array(a), friction="cone"),
        lv.Problem.from_jacobian(a, np.eye(6), np.ones(6), cones=contacts, compliance=np.ones(6)),
        random_contact_problem(2, tangents=2, spin=False, bodies=3, joints=0, contacts=2),
    ):
        for suffix in (".npz", ".hdf5"):
            path = folder / f"p{suffix}"
            with contextlib.suppress(lv.CapabilityError):  # FCLIB has no place for some of them.
                io.save(problem, path, impulse=np.zeros(problem.m))
                files.append((suffix, path.read_bytes()))
    three = {"b": np.ones(3), "lo": np.zeros(3), "hi": np.ones(3)}
    sparse = {
        "A_data": np.ones(3),
        "A_indices": np.arange(3),
        "A_indptr": np.arange(4),
        "A_shape": np.array([3, 3]),
    }
    cones = {"cone_start": np.array([0]), "cone_dim": np.array([3]), "cone_mu": np.array([0.5])}
    plain = {"A": np.eye(3), "l_ref": np.ones(3), "w_ref": np.zeros(3), "compare": "l,w"}
    mass = sp.csr_array(np.eye(6))
    h = sp.csr_array(np.ones((6, 3)))
    vectors = {
        "spacedim": np.array([3], np.int32),
        "vectors/f": np.ones(6),
        "vectors/w": np.zeros(3),
    }
    whole = (
        matrix("M", 6, 6, -2, mass.indptr, mass.indices, mass.data)
        | vectors
        | {"vectors/mu": np.array([0.5])}
    )
    whole |= matrix("H", 6, 3, -2, h.indptr, h.indices, h.data)
    return [
        *files,
        (".npz", file_of(".npz", three | plain)),
        (".npz", file_of(".npz", three | sparse | cones)),
        (".hdf5", file_of(".hdf5", {f"fclib_global/{name}": x for name, x in whole.items()})),
    ]


def arrays_in(suffix, data):
    """Return the arrays of a file by name."""
    if suffix == ".npz":
        with np.load(streams.BytesIO(data)) as archive:
            return {name: archive[name] for name in archive.files}
    with h5py.File(streams.BytesIO(data)) as file:
        names = []
        file.visititems(
            lambda name, node: names.append(name) if isinstance(node, h5py.Dataset) else None
        )
        return {name: file[name][()] for name in names}


def file_of(suffix, arrays):
    """Return the bytes of a file of arrays; HDF5 has no place for texts of NumPy."""
    stream = streams.BytesIO()
    if suffix == ".npz":
        np.savez(stream, **arrays)
        return stream.getvalue()
    with h5py.File(stream, "w") as file:
        for name, x in arrays.items():
            if np.asarray(x).dtype.kind != "U":
                file[name] = x
    return stream.getvalue()


#: Words for an entry in messages, if they are not its name.
WORDS = {
    "data": "values|A|J|M",
    "indices": "indices|M",
    "indptr": "pointers",
    "i": "indices",
    "p": "pointers",
    "x": "values",
    "m": "rows|x|f",
    "n": "columns|x|w|rows",
    "lo": "lower",
    "hi": "upper",
    "b": "lo",
    "nz": "compressed",
    "inv_mass": "inv_inertia",
    "v_free": "compressed",
    "A": "A_shape",
    "start": "cone_dim",
}


def list_replacements(x):
    """Yield (description, array) in place of x; None: the entry is left out."""
    flat = x.reshape(-1)
    yield from {
        "missing": None,
        "longer": np.concatenate([flat, flat[:1]]),
        "shorter": flat[:-1],
        "a column": x.reshape(-1, 1, 1),
        "a scalar": np.array(2.5),
    }.items()
    if x.dtype.kind in "iuf":
        yield from {"text": np.full(x.shape, "a"), "complex": x.astype(complex)}.items()
        above = (
            int(np.max(x, initial=0)) + 1 if x.dtype.kind in "iu" else 0
        )  # the first number out of range
        for value in (-1, above, 2**31 - 1) if above else (np.nan, np.inf, -1.0):
            with np.errstate(all="ignore"):
                y = x.astype(x.dtype)
                y.reshape(-1)[-1:] = np.array(value).astype(x.dtype)
            yield "last one too large" if value == above else f"last {value}", y
    if x.dtype.kind in "iu":
        yield from {"floats": x.astype(float), "reversed": flat[::-1]}.items()


def read_replaced(path, suffix, arrays, name, x):
    """Read a file in which one array is replaced; return the error's message, or an empty string."""
    path.write_bytes(
        file_of(suffix, {k: v for k, v in (arrays | {name: x}).items() if v is not None})
    )
    try:
        io.read(path)
    except lv.LavenderError as error:
        return str(error)
    return ""


@pytest.mark.filterwarnings("error")
def test_file_with_an_array_replaced_names_it_or_is_read_as_approved(tmp_path):
    unnamed = []
    accepted = {}
    for suffix, data in valid_files(tmp_path):
        arrays = arrays_in(suffix, data)
        path = tmp_path / f"replaced{suffix}"
        kind = f"{suffix}, {', '.join(sorted({name.partition('_')[0].partition('/')[0] for name in arrays}))}"
        if kind in accepted:
            continue  # another problem in the same layout
        accepted[kind] = []
        for name, x in arrays.items():
            last = name.rpartition("/")[2]
            words = [
                re.escape(w) for w in (last, last.replace("_", "."), last.partition("_")[2]) if w
            ]
            words += [
                WORDS[key]
                for key in (last, last.rpartition("_")[2], last.partition("_")[2])
                if key in WORDS
            ]
            pattern = re.compile(rf"{re.escape(str(path))}.*\b(?:{'|'.join(words)})\b", re.DOTALL)
            read = []
            for how, value in list_replacements(np.array(x)):
                if suffix == ".hdf5" and how == "text":
                    continue  # HDF5 has no texts of NumPy.
                message = read_replaced(path, suffix, arrays, name, value)
                read += [how] * (not message)
                unnamed += [f"{name}, {how}: {message}"] * bool(
                    message and not pattern.search(message)
                )
            accepted[kind] += [f"{name}: {', '.join(read) or 'none'}"]
    assert not unnamed, "\n".join(unnamed)
    for kind, names in accepted.items():
        check_text("accepted_arrays.txt", kind, "\n".join(names))
