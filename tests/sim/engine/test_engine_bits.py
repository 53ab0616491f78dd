"""Ways to go on with a run that have the bits of the run: one table, beside scenes of every kind."""

import copy
import pickle

import numpy as np
import pytest
from worked import after

import lavender as lv
from lavender.sim.engine.layout import HEAD
from lavender.sim.engine.state import State
from lavender_ext.driver import memory

SCENES = {
    "stack": {},
    "pyramid": {"base": 4, "friction_shape": "box"},
    "chain": {"n": 8},
    "spinner": {},
    "ramp": {"rolling_radius": 0.01},
    "four_bar": {"motor": 1.0},
    "bridge": {"n": 6},
    "pile": {"n": 20, "kind": "mixed", "rolling_radius": 0.03, "patch_radius": 0.05},
    "card_house": {},
}


def trajectory(sim, steps):
    out = []
    for _ in range(steps):
        seen = sim.step()[0]
        keys = "positions", "quaternions", "velocities", "joint_impulses", "solver"
        out += [
            np.asarray(x).tobytes()
            for x in (*(seen[key] for key in keys), *seen["contacts"].values())
        ]
    return out


def with_room(state, pairs, contacts):
    """The same state in arrays of so much room."""
    size = state.size.copy()
    size[8:10] = pairs, contacts
    tight = State(size)
    for name, array in state.a.items():
        goal = tight.a[name]
        goal[...] = array[tuple(slice(n) for n in goal.shape)]
    return tight


def restored(sim, folder):
    state = sim.snapshot()
    twin = lv.Simulation(sim.scene)
    twin.step()
    twin.restore(state)
    return twin


def loaded(sim, folder):
    sim.save(folder / "state")
    twin = lv.Simulation(sim.scene)
    twin.load(folder / "state")
    assert (twin.solver_iterations, twin.warm_start) == (sim.solver_iterations, sim.warm_start)
    return twin


def moved(sim, folder):
    """To arrays of more room, as a host without Python does."""
    twin = copy.copy(sim)
    size = sim.state.size.copy()
    size[8:] += 100
    twin.state = State(size)
    memory.move_engine_state(
        *((s.size, s.real, s.index, s.keys)[i] for s in (sim.state, twin.state) for i in range(4))
    )
    return twin


def tight(sim, folder):
    """In arrays that must grow."""
    twin = copy.copy(sim)
    twin.state = with_room(sim.state, 3, 3)
    return twin


def paired_anew(sim, folder):
    """The pair list is made in every step."""
    twin = copy.copy(sim)
    step = twin.step

    def stepped():
        twin.state.head[HEAD["pairs_valid"]] = 0
        return step()

    twin.step = stepped
    return twin


WAYS = {  # steps that were done before
    "another": (0, lambda sim, folder: lv.Simulation(sim.scene)),
    "restored": (15, restored),
    "loaded": (15, loaded),
    "copied": (15, lambda sim, folder: copy.copy(sim)),
    "copied deeply": (15, lambda sim, folder: copy.deepcopy(sim)),
    "pickled": (15, lambda sim, folder: pickle.loads(pickle.dumps(sim))),
    "moved": (15, moved),
    "tight": (0, tight),
    "paired anew": (0, paired_anew),
}


@pytest.mark.parametrize(
    ("name", "more"),
    [
        *((name, {"order": "random"}) for name in SCENES),
        ("stack", {"solver": "block_gauss_seidel"}),
    ],
)
def test_simulation_continued_in_any_way_has_the_bits_of_the_run(name, more, tmp_path):
    scene = lv.Scene(name, seed=3, **SCENES[name], **more)
    for way, (before, make) in WAYS.items():
        sim = after(before, scene)
        if before:
            sim.set_solver_iterations(7)
            sim.set_warm_start(name != "stack")
            sim.set_velocity(len(scene.bodies) - 1, (0.3, -0.2, 1.5), (0.4, 2.0, -0.1))
        twin = make(sim, tmp_path)
        assert twin.steps == before
        expected = trajectory(sim, 20)
        assert trajectory(twin, 20) == expected, way


def test_scene_substeps_have_the_bits_of_shorter_steps_if_every_substep_builds_contacts():
    # Without a margin no contact is kept for a body that moves; alternating orders would differ in the first substeps.
    more = {"n": 3, "order": "given", "margin": 0.0}
    one = lv.Simulation(lv.Scene("stack", dt=0.01, substeps=2, **more))
    two = lv.Simulation(lv.Scene("stack", dt=0.005, substeps=1, **more))
    for _ in range(30):
        two.step()
        assert trajectory(one, 1) == trajectory(two, 1)
    assert one.time == pytest.approx(two.time, rel=1e-15)


def test_reset_keeps_the_iterations_and_the_warm_start_that_were_set():
    sim = lv.Simulation(lv.Scene("stack", n=2))
    sim.set_solver_iterations(32)
    sim.set_warm_start(False)
    for seed in (None, 3):
        sim.reset(seed=seed)
        assert (sim.solver_iterations, sim.warm_start) == (32, False)


def test_reset_starts_again_and_a_seed_builds_the_scene_anew():
    sim = lv.Simulation(lv.Scene("pile", n=10, seed=1))
    first = sim.reset()[0]["positions"]
    trajectory(sim, 5)
    observation, info = sim.reset()
    np.testing.assert_array_equal(observation["positions"], first)
    assert info["step"] == 0
    assert not np.array_equal(sim.reset(seed=2)[0]["positions"], first)
    np.testing.assert_array_equal(sim.reset(seed=1)[0]["positions"], first)


def test_simulation_beyond_its_buffers_raises_before_the_state_changes():
    sim = lv.Simulation("stack")
    state = with_room(sim.state, sim.state.size[8], 5)
    before = {
        k: state.a[k].copy() for k in ("x", "q", "v", "cache_key", "cache_impulse", "joint_impulse")
    }
    assert state.kernel.run_substeps(3) == (1, 0)
    assert state.head[HEAD["need_contacts"]] == 24
    for key, value in before.items():
        np.testing.assert_array_equal(state.a[key], value)
