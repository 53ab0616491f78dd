"""Problems: what they derive, what they keep, and every kind of bad input by its message."""

import copy
import pickle
from dataclasses import fields, replace

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from random_problems import FORMS, arrays_of, as_matrix, random_contact_problem, random_lcp, seeds
from worked import python

import lavender as lv

I2 = np.eye(2)


def test_problem_law_follows_from_the_kinds_of_blocks():
    assert lv.Problem.linear(I2, [1, 1]).law == "linear"
    assert lv.Problem.lcp(I2, [1, 1]).law == "lcp"
    assert lv.Problem.lcp(I2, [1, 1], lower=-np.inf).law == "linear"
    assert lv.Problem.contact(I2, [1, 1], [0.0, 0.0]).law == "lcp"  # normals only
    assert lv.Problem.contact(I2, [1, 1], [0.5]).law == "coulomb"
    assert lv.Problem.contact(I2, [1, 1], [0.5], friction="cone").law == "cone"
    assert repr(lv.Problem.contact(I2, [1, 1], [0.5], friction=np.str_("cone")).law) == repr("cone")
    assert lv.Problem.contact(I2, [1, 1], [0.5], patch_radius=[0.1]).law == "coulomb"


@pytest.mark.parametrize("given_by", ["rows", "J and M"])
@given(seed=seeds)
def test_problem_of_v_free_has_the_b_of_its_target(given_by, seed):
    problem = FORMS[given_by](random_contact_problem(seed))
    form = problem.velocity_form()
    k = form.jacobian.toarray()
    s = form.scale
    a = (k @ k.T + np.diag(form.theta)) / np.outer(s, s)
    np.testing.assert_allclose(a, problem.dense(), atol=1e-12 * np.abs(a).max())
    np.testing.assert_allclose(form.rhs / s, problem.b, rtol=1e-14)
    z = np.ones(problem.m)
    np.testing.assert_allclose(form.impulse(z), s)


def test_problem_relaxed_or_boxed_differs_in_its_law_alone():
    problem = random_contact_problem(4, tangents=2, spin=True)
    cone = problem.relaxed("cone")
    assert (cone.law, cone.relaxed("coulomb")) == ("cone", problem)
    coordinates = FORMS["J and M"](problem)
    for other in (coordinates.relaxed("cone"), coordinates.boxed(0.7)):
        assert other.generalized is coordinates.generalized
    c = problem.rows.n_contacts
    boxed = problem.boxed(np.full(c, 2.0))
    assert boxed.law == "lcp"
    i = problem.rows.n_joints
    j, mu, r = problem.cones.ptr[i], problem.cones.mu[i], problem.cones.patch_radius[i]
    np.testing.assert_allclose(boxed.cones.upper[j : j + 4], [np.inf, 2 * mu, 2 * mu, 2 * mu * r])
    np.testing.assert_allclose(boxed.cones.lower[j : j + 4], [0.0, -2 * mu, -2 * mu, -2 * mu * r])


def test_problem_rows_have_names():
    problem = random_contact_problem(6, tangents=2, spin=True)
    kj = problem.rows.n_joints
    first = int(problem.cones.ptr[kj])
    assert [problem.row_name(first + i) for i in range(4)] == [
        "contact 0, normal",
        "contact 0, tangent 1",
        "contact 0, tangent 2",
        "contact 0, spin",
    ]
    cone = lv.Problem(np.ones(6), lv.Cones.contacts(0.5, 5), np.eye(6), friction="cone")
    assert [cone.row_name(i) for i in (3, 4)] == ["contact 0, spin", "contact 0, roll 1"]
    named = lv.Problem(
        problem.b,
        problem.cones,
        rows=problem.rows,
        names=[f"hinge {i}" for i in range(kj)] + ["box 1 on box 2"] * 8,
    )
    wide = int(np.argmax(np.diff(problem.cones.ptr[: kj + 1]) > 1))
    assert named.row_name(int(problem.cones.ptr[wide]) + 1) == f"hinge {wide}, axis 1"
    assert named.row_name(first) == "box 1 on box 2, normal"
    assert random_lcp(1).row_name(3) == "row 3"


def test_from_rows_with_a_scalar_mu_or_one_for_each_contact_is_the_same():
    assert lv.Problem.contact(np.eye(3), np.ones(3), mu=[0.0, 0.0, 0.0]).law == "lcp"
    assert lv.Problem.contact(np.eye(9), np.ones(9), mu=0.5) == lv.Problem.contact(
        np.eye(9), np.ones(9), mu=[0.5] * 3
    )
    assert lv.Problem.contact(np.eye(8), np.ones(8), mu=0.5, patch_radius=0.1).n_blocks == 2
    assert lv.Problem.contact(np.eye(2), np.ones(2), mu=0.5).n_blocks == 1


@pytest.mark.parametrize(
    "again", [copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))]
)
def test_problems_and_solutions_are_copied_and_pickled_after_use(again):
    for problem in (random_lcp(0), random_contact_problem(0), as_matrix(random_contact_problem(0))):
        solution = lv.solve(problem, "pgs", history=True)
        twin, result = again(problem), again(solution)
        assert twin == problem
        assert not twin.b.flags.writeable
        for name in ("ptr", "kind", "lower", "upper", "mu", "patch_radius"):
            assert not getattr(twin.cones, name).flags.writeable
        assert twin.rows is None or not twin.rows.jac.flags.writeable
        np.testing.assert_array_equal(lv.solve(twin, "pgs").impulse, solution.impulse)
        np.testing.assert_array_equal(result.slack, solution.slack)
        assert str(result) == str(solution)
        assert result.work == solution.work


def test_ctrl_c_by_a_signal_ends_a_solve_as_interrupted():
    code = (
        "import _thread, threading, numpy as np, lavender as lv\n"
        "problem = lv.Problem.lcp(np.eye(3) * 2 - np.eye(3, k=1) - np.eye(3, k=-1), [1.0, 1.0, 1.0])\n"
        "lv.solve(problem, 'pgs')\n"  # first: what is imported at first use takes its time
        "seen = threading.Event()\n"
        "threading.Thread(target=lambda: seen.wait() and _thread.interrupt_main()).start()\n"
        "watch = lambda n, impulse, residual: seen.set() if n > 1000 else None\n"
        "solution = lv.solve(problem, 'pgs', tol=0.0, max_iter=2**31 - 1, callback=watch)\n"
        "assert solution.status is lv.Status.INTERRUPTED, solution\n"
        "assert solution.iterations > 1000 and solution.residual.relative < 1e-9, solution\n"
    )
    python("-c", code)


def given_arrays():
    """Arrays as callers hold them, float64 and int32, writable and contiguous: what could be taken as it is."""
    general = random_contact_problem(3)
    rows = general.rows
    jac = general.jacobian.toarray()
    given = {
        "A": random_lcp(3).dense(),
        "b": np.array(random_lcp(3).b),
        "lower": np.zeros(12),
        "upper": np.full(12, 2.0),
        "mu": np.full(4, 0.5),
        "patch": np.full(4, 0.1),
        "guess": np.zeros(12),
        "J": jac,
        "M": 2.0 * np.eye(jac.shape[1]),
        "v": np.ones(jac.shape[1]),
        "target": np.array(general.b),
        "soft": np.full(general.m, 1e-3),
        "warm": np.zeros(general.m),
        "key": np.arange(12, dtype=np.uint64),
    }
    return given | {
        f.name: np.array(getattr(rows, f.name)) for f in fields(rows) if f.name != "copy"
    }


def makers(sparse):
    """A problem of each constructor; `sparse`, where it is not None, is the format of A, J and M."""
    form = sparse or (lambda a: a)
    cones = random_contact_problem(3).cones

    def of_rows(g):
        return lv.Rows(**{f.name: g[f.name] for f in fields(lv.Rows) if f.name != "copy"})

    def of_jacobian(g):
        return lv.Problem.from_jacobian(
            form(g["J"]),
            form(g["M"]),
            g["v"],
            target=g["target"],
            cones=cones,
            compliance=g["soft"],
            guess=g["warm"],
        )

    def blocks_of_mass(g):
        half = g["M"].shape[0] // 2
        blocks = [
            np.ascontiguousarray(g["M"][:half, :half]),
            np.ascontiguousarray(g["M"][half:, half:]),
        ]
        made = lv.Problem.from_jacobian(g["J"], blocks, g["v"], target=g["target"], cones=cones)
        assert all(block.flags.writeable for block in blocks)
        return made

    return {
        "linear": lambda g: lv.Problem.linear(form(g["A"]), g["b"], guess=g["guess"]),
        "lcp": lambda g: lv.Problem.lcp(form(g["A"]), g["b"], g["lower"], g["upper"], key=g["key"]),
        "contact": lambda g: lv.Problem.contact(form(g["A"]), g["b"], g["mu"]),
        "spin": lambda g: lv.Problem.contact(
            form(g["A"]), g["b"], g["mu"], patch_radius=g["patch"]
        ),
        "from_rows": lambda g: lv.Problem.from_rows(
            of_rows(g), g["target"][: len(g["jac"]) + len(g["normal"])]
        ),
        "from_jacobian": of_jacobian,
        "blocks of M": blocks_of_mass,
        "updated": lambda g: of_jacobian(given_arrays()).updated(
            J=form(g["J"]), M=form(g["M"]), v_free=g["v"], target=g["target"], guess=g["warm"]
        ),
        "with a new J": lambda g: of_jacobian(given_arrays()).updated(
            J=form(g["J"]), b=g["target"]
        ),
        "of an adopted one": lambda g: lv.Problem.lcp(
            given_arrays()["A"], given_arrays()["b"], copy=False
        ).updated(b=g["b"], guess=g["guess"]),
        "of another law": lambda g: (
            random_contact_problem(3).relaxed().updated(b=g["target"], guess=g["warm"])
        ),
        "replaced": lambda g: replace(random_contact_problem(3), b=g["target"], guess=g["warm"]),
    }


@pytest.mark.parametrize("sparse", [None, sp.csr_array, sp.coo_array])
@pytest.mark.parametrize("maker", makers(None))
def test_problem_with_copy_leaves_arrays_writable_and_unshared(maker, sparse):
    given = given_arrays()
    matrices = []
    form = sparse and (lambda a: matrices.append(sparse(a)) or matrices[-1])
    problem = makers(form)[maker](given)
    before = pickle.dumps(problem)
    assert [name for name, array in given.items() if not array.flags.writeable] == []
    kept = arrays_of(problem, "problem", set())
    assert [k for k, x in kept for y in given.values() if x.size and np.shares_memory(x, y)] == []
    for array in given.values():
        array[...] = array + 1  # a loop fills its arrays anew
    for matrix in matrices:
        matrix.data += 1.0
    assert pickle.dumps(problem) == before


def test_problem_without_copy_shares_read_only_arrays():
    given = given_arrays()
    problem = lv.Problem(
        given["b"], random_lcp(3).cones, given["A"], guess=given["guess"], copy=False
    )
    for name, kept in (("b", problem.b), ("A", problem.matrix), ("guess", problem.guess)):
        assert kept is given[name]
        assert not kept.flags.writeable


@pytest.mark.parametrize(
    ("rows", "bounds", "tangents"),
    [
        (6, {"mu": 0.7}, [2, 2]),
        (6, {"mu": [0.7, 0.2]}, [2, 2]),
        (4, {"mu": 0.7, "tangents": 1}, [1, 1]),
        (4, {"mu": [0.7, 0.2]}, [1, 1]),
        (2, {"mu": 0.0, "tangents": 0}, [0, 0]),
        (6, {"mu": [(0.7, 0.2)] * 2}, [2, 2]),
    ],
)
def test_from_jacobian_with_mu_has_the_contacts_of_its_rows(rows, bounds, tangents):
    rng = np.random.default_rng(0)
    jac = rng.normal(size=(rows, 7))
    mass = np.eye(7)
    v = rng.normal(size=7)
    problem = lv.Problem.from_jacobian(jac, mass, v, **bounds)
    cones = lv.Cones.contacts(
        np.broadcast_to(bounds["mu"], (2, *np.shape(bounds["mu"])[1:])), tangents[0]
    )
    assert problem == lv.Problem.from_jacobian(jac, mass, v, cones=cones)
    assert problem.cones.n_tangents.tolist() == tangents
