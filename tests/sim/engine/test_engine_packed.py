"""Contacts of an engine's step are swept two at a time where they share no body: the same bits."""

import numpy as np
import pytest

import lavender as lv

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
    ("stack", {"n": 8, "friction": 0.0}),  # one row
    ("stack", {"n": 8, "patch_radius": 0.1}),  # four
    ("pyramid", {"base": 6, "friction": 0.05, "patch_radius": 0.1}),  # slides and spins
    ("stack", {"n": 8, "rolling_radius": 0.05}),  # five
    ("pyramid", {"base": 6, "friction": 0.05, "patch_radius": 0.1, "rolling_radius": 0.001}),  # six; rolls
    ("pile", {"n": 60, "friction": 0.0}),
    ("newtons_cradle", {}),
    ("four_bar", {}),
]


ORDERS = ["given", "reverse", "symmetric", "random", "bottom_up", "top_down", "colored", "alternating"]


def one_by_one(state):
    """A substep in stages: `solve` sweeps contact after contact."""
    assert state.kernel.prepare_substep() == 0
    state.kernel.solve()
    return state.kernel.finish_substep()


def same(a, b):
    for name in ("x", "q", "v", "impulse", "dv", "setting", "cache_impulse", "joint_impulse", "b"):
        np.testing.assert_array_equal(a.a[name].view(np.uint8), b.a[name].view(np.uint8), err_msg=name)


@pytest.mark.parametrize(
    ("name", "more"),
    [*CASES, *((name, {"order": order, "seed": 3}) for name in ("pyramid", "bridge") for order in ORDERS)],
)
def test_packed_contacts_change_no_bit(name, more):
    """Nor do stages one by one."""
    sim = lv.Simulation(lv.Scene(name, **more))
    for sweeps in 8 * (4, 16, 33):
        sim.set_solver_iterations(sweeps)
        sim.step()
        before = sim.state.copy()
        twin = before.copy()
        assert before.kernel.run_substeps(1) == (0, 1)
        assert one_by_one(twin) == 0
        same(before, twin)
