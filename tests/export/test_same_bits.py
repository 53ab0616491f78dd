"""Every method, through the public header alone, has the bits of the package."""

import ctypes as ct
import itertools

import numpy as np
import pytest
import random_problems as rp
from clib import METHODS, Refused
from tower import self_test_hash, self_test_problem

import lavender as lv
from lavender.export.view import METHODS as IN_LIBRARY
from lavender.export.view import NotTaken


def problems():
    yield self_test_problem()
    for seed in range(3):
        rng = np.random.default_rng(seed)
        m = 6 + 6 * seed
        g = rng.normal(size=(m, m + 2))
        a = g @ g.T
        yield lv.Problem.linear(a, rng.normal(size=m))
        yield lv.Problem.lcp(a, rng.normal(size=m), lower=-0.2, upper=1.5)
        yield lv.Problem.contact(a, rng.normal(size=m), rng.uniform(0.2, 0.8, size=m // 3))
        yield rp.random_contact_problem(seed)
        yield rp.random_contact_problem(seed, "cone")
    yield rp.random_contact_problem(9, bodies=20, joints=6, contacts=40)  # enough blocks to be swept in pairs
    yield rp.box_stack(3)
    for friction in ("coulomb", "cone"):
        rng = np.random.default_rng(7)
        root = np.diag(rng.uniform(1.0, 2.0, size=12))
        jac = rng.normal(size=(9, 12))
        cones = lv.Cones.contacts(0.5, count=3)
        yield lv.Problem.from_jacobian(jac, root, rng.normal(size=12), cones=cones, friction=friction)


GIVEN = list(problems())
UNSUPPORTED = -11


def test_the_self_test_is_of_the_package(library):
    assert library.c.lav_self_test() == 0
    text = (library.path.parent / "lavender.c").read_text()
    assert f"TEST_HASH = {self_test_hash():#x}u" in text


def test_methods_are_numbered_and_named_as_in_the_header(library):
    for number, name in enumerate(METHODS, 1):
        assert library.c.lav_name(number).decode() == name
    assert {METHODS[number - 1]: number for number in IN_LIBRARY.values()} == IN_LIBRARY


@pytest.mark.parametrize("at", range(len(GIVEN)))
def test_every_method_has_the_bits_of_the_package(library, at):
    given = GIVEN[at]
    start, ran = given.start(), 0
    try:
        problem = library.problem(given, impulse=start)
    except NotTaken as reason:
        pytest.skip(str(reason))
    for name, (n, tol) in itertools.product(IN_LIBRARY, ((1, 0.0), (9, 0.0), (40, 0.0), (300, 1e-7))):
        if name in ("newton", "direct") and tol == 0.0:
            continue  # no fixed budget
        if library.c.lav_takes(ct.byref(problem), ct.byref(library.options(name))) == UNSUPPORTED:
            continue
        try:
            solver = library.open(problem, library.options(name))
        except Refused as refused:
            if (name, refused.code) != ("direct", UNSUPPORTED):
                raise  # `direct` finds an asymmetric A when it has its numbers
            continue
        found = lv.solve(given, name, tol=tol, max_iter=n, impulse=start)
        if given.matrix is None and "rows of A" in found.solver.form:
            continue  # the package formed A, where that costs less
        said = solver.run(n, tol)
        if name == "direct" and said.outcome == 6:
            continue  # FAILED: the package goes on by a line search, which is not in the library
        ran += 1
        case = (name, n, tol, found.solver.form)
        assert solver.impulse().tobytes() == found.impulse.tobytes(), case
        assert said.verdict.relative == found.residual.relative, case
        assert said.verdict.floor == found.residual.floor, case
        assert (
            said.verdict.energy == found.residual.energy and said.verdict.velocity == found.residual.velocity
        )
        if tol and name not in ("newton", "direct"):
            assert said.iterations == found.iterations, case
    assert ran >= 4


@pytest.mark.parametrize("order", ["symmetric", "random", "reverse"])
def test_orders_of_a_sweep(library, order):
    given = self_test_problem()
    options = library.options("sequential_impulses", order={"symmetric": 1, "random": 2, "reverse": 3}[order])
    options.seed = 5 if order == "random" else 0
    more = {"seed": 5} if order == "random" else {}
    found = lv.solve(given, "sequential_impulses", tol=0, max_iter=17, order=order, **more)
    solver = library.open(library.problem(given), options)
    solver.run(10, 0.0)
    solver.run(7, 0.0)  # runs go on where the last one ended
    assert solver.impulse().tobytes() == found.impulse.tobytes()


@pytest.mark.parametrize("options", [{"memory": 2}, {"sweep": 2}, {"convex": 5}])
def test_options_of_accelerated_sweeps(library, options):
    given = self_test_problem()
    words = {key: "blocks" if key == "sweep" else value for key, value in options.items()}
    found = lv.solve(given, "anderson", tol=0, max_iter=25, **words)
    solver = library.open(library.problem(given), library.options("anderson", **options))
    solver.run(25, 0.0)
    assert solver.impulse().tobytes() == found.impulse.tobytes()


def test_impulses_are_carried_by_key(library):
    given = self_test_problem()
    key = np.arange(12, dtype=np.uint64) + np.uint64(100)
    solver = library.open(library.problem(given, key=key), library.options("sequential_impulses"))
    solver.run(20, 0.0)
    before = solver.impulse().reshape(12, 3)
    turned = np.roll(key, 5)
    turned[3] = 7  # nobody's before
    assert solver.set(library.problem(given, key=turned)) == 0
    wanted = np.roll(before, 5, axis=0)
    wanted[3] = 0.0
    assert solver.impulse().tobytes() == wanted.tobytes()
    assert solver.set(library.problem(given)) == 0  # without keys nothing is carried
    assert not solver.impulse().any()


def test_velocities_are_those_of_the_problem(library):
    given = self_test_problem()
    solver = library.open(library.problem(given), library.options("sequential_impulses"))
    solver.run(30, 0.0)
    out = np.zeros(18)
    assert library.c.lav_velocity(solver.at, out.ctypes.data, 18) == 0
    np.testing.assert_allclose(out.reshape(3, 6), given.velocity(solver.impulse()), rtol=0.0, atol=1e-14)


def test_islands_are_what_shares_no_body(library):
    given = rp.random_contact_problem(3)
    solver = library.open(library.problem(given), library.options("block_gauss_seidel"))
    label = np.full(given.n_blocks, -1, np.int32)
    count = library.c.lav_islands(solver.at, label.ctypes.data, given.n_blocks)
    assert count >= 1 and sorted(set(label.tolist())) == list(range(count))
