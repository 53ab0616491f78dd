"""Sweeps over packed contacts give the bits of one contact after the other, whatever the order and the scene."""

import numpy as np
import pytest

import lavender as lv
from lavender.engine.layout import HEAD
from lavender.solvers.sequential_impulses import SequentialImpulses

CASES = [
    ("stack", {}),
    ("stack", {"n": 1}),
    ("pyramid", {"base": 7}),
    ("pyramid", {"base": 6, "friction": 0.05}),  # slides
    ("pile", {"n": 60}),
    ("ramp", {}),
    ("bridge", {"n": 6}),  # joints before contacts
    ("chain", {"n": 6}),
    ("table", {}),
    ("stack", {"n": 3, "friction": 0.0}),  # not packed: no tangents
    ("stack", {"n": 3, "patch_radius": 0.1}),  # not packed: spin
]
ORDERS = ["given", "reverse", "symmetric", "random", "bottom_up", "top_down", "colored"]


def one_by_one(state):
    """A substep in stages: `solve` sweeps contact after contact."""
    assert state.kernel.prepare() == 0
    state.kernel.solve()
    return state.kernel.finish()


def same(a, b):
    for name in ("x", "q", "v", "impulse", "dv", "setting", "cache_impulse", "joint_impulse", "b"):
        np.testing.assert_array_equal(a.a[name].view(np.uint8), b.a[name].view(np.uint8), err_msg=name)


@pytest.mark.parametrize(("name", "more"), CASES)
@pytest.mark.parametrize("sweeps", [4, 16, 33])
def test_packed_contacts_change_no_bit(name, more, sweeps):
    sim = lv.Simulation(lv.Scene(name, **more))
    sim.set_solver_iterations(sweeps)
    for _ in range(25):
        sim.step()
        before = sim._state.copy()
        twin = before.copy()
        assert before.kernel.substeps(1) == (0, 1)
        assert one_by_one(twin) == 0
        same(before, twin)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("name", ["pyramid", "bridge"])
def test_packed_contacts_keep_every_order(name, order):
    sim = lv.Simulation(lv.Scene(name, order=order, seed=3))
    for _ in range(12):
        sim.step()
        before, twin = sim._state.copy(), sim._state.copy()
        assert before.kernel.substeps(1) == (0, 1)
        assert one_by_one(twin) == 0
        same(before, twin)


def test_packed_contacts_of_boxes_thrown_together():
    rng = np.random.default_rng(5)
    scene = lv.Scene(dt=1 / 120, friction=0.4)
    scene.add_plane()
    for i in range(30):
        scene.add_box(
            size=rng.uniform(0.3, 1.0, 3), position=(*rng.uniform(-1.2, 1.2, 2), 0.8 + 0.45 * i),
            quaternion=rng.normal(size=4), velocity=rng.normal(size=3), mass=float(rng.uniform(0.1, 20.0)),
        )  # fmt: skip
    sim = lv.Simulation(scene)
    most = 0
    for _ in range(150):
        sim.step()
        before, twin = sim._state.copy(), sim._state.copy()
        if before.kernel.substeps(1)[0] == 1:  # more contacts than there is room for: `step` makes it
            continue
        assert one_by_one(twin) == 0
        same(before, twin)
        most = max(most, int(before.head[HEAD["contacts"]]))
    assert most > 40


@pytest.mark.parametrize("order", ["given", "reverse", "bottom_up", "colored", "symmetric", "random"])
@pytest.mark.parametrize("name", ["pyramid", "bridge", "pile"])
def test_the_solver_packs_long_runs_and_changes_no_bit(name, order):
    sim = lv.Simulation(lv.Scene(name))
    for _ in range(30):
        sim.step()
    problem = sim.constraint_problem()
    solver = SequentialImpulses(order=order)
    whole, single = np.zeros(problem.m), np.zeros(problem.m)
    solver.run(solver.prepare(problem), whole, 40, 0.0)
    state = solver.prepare(problem)
    for _ in range(40):  # too short a run for packing
        solver.run(state, single, 1, 0.0)
    np.testing.assert_array_equal(whole.view(np.uint8), single.view(np.uint8))
    # an order that mixes joints and contacts is swept one by one
    mixed = np.random.default_rng(2).permutation(problem.n_blocks).astype(np.int32)
    a = lv.solve(problem, "sequential_impulses", tol=0, max_iter=40, order=mixed).impulse
    state, b = SequentialImpulses(order=mixed).prepare(problem), np.zeros(problem.m)
    b[:] = problem.start() if problem.guess is None else problem.guess
    for _ in range(40):
        SequentialImpulses(order=mixed).run(state, b, 1, 0.0)
    np.testing.assert_array_equal(a.view(np.uint8), b.view(np.uint8))
