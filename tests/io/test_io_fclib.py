"""FCLIB files: what they hold is kept to the bit, what they cannot hold is named."""

import dataclasses
import os

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from random_problems import as_matrix, dragged, random_contact_problem, seeds, touching

import lavender as lv
import lavender.io

h5py = pytest.importorskip("h5py", reason="FCLIB files need the extra fclib")


def local_problem(spacedim=3, contacts=4, guess=True):
    """An asymmetric W with a stored zero, as recorded problems have them."""
    rng = np.random.default_rng(contacts)
    m = spacedim * contacts
    w = sp.csr_array(rng.normal(size=(m, m)) * (rng.random((m, m)) < 0.6))
    w.data[0] = 0.0
    rolling = rng.uniform(0.0, 0.3, contacts) if spacedim == 5 else None
    cones = lv.Cones.contacts(
        rng.uniform(0.0, 1.0, contacts), min(spacedim - 1, 2), rolling=rolling
    )
    guess = rng.random(m) if guess else None
    return lv.Problem(rng.normal(size=m), cones, w, guess=guess, name="local")


def global_problem(seed=0, tangents=2, **more):
    return random_contact_problem(seed, tangents=tangents, spin=False, joints=0, **more)


def soft(problem, compliance=0.0):
    """The same with one compliance for every row."""
    return lv.Problem(
        problem.b, problem.cones, rows=problem.rows, compliance=np.full(problem.m, compliance)
    )


@pytest.mark.parametrize("spacedim", [2, 3, 5])
@pytest.mark.parametrize("suffix", [".hdf5", ".h5"])
def test_fclib_local_file_keeps_every_bit(tmp_path, spacedim, suffix):
    problem = local_problem(spacedim)
    kind = "fclib_local_rolling" if spacedim == 5 else "fclib_local"
    impulse = np.linspace(0.0, 1.0, problem.m)
    path = tmp_path / f"p{suffix}"
    lavender.io.save(problem, path, impulse=impulse)
    stored = lavender.io.read(path)
    assert stored.problem == problem and stored.format == kind
    assert stored.problem.guess.tobytes() == problem.guess.tobytes()
    assert stored.impulse.tobytes() == impulse.tobytes()
    assert stored.slack.tobytes() == problem.slack(impulse).tobytes()
    assert [g.tobytes() for g in stored.guesses] == [problem.guess.tobytes()]
    assert stored.info["title"] == "local"
    with h5py.File(path) as file:  # FCLIB's own names, in FCLIB's sign
        group = file[kind]
        w = sp.csr_array(
            (group["W/x"][()], group["W/i"][()], group["W/p"][()]), shape=(problem.m, problem.m)
        )
        assert np.array_equal(w.toarray(), problem.dense())
        assert np.array_equal(group["vectors/q"][()], -problem.b)
        assert np.array_equal(group["vectors/mu"][()], problem.cones.mu)
        assert spacedim < 5 or np.array_equal(group["vectors/mu_r"][()], problem.cones.rolling)
        assert [group[f"W/{n}"][()].tolist() for n in ("m", "n", "nz", "nzmax")] == [
            [problem.m],
            [problem.m],
            [-2],
            [w.nnz],
        ]
        assert group["spacedim"][()].tolist() == [spacedim]
        assert group["W/p"].dtype == np.int32
        assert file["guesses/number_of_guesses"][()].tolist() == [1]
        assert np.array_equal(file["guesses/1/r"][()], problem.guess)
        assert np.array_equal(file["solution/r"][()], impulse)
    with h5py.File(path, "r+") as file:  # Of several guesses the first is the problem's.
        file.copy("guesses/1", "guesses/2")
        file["guesses/2/r"][...] = 2.0 * problem.guess
        file["guesses/number_of_guesses"][...] = 2
    assert lv.load(path).guess.tobytes() == problem.guess.tobytes()


@given(seeds, st.sampled_from([2, 3, 5]))
def test_save_of_bodies_writes_the_local_form_with_the_bits_of_a(tmp_path_factory, seed, spacedim):
    problem = soft(global_problem(seed, min(spacedim - 1, 2), rolling=spacedim == 5), 0.125)
    impulse = np.linspace(0.0, 1.0, problem.m)
    path = tmp_path_factory.mktemp("local") / "p.hdf5"
    lavender.io.save(problem, path, impulse=impulse)
    stored = lavender.io.read(path)
    assert stored.format == ("fclib_local_rolling" if spacedim == 5 else "fclib_local")
    assert stored.problem.cones == problem.cones and stored.impulse.tobytes() == impulse.tobytes()
    assert np.array_equal(
        stored.problem.dense(), problem.dense()
    )  # compliance is on the diagonal of W
    assert np.array_equal(stored.problem.b, problem.b)


def make(path, spacedim=3, **parts):
    """An FCLIB file by hand: matrices as dicts of datasets, vectors as arrays."""
    kind = "fclib_global" if "M" in parts else "fclib_local"
    with h5py.File(path, "w") as file:
        group = file.create_group(kind)
        group["spacedim"] = np.array([spacedim], np.int32)
        for name, value in parts.items():
            if isinstance(value, dict):
                for part, x in value.items():
                    group[f"{name}/{part}"] = x
            else:
                group[f"vectors/{name}"] = value
    return path


def encoded(a, nz, spare=0):
    """A dense matrix in FCLIB's compressed rows (-2), columns (-1), or triplets, with `spare` unused entries."""
    a = np.asarray(a, float)
    rest = np.full(spare, 7)
    if nz == -2:
        c = sp.csr_array(a)
        p, i, x = c.indptr, c.indices, c.data
    elif nz == -1:
        c = sp.csc_array(a)
        p, i, x = c.indptr, c.indices, c.data
    else:
        c = sp.coo_array(a)
        p = np.append(c.coords[1], rest)
        i = c.coords[0]
        x = c.data
        nz = c.nnz
    x = np.append(x, np.full(spare, np.nan))
    i = np.append(i, rest)
    numbers = {"m": a.shape[0], "n": a.shape[1], "nz": nz, "nzmax": len(x)}
    out = {name: np.array([value], np.int32) for name, value in numbers.items()}
    return out | {"p": p.astype(np.int32), "i": i.astype(np.int32), "x": x}


W = np.array([[2.0, 0.5, 0.0], [0.0, 1.0, 0.25], [0.125, 0.0, 3.0]])


@pytest.mark.parametrize("spare", [0, 5])
@pytest.mark.parametrize("nz", [-2, -1, 0])
def test_load_of_fclib_in_every_matrix_storage_gives_the_same_problem(tmp_path, nz, spare):
    problem = lavender.io.load(
        make(tmp_path / "p.h5", W=encoded(W, nz, spare), q=np.arange(3.0), mu=[0.5])
    )
    assert np.array_equal(problem.dense(), W)
    assert np.array_equal(problem.b, -np.arange(3.0))
    m = np.diag([2.0, 4.0, 0.5, 1.0])
    h = np.vstack([W, np.ones(3)])
    parts = {"M": encoded(m, nz, spare), "H": encoded(h, nz, spare)}
    problem = lavender.io.load(
        make(tmp_path / "g.h5", f=np.arange(4.0), w=np.ones(3), mu=[0.5], **parts)
    )
    assert np.array_equal(problem.generalized.jac.toarray(), h.T)
    assert np.array_equal(problem.generalized.mass.toarray(), m)
    np.testing.assert_allclose(problem.dense(), h.T @ np.linalg.inv(m) @ h, rtol=1e-15)
    assert np.array_equal(
        problem.b, -(np.ones(3) + h.T @ np.linalg.inv(m) @ np.arange(4.0))
    )  # powers of two: exact


def test_load_of_fclib_sums_repeated_triplets(tmp_path):
    parts = {n: np.array([v], np.int32) for n, v in {"m": 3, "n": 3, "nz": 4, "nzmax": 4}.items()}
    parts |= {
        "p": np.array([0, 1, 2, 1]),
        "i": np.array([0, 1, 2, 1]),
        "x": np.array([1.0, 2.0, 3.0, 4.0]),
    }
    problem = lavender.io.load(make(tmp_path / "p.h5", W=parts, q=np.zeros(3), mu=[0.0]))
    assert np.array_equal(problem.dense(), np.diag([1.0, 6.0, 3.0]))


def test_load_of_global_fclib_with_an_asymmetric_m_forms_a(tmp_path):
    m = np.diag([2.0, 4.0, 0.5])
    h = W.T
    m[0, 1] = 1.0
    parts = {"M": encoded(m, -2), "H": encoded(h, -2)}
    problem = lavender.io.load(
        make(tmp_path / "g.h5", f=np.arange(3.0), w=np.ones(3), mu=[0.5], **parts)
    )
    assert problem.operator == "matrix"
    np.testing.assert_allclose(problem.dense(), h.T @ np.linalg.inv(m) @ h, rtol=1e-14, atol=1e-15)
    # A change of the rest of M that makes it symmetric changes the way, not the formula.
    for asymmetry in (0.0, 1.0):
        m[0, 1] = asymmetry
        parts = {"M": encoded(m, -2), "H": encoded(h, -2)}
        path = make(tmp_path / f"{asymmetry}.h5", f=np.arange(3.0), w=np.ones(3), mu=[0.5], **parts)
        expected = -(1.0 + h.T @ np.linalg.inv(m) @ np.arange(3.0))
        np.testing.assert_allclose(lavender.io.load(path).b, expected, rtol=1e-14, atol=1e-15)


def test_load_of_fclib_equations_become_free_rows(tmp_path):
    """Local V, R, s and global G, b: the same mechanism, joined rigidly at one row."""
    m = np.diag([2.0, 4.0, 0.5, 1.0])
    h = np.vstack([W, np.ones(3)])
    g = np.array([[1.0], [0.0], [0.0], [-1.0]])
    f = np.arange(4.0)
    w = np.ones(3)
    b = np.array([0.25])
    glob = lavender.io.load(
        make(
            tmp_path / "g.h5",
            M=encoded(m, -2),
            H=encoded(h, -2),
            G=encoded(g, -2),
            f=f,
            w=w,
            b=b,
            mu=[0.5],
        )
    )
    inv = np.linalg.inv(m)
    local = {"W": h.T @ inv @ h, "V": h.T @ inv @ g, "R": g.T @ inv @ g}
    parts = {name: encoded(x, -2) for name, x in local.items()}
    loc = lavender.io.load(
        make(tmp_path / "l.h5", q=w + h.T @ inv @ f, s=b + g.T @ inv @ f, mu=[0.5], **parts)
    )
    assert glob.cones.kind.tolist() == [lv.CONTACT, lv.ROW]
    np.testing.assert_allclose(glob.dense(), loc.dense(), rtol=1e-15, atol=1e-15)
    assert np.array_equal(glob.b, loc.b)
    assert glob.cones == loc.cones
    assert np.all(np.isinf([glob.cones.lower[3], glob.cones.upper[3]]))
    with h5py.File(tmp_path / "l.h5", "a") as file:
        for name, x in (("r", [1.0, 0.2, 0.3]), ("u", [0.0, 0.5, 0.0]), ("l", [7.0])):
            file[f"solution/{name}"] = x
    stored = lavender.io.read(tmp_path / "l.h5")  # On an equation the slack is 0.
    assert (stored.impulse.tolist(), stored.slack.tolist()) == (
        [1.0, 0.2, 0.3, 7.0],
        [0.0, 0.5, 0.0, 0.0],
    )


def test_load_of_fclib_with_both_forms_reads_the_local_one(tmp_path):
    path = make(tmp_path / "p.h5", W=encoded(W, -2), q=np.zeros(3), mu=[0.5])
    with h5py.File(path, "a") as file:
        file.create_group("fclib_global")
    assert lavender.io.read(path).format == "fclib_local"


def test_save_to_fclib_of_unsupported_data_names_it(tmp_path):
    rows = soft(global_problem())
    named = lv.Problem(rows.b, rows.cones, rows=rows.rows, names=["x"] * 8, key=range(8))
    single = np.eye(3, dtype=np.float32)
    moved = lv.Problem.from_jacobian(
        single,
        single,
        single[0],
        cones=lv.Cones.contacts(0.5),
        dof_names=["x", "y", "z"],
        name="\ud800",
    )
    heavy = lv.Problem.from_rows(touching([[-1, 0]], inv_mass=[0.0]), tangents=2)
    cases = [
        (lv.Problem.lcp(np.eye(2), [1.0, 1.0]), {}, ["blocks of bounded rows .*2 bounded rows"]),
        (lv.Problem.linear(np.eye(2), [1.0, 1.0]), {}, ["blocks of bounded rows .*2 free rows"]),
        (
            random_contact_problem(0),
            {},
            ["blocks of bounded rows", "torsional friction", "contacts of"],
        ),
        (
            lv.Problem.contact(np.eye(4), np.ones(4), [0.5], patch_radius=[0.1]),
            {},
            ["torsional friction"],
        ),
        (lv.Problem.contact(np.eye(2), np.ones(2), [0.0, 0.0]), {}, ["contacts of 1 rows"]),
        (lv.Problem.contact(np.eye(3), np.ones(3), [0.5], friction="cone"), {}, ["'cone' law"]),
        (lv.Problem.contact(np.zeros((0, 0)), [], []), {}, ["without contacts"]),
        (named, {}, ["names of blocks", "keys of blocks"]),
        (named, {"drop": ["names"]}, ["keys of blocks"]),
        (moved, {}, ["names of velocities", "precision 'float32'", "surrogate"]),
        (dataclasses.replace(named, name="whole\0"), {}, ["NUL character in its name"]),
        (as_matrix(dragged(3, 4, shape="box")), {}, ["box"]),
        (dragged(0, 3), {}, ["ellipses"]),
    ]
    for problem, options, signs in cases:
        for sign in signs:
            with pytest.raises(lv.CapabilityError, match=sign):
                lavender.io.save(problem, tmp_path / "p.hdf5", **options)
    assert os.listdir(tmp_path) == []
    lavender.io.save(named, tmp_path / "p.hdf5", drop=["names", "key"])
    lavender.io.save(heavy, tmp_path / "p.hdf5")
    plain = dataclasses.replace(moved, name="plain")
    lavender.io.save(plain, tmp_path / "p.hdf5", drop=["names", "precision"])
    with pytest.raises(lv.InputError, match="only 'names', 'key' and 'precision'"):
        lavender.io.save(rows, tmp_path / "p.hdf5", drop=["compliance"])
    with pytest.raises(lv.InputError, match=r"a lavender\.Problem is needed"):
        lavender.io.save(None, tmp_path / "p.hdf5")


GOOD = encoded(W, -2)


@pytest.mark.parametrize(
    ("changes", "sign"),
    [
        ({"W": GOOD | {"m": np.array([2**40])}}, "32-bit integer"),
        ({"W": GOOD | {"nz": np.array([-3], np.int32)}}, "nz must be -2"),
        (
            {"W": GOOD | {"nz": np.array([5], np.int32), "p": np.zeros(4, np.int32)}},
            "nz announces 5 triplets",
        ),
        (
            {"W": GOOD | {"nz": np.array([3], np.int32), "p": np.array([0, 1, 3], np.int32)}},
            "outside of the matrix",
        ),
        ({"mu": [-0.5]}, "mu"),
        ({"spacedim": 2}, "has 3 rows; a multiple of spacedim = 2"),
        ({"spacedim": 5}, "2 or 3 is needed"),
    ],
)
def test_load_of_an_inconsistent_fclib_file_names_the_entry(tmp_path, changes, sign):
    parts = {"W": GOOD, "q": np.zeros(3), "mu": [0.5]} | changes
    path = make(tmp_path / "bad.h5", **{n: v for n, v in parts.items() if v is not None})
    with pytest.raises(lv.InputError, match=sign) as error:
        lavender.io.load(path)
    assert "bad.h5" in str(error.value)
