"""Contacts of an engine's step are swept two at a time where they share no body: the same bits."""

import numpy as np
import pytest

import lavender as lv
from lavender.sim.engine.layout import HEAD

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


@pytest.mark.parametrize("mixed", [False, True])
def test_packed_contacts_of_boxes_thrown_together(mixed):
    """`mixed`: contacts of one, three and four rows, chains with every joint among them, and others far away."""
    rng = np.random.default_rng(5)
    scene = lv.Scene(dt=1 / 120, friction=0.4)
    scene.add_plane()
    for i in range(30):
        scene.add_box(
            size=rng.uniform(0.3, 1.0, 3), position=(*rng.uniform(-1.2, 1.2, 2), 0.8 + 0.45 * i),
            quaternion=rng.normal(size=4), velocity=rng.normal(size=3), mass=float(rng.uniform(0.1, 20.0)),
            friction=0.0 if mixed and i % 3 == 0 else 0.4, patch_radius=0.1 if mixed and i % 3 == 1 else 0.0,
        )  # fmt: skip
    for i in range(12 if mixed else 0):
        here = scene.bodies[i + 1].position if i < 8 else (50.0 + 3.0 * i, 0.0, 9.0)
        far = scene.add_sphere(radius=0.2, position=(here[0] + 1.0, here[1], here[2]), mass=0.5)
        if i % 4 == 0:
            scene.add_joint("distance", far, i + 1 if i < 8 else -1, anchor_b=here, hertz=5.0 * (i % 8))
        elif i % 4 == 1:
            scene.add_joint("ball", i + 1 if i < 8 else -1, far, anchor=here)
        else:
            motor = {"motor_speed": 3.0, "motor_torque": 0.5} if i % 4 == 3 else {}
            scene.add_joint("hinge", i + 1 if i < 8 else -1, far, anchor=here, axis=(0.0, 1.0, 0.0), **motor)
    sim = lv.Simulation(scene)
    most, rows_of = 0, set()
    for _ in range(150):
        sim.step()
        before, twin = sim.state.copy(), sim.state.copy()
        if before.kernel.run_substeps(1)[0] == 1:  # more contacts than there is room for: `step` makes it
            continue
        assert one_by_one(twin) == 0
        same(before, twin)
        if mixed:
            rows_of |= set(np.diff(before.a["ptr"][: before.head[HEAD["contacts"]] + 13]))
        most = max(most, int(before.head[HEAD["contacts"]]))
    assert most > 30
    assert not mixed or rows_of >= {1, 3, 4, 5, 6}
