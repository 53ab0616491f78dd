"""A time limit is the caller's clock: played here by counted work, so that nothing hangs on the machine."""

import os
import sys
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from calls import dense, over_velocities
from random_problems import FORMS, random_contact_problem, random_ellipse_friction_contacts
from worked import python

import lavender as lv
from benchmarks.core_problems import fresh
from lavender import registry
from lavender.problem.operators import Operators
from lavender.solvers.costs import estimate_disk_cost, estimate_judge_setup_cost


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


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("threads", [1, 2])
def test_a_limit_of_many_that_does_not_bind_costs_none_of_them(form, threads, clock):
    """The judge's time was kept free for each: of 1,000 problems under 0.1 s nothing was solved."""
    drawn = (FORMS[form](random_contact_problem(seed, "cone", 2, False)) for seed in range(20))
    small = [fresh(p) for p in drawn if lv.explain(p).small for _ in range(10)]
    without = lv.solve_many(small, threads=threads)
    within = lv.solve_many([fresh(p) for p in small], time_limit=0.06, threads=threads)
    assert all(a.impulse.tobytes() == b.impulse.tobytes() for a, b in zip(without, within, strict=True))
    assert [a.status for a in within] == [b.status for b in without]


@pytest.fixture
def slow_disks(clock, monkeypatch):
    """Disks and the judge's numbers take, by a clock that is played, what is counted for them; how many were made."""
    made = SimpleNamespace(disks=0)
    disk, metric = (vars(of)[name] for of, name in ((lv.Problem, "_disk"), (Operators, "metric")))
    make_disk, make_metric = disk.function, metric.function

    def slow_disk(problem):
        counted = 1e-9 * estimate_disk_cost(problem)
        found = make_disk(problem)
        clock.now, made.disks = clock.now + counted, made.disks + 1
        return found

    def slow_metric(problem):
        clock.now += 1e-9 * estimate_judge_setup_cost(problem)
        return make_metric(problem)

    monkeypatch.setattr(disk, "function", slow_disk)
    monkeypatch.setattr(metric, "function", slow_metric)
    return made


def grown(seed, form, kind):
    """Contacts with ellipses, or with disks, enough of them that no form is made in a microsecond."""
    own = (random_ellipse_friction_contacts if kind == "ellipse" else random_contact_problem)(
        seed, "cone", bodies=30, contacts=40
    )
    return FORMS[form](own)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", ["ellipse", "disk"])
def test_no_form_of_a_problem_is_made_after_the_deadline(form, kind, slow_disks, clock):
    """`Problem.disk` was made, and A for it, before the clock was read: 0.2 ms took 8 to 20 times as long."""
    start, before = grown(0, form, kind).start(), made_once(grown(0, form, kind))
    for name, spec in registry.specs().items():
        problem = grown(0, form, kind)
        if spec.missing() or spec.external or spec.refuses(problem, True) is not None:
            continue
        prepared = lv.prepare(problem, name)
        for limit, again in product((1e-9, 2e-4), (False, True)):
            given, clock.now = grown(0, form, kind), 0.0
            late = prepared.solve(given, time_limit=limit) if again else lv.solve(given, name, time_limit=limit)
            assert clock.now <= limit, (name, limit)
            if limit == 1e-9:
                assert made_once(given) == before and late.status is lv.Status.TIME_LIMIT, name
                assert np.array_equal(late.impulse, start)  # to the bit: nothing was stretched and back
                assert late.residual.relative == lv.residual(given, late.impulse).relative
                assert late.message and not late.iterations


def stacked(worlds):
    of = [(p.generalized.jac, p.generalized.mass, p.generalized.v_free) for p in worlds]
    parts = (np.array([x if x.ndim == 1 else x.toarray() for x in xs]) for xs in zip(*of, strict=True))
    return lv.Batch(*parts, cones=worlds[0].cones)


LATE = {  # worlds, solver, limit, whether as one stack
    "rows of A": (lambda: [dense(100, "lcp", seed) for seed in range(3)], "pgs", 1e-9, False),
    "rows of A, no compiled call": (lambda: [dense(100, "lcp", seed) for seed in range(3)], "auto", 1e-9, False),
    "J and M": (lambda: [over_velocities(6, 4, seed) for seed in range(3)], "auto", 1e-9, False),
    "J and M, no compiled call": (lambda: [over_velocities(6, 4, seed) for seed in range(3)], "pgs", 1e-9, False),
    "ellipses": (lambda: [grown(seed, "J and M", "ellipse") for seed in range(3)], "auto", 1e-9, False),
    # Judging takes 65 us, for which 10 were kept: 10 ms took 20.
    "long to judge": (lambda: [over_velocities(150, 60, seed) for seed in range(10)], "auto", 5e-4, False),
    "long to judge, stacked": (lambda: [over_velocities(150, 60, seed) for seed in range(10)], "auto", 5e-4, True),
}  # fmt: skip


@pytest.mark.parametrize("started", [False, True])
@pytest.mark.parametrize("name", LATE)
def test_worlds_whose_turn_comes_too_late_keep_their_start(name, started, clock):
    make, solver, limit, one = LATE[name]
    worlds = make()
    starts = [np.full(p.m, 0.1) for p in worlds]
    impulse = {"impulse" if one else "impulses": np.array(starts) if one else starts} if started else {}
    found = lv.solve_many(stacked(worlds) if one else worlds, solver, time_limit=limit, **impulse)
    for problem, start, late in zip(worlds, starts, found, strict=True):
        assert "_disk" not in vars(problem)  # before anything is read
        assert (late.status, late.iterations, dict(late.work)) == (lv.Status.TIME_LIMIT, 0, {})
        assert "time limit" in late.message and str(late)
        start = start if started else problem.start()
        assert late.residual.relative == lv.residual(problem, late.impulse).relative
        assert np.array_equal(late.impulse, start)


def made_once(problem):
    """What was worked out of a problem and kept."""
    return {name for name in vars(problem) if getattr(getattr(type(problem), name, None), "is_locked", False)}


def test_a_package_of_others_does_not_read_a_matrix_after_the_deadline(clock):
    pytest.importorskip("daqp")
    problem = lv.Problem.lcp(np.eye(30), np.ones(30))
    assert lv.solve(problem, "daqp", time_limit=1e-9).status is lv.Status.TIME_LIMIT
    assert not made_once(problem)


def test_a_kind_that_a_solver_does_not_take_is_refused_under_any_limit(slow_disks, clock):
    problem = grown(0, "rows", "ellipse")
    for name in ("gauss_seidel", "sequential_impulses"):
        with pytest.raises(lv.CapabilityError):
            lv.solve(problem, name, time_limit=1e-9)
    assert not slow_disks.disks


def test_late_worlds_of_a_batch_are_not_made(clock, monkeypatch):
    """Of ellipses each was, with its disks, and judged: 20 ms of 200 worlds took 14 to 18 times as long."""
    rng, n, each = np.random.default_rng(0), 60, 1e-3
    cones = lv.Cones.contacts([(0.5, 0.8)] * 3) + lv.Cones.bounded([0.25], [np.inf])
    batch = lv.Batch(rng.normal(size=(n, 10, 8)), np.eye(8), rng.normal(size=(n, 8)), cones=cones)
    make, made = lv.Batch.__getitem__, []

    def slow(self, i):
        clock.now += each
        made.append(i)
        return make(self, i)

    monkeypatch.setattr(lv.Batch, "__getitem__", slow)
    starts = np.zeros((n, 10))
    starts[:, 0] = 0.5
    for more in ({}, {"impulse": starts}):
        made.clear()
        clock.now = 0.0
        found = lv.solve_many(batch, time_limit=20.0 * each, **more)
        assert clock.now <= 22.0 * each and len(made) <= 22  # one that the limit overtakes, one that says if it refuses
        late = np.array([status is lv.Status.TIME_LIMIT for status in found.status])
        assert np.sum(~late) >= 15 and found.success[~late].all() and late[-1]
        wanted = starts[-1] if more else make(batch, 0).start()
        assert wanted.any() and (found.impulse[late] == wanted).all()
        i = n - 1  # its numbers, when they are read
        assert found[i].residual.relative == found.relative[i] == lv.residual(make(batch, i), wanted).relative
        assert found.velocity[i].tobytes() == make(batch, i).velocity(wanted).tobytes()
        assert "turn" in found[i].message and not found.iterations[i]
    with pytest.raises(lv.CapabilityError):
        lv.solve_many(batch, "direct", time_limit=1e-9)


def test_a_late_world_whose_data_are_no_problems_says_so_when_it_is_read(clock, monkeypatch):
    cones, free = lv.Cones.contacts([(0.5, 0.8)]), np.zeros((9, 3))
    free[7] = np.nan
    batch, make = lv.Batch(np.tile(np.eye(3), (9, 1, 1)), np.eye(3), free, cones=cones), lv.Batch.__getitem__

    def slow(self, i):
        clock.now += 1.0
        return make(self, i)

    monkeypatch.setattr(lv.Batch, "__getitem__", slow)
    found = lv.solve_many(batch, time_limit=2.0, errors="status")
    assert np.isnan(found.relative[7]) and np.isnan(found.impulse[7]).all() and np.isfinite(found.relative[8])
    assert "world 7" in str(found.faults[7])
    with pytest.raises(lv.InputError, match="world 7"):
        lv.solve_many(batch, time_limit=2.0).relative  # noqa: B018


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


@pytest.mark.parametrize("name", [pytest.param("osqp", marks=pytest.mark.nightly), "slow_plug_in"])
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
    solve = f"lv.solve(lv.Problem.lcp([[2.0]], [1.0]), {name!r}, time_limit=0.5)"  # [s], 20 times what it takes
    paths = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    done = python("-c", f"import lavender as lv; print({solve})", env={**os.environ, "PYTHONPATH": paths})
    assert f"{name}: CONVERGED" in done.stdout


def test_auto_says_what_it_went_without():
    code = """
import numpy as np
import lavender as lv

half = np.random.default_rng(0).normal(size=(800, 400)) * 0.9 ** np.arange(400)  # no sweeps solve it in 0.2 s
problem = lv.Problem.lcp(half @ half.T, half[:, 0])
print(lv.solve(problem, tol=1e-13, time_limit=0.2))
import scipy.linalg.lapack, scipy.sparse
print(lv.solve(problem, tol=1e-13, time_limit=0.2))
"""
    before, after = python("-c", code).stdout.splitlines()
    assert "import scipy.linalg.lapack, scipy.sparse before" in before
    assert "scipy" not in after


def test_set_up_of_sequential_impulses_is_estimated_without_forming_a():
    builder = lv.RowBuilder(np.ones(50), np.tile(np.eye(3), (50, 1, 1)), np.zeros((50, 6)), 0.01, np.zeros((50, 3)))
    pairs = np.column_stack([np.arange(50) - 1, np.arange(50)])
    builder.contacts(pairs, np.arange(150.0).reshape(50, 3), (0.0, 0.0, 1.0), mu=0.5)
    problem = builder.problem()
    assert registry.get("sequential_impulses").load()().cost(problem).setup == 0.0
    assert registry.get("jacobi").load()().cost(problem).setup > 0.0
