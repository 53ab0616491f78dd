"""A deadline is read between pieces of work; the test plays the clock, so that nothing depends on the machine."""

import os
import sys

import numpy as np
import pytest
import scipy.sparse as sp
from calls import dense, over_velocities
from random_problems import FORMS, random_contact_problem
from worked import python

import lavender as lv
from benchmarks.core_problems import fresh
from lavender import registry, suite
from lavender.base.deadline import Deadline, limit_forming
from lavender.base.rates import RATES
from lavender.solvers.newton_systems import general
from lavender.solvers.newton_systems.systems import make_system, run_newton_method
from lavender.solvers.pivoting import PivotState
from lavender_ext.factor.linear import LinearSystem
from lavender_ext.pivot import lemke

MAX_WORK = 2e6  # ns of counted work between two readings, as docs/choose.md promises
OWN = [name for name, spec in registry.specs().items() if spec.builtin and not spec.external]


def counted_deadline():
    """A deadline that does not pass; kernels count for it."""
    return Deadline(1e6)


def lattice(n):
    """The Laplacian of n^3 points with a unit shift, as a positive definite sparse matrix."""
    line = sp.diags_array([-np.ones(n - 1), 2.0 * np.ones(n), -np.ones(n - 1)], offsets=[-1, 0, 1])
    one = sp.eye_array(n)
    matrix = (
        sp.kron(sp.kron(line, one), one)
        + sp.kron(sp.kron(one, line), one)
        + sp.kron(sp.kron(one, one), line)
    )
    matrix = sp.csr_array(matrix + sp.eye_array(n**3))
    matrix.sort_indices()
    return matrix


@pytest.mark.parametrize("lu", [False, True])
@pytest.mark.parametrize("kind", ["dense", "lattice"])
def test_factorisation_reads_the_clock_within_two_milliseconds_of_counted_work(kind, lu):
    """The counted work of a dense factor is compared with n^3 / 6 and n^3 / 3 multiply-adds."""
    if kind == "dense":
        n = 1500
        rng = np.random.default_rng(0)
        half = rng.normal(size=(n, 40))
        system = LinearSystem(n)
        data = half @ half.T + n * np.eye(n)
        least = RATES["work"]["dense"] * n**3 / (3.0 if lu else 6.0)
    else:
        matrix = lattice(17 if lu else 27)  # 4,913 and 19,683 rows
        system = LinearSystem((matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32)))
        data = matrix.data
        system.analyse()
        least = RATES["work"]["dense"] * system.cost
    deadline = counted_deadline()
    assert system.factor(data, None, 0.0, 1e-13, lu, deadline=deadline) == 0
    total, longest = deadline.counted
    assert 0.7 * least <= total and longest <= MAX_WORK


@pytest.mark.parametrize("form", ["bodies", "rows", "velocities"])
def test_newton_reads_the_clock_within_two_milliseconds_of_counted_work(form):
    """A pile of 2,400 rows; the counted work is at least that of the rows of all steps."""
    problem = fresh(suite.case("granularF(n=7)").problem)
    deadline = counted_deadline()
    impulse = problem.start()
    n = 3
    if form == "velocities":
        problem = FORMS["J and M"](problem)
        kernel = general.prepare_islands(problem)
        claim = general.run_newton_steps(problem, kernel, impulse, n, 1e-9, deadline)
        assert claim.iterations == n
    else:
        system = make_system(problem, "velocity" if form == "bodies" else "impulse")
        run_newton_method(problem, system.solve, impulse, n, 1e-9, deadline, 1)
    total, longest = deadline.counted
    assert (
        total
        >= 0.3 * n * RATES["velocity contact row" if form == "velocities" else "row"] * problem.m
    )
    assert longest <= MAX_WORK


def test_lemke_reads_the_clock_within_two_milliseconds_of_counted_work():
    """Three quarters of the rows are free and are retired before the path, whose pivots and exchanges follow."""
    rng = np.random.default_rng(1)
    m = 300
    deadline = counted_deadline()
    half = rng.normal(size=(m, m))
    lower = np.where(np.arange(m) % 4 == 0, 0.0, -np.inf)
    problem = lv.Problem.lcp(half @ half.T / m + 0.1 * np.eye(m), rng.normal(size=m), lower)
    state = PivotState(problem)
    state.set_deadline(deadline)
    paths = lemke.Lemke(state.rows)
    code = lemke.EXCHANGES
    paths.set_start(problem.start())
    while code == lemke.EXCHANGES:
        code = paths.run(10**6)
    total, longest = deadline.counted
    assert code == lemke.DONE and state.rows.relative <= 1e-9
    assert total >= RATES["dictionary pivot"] * 0.75 * m * m**2 and longest <= MAX_WORK


class Readings:
    """A clock that advances by 1 s at every reading."""

    def __init__(self):
        self.count = 0

    def __call__(self):
        self.count += 1
        return float(self.count)


@pytest.fixture
def readings(clock):
    """Play a clock that counts its readings."""
    from lavender_ext.core.deadline import play_clock

    made = Readings()
    play_clock(made)
    return made


@pytest.mark.parametrize("lu", [False, True])
def test_factorisation_that_the_deadline_ends_leaves_no_factor(lu, readings):
    """The exchanges of rows that L U did not reach were not written; a solve with them crashed."""
    matrix = lattice(15)
    system = LinearSystem((matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32)))
    assert system.factor(matrix.data, None, 0.0, 1e-13, lu, deadline=Deadline(2.5)) == -1
    assert np.isinf(system.solve(np.ones(15**3))).all()
    assert system.factor(matrix.data, None, 0.0, 1e-13, lu) == 0
    np.testing.assert_allclose(matrix @ system.solve(np.ones(15**3)), 1.0, rtol=1e-9)


@pytest.mark.parametrize("form", ["bodies", "rows", "velocities"])
def test_newton_whose_deadline_passes_inside_a_factorisation_returns_a_finite_impulse(
    form, readings
):
    problem = fresh(suite.case("granularF(n=6)").problem)
    if form == "velocities":
        problem = FORMS["J and M"](problem)
    for limit in np.arange(1.5, 40.0, 3.0):
        impulse = problem.start()
        deadline = Deadline(limit)
        if form == "velocities":
            status = general.run_newton_steps(
                problem, general.prepare_islands(problem), impulse, 9, 1e-9, deadline
            ).status
        else:
            system = make_system(problem, "velocity" if form == "bodies" else "impulse")
            status = run_newton_method(problem, system.solve, impulse, 9, 1e-9, deadline, 1).status
        assert status is lv.Status.TIME_LIMIT and np.isfinite(impulse).all()


def list_problems():
    """Yield small problems of every law and form."""
    for law in ("coulomb", "cone"):
        for form, convert in FORMS.items():
            yield f"{law}, {form}", convert(random_contact_problem(1, law, bodies=12, contacts=20))
    yield "lcp, full matrix", dense(100, "lcp")
    yield "lcp, J and M", over_velocities(150, 60)
    yield "linear, full matrix", lv.Problem.linear(dense(100, "lcp").dense(), np.ones(100))


PROBLEMS = dict(list_problems())


@pytest.mark.parametrize("name", OWN)
def test_solve_without_limit_reads_no_clock(name, readings):
    for problem in PROBLEMS.values():
        if registry.get(name).refuses(problem) is None:
            lv.solve(fresh(problem), name, tol=1e-8, max_iter=50)
    assert readings.count == 0


@pytest.mark.parametrize("name", OWN)
def test_solve_whose_deadline_passes_at_any_reading_returns_a_judged_impulse(name, readings):
    """Not worse than the start: by the objective, by E under Coulomb's law except from sweeps of engines."""
    late = 0
    for problem in PROBLEMS.values():
        if registry.get(name).refuses(problem) is not None:
            continue
        for limit in (0.5, 1.5, 2.5, 3.5, 5.5, 9.5, 30.5):
            solution = lv.solve(fresh(problem), name, tol=1e-10, time_limit=limit)
            late += solution.status is lv.Status.TIME_LIMIT
            assert np.isfinite(solution.impulse).all()
            assert solution.residual.relative == lv.residual(problem, solution.impulse).relative
            if problem.law != "coulomb":
                x = solution.impulse
                assert 0.5 * x @ (problem.slack(x) - problem.b) <= 1e-12
            elif not registry.get(name).load().keeps_last:
                assert solution.residual.energy <= solution.residual.energy_at_zero * (1.0 + 1e-9)
    assert late


@pytest.mark.parametrize("name", ["newton", "pgs", "anderson", "auto"])
def test_solve_with_a_set_up_beyond_the_limit_makes_no_iteration(name, clock, monkeypatch):
    problem = dense(100, "lcp")
    solver = registry.get(name).load()
    prepare = solver.prepare

    def slow(self, *of):
        clock.now += 2.0
        return prepare(self, *of)

    monkeypatch.setattr(solver, "prepare", slow)
    monkeypatch.setattr(solver, "run", None)
    late = lv.solve(problem, name, time_limit=1.0)
    assert (
        late.status is lv.Status.TIME_LIMIT
        and late.iterations == 0
        and "time limit" in late.message
    )
    assert np.array_equal(late.impulse, problem.start())


def stacked(worlds):
    of = [(p.generalized.jac, p.generalized.mass, p.generalized.v_free) for p in worlds]
    parts = (
        np.array([x if x.ndim == 1 else x.toarray() for x in xs]) for xs in zip(*of, strict=True)
    )
    return lv.Batch(*parts, cones=worlds[0].cones)


@pytest.mark.parametrize("solver", ["auto", "pgs"])
@pytest.mark.parametrize("kind", ["rows of A", "J and M", "J and M, stacked"])
@pytest.mark.parametrize("started", [False, True])
def test_worlds_whose_turn_comes_after_the_deadline_keep_their_judged_start(
    kind, solver, started, readings
):
    worlds = [
        dense(30, "lcp", seed) if kind == "rows of A" else over_velocities(9, 6, seed)
        for seed in range(12)
    ]
    starts = [np.full(p.m, 0.1) if started else p.start() for p in worlds]
    one = kind.endswith("stacked")
    given = (
        {"impulse" if one else "impulses": np.array(starts) if one else starts} if started else {}
    )
    found = lv.solve_many(
        stacked(worlds) if one else worlds, solver, time_limit=8.5, tol=1e-12, **given
    )
    last = found[11]
    assert (
        last.status is lv.Status.TIME_LIMIT and not last.iterations and "time limit" in last.message
    )
    for i in range(12):
        assert found.relative[i] == lv.residual(worlds[i], found[i].impulse).relative
    assert (
        np.array_equal(last.impulse, starts[11])
        or last.residual.relative <= lv.residual(worlds[11], starts[11]).relative
    )


@pytest.mark.parametrize("rows", [180, 189, 198])
def test_deadline_that_passes_inside_a_compiled_world_of_a_batch_ends_it(rows, readings):
    problem = over_velocities(rows, rows // 2)

    def solve(limit):
        readings.count = 0
        return lv.solve_many([fresh(problem)], tol=1e-10, time_limit=limit)[0], readings.count

    whole, count = solve(1e9)
    assert (
        whole.success and count >= 3
    )  # the first is that of the deadline, the last that after the world
    for limit in np.arange(0.5, count - 1):
        late = solve(limit)[0]
        # A step with a factored matrix ends, and may be the last one.
        assert late.status is lv.Status.TIME_LIMIT or (late.success and limit > count - 2)
        assert late.residual.relative == lv.residual(problem, late.impulse).relative


SLOW = """
import sys, time

class Slow:  # to import, once in a process
    def find_spec(self, name, path=None, target=None):
        if name in ("osqp", "slow_plug_in", "scipy.optimize"):
            sys.meta_path.remove(self)
            time.sleep(1.5)

sys.meta_path.insert(0, Slow())
"""
PLUG_IN = """
import lavender as lv

class Copied:
    def prepare(self, problem): return lv.prepare(problem, "pgs")
    def run(self, state, impulse, n, tol, time_limit=None):
        impulse[:] = state.solve(tol=tol).impulse
        return lv.Claim(lv.Status.CONVERGED, 1)

SPEC = lv.SolverSpec("slow_plug_in", "slow_plug_in:Copied", laws={"lcp"}, summary="test", resumable=False)
"""


@pytest.mark.parametrize(
    "name", [pytest.param("osqp", marks=pytest.mark.nightly), "slow_plug_in", "lemke"]
)
def test_modules_are_imported_before_the_clock_of_the_first_limit(name, tmp_path):
    """A plug-in's first solve was late; a backend's process was ended in its import, at every call."""
    if name == "osqp":
        pytest.importorskip("osqp")
    (tmp_path / "sitecustomize.py").write_text(SLOW)
    (tmp_path / "slow_plug_in.py").write_text(PLUG_IN)
    (tmp_path / "slow-1.dist-info").mkdir()
    (tmp_path / "slow-1.dist-info/METADATA").write_text(
        "Metadata-Version: 2.1\nName: slow\nVersion: 1\n"
    )
    points = "[lavender.solvers]\nslow_plug_in = slow_plug_in:SPEC\n"
    (tmp_path / "slow-1.dist-info/entry_points.txt").write_text(points)
    solve = f"lv.solve(lv.Problem.lcp([[2.0]], [1.0]), {name!r}, time_limit=0.5)"  # [s], 20 times what it takes
    paths = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    done = python(
        "-c", f"import lavender as lv; print({solve})", env={**os.environ, "PYTHONPATH": paths}
    )
    assert f"{name}: CONVERGED" in done.stdout


def draw_jacobian_problem(seed, m=240, n=150, law="coulomb"):
    """Contacts, or bounded rows, over a full J and M."""
    return over_velocities(
        m, n, seed, cones=lv.Cones.bounded(np.zeros(m), np.inf) if law == "lcp" else None
    )


def test_forming_a_matrix_of_j_and_m_reads_the_clock_and_ends_at_the_deadline(readings):
    problem = draw_jacobian_problem(0, 600, 300)
    for name in ("newton", "admm", "pgs"):
        cold = fresh(problem)
        solution = lv.solve(cold, name, time_limit=4.5)
        assert solution.status is lv.Status.TIME_LIMIT and "_compressed" not in cold.__dict__
        assert solution.iterations == 0


@pytest.mark.parametrize("law", ["coulomb", "lcp"])
def test_starts_over_j_and_m_read_the_clock_within_two_milliseconds_and_then_keep_the_matrix(law):
    kernel = general.prepare_islands(fresh(draw_jacobian_problem(0, 600, 300, law)))
    first, second = counted_deadline(), counted_deadline()
    for deadline in (first, second):
        kernel.set_deadline(deadline)
        kernel.keep_matrix()
        kernel.start(np.zeros(600), 1e-6, 1)
    total, longest = first.counted
    assert total >= 600 * 600 * 300 * 0.1 and longest <= MAX_WORK
    assert second.counted[0] <= 1e-3 * total


def test_forming_a_reads_the_clock_within_two_milliseconds_of_counted_work():
    for density in (1.0, 0.2):
        problem = draw_jacobian_problem(0, 600, 300)
        jac = problem.generalized.jac.toarray() * (
            np.random.default_rng(0).random((600, 300)) < density
        )
        problem = lv.Problem.from_jacobian(jac, np.eye(300), np.ones(300), cones=problem.cones)
        deadline = counted_deadline()
        with limit_forming(deadline):
            problem.csr  # noqa: B018 - forms A
        total, longest = deadline.counted
        assert total >= 600 * 600 * 300 * 0.1 * density**2 and longest <= MAX_WORK
