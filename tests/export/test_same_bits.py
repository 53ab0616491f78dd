"""Every method, through the public header alone, has the bits of the package."""

import ctypes as ct
import dataclasses
import itertools
import re
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
import random_problems as rp
from clib import METHODS, Motion, Refused, run
from tower import self_test_hash, self_test_problem
from vectors import OTHER_BITS, NotSupported, is_accepted_by_library, run_compiled_newton
from worked import ROOT

import lavender as lv


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
    yield rp.random_contact_problem(
        9, bodies=20, joints=6, contacts=40
    )  # enough blocks to be swept in pairs
    yield lv.suite.box_stack(3).problem
    for friction in ("coulomb", "cone"):
        rng = np.random.default_rng(7)
        root = np.diag(rng.uniform(1.0, 2.0, size=4))  # so few that sweeps go over J
        jac = rng.normal(size=(9, 4))
        cones = lv.Cones.contacts(0.5, count=3)
        yield lv.Problem.from_jacobian(
            jac, root, rng.normal(size=4), cones=cones, friction=friction
        )
        yield ill_conditioned(7, friction)
        yield from kinds_of(friction)
        yield from kinds_of(
            friction, mu=0.0
        )  # the law is what sweeps know, not how rough a contact is


def ill_conditioned(seed, friction):
    """J and an M of condition 1e10, whose factor loses what is asked for."""
    rng = np.random.default_rng(seed)
    mass = rp.conditioned(rng, 4, 1e10)
    cones = lv.Cones.contacts(0.5, count=2)
    jac = rng.normal(size=(6, 4))
    v = rng.normal(size=4)
    return lv.Problem.from_jacobian(jac, mass, v, cones=cones, friction=friction)


def kinds_of(friction, mu=0.4):
    """Boxes, contacts that resist rolling, and round cones; bodies have none of the last."""
    rng = np.random.default_rng(11)
    shapes = [({"shape": "box"}, 3), ({"rolling": 0.1, "tangents": 2}, 5)]
    shapes += [({"tangents": 4}, 5)] if friction == "cone" else []
    tower = self_test_problem().rows
    for more in ({"shape": "box", "tangents": 2}, {"rolling": 0.05, "tangents": 2}):
        yield lv.Problem.from_rows(tower, mu=mu, friction=friction, **more)
    for given, rows in shapes:
        cones = lv.Cones.contacts(mu, count=3, **given)
        jac = rng.normal(size=(3 * rows, 20))
        yield lv.Problem(rng.normal(size=3 * rows), cones, jac @ jac.T, friction=friction)
        yield lv.Problem.from_jacobian(
            jac[:, :4], np.eye(4), rng.normal(size=4), cones=cones, friction=friction
        )


def is_formed(given, found):
    """Whether the package swept over rows of an A that it formed, by what `solver.form` says."""
    form = found.solver.form
    return given.matrix is None and (
        "rows of A" in form or (found.solver.name in ("pgs", "jacobi") and form != "whitened J")
    )


def dense_velocities():
    """J and a full M, so few velocities that sweeps over A cost less: the package forms it."""
    for seed, friction in itertools.product(range(4), ("coulomb", "cone")):
        rng = np.random.default_rng(seed)
        root = rng.normal(size=(24, 24))
        m = 9 * (1 + seed)
        cones = (
            lv.Cones.contacts(0.5, count=m // 3)
            if seed
            else lv.Cones.contacts(0.0, count=m, tangents=0)
        )
        jac = rng.normal(size=(m, 24))
        mass = np.eye(24) + 0.1 * root @ root.T
        yield lv.Problem.from_jacobian(
            jac, mass, rng.normal(size=24), cones=cones, friction=friction
        )


def of_matrix(given):
    return lv.Problem(given.b, given.cones, given.csr, friction=given.friction)


GIVEN = list(problems())
SWEPT = [*GIVEN, *dense_velocities()]
UNSUPPORTED = -11


def test_c_library_self_test_has_the_hash_of_the_package(library):
    assert library.c.lav_self_test() == 0
    text = (library.path.parent / "lavender.c").read_text()
    assert f"TEST_HASH = {self_test_hash():#x}u" in text


def test_methods_are_numbered_and_named_as_in_the_header(library):
    assert sorted(METHODS.values()) == list(range(1, 13))
    for name, number in METHODS.items():
        assert library.c.lav_name(number).decode() == name
    (part,) = re.findall(
        r"^- \*\*Methods\*\*: (.*?)^- ", (ROOT / "docs" / "c.md").read_text(), re.M | re.S
    )
    assert sorted(re.findall(r"`(\w+)`", part)) == sorted(METHODS)


@pytest.mark.parametrize("at", range(len(SWEPT)))
def test_c_library_method_has_the_bits_of_the_package(library, at):
    """Where `solver.form` says that it swept over rows of A, on that matrix: `problem.csr` is the one to give."""
    given = SWEPT[at]
    start = given.start()
    ran = 0
    formed = 0
    try:
        problem = library.problem(given, impulse=start)
    except NotSupported as reason:
        pytest.skip(str(reason))
    for name, (n, tol) in itertools.product(METHODS, ((1, 0.0), (9, 0.0), (40, 0.0), (300, 1e-7))):
        if name in OTHER_BITS or (name in ("newton", "direct") and tol == 0.0):
            continue  # no fixed budget
        if library.c.lav_takes(ct.byref(problem), ct.byref(library.options(name))) == UNSUPPORTED:
            continue
        try:
            solver = library.open(problem, library.options(name))
        except Refused as refused:
            if (name, refused.code) != ("direct", UNSUPPORTED):
                raise  # `direct` finds an asymmetric A when it has its numbers
            continue
        if name == "newton" and given.generalized is None:
            wanted, factorisations = run_compiled_newton(given, tol, n)
            said = solver.run(n, tol)
            assert (solver.impulse().tobytes(), said.iterations) == (
                wanted.tobytes(),
                factorisations,
            )
            continue
        found = lv.solve(given, name, tol=tol, max_iter=n, impulse=start)
        case = (name, n, tol, found.solver.form)
        ran += 1
        if is_formed(given, found):
            formed += 1
            solver = library.open(
                library.problem(of_matrix(given), impulse=start), library.options(name)
            )
            solver.run(n, tol)
            if tol == 0.0:  # the judge, who ends it, reads the problem as it is given
                assert solver.impulse().tobytes() == found.impulse.tobytes(), case
            continue
        said = solver.run(n, tol)
        assert solver.impulse().tobytes() == found.impulse.tobytes(), case
        assert said.verdict.relative == found.residual.relative, case
        assert said.verdict.floor == found.residual.roundoff_floor, case
        assert said.verdict.worst == found.residual.worst_row, case
        assert tol == 0.0 or (said.outcome == 1) == (said.verdict.relative <= tol), case
        assert (
            said.verdict.energy == found.residual.energy
            and said.verdict.velocity == found.residual.velocity
        )
        if (tol or name == "lemke") and name not in ("newton", "direct"):
            assert said.iterations == found.iterations, case
    assert ran >= 4 and (formed or at < len(GIVEN))


@pytest.mark.parametrize(
    ("name", "friction"),
    [
        ("pgs", "coulomb"),
        ("block_gauss_seidel", "cone"),
        ("anderson", "coulomb"),
        ("nncg", "cone"),
        ("newton", "cone"),
    ],
)
def test_c_library_claims_on_ill_conditioned_mass_are_those_of_the_package(library, name, friction):
    """The residual is refined in the library as well: with the package's status, and at its floor where it is."""
    count = 0
    for seed in range(8):
        given = ill_conditioned(seed, friction)
        problem = library.problem(given, impulse=given.start())
        solver = library.open(problem, library.options(name))
        said = solver.run(100_000, 1e-9)
        judged = lv.residual(given, solver.impulse(), tol=1e-9)
        assert (said.verdict.relative, said.verdict.floor) == (
            judged.relative,
            judged.roundoff_floor,
        )
        if said.outcome == 4:
            assert judged.relative > 1e-9 and judged.at_floor
            count += 1
        else:
            assert said.outcome != 1 or judged.relative <= 1e-9
    assert count >= 3


def test_vectors_are_of_methods_that_the_library_takes(library):
    looked = set()
    for given in GIVEN:
        problem = library.problem(given)
        for name in METHODS:
            try:
                lv.solve(given, name, tol=0, max_iter=1)
            except lv.CapabilityError:
                continue
            code = library.c.lav_takes(ct.byref(problem), ct.byref(library.options(name)))
            assert is_accepted_by_library(given, name) == (code == 0), (
                name,
                given.law,
                given.cones.kind,
            )
            looked.add((name, code))
    assert len(looked) > len(METHODS)


@pytest.mark.parametrize(
    ("method", "asked", "words"),
    [
        ("sequential_impulses", {"order": 1}, {"order": "symmetric"}),
        ("sequential_impulses", {"order": 2, "seed": 5}, {"order": "random", "seed": 5}),
        ("sequential_impulses", {"order": 3}, {"order": "reverse"}),
        ("anderson", {"memory": 2}, {"memory": 2}),
        ("anderson", {"sweep": 2}, {"sweep": "blocks"}),
        ("anderson", {"convex": 5}, {"convex": 5}),
    ],
)
def test_options_equal_the_options_of_the_package(library, method, asked, words):
    given = self_test_problem()
    found = lv.solve(given, method, tol=0, max_iter=25, **words)
    solver = library.open(library.problem(given), library.options(method, **asked))
    for n in (
        (25,) if method == "anderson" else (10, 15)
    ):  # runs of sweeps go on where the last one ended
        solver.run(n, 0.0)
    assert solver.impulse().tobytes() == found.impulse.tobytes()


@pytest.mark.parametrize("method", ["sequential_impulses", "pgs", "anderson", "nncg", "jacobi"])
def test_c_workspace_size_exceeds_the_need_by_at_most_five_percent(library, method):
    looked = 0
    for given in GIVEN:
        problem, options = library.problem(given), library.options(method)
        if given.generalized is not None or library.c.lav_takes(
            ct.byref(problem), ct.byref(options)
        ):
            continue
        workspace = library.workspace(problem, options).value
        solver = library.open(problem, options)
        needed = library.c.lav_needed(solver.at)
        assert needed <= workspace <= 1.05 * needed + 8192, (given.m, given.n_blocks)
        looked += 1
    assert looked >= 3


@pytest.mark.parametrize("method", ["direct", "lemke"])
@pytest.mark.parametrize("n_bodies", [3, 100, 2000])
def test_c_workspace_of_pivots_counts_unmoved_bodies(library, method, n_bodies):
    rows = lv.Rows(
        np.ones(n_bodies),
        np.tile(np.eye(3), (n_bodies, 1, 1)),
        np.ones((n_bodies, 6)),
        jac=np.tile(np.eye(12)[6], (2, 1)),
        joint_ptr=[0, 1, 2],
        joint_body=[[-1, 0], [-1, 1]],
    )
    problem = library.problem(lv.Problem.from_rows(rows, target=2.0, lower=0.0))
    options = library.options(method)
    assert (
        library.c.lav_needed(library.open(problem, options).at)
        <= library.workspace(problem, options).value
    )


def test_c_library_carries_impulses_by_key(library):
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


def test_c_library_velocities_equal_the_package(library):
    given = self_test_problem()
    solver = library.open(library.problem(given), library.options("sequential_impulses"))
    solver.run(30, 0.0)
    out = np.zeros(18)
    assert library.c.lav_velocity(solver.at, out.ctypes.data, 18) == 0
    np.testing.assert_allclose(
        out.reshape(3, 6), given.velocity(solver.impulse()), rtol=0.0, atol=1e-14
    )


def count_islands(library, given, **arrays):
    method = (
        "pgs"
        if given.matrix is not None
        else "sequential_impulses"
        if given.rows is not None
        else "nncg"
    )
    solver = library.open(library.problem(given, **arrays), library.options(method))
    label = np.full(given.n_blocks, -1, np.int32)
    return library.c.lav_islands(solver.at, label.ctypes.data, given.n_blocks)


def test_islands_immovable_bodies_and_stored_zeros_connect_nothing(library):
    two = lv.Problem.from_rows(rp.touching([(-1, 0), (-1, 1)]), tangents=0)
    assert count_islands(library, two) == count_islands(library, rp.with_ground_as_body(two)) == 2
    dense = np.eye(2)
    cones = lv.Cones.contacts(0.0, count=2, tangents=0)
    stored = {
        "index_ptr": np.array([0, 2, 4], np.int32),
        "index": np.array([0, 1, 0, 1], np.int32),
        "value": dense.ravel(),
    }
    mass = {
        "mass_ptr": np.array([0, 1, 3], np.int32),
        "mass_index": np.array([0, 0, 1], np.int32),
        "mass_value": np.array([1.0, 0.0, 1.0]),
    }
    for given, arrays in (
        (lv.Problem(np.ones(2), cones, dense), stored),
        (lv.Problem.from_jacobian(dense, dense, [-1.0, -1.0], cones=cones), stored),
        (lv.Problem.from_jacobian(dense, dense, [-1.0, -1.0], cones=cones), mass),
    ):
        made = library.problem(given, **arrays)
        made.n_entries = 4 if "value" in arrays else made.n_entries
        made.n_mass_entries = 3 if "mass_ptr" in arrays else made.n_mass_entries
        solver = library.open(made, library.options("nncg"))
        label = np.full(2, -1, np.int32)
        assert library.c.lav_islands(solver.at, label.ctypes.data, 2) == 2


@pytest.mark.parametrize("name", ["newton", "admm"])
def test_methods_with_bits_of_their_own_meet_the_tolerance_where_the_package_does(library, name):
    met = 0
    for given in GIVEN:
        try:
            solver = library.open(library.problem(given), library.options(name))
        except (NotSupported, Refused):
            continue
        said = solver.run(10_000, 1e-7)
        truth = lv.residual(given, solver.impulse()).relative
        assert said.verdict.relative == truth
        assert (said.outcome == 1) == (truth <= 1e-7)
        assert said.outcome == 1 or not lv.solve(given, name, tol=1e-7, max_iter=10_000).success
        met += said.outcome == 1
    assert met >= 7


def row_of_boxes(n):
    """n unit boxes on the ground in a row: each touches the next one, and the first is pushed against it."""
    up = np.tile([0.0, 0.0, 1.0], (n, 1))
    along = np.tile([1.0, 0.0, 0.0], (n - 1, 1))
    normal = np.vstack([up, along])
    body = np.vstack(
        [
            np.column_stack([np.full(n, -1), np.arange(n)]),
            np.column_stack([np.arange(n - 1), np.arange(1, n)]),
        ]
    )
    v_free = np.tile([0.0, 0.0, -0.1, 0.0, 0.0, 0.0], (n, 1))
    v_free[0, 0] = 0.02
    rows = lv.Rows(
        np.ones(n),
        np.tile(6.0 * np.eye(3), (n, 1, 1)),
        v_free,
        normal=normal,
        tangent=np.roll(normal, 1, axis=1),
        arm_a=0.5 * normal,
        arm_b=-0.5 * normal,
        contact_body=body,
    )
    return lv.Problem.from_rows(rows, mu=0.3, tangents=2)


def test_newton_solves_more_bodies_than_a_full_factor_would_hold(library):
    given = row_of_boxes(1600)
    wanted, factorisations = run_compiled_newton(given, 1e-9, 400)
    solver = library.open(library.problem(given), library.options("newton"))
    result = solver.run(400, 1e-9)
    assert result.outcome == 1 and result.verdict.relative <= 1e-9
    assert (solver.impulse().tobytes(), result.iterations) == (wanted.tobytes(), factorisations)
    assert np.abs(wanted).max() > 0.05


def test_newton_pile_slides_shifted_newton_has_the_bits_of_the_package(library):
    given = lv.suite.case("granularF(n=4, sliding=2, seed=10)").problem
    wanted, factorisations = run_compiled_newton(given, 1e-6, 100)
    solver = library.open(library.problem(given), library.options("newton"))
    result = solver.run(100, 1e-6)
    # Without Euler steps, 300 factorisations do not suffice.
    assert result.outcome == 1 and result.verdict.relative <= 1e-6
    assert (solver.impulse().tobytes(), result.iterations) == (wanted.tobytes(), factorisations)


def test_c_library_newton_on_singular_rows_ends_by_a_line_search(library):
    descended = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        g = rng.normal(size=(14, 6)) * 10.0 ** rng.uniform(-3, 3, size=(14, 1))
        given = lv.Problem.lcp(
            g @ g.T, g @ rng.normal(size=6), upper=rng.uniform(0.1, 2.0, size=14)
        )
        found = lv.solve(given, "direct", tol=1e-9)
        solver = library.open(library.problem(given), library.options("direct"))
        said = solver.run(1000, 1e-9)
        if "line_searches" in found.work:
            descended += 1
            assert said.verdict.relative <= max(1e-9, 10.0 * found.residual.relative)
        else:
            assert solver.impulse().tobytes() == found.impulse.tobytes()
    assert descended


def test_motion_errors_equal_the_package(library):
    looked = 0
    for given in GIVEN:
        try:
            solver = library.open(library.problem(given), library.options("newton"))
        except (NotSupported, Refused):
            continue
        if solver.run(5000, 1e-12).verdict.relative > 1e-11:
            continue
        reference = solver.impulse()
        x = reference * (1.0 + 0.01 * np.cos(np.arange(given.m)))
        out = motion(library, solver, x, reference)
        wanted = lv.motion_error(given, x, reference)
        if wanted.energy is None:
            continue
        looked += 1
        assert out.energy == pytest.approx(wanted.energy, rel=1e-6)
        assert out.kinetic == pytest.approx(
            wanted.energy if wanted.kinetic is None else wanted.kinetic, rel=1e-6
        )
        assert out.relative == pytest.approx(wanted.relative, rel=1e-6)
        assert (out.row, out.rows) == (wanted.row, pytest.approx(wanted.rows, rel=1e-6))
        if wanted.speed is not None:
            assert (out.body, out.speed) == (wanted.body, pytest.approx(wanted.speed, rel=1e-6))
            assert out.spin == pytest.approx(wanted.spin or 0.0, rel=1e-6)
    assert looked >= 5


def motion(library, solver, impulse, reference):
    out = Motion()
    out.size = ct.sizeof(Motion)
    at = [ct.c_void_p(x.ctypes.data) for x in (impulse, reference)]
    assert library.c.lav_motion_error(solver.at, *at, len(impulse), ct.byref(out)) == 0
    return out


def test_c_frames_in_float32_are_corrected_like_the_package(library):
    rng = np.random.default_rng(4)
    tower = self_test_problem().rows
    axes = np.linalg.qr(rng.normal(size=(12, 3, 3)))[0].astype(np.float32).astype(float)
    rough = {"normal": axes[:, 0].copy(), "tangent": axes[:, 1].copy()}
    given = lv.Problem.from_rows(dataclasses.replace(tower, **rough), mu=0.3, tangents=2)
    assert not np.array_equal(given.rows.normal, rough["normal"])
    found = lv.solve(given, "sequential_impulses", tol=0, max_iter=30)
    problem = library.problem(given, **{name: np.ascontiguousarray(x) for name, x in rough.items()})
    solver = library.open(problem, library.options("sequential_impulses"))
    solver.run(30, 0.0)
    np.testing.assert_allclose(solver.impulse(), found.impulse, rtol=0.0, atol=1e-13)


DUMP = """#include "lavender_dump.h"
LAV_API int32_t dump(lav_solver *s, const lav_problem *q, const char *path) { return lav_dump(s, q, path); }
LAV_API int32_t dump_named(lav_solver *s, const lav_problem *q, const char *folder, const double *x,
                           const lav_names *names) {
  return lav_dump_named(s, q, folder, "named", x, 0.0, "mine", names);
}
LAV_API int32_t load(const char *path) {
  lav_loaded x;
  const int32_t code = lav_load(path, &x);
  lav_unload(&x);
  return code;
}
/* Read a file, run a solver on it, and write what was read with the impulses. */
LAV_API int32_t reload(const char *path, const lav_options *options, const char *again) {
  lav_loaded x;
  lav_solver *s;
  lav_budget budget;
  lav_result result;
  uint64_t bytes;
  double *impulse;
  void *memory = NULL;
  int32_t code = lav_load(path, &x);
  if (code != LAV_OK) return code;
  impulse = (double *)calloc((size_t)x.problem.n_rows + 1, 8);
  result.size = (uint32_t)sizeof result;
  lav_default_budget(&budget), budget.iterations = 7, budget.tol = 0.0;
  if ((code = lav_workspace_size(&x.problem, options, &bytes)) == LAV_OK) memory = malloc((size_t)bytes + (1 << 20));
  if (code == LAV_OK) code = lav_open(memory, bytes + (1 << 20), &x.problem, options, &s);
  if (code == LAV_OK) code = lav_set(s, &x.problem);
  if (code == LAV_OK) code = lav_run(s, &budget, &result);
  if (code == LAV_OK) code = lav_impulse(s, impulse, x.problem.n_rows);
  if (code == LAV_OK) code = lav_dump_with(s, &x.problem, again, impulse, NULL);
  lav_unload(&x), free(memory), free(impulse);
  return code;
}
"""


@pytest.fixture(scope="module")
def dumper(library, folder, compiler, tmp_path_factory):
    """The functions of DUMP, compiled as C99 without a warning and accepted as C++11."""
    out = tmp_path_factory.mktemp("dump")
    (out / "dump.c").write_text(DUMP)
    flags = ["-Wall", "-Wextra", "-Wpedantic", "-Werror", "-DLAV_SHARED"]
    flags += ["-fPIC", "-shared", "-I", folder]
    run(compiler, "-std=c99", *flags, out / "dump.c", library.path, "-o", out / "dump.so")
    run(compiler, "-std=c++11", "-x", "c++", *flags, "-fsyntax-only", out / "dump.c")
    return ct.CDLL(str(out / "dump.so"))


def test_c_library_dump_is_the_problem_to_the_last_bit(library, dumper, tmp_path):
    c = dumper
    path = tmp_path / "step.npz"
    looked = set()
    for given in GIVEN:
        key = np.arange(given.n_blocks, dtype=np.uint64) + np.uint64(2**63)
        problem = library.problem(given, key=key)
        solver = library.open(problem, library.options("block_gauss_seidel"))
        assert c.dump(solver.at, ct.byref(problem), str(path).encode()) == 0
        found = lv.load(path)
        assert (
            found.b.tobytes() == given.b.tobytes()
            and found.cones == given.cones
            and found.rows == given.rows
        )
        assert np.array_equal(found.key, key) and found.friction == given.friction
        velocity = problem.keep.get("velocity")
        if (
            velocity is not None and velocity.size
        ):  # an engine reads v+ into the array of v* before it dumps the step
            after = np.full_like(velocity, 7.0)
            problem.velocity = after.ctypes.data
            assert c.dump(solver.at, ct.byref(problem), str(path).encode()) == 0
            assert (
                lv.load(path).rows == given.rows and lv.load(path).generalized == given.generalized
            )
            problem.velocity = velocity.ctypes.data
        again = library.open(library.problem(found), library.options("block_gauss_seidel"))
        solver.run(7, 0.0), again.run(7, 0.0)
        assert solver.impulse().tobytes() == again.impulse().tobytes()
        looked.add(given.operator)
    assert looked == {"matrix", "rows", "generalized"}
    missing = str(tmp_path / "no" / "such").encode()
    assert c.dump(solver.at, ct.byref(problem), missing) == -20
    assert c.dump(solver.at, None, missing) == c.dump(solver.at, ct.byref(problem), None) == -1


def test_c_library_reads_its_files_to_the_last_bit(library, dumper, tmp_path):
    path, again = tmp_path / "step.npz", tmp_path / "again.npz"
    for given in GIVEN:
        key = np.arange(given.n_blocks, dtype=np.uint64) + np.uint64(2**63)
        problem = library.problem(given, key=key)
        options = library.options("block_gauss_seidel")
        solver = library.open(problem, options)
        assert dumper.dump(solver.at, ct.byref(problem), str(path).encode()) == 0
        for stored in (path, tmp_path / "plain.npz"):  # NumPy's own uncompressed archive, too.
            np.savez(tmp_path / "plain.npz", **dict(np.load(path)))
            code = dumper.reload(str(stored).encode(), ct.byref(options), str(again).encode())
            assert code == 0
            found = lv.io.read(again)
            assert found.problem == lv.load(path)
            assert np.array_equal(found.problem.key, key)
            solver.run(7, 0.0)
            assert found.impulse.tobytes() == solver.impulse().tobytes()
            solver = library.open(problem, options)


def test_c_library_reads_no_damaged_file(library, dumper, tmp_path):
    given = lv.suite.box_stack(2).problem
    problem = library.problem(given)
    solver = library.open(problem, library.options("block_gauss_seidel"))
    path, bad = tmp_path / "step.npz", tmp_path / "bad.npz"
    assert dumper.dump(solver.at, ct.byref(problem), str(path).encode()) == 0
    assert dumper.load(str(path).encode()) == 0
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for end in (0, 1, 21, 22, *rng.integers(23, len(whole), 40).tolist()):
        bad.write_bytes(whole[:end])
        assert dumper.load(str(bad).encode()) == -20
    for _ in range(300):  # An answer, and no crash; a changed number may still be a problem.
        changed = bytearray(whole)
        for at in rng.integers(0, len(whole), rng.integers(1, 9)):
            changed[at] = rng.integers(256)
        bad.write_bytes(changed)
        assert dumper.load(str(bad).encode()) in (0, -11, -20)
    lv.io.save(given, bad)
    assert dumper.load(str(bad).encode()) == -20  # Compressed.
    assert dumper.load(str(tmp_path / "none.npz").encode()) == -20
    assert dumper.load(None) == -1


class Names(ct.Structure):
    _fields_ = [(name, ct.c_void_p) for name in ("block", "body", "gap")]


@pytest.mark.parametrize("with_blocks", [False, True])
def test_c_library_names_bodies_rows_and_gaps_for_judge(library, dumper, tmp_path, with_blocks):
    given = rp.random_contact_problem(3)
    problem, rows = library.problem(given), given.rows
    solver = library.open(problem, library.options("block_gauss_seidel"))
    solver.run(3, 0.0)
    impulse = np.ascontiguousarray(solver.impulse())
    bodies = [f'no. {i} "\\ü\t' for i in range(given.rows.inv_mass.size)]
    blocks = [f"b{i}" if i % 2 else None for i in range(given.n_blocks)]
    gap = np.linspace(-1e-3, 1e-3, given.n_blocks)
    gap[: rows.n_joints] = np.nan
    texts = [[None if x is None else x.encode() for x in names] for names in (blocks, bodies)]
    arrays = [(ct.c_char_p * len(x))(*x) for x in texts]
    at = [ct.cast(x, ct.c_void_p) for x in arrays]
    names = Names(at[0] if with_blocks else None, at[1], gap.ctypes.data)
    code = dumper.dump_named(
        solver.at, ct.byref(problem), str(tmp_path).encode(),
        impulse.ctypes.data_as(ct.c_void_p), ct.byref(names),
    )  # fmt: skip
    assert code == 0
    stored = lv.io.read(tmp_path / "named.npz")
    np.testing.assert_array_equal(stored.gap, gap)
    np.testing.assert_array_equal(stored.impulse, impulse)
    pairs = np.vstack([rows.joint_body, rows.contact_body]).tolist()
    number = 0
    for k, (name, pair) in enumerate(zip(stored.problem.names, pairs, strict=True)):
        word = f"contact {number}" if given.cones.is_contact[k] else f"row {given.cones.ptr[k]}"
        number += bool(given.cones.is_contact[k])
        own = blocks[k] if with_blocks and blocks[k] else word
        sides = ", ".join("world" if b < 0 else bodies[b] for b in pair)
        assert name == f"{own} ({sides})"
    words = ["lavender", "judge", tmp_path / "named.npz", "--csv", tmp_path / "rows.csv"]
    done = subprocess.run([sys.executable, "-m", *words], capture_output=True, text=True)
    table = pd.read_csv(tmp_path / "rows.csv")
    assert done.stderr == "" and len(table) == given.m
    for text, number in zip(table["row"], table["gap [mm]"], strict=True):
        if not text.endswith("normal"):
            assert np.isnan(number)
    known = sorted(table["gap [mm]"].dropna())
    np.testing.assert_allclose(known, 1e3 * gap[rows.n_joints :], rtol=1e-12)
    assert any("no. 0" in text for text in table["bodies"]) and " and " in table["bodies"][0]
