"""Problems in .npz: nothing is lost, nothing foreign gets in."""

import dataclasses
import io
import json
import os
import pickle
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from random_problems import (
    CONTACTS,
    FORMS,
    random_contact_problem,
    random_generalized_problem,
    random_lcp,
    seeds,
)

import lavender as lv
import lavender.io


def variants():
    """One problem of every operator, law and optional field."""
    rows = random_contact_problem(1)
    k = rows.n_blocks
    a = sp.csr_array(
        np.where(
            np.random.default_rng(0).random((9, 9)) < 0.3,
            np.random.default_rng(1).random((9, 9)),
            0.0,
        )
    )
    a.data[0] = 0.0  # a stored zero is kept
    kept = {
        "guess": np.arange(rows.m, dtype=float) - 0.0,
        "key": np.array([2**64 - 1, *range(k - 1)], np.uint64),
        "names": ['hinge "7"', "Gelenk ä, \ud800", "nul\0", *(f"block {i}" for i in range(3, k))],
        "name": "a\\name\n",
    }
    single = {
        f.name: getattr(rows.rows, f.name) for f in dataclasses.fields(lv.Rows) if f.name != "copy"
    }
    single = {key: x.astype(np.float32) if x.dtype == float else x for key, x in single.items()}
    yield "rows, everything", dataclasses.replace(rows, **kept)
    yield "rows, cone law", rows.relaxed("cone")
    yield "rows in float32", lv.Problem.from_rows(lv.Rows(**single), mu=0.5)
    yield "csr", lv.Problem.linear(a, np.linspace(-1.0, 1.0, 9))
    yield "csr, contacts", lv.Problem.contact(a, np.ones(9), [0.0, 0.5, 1e60], name="contacts")
    jac = np.arange(12.0).reshape(3, 4)
    mass = np.diag([1.0, 2.0, 3.0, 4.0])
    mass[-1, :-1] = mass[:-1, -1] = 0.5  # fills in as it is given: kept in another order
    yield (
        "J and M, everything",
        lv.Problem.from_jacobian(
            jac,
            mass,
            np.ones(4),
            cones=lv.Cones.contacts(0.3),
            friction="cone",
            compliance=0.1,
            names=["foot"],
            dof_names=["hip", "knee", "ankle", "toe"],
        ),
    )
    for rows in (
        {},
        {"A": [[1.0, 1.0]], "b": [1.0]},
        {"G": [[1.0, -1.0]], "h": [1.0], "lb": [0.0, 1.0], "ub": [2.0, 1.0]},
    ):
        for p in ([1.0, 0.0], [3.0, 0.1]):
            program = lv.Problem.from_qp(np.diag(p), [1.0, -1.0], **rows, name="flat", guess=None)
            yield f"a program with P = {p} and {', '.join(rows) or 'no rows'}", program
    yield "empty", lv.Problem.linear(np.zeros((0, 0)), [])
    yield "empty csr", lv.Problem.linear(sp.csr_array((0, 0)), [])
    yield (
        "the ends of the door",
        lv.Problem.lcp([[5e-324, -0.0], [0.0, 1e60]], [-1e-60, -0.0], lower=-np.inf, upper=5e-324),
    )


@pytest.mark.parametrize(
    "problem", [pytest.param(problem, id=name) for name, problem in variants()]
)
def test_save_and_load_of_npz_keeps_the_problem(tmp_path, problem):
    path = tmp_path / "problem.npz"
    impulse = np.linspace(0.0, 1.0, problem.m)
    lavender.io.save(problem, path, impulse=impulse)
    stored = lavender.io.read(path)
    assert stored.problem == problem == lavender.io.load(path)
    assert stored.problem.precision == problem.precision
    assert stored.problem.b.tobytes() == problem.b.tobytes()  # also the sign of zero
    assert np.array_equal(lavender.io.load_solution(path), impulse)
    lavender.io.save(problem, path)
    assert lavender.io.load_solution(path) is None


@given(seeds)
def test_save_and_load_of_every_kind_of_block_keeps_it(tmp_path_factory, seed):
    path = tmp_path_factory.mktemp("npz") / "p.npz"
    bodies = [given_by(make(seed)) for make in CONTACTS.values() for given_by in FORMS.values()]
    for problem in (*bodies, random_lcp(seed), random_generalized_problem(seed, tangents=5)):
        lavender.io.save(problem, path)
        stored = lavender.io.read(path)
        assert stored.problem == pickle.loads(pickle.dumps(stored)).problem == problem


def test_save_of_npz_twice_has_the_same_bytes(tmp_path):
    problem = random_contact_problem(5)
    for name in ("a.npz", "b.npz"):
        lavender.io.save(problem, tmp_path / name)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_save_of_invalid_arguments_names_them_and_leaves_no_file(tmp_path):
    problem = random_lcp(1)
    for name in ("p.mat", "p"):
        with pytest.raises(lv.InputError, match=r"\.npz or \.hdf5"):
            lavender.io.save(problem, tmp_path / name)
    with pytest.raises(lv.InputError, match=r"a lavender\.Problem is needed"):
        lavender.io.save("problem", tmp_path / "p.npz")
    with pytest.raises(lv.InputError, match="impulse"):
        lavender.io.save(problem, tmp_path / "p.npz", impulse=[1.0])
    with pytest.raises(lv.InputError, match="has no effect on an"):
        lavender.io.save(problem, tmp_path / "p.npz", drop=["names"])
    assert not list(tmp_path.iterdir())


def archive(path, entries):
    """An .npz of arrays, or of raw bytes for one entry."""
    with zipfile.ZipFile(path, "w") as out:
        for name, value in entries.items():
            if not isinstance(value, bytes):
                stream = io.BytesIO()
                np.lib.format.write_array(stream, np.asanyarray(value), allow_pickle=True)
                value = stream.getvalue()
            out.writestr(f"{name}.npy", value)
    return path


def own(tmp_path, problem=None, **changes):
    """The entries of a saved problem, some replaced (None: left out), as a file."""
    path = tmp_path / "own.npz"
    lavender.io.save(problem or random_lcp(1, boxed=False), path)
    with np.load(path) as saved:
        entries = dict(saved)
    entries.update(changes)
    return archive(path, {name: value for name, value in entries.items() if value is not None})


def npy(descr, shape, data=b"", fortran=False, version=1):
    header = repr({"descr": descr, "fortran_order": fortran, "shape": shape}).encode() + b"\n"
    return (
        b"\x93NUMPY"
        + bytes([version, 0])
        + struct.pack("<H" if version == 1 else "<I", len(header))
        + header
        + data
    )


class Bomb:
    def __reduce__(self):
        return (os.mkdir, (os.environ["LAVENDER_TEST_BOMB"],))


def test_load_of_an_npz_unpickles_nothing(tmp_path, monkeypatch):
    trace = tmp_path / "executed"
    monkeypatch.setenv("LAVENDER_TEST_BOMB", str(trace))
    for entry in (
        np.array(Bomb(), object),
        npy("|O", (1,), pickle.dumps(Bomb())),
        pickle.dumps(Bomb()),
    ):
        for path in (
            own(tmp_path, b=entry),
            archive(tmp_path / "box.npz", {"b": entry, "lo": 0, "hi": 0, "A": 0}),
        ):
            with pytest.raises(lv.InputError, match="'b'"):
                lavender.io.load(path)
    assert not trace.exists()


PROGRAM = {
    "P": np.array([[2.0, 0.5], [0.5, 1.0]]),
    "q": np.array([1.0, -3.0]),
    "A": np.array([[1.0, 2.0]]),
    "b": np.array([-2.1]),
    "G": np.array([[1.0, -1.0], [0.3, 1.0], [0.0, 1.0]]),
    "h": np.array([1.0, np.inf, 0.7]),
    "lb": np.array([-np.inf, -1.0]),
    "ub": np.array([5.0, -1.0]),
}


def compressed(arrays, keys="PGA"):
    """The entries of a program with some matrices in compressed columns."""
    entries = {name: x for name, x in arrays.items() if name not in keys}
    for key in keys:
        matrix = sp.csc_array(arrays[key])
        entries |= {
            f"{key}_{part}": getattr(matrix, part)
            for part in ("data", "indices", "indptr", "shape")
        }
    return entries


def answers_of(problem):
    """The bytes of x and of the multipliers."""
    answer = lv.solve_qp(problem, tol=1e-6)
    return [x if x is None else x.tobytes() for x in (answer.x, answer.y, answer.z, answer.z_box)]


@pytest.mark.parametrize("flat", [False, True], ids=["definite", "singular"])
def test_a_saved_program_goes_back_into_solve_qp_with_the_same_bits(tmp_path, flat):
    arrays = PROGRAM | ({"P": np.diag([1.0, 0.0])} if flat else {})
    problem = lv.Problem.from_qp(**arrays, name="small")
    lavender.io.save(problem, tmp_path / "p.npz", impulse=lv.solve_qp(problem).impulse)
    stored = lavender.io.read(tmp_path / "p.npz")
    assert stored.problem == problem and stored.problem.name == "small"
    assert stored.problem.qp.solution(stored.impulse).error < 1e-9
    assert answers_of(stored.problem) == answers_of(problem)
    assert (stored.problem.qp.arrays["h"] == arrays["h"]).all()


@pytest.mark.parametrize("keys", ["", "PGA", "G"])
def test_a_plain_archive_of_arrays_is_a_program(tmp_path, keys):
    path = archive(tmp_path / "mine.npz", compressed(PROGRAM, keys))
    stored = lavender.io.read(path)
    assert (stored.format, stored.problem.name) == ("program", "mine")
    assert answers_of(stored.problem) == answers_of(lv.Problem.from_qp(**PROGRAM))
    linear = lavender.io.load(archive(path, {"q": [1.0, 2.0], "lb": [0.0, 3.0]}))
    assert lv.solve_qp(linear, "highs").x.round(9).tolist() == [0.0, 3.0]


def box(tmp_path, **changes):
    rng = np.random.default_rng(0)
    g = rng.normal(size=(7, 7))
    entries = {
        "A": g @ g.T,
        "b": rng.normal(size=7),
        "lo": np.zeros(7),
        "hi": np.full(7, np.inf),
    } | changes
    return archive(tmp_path / "box.npz", {n: v for n, v in entries.items() if v is not None})


def test_load_of_box_npz_keeps_rows_and_contacts_in_order(tmp_path):
    lo = np.array([0.0, -np.inf, 5.0, 5.0, 5.0, -1.0, 7.0])
    hi = np.array([1.0, 0.5, 4.0, 4.0, 4.0, 0.0, 6.0])  # rows of cones do not read theirs
    cones = {"cone_start": [6, 2], "cone_dim": [1, 3], "cone_mu": [0.25, 0.5]}
    found = {"l_ref": np.ones(7), "w_ref": np.zeros(7), "compare": "w"}
    stored = lavender.io.read(box(tmp_path, lo=lo, hi=hi, **cones, **found))
    cones = stored.problem.cones
    assert cones.ptr.tolist() == [0, 1, 2, 5, 6, 7]
    assert cones.kind.tolist() == [lv.ROW, lv.ROW, lv.CONTACT, lv.ROW, lv.CONTACT]
    assert cones.mu.tolist() == [0.0, 0.0, 0.5, 0.0, 0.25]
    assert cones.lower[[0, 1, 5]].tolist() == [0.0, -np.inf, -1.0]
    assert cones.upper[[0, 1, 5]].tolist() == [1.0, 0.5, 0.0]
    assert stored.problem.name == "box"
    assert stored.format == "box"
    assert stored.compare == "w"
    assert np.array_equal(stored.impulse, np.ones(7))
    assert np.array_equal(stored.slack, np.zeros(7))


def test_load_of_box_npz_reads_sparse_matrices_and_any_number_type(tmp_path):
    rng = np.random.default_rng(1)
    a = sp.csr_array(np.where(rng.random((7, 7)) < 0.4, rng.random((7, 7)), 0.0))
    parts = {
        "A": None,
        "A_data": a.data,
        "A_indices": a.indices,
        "A_indptr": a.indptr,
        "A_shape": np.array(a.shape),
    }
    problem = lavender.io.load(box(tmp_path, **parts))
    assert np.array_equal(problem.dense(), a.toarray())
    whole = lavender.io.load(
        box(tmp_path, A=np.asfortranarray(np.triu(np.ones((7, 7), np.int16))), b=np.ones(7, ">f4"))
    )
    assert np.array_equal(whole.dense(), np.triu(np.ones((7, 7))))
    assert whole.b.dtype == np.float64


def test_documentation_lists_every_entry_of_npz(tmp_path):
    text = (Path(__file__).resolve().parent.parent.parent / "docs" / "formats.md").read_text(
        encoding="utf-8"
    )
    for _, problem in variants():
        lavender.io.save(problem, tmp_path / "p.npz", impulse=np.zeros(problem.m))
        with np.load(tmp_path / "p.npz") as saved:
            missing = [name for name in saved if f"`{name}`" not in text]
        assert missing == []


META = {"operator": "dense", "friction": "coulomb", "name": "", "names": None}


@pytest.mark.parametrize(
    ("changes", "sign"),
    [
        ({"lavender_format": np.int64(2)}, "this lavender reads 1"),
        ({"lavender_format": np.array([1, 1])}, "this lavender reads 1"),
        ({"A": None}, "no entry 'A_shape'"),
        ({"cones_mu": None}, "no entry 'cones_mu'"),
        *(
            ({"meta": np.frombuffer(text, np.uint8)}, "JSON")
            for text in (b"{", b"[]", b"\xff\xfe", b"[" * 100_000)
        ),
        ({"meta": {k: x for k, x in META.items() if k != "names"}}, "entry 'meta' has no names"),
        *(
            ({"meta": META | change}, words)
            for change, words in (
                ({"operator": "magic"}, "operator 'magic'"),
                ({"names": "abc"}, "names of blocks is 'abc'"),
                ({"friction": "glue"}, "'coulomb' or 'cone'"),
                ({"names": ["one"]}, "entries for 12 blocks"),
                ({"precision": "float16"}, "precision"),
            )
        ),
    ],
)
def test_load_of_npz_with_other_entries_or_metadata_names_them(tmp_path, changes, sign):
    changes = {
        k: np.frombuffer(json.dumps(v).encode(), np.uint8) if isinstance(v, dict) else v
        for k, v in changes.items()
    }
    with pytest.raises(lv.InputError, match=rf"(?s)own\.npz.*{sign}"):
        lavender.io.load(own(tmp_path, **changes))


@pytest.mark.skipif(os.name != "posix", reason="permissions of POSIX")
@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664])
def test_save_over_a_file_keeps_its_permissions(tmp_path, mode):
    problem = lv.Problem.lcp([[2.0]], [1.0])
    path = tmp_path / "a.npz"
    problem.save(path)
    path.chmod(mode)
    problem.save(path)
    assert path.stat().st_mode & 0o777 == mode


@pytest.mark.parametrize("kind", ["dense", "csr", "rows", "generalized", "program"])
def test_unknown_entries_and_keys_are_refused_by_name_except_the_users_own(tmp_path, kind):
    A = np.array([[2.0, 1.0], [1.0, 2.0]])
    cones = lv.Cones.contacts(0.5, tangents=1)
    problem = {
        "dense": lambda: lv.Problem.lcp(A, [1.0, 1.0]),
        "csr": lambda: lv.Problem.lcp(sp.csr_array(A), [1.0, 1.0]),
        "rows": lambda: lv.suite.case("stack(n=2)").problem,
        "generalized": lambda: lv.Problem.from_jacobian(A, A, [1.0, 0.0], cones=cones),
        "program": lambda: lv.Problem.from_qp(A, [1.0, 1.0], lb=[0.0, 0.0]),
    }[kind]()
    path = tmp_path / "a.npz"
    problem.save(path)
    entries = dict(np.load(path))
    meta = json.loads(bytes(entries["meta"]).decode())
    assert meta["operator"] == kind

    def read(changes, **keys):
        text = np.frombuffer(json.dumps(meta | keys).encode(), np.uint8)
        np.savez(path, **(entries | {"meta": text} | changes))
        return lavender.io.load(path)

    assert (
        read({"user/robot": np.arange(3.0), "user/notes": np.array("text")}, user={"a": 1})
        == problem
    )
    other = {"rows_inv_mass": np.ones(2)} if kind != "rows" else {"A": A}
    for changes in ({"guesss": np.ones(problem.m)}, {"Impulse": np.ones(problem.m)}, other):
        with pytest.raises(lv.InputError, match=f"entry '{next(iter(changes))}' is unknown"):
            read(changes)
    for key in ("foo", "frictions"):
        with pytest.raises(lv.InputError, match=f"'meta': '{key}' is unknown"):
            read({}, **{key: 1})
    with pytest.raises(lv.InputError, match="this lavender reads 1: update it"):
        read({"lavender_format": np.int64(2), "new": np.ones(1)})


def test_misspelt_array_of_a_plain_program_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, P=np.eye(2), q=np.ones(2), lbb=np.zeros(2))
    with pytest.raises(lv.InputError, match="entry 'lbb' is unknown: did you mean 'lb'"):
        lavender.io.load(path)
