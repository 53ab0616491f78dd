"""Stacks stand on few warm sweeps: short versions of runs of ten minutes."""

import numpy as np
import pytest

import lavender as lv
from lavender.sim.engine.layout import HEAD, SETTING
from lavender.sim.scene.parameters import SCENE_ORDERS

MOST = 5e-3  # m, that a box may move between two seconds and the end
SECONDS = 30.0  # s
MAX_DISPLACEMENT = 0.05  # m: a box that is further from its start at any time does not stand still


def drift(name, seconds=SECONDS, *, dt=1 / 60, **parameters):
    """Largest distance [m] of a body from where it was after two seconds, looked at ten times a second."""
    sim = lv.Simulation(lv.Scene(name, dt=dt, **parameters))
    every = round(0.1 / dt)
    start = None
    most = 0.0
    first = sim.state.a["x"].copy()
    for step in range(every, round(seconds / dt) + 1, every):
        left = every * sim.scene.parameters.substeps
        while left:
            status, done = sim.state.kernel.run_substeps(left)
            left -= done
            if status == 1:
                sim.state = sim.state.with_larger_buffers()
        x = sim.state.a["x"]
        if np.abs(x - first).max() > MAX_DISPLACEMENT:  # also in the first two seconds
            return np.inf
        if step * dt >= 2.0 - 1e-9:
            if start is None:
                start = x.copy()
            most = max(most, float(np.linalg.norm(x - start, axis=1).max()))
    return most


def standing(name, sweeps, seconds=SECONDS, rates=(1 / 60, 1 / 120), **varied):
    """What stands on so many sweeps, whatever one of its parameters is."""
    ((key, values),) = varied.items()
    more = {"stack": {"n": 6}, "heavy_on_light": {"ratio": 100.0}}[name]
    for dt in rates:
        for value in values:
            yield name, seconds, more | {"solver_iterations": sweeps, "dt": dt, key: value}


@pytest.mark.parametrize(
    ("name", "seconds", "parameters"),
    [
        *standing("stack", 4, rates=(1 / 60,), order=SCENE_ORDERS),
        *standing("stack", 4, rates=(1 / 120,), order=("alternating",)),
        *standing("stack", 8, n=(10,)),
        *standing("stack", 16, n=(20,)),
        *standing("stack", 5, rates=(1 / 60,), friction=(0.1, 0.2, 0.35, 0.8, 1.5)),
        *standing("heavy_on_light", 4, ratio=(100.0,)),
        *standing("heavy_on_light", 8, rates=(1 / 60,), order=SCENE_ORDERS),
    ],
)
def test_stacks_stand_on_few_sweeps_in_every_order_and_friction(name, seconds, parameters):
    assert drift(name, seconds, **parameters) < MOST


def test_scene_stack_in_whole_steps_and_given_order_drifts():
    # Whole steps swept in one direction: the measure above does see a stack that leaves its place.
    assert drift("stack", n=10, solver_iterations=8, substeps=1, order="given") > 10 * MOST


@pytest.mark.parametrize(
    ("dt", "substeps"),
    [
        (1 / 60, 4),
        (1 / 120, 2),
        (1 / 240, 1),
        (1 / 50, 5),
        (1 / 100, 3),
        (1 / 1000, 1),
        (1 / 30, 8),
        (0.1, 24),
    ],
)
def test_scene_substeps_are_no_longer_than_the_maximum(dt, substeps):
    assert lv.Scene("stack", dt=dt).parameters.substeps == substeps
    assert lv.Scene("stack", dt=dt, max_substep=dt / 3).parameters.substeps == 3
    assert lv.Scene("stack", dt=dt, substeps=7).parameters.substeps == 7
    # whoever solves each step accurately needs none
    other = lv.Scene("stack", dt=dt, solver="newton").parameters
    assert (other.substeps, other.order) == (1, "given")
    assert lv.Scene("stack", solver="newton", dt=0.01, max_substep=0.004).parameters.substeps == 3


def test_scene_defaults_follow_other_parameters():
    scene = lv.Scene("stack", friction=0.3).with_parameters(solver="newton", dt=1 / 30)
    p = scene.parameters
    assert (p.substeps, p.order, p.friction) == (1, "given", 0.3)
    assert p.solver_iterations == lv.Scene("stack", solver="newton").parameters.solver_iterations
    assert scene.with_parameters(solver="sequential_impulses").parameters.substeps == 8


def test_scene_with_alternating_order_reverses_contacts_in_each_substep():
    sim = lv.Simulation(lv.Scene("pyramid", base=3, substeps=1))
    seen = []
    for _ in range(6):
        problem = sim.constraint_problem()
        contacts = sim.step()[0]["contacts"]
        assert sim.state.a["key"][: len(contacts["pair"])].tolist() == problem.key.tolist()
        seen.append(problem.key.tolist())
    assert seen[0] != sorted(seen[0])[::-1]
    for even, odd in zip(seen[::2], seen[1::2], strict=True):
        assert [k >> 16 for k in odd] == sorted((k >> 16 for k in even), reverse=True)
        assert odd == even[::-1]
    # every contact found its impulse, whichever way the last substep went
    assert sim.step()[0]["solver"][3] == len(seen[0])


def test_bearing_contact_within_the_slop_is_in_place():
    """Target of the normal row, equations (1) and (2) of the engine's contacts, read from the problem."""
    sim = lv.Simulation(lv.Scene("stack", n=1, substeps=1, dt=0.01, gravity=10.0))
    p = sim.scene.parameters
    beta = sim.state.setting[SETTING["beta"]]
    for _ in range(5):
        sim.step()

    def targets(gap, warm):
        a, head = sim.state.a, sim.state.head
        kept = a["x"].copy(), head[HEAD["warm_start"]]
        a["x"][1, 2] = 0.5 + gap
        head[HEAD["warm_start"]] = warm
        problem = sim.constraint_problem()
        a["x"][:], head[HEAD["warm_start"]] = kept
        return (problem.b + problem.rows.jacobian(problem.cones) @ problem.rows.v_free.ravel())[
            problem.cones.ptr[:-1]
        ]

    h, slop = p.dt, p.slop
    np.testing.assert_allclose(targets(0.5 * slop, True), 0.0, atol=1e-13)
    # settling has turned the box by less than a microradian
    np.testing.assert_allclose(targets(3.0 * slop, True), -beta * 2.0 * slop / h, rtol=1e-5)
    np.testing.assert_allclose(targets(-0.5 * slop, True), 0.0, atol=1e-13)
    # what the cache does not know bears nothing yet: the whole gap may close
    np.testing.assert_allclose(targets(0.5 * slop, False), -0.5 * slop / h, rtol=1e-4)
