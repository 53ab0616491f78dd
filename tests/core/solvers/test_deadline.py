"""A time limit is the caller's clock: played here by counted work, so that nothing hangs on the machine."""

import os
import sys

import numpy as np
import pytest
import scipy.sparse as sp
from calls import dense, over_velocities
from random_problems import FORMS, random_contact_problem
from worked import python

import lavender as lv
from benchmarks.made import fresh
from lavender import registry
from lavender.base.later import load
from lavender.judge import residuals
from lavender.judge.residuals import judging_time
from lavender.solvers import factors
from lavender.solvers.auto import Auto
from lavender.solvers.setup_times import forming
from lavender.solvers.small import AUTO


def test_set_up_is_inside(clock, monkeypatch):
    problem, given = dense(100, "lcp"), []
    newton = registry.get("newton").load()
    prepare, run = newton.prepare, newton.run

    def slow(self, *of):
        clock.now += 0.6
        return prepare(self, of[-1])

    def told(self, state, impulse, max_iter, tol, time_limit=None):
        given.append(time_limit)
        return run(self, state, impulse, max_iter, tol, time_limit)

    monkeypatch.setattr(newton, "prepare", slow)
    monkeypatch.setattr(newton, "update", slow)
    monkeypatch.setattr(newton, "run", told)
    assert lv.solve(problem, "newton", time_limit=1.0).success
    prepared = lv.prepare(problem, "newton")
    assert prepared.solve(time_limit=1.0).success
    assert prepared.solve(dense(100, "lcp", 1), time_limit=1.0).success
    inside = [left < 0.4 for left in given]
    assert inside == [True, False, True]


@pytest.mark.parametrize("name", ["newton", "pgs", "anderson"])
def test_nothing_runs_after_a_set_up_that_took_the_whole_limit(name, clock, monkeypatch):
    """A first iteration was: of 5,000 rows 1.2 ms more under a limit of 1 ms."""
    problem, solver = dense(100, "lcp"), registry.get(name).load()
    prepare = solver.prepare

    def slow(self, *of):
        clock.now += 2.0
        return prepare(self, *of)

    monkeypatch.setattr(solver, "prepare", slow)
    monkeypatch.setattr(solver, "run", None)
    late = lv.solve(problem, name, time_limit=1.0)
    assert late.status is lv.Status.TIME_LIMIT and "residual" not in vars(late)  # nor does the judge
    assert late.iterations == 0 and "set up" in late.message and "unjudged" in late.message
    nothing = lv.residual(problem, problem.start()).relative
    assert np.array_equal(late.impulse, problem.start()) and late.residual.relative == nothing
    worse = lv.solve(fresh(problem), name, impulse=1e3 * np.ones(100), time_limit=1.0)
    assert worse.residual.relative == nothing  # who brings a start has it weighed


@pytest.mark.parametrize("name", ["newton", "admm"])
def test_the_analysis_of_what_fills_in_ends_in_time(name, clock, monkeypatch):
    """Counted as laid out alone, it was begun: 4.8 ms under 3 ms on 1,000 rows, 22 under 10 on 2,700."""
    load()  # of SciPy, which is counted, too
    a = sp.random_array((1000, 1000), density=0.024, rng=np.random.default_rng(0))
    problem = lv.Problem.lcp(sp.csr_array(a + a.T + 100.0 * sp.eye_array(1000)), np.ones(1000))
    panels, done = factors.SparsePanels, []

    class Played(panels):
        def __init__(self, indptr, indices, *more):
            clock.now += 9e-8 * len(indices)
            done.append(len(indices))
            super().__init__(indptr, indices, *more)

    monkeypatch.setattr(factors, "SparsePanels", Played)
    late = lv.solve(fresh(problem), name, time_limit=3e-3)
    assert late.status is lv.Status.TIME_LIMIT and not done and clock.now == 0.0
    assert lv.solve(fresh(problem), name, time_limit=0.3).success
    assert 3e-3 < clock.now < 0.3 and done[0] > 40_000


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("law", ["lcp", "coulomb", "cone"])
def test_a_limit_that_does_not_bind_takes_the_same_small_call(form, law, monkeypatch):
    """The bits of no limit, and nothing is prepared; one that binds ends it no worse than it began."""
    ended = []
    for seed in range(12):
        problem = FORMS[form](random_contact_problem(seed, "coulomb" if law == "lcp" else law, 2, False))
        if law == "lcp":
            problem = lv.Problem.lcp(problem.dense() + 0.1 * np.diag(problem.d), problem.b)
        without = lv.solve(fresh(problem), tol=1e-9)
        if without.turns and problem.m <= registry.SMALL_ROWS:
            with monkeypatch.context() as patch:
                patch.setattr(Auto, "run", None)
                within = lv.solve(fresh(problem), tol=1e-9, time_limit=10.0)
            assert within.impulse.tobytes() == without.impulse.tobytes()
            assert within.message == without.message and within.work == without.work
        for most in (0.0, 3e3, 1e4, 1e5, 1e6):
            small = fresh(problem)
            found, counts = AUTO.attempt(small, None, 1e-9, most)
            assert small.derived.vain is None  # it may be tried again without a limit
            if found is not None:
                claim = AUTO.claim(small, counts, None, found.relative, lv.Status.TIME_LIMIT)
                assert claim.message and np.isfinite(found.impulse).all()
                ended.append(found.relative <= 1e-9)
    assert any(ended) and not all(ended)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("threads", [1, 2])
def test_a_limit_of_many_that_does_not_bind_costs_none_of_them(form, threads, clock):
    """The judge's time was kept free for each: of 1,000 problems under 0.1 s nothing was solved."""
    drawn = (FORMS[form](random_contact_problem(seed, "cone", 2, False)) for seed in range(20))
    small = [fresh(p) for p in drawn if p.m <= registry.SMALL_ROWS for _ in range(10)]
    without = lv.solve_many(small, threads=threads)
    within = lv.solve_many([fresh(p) for p in small], time_limit=0.06, threads=threads)
    assert all(a.impulse.tobytes() == b.impulse.tobytes() for a, b in zip(without, within, strict=True))
    assert [a.status for a in within] == [b.status for b in without]


@pytest.mark.parametrize("stacked", [False, True])
def test_what_late_worlds_take_is_counted_by_their_size(stacked, clock):
    """Judging 150 rows over 60 velocities takes 65 us, for which 10 were kept: 10 ms took 20."""
    worlds = [over_velocities(150, 60, seed) for seed in range(10)]
    if stacked:
        of = [(p.generalized.jac, p.generalized.mass, p.generalized.v_free) for p in worlds]
        jac, mass, free = (
            np.array([x if x.ndim == 1 else x.toarray() for x in xs]) for xs in zip(*of, strict=True)
        )
        worlds = lv.Batch(jac, mass, free, cones=worlds[0].cones)
    within, without = (lv.solve_many(worlds, time_limit=limit) for limit in (5e-4, 10.0))
    assert not within.iterations.any() and all(status is lv.Status.TIME_LIMIT for status in within.status)
    for i in (0, 9):  # the start, and doing nothing is not better than it is
        assert not within[i].impulse.any() and within[i].residual.relative == within.relative[i] == 1.0
    assert without.success.all()


def test_those_whose_turn_comes_too_late_keep_their_start(clock, monkeypatch):
    problems = [dense(100, "lcp", seed) for seed in range(4)]
    first = lv.solve(problems[0])

    def slow(*of, **more):
        clock.now += 1.0
        return first

    monkeypatch.setattr(sys.modules["lavender.solving.many"], "solve", slow)
    starts = [None, None, np.ones(100), None]
    made = lv.solve_many(problems, time_limit=0.5, impulses=starts)
    assert made[0] is first or made[0].success
    for problem, start, late in zip(problems[1:], starts[1:], made[1:], strict=True):
        assert late.status is lv.Status.TIME_LIMIT and "metric" not in vars(problem)
        assert np.array_equal(late.impulse, problem.start() if start is None else start)
        assert (
            late.residual.relative == lv.residual(problem, late.impulse).relative and "turn" in late.message
        )
    with pytest.raises(lv.CapabilityError):
        lv.solve_many([problems[0], dense(30, "cone")], "direct", time_limit=0.5)


@pytest.mark.parametrize("name", ["auto", "pgs"])
def test_a_world_of_j_and_m_whose_turn_comes_too_late_says_so(name):
    """Its numbers are the compiled loop's; a solver without a compiled call of its own had no words for them."""
    worlds = [over_velocities(6, 4, seed) for seed in range(3)]
    for late in lv.solve_many(worlds, name, time_limit=1e-9):
        assert (late.status, late.iterations, dict(late.work)) == (lv.Status.TIME_LIMIT, 0, {})
        assert "time limit" in late.message and not late.impulse.any() and str(late)


def test_the_first_solve_imports_nothing():
    """0.2 to 0.45 s went into it, in the first call of a control loop."""
    code = """
import sys
import numpy as np
import lavender as lv

rng = np.random.default_rng(0)
half = rng.normal(size=(300, 100))
A = half @ half.T / 300 + 0.1 * np.eye(300)
problems = [
    lv.Problem.lcp(A, rng.normal(size=300)),
    lv.Problem.contact(A, rng.normal(size=300), 0.5),
    lv.Problem.contact(A[:30, :30], rng.normal(size=30), 0.5, friction="cone"),
    lv.Problem.from_jacobian(half, np.eye(100), rng.normal(size=100), cones=lv.Cones.contacts(0.5, 2, count=100)),
]
before = set(sys.modules)
for problem in problems:
    lv.solve(problem, time_limit=0.01)
print(sorted(set(sys.modules) - before))
"""
    assert python("-c", code).stdout.strip() == "[]"


@pytest.mark.parametrize("name", ["newton", "direct", "lemke", "admm"])
def test_what_a_name_needs_of_scipy_is_loaded_before_the_clock_of_its_first_limit(name):
    """Counted and never done, it made every call of a process within 0.3 s late: a set-up of 1 ms never began."""
    code = f"""
import numpy as np
import lavender as lv

half = np.random.default_rng(0).normal(size=(100, 130))
problem = lv.Problem.lcp(half @ half.T, half[:, 0])
print(*(lv.solve(problem, {name!r}, time_limit=0.2).success for _ in range(3)))
"""
    assert "True" in python("-c", code).stdout


SLOW = """
import sys, time

class Slow:  # to import, once in a process
    def find_spec(self, name, path=None, target=None):
        if name in ("osqp", "slow_plug_in"):
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


@pytest.mark.parametrize("name", ["osqp", "slow_plug_in"])
def test_code_of_others_is_imported_before_the_clock_of_its_first_limit(name, tmp_path):
    """A plug-in's first solve was late; a backend's process was ended in its import, at every call."""
    if name == "osqp":
        pytest.importorskip("osqp")
    (tmp_path / "sitecustomize.py").write_text(SLOW)
    (tmp_path / "slow_plug_in.py").write_text(PLUG_IN)
    (tmp_path / "slow-1.dist-info").mkdir()
    (tmp_path / "slow-1.dist-info/METADATA").write_text("Metadata-Version: 2.1\nName: slow\nVersion: 1\n")
    points = "[lavender.solvers]\nslow_plug_in = slow_plug_in:SPEC\n"
    (tmp_path / "slow-1.dist-info/entry_points.txt").write_text(points)
    solve = (
        f"lv.solve(lv.Problem.lcp([[2.0]], [1.0]), {name!r}, time_limit=0.5)"  # [s], 20 times what it takes
    )
    paths = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    done = python("-c", f"import lavender as lv; print({solve})", env={**os.environ, "PYTHONPATH": paths})
    assert f"{name}: CONVERGED" in done.stdout


def test_auto_says_what_it_went_without():
    code = """
import numpy as np
import lavender as lv

half = np.random.default_rng(0).normal(size=(200, 100)) * 0.9 ** np.arange(100)  # no sweeps solve it in 0.2 s
problem = lv.Problem.lcp(half @ half.T, half[:, 0])
print(lv.solve(problem, tol=1e-13, time_limit=0.2))
import scipy.linalg.lapack, scipy.sparse
print(lv.solve(problem, tol=1e-13, time_limit=0.2))
"""
    before, after = python("-c", code).stdout.splitlines()
    assert "import scipy.linalg.lapack, scipy.sparse before" in before
    assert "scipy" not in after


@pytest.mark.parametrize("form", FORMS)
def test_a_limit_shorter_than_any_call_gives_a_solution_or_the_better_of_start_and_nothing(form):
    solved = []
    problems = [
        FORMS[form](random_contact_problem(seed, law, 2, False))
        for seed, law in enumerate(("coulomb", "cone"))
    ]
    for problem in (*problems, lv.Problem.lcp(np.eye(2), [1.0, 2.0])):
        for name in lv.available(problem):
            for start in (None, np.full(problem.m, 0.1)):
                if not registry.get(name).external:
                    made = lv.solve(fresh(problem), name, impulse=start, time_limit=1e-9)
                    began = lv.residual(problem, problem.start() if start is None else start).relative
                    assert made.success or made.status is lv.Status.TIME_LIMIT
                    assert made.residual.relative <= began and not made.contradicted
                    solved.append(made.success)
    assert any(solved) and not all(solved)


def test_the_package_loads_what_auto_needs_and_a_name_its_own_file():
    """Files of the others, and what nobody needs, are a quarter of what `import lavender` adds to NumPy."""
    code = """
import sys

site = set(sys.modules)  # with what .pth files of other packages load
import lavender as lv

files = lambda: {name.rpartition(".")[2] for name in sys.modules if name.startswith("lavender.solvers.")}
others = {"lemke", "jacobi", "gauss_seidel", "sequential_impulses"} & files()
print(sorted(others), "pathlib" in set(sys.modules) - site)
before = set(sys.modules)
lv.solve(lv.Problem.lcp([[2.0]], [1.0]), "jacobi", time_limit=0.01)
print(sorted(set(sys.modules) - before))
print(list(lv.registry.specs())[:3], list(lv.registry.specs())[-1], lv.registry.get("jacobi").own)
"""
    first, second, third = python("-c", code).stdout.splitlines()
    assert first == "[] False"
    assert "lavender.solvers.jacobi" in second and "external" not in second and "lemke" not in second
    # The order of the table, whoever was asked for first.
    assert third.startswith("['auto', 'direct', 'newton']") and third.endswith("True")


@pytest.mark.parametrize(("contacts", "velocities"), [(60, 120), (100, 200), (200, 300)])
def test_auto_forms_no_dense_a_beyond_its_limit(contacts, velocities, monkeypatch):
    """A of dense J and M had been formed to count what it costs: 5 times the limit, and nothing found."""
    rng = np.random.default_rng(0)
    jac, root = rng.normal(size=(3 * contacts, velocities)), rng.normal(size=(velocities, velocities))
    mass = root @ root.T / velocities + 0.1 * np.eye(velocities)
    problem = lv.Problem.from_jacobian(
        jac, mass, 2.0 * rng.normal(size=velocities), cones=lv.Cones.contacts(0.5, count=contacts)
    )
    limit = residuals.setup_time(problem) + judging_time(problem) + 0.5 * forming(problem)
    monkeypatch.setattr("lavender.problem.operators.assemble.gram", None)  # which A = Y Y^T is formed by
    assert lv.solve(problem, time_limit=limit).residual.relative <= 1.0
