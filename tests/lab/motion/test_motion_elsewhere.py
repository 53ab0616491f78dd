"""SolutionSet of problems that other rooms are tested on: ellipses, rolling, float32, derivatives."""

import dataclasses

import numpy as np
import pytest
import scipy.sparse as sp
from worked import python

import lavender as lv
from lavender.lab.motion.unique import prove_uniqueness


def test_several_motions_are_told():
    # Painleve's kind: friction and normal couple so that a contact may stick or lift
    p = lv.Problem.contact(np.array([[1.0, -2.5], [-2.5, 8.0]]), [1.0, -4.0], mu=[1.0])
    found = lv.find_solutions(p)
    d = lv.derivative(p, found[0].impulse)
    assert len(d.motions) == len(found) and d.motions.all == found.all


def test_our_solvers_are_held_to_the_floor_of_float64_whatever_the_data_were():
    rng = np.random.default_rng(0)
    b = rng.normal(size=(40, 40))
    p = lv.Problem.lcp(b @ b.T / 40 + 0.3 * np.eye(40), rng.normal(size=40) + 1.0, precision="float32")
    exact = lv.solve(p, tol=1e-13)
    early = lv.solve(p, "pgs", tol=1e-13, impulse=exact.impulse.astype(np.float32), max_iter=1)
    assert lv.residual(p, early.impulse).at_floor  # of an answer made in float32
    assert early.status is lv.Status.MAX_ITERATIONS
    assert not early.residual.at_floor
    assert not lv.motion.store_reference_if_better(p, early.impulse).is_accepted
    for solution in (exact, lv.solve(p, max_iter=1000)):  # by a compiled call, and step by step
        assert solution.residual.precision == "float64"


@pytest.mark.parametrize("light", [1.0, 1e16])
def test_an_asymmetry_is_seen_beside_lighter_bodies(light):
    """Entries of heavy bodies are rounding beside those of light ones; they are none beside each other."""
    heavy = [[1.0, 0.9], [-0.9, 1.0]]
    problem = lv.Problem.lcp(sp.block_diag([sp.coo_array([[light]]), heavy]).toarray(), [1.0, 1.0, -0.5])
    assert not problem.is_symmetric and not problem.is_semidefinite
    assert problem.asymmetry == pytest.approx(1.8)
    assert "osqp" not in lv.available(problem)
    assert lv.motion_error(problem, np.zeros(3)).bound is None
    rng = np.random.default_rng(0)
    root = rng.normal(size=(40, 60)) * 10.0 ** rng.uniform(-9.0, 9.0, (40, 1))
    a = root @ root.T
    assert lv.Problem.linear(a * (1.0 + 1e-15 * rng.normal(size=a.shape)), np.ones(40)).is_symmetric


def test_where_one_motion_is_proven_starts_find_no_other():
    """Small friction and a small moment: one motion by the criterion; with much of both each one found is one."""
    rng = np.random.default_rng(3)
    g = rng.normal(size=(10, 12))
    a, b = g @ g.T + 2.0 * np.eye(10), rng.normal(size=10)
    few = lv.Problem(b, lv.Cones.contacts(0.01, rolling=0.01, count=2), a)
    assert prove_uniqueness(few)
    assert not prove_uniqueness(lv.Problem(b, lv.Cones.contacts(0.01, rolling=5.0, count=2), a))
    assert len(lv.find_solutions(few)) == 1
    for motion in lv.find_solutions(lv.Problem(b, lv.Cones.contacts(2.0, rolling=3.0, count=2), a)):
        assert motion.reference.residual.relative <= 1e-9


TINY = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0])


def test_what_is_found_can_be_compared_and_kept_in_a_set():
    for found in (
        lambda: lv.solve(TINY, "pgs", history=True),
        lambda: lv.solve(TINY, "pgs", history=True).history,
        lambda: lv.solve(TINY).residual,
        lambda: lv.redundancy(TINY),
        lambda: lv.motion_error(dataclasses.replace(TINY), [0.0, 0.0]),
        lambda: lv.Simulation("stack").scene.bodies[1],
    ):
        one, two = found(), found()
        assert one == one and one != two and len({one, two}) == 2


def test_the_motion_of_a_step_is_the_motion_error_of_its_problem():
    sim = lv.Simulation(lv.Scene("stack", friction=0.0, solver_iterations=4, substeps=1), report_motion=True)
    for _ in range(20):
        problem = sim.constraint_problem()
        *_, info = sim.step()
    error = lv.solve(problem, "sequential_impulses", tol=0, max_iter=4).motion_error()
    # 1e-10: both references are solved to 1e-12 and better, from two starts and so by other sweeps.
    for key in ("relative", "speed", "bound"):
        assert info["motion"][key] == pytest.approx(getattr(error, key), rel=1e-10)
    # The plane is body 0 of the scene and no body of the rows.
    assert info["motion"]["body"] == sim.scene.bodies[1 + error.body].name
    assert info["motion"]["open"] == 0.0


def test_under_friction_a_step_is_near_one_of_its_motions():
    sim = lv.Simulation(lv.Scene("stack", solver_iterations=16), report_motion=True)
    for _ in range(10):
        *_, info = sim.step()
    motion = info["motion"]
    assert 0.0 < motion["relative"] < 0.5
    assert motion["bound"] is None
    assert motion["open"] >= 0.0


def test_threads_that_enter_a_package_by_different_files_all_get_it():
    """The first is in `motion/__init__.py` when the second asks for another file of that package."""
    code = """if True:
        import importlib.abc, sys, threading, time
        import lavender as lv

        inside, found = threading.Event(), []

        class Slow(importlib.abc.MetaPathFinder):
            def find_spec(self, name, path, target=None):
                if name == "lavender.lab.motion.bound":
                    inside.set()
                    time.sleep(0.5)  # for the second to get there

        sys.meta_path.insert(0, Slow())
        first = threading.Thread(target=lambda: found.append(lv.motion_error))
        first.start()
        assert inside.wait(600)
        found.append(lv.find_solutions)
        first.join()
        assert len(found) == 2"""
    assert python("-W", "error", "-c", code).stderr == ""
