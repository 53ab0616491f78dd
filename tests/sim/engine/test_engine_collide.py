"""Broad and narrow phase against slow twins, and the contact cache against shuffled and false keys."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog
from worked import after

import lavender as lv
from lavender.sim.engine.layout import HEAD
from lavender.sim.scene.parts import convert_to_rotation_matrix

MARGIN = 0.05


def manifold(a, b, **more):
    """Contacts of two bodies given as (kind, size, keywords); (pair, point, normal, gap)."""
    scene = lv.Scene(gravity=0.0, friction=0.0, margin=MARGIN, **more)
    for kind, size, keywords in (a, b):
        getattr(scene, f"add_{kind}")(size, **keywords)
    sim = lv.Simulation(scene)
    sim.prepare_substep()
    c = int(sim.state.head[HEAD["contacts"]])
    return {k: sim.state.a[k][:c].copy() for k in ("contact_pair", "point", "normal", "gap", "key")}


def support(body, d):
    """Furthest point of a box (half extents, centre, R) along d."""
    half, x, r = body
    return x + r @ (half * np.where(r.T @ d >= 0, 1.0, -1.0))


def separation(a, b):
    """Largest separation of two boxes over the 15 axes, in NumPy: the slow twin."""
    best = -np.inf
    axes = [*a[2].T, *b[2].T, *(np.cross(p, q) for p in a[2].T for q in b[2].T)]
    for n in axes:
        size = np.linalg.norm(n)
        if size < 1e-3:
            continue
        n = n / size
        if n @ (b[1] - a[1]) < 0:
            n = -n
        best = max(best, n @ (support(b, -n) - support(a, n)))
    return best


box_numbers = st.tuples(*[st.floats(-1, 1)] * 10, *[st.floats(0.2, 1.5)] * 6)


@given(numbers=box_numbers)
def test_collide_of_two_boxes_agrees_with_the_slow_twin(numbers):
    x = np.array(numbers)
    q = [np.array([1.0, *x[:3]]), np.array([1.0, *x[3:6]])]
    q = [y / np.linalg.norm(y) for y in q]
    half = [x[10:13] / 2, x[13:16] / 2]
    place = np.array([x[6], x[7], 1.2 * x[8]])
    a = (half[0], np.zeros(3), convert_to_rotation_matrix(q[0]))
    b = (half[1], place, convert_to_rotation_matrix(q[1]))
    found = manifold(
        ("box", 2 * half[0], {"quaternion": q[0]}),
        ("box", 2 * half[1], {"quaternion": q[1], "position": place}),
    )
    exact = separation(a, b)
    tol = 1e-3 * min(half[0].min(), half[1].min())
    if exact > MARGIN + 1e-9:
        assert len(found["gap"]) == 0
        return
    assert len(found["gap"]) <= 4
    if exact < -0.12 * abs(exact) - 3 * tol:
        # Overlapping boxes touch somewhere. Boxes apart may lose a speculative point: a corner nearest along
        # an axis can lie beside the face that it faces.
        assert len(found["gap"]) >= 1
    for n, p, gap in zip(found["normal"], found["point"], found["gap"], strict=True):
        assert abs(np.linalg.norm(n) - 1) < 1e-12
        # The normal points from a to b: moving b along it by the overlap separates the boxes.
        overlap = n @ support(a, n) - n @ support(b, -n)
        assert overlap <= -exact + 0.12 * abs(exact) + 3 * tol
        assert gap >= -overlap - 1e-9
        assert gap <= MARGIN
        # The point lies halfway between the surfaces along n: half a gap inside or outside of both boxes.
        slack = 0.5 * abs(gap) + 2 * tol + 1e-9
        for half_box, centre, r in (a, b):
            assert np.all(np.abs(r.T @ (p - centre)) <= half_box + slack)
    if len(found["gap"]):
        if exact < 0.0:
            # Faces are preferred to edges, and those of a, by 5 % and a tolerance each: the deepest gap may
            # be that much above the exact one.
            assert found["gap"].min() <= exact + 0.12 * abs(exact) + 3 * tol
        assert len(set(found["key"].tolist())) == len(found["key"])


def test_collide_of_a_box_on_a_box_gives_the_four_corners_in_the_order_of_a_plane():
    for below in (
        ("plane", (0, 0, 1), {}),
        ("box", (2, 2, 2), {"position": (0, 0, -1), "mass": 0, "static": True}),
    ):
        found = manifold(below, ("box", (1, 0.6, 0.4), {"position": (0, 0, 0.2 - 1e-3)}))
        np.testing.assert_allclose(found["gap"], -1e-3, atol=1e-15)
        np.testing.assert_allclose(found["normal"], [[0, 0, 1]] * 4, atol=1e-15)
        expected = [[x, y, -0.5e-3] for y in (-0.3, 0.3) for x in (-0.5, 0.5)]
        np.testing.assert_allclose(found["point"], expected, atol=1e-15)


def test_crossed_edges_meet_in_one_point():
    turn = [np.cos(np.pi / 8), np.sin(np.pi / 8), 0, 0]  # 45 degrees about x, then about y
    other = [np.cos(np.pi / 8), 0, np.sin(np.pi / 8), 0]
    z = np.sqrt(2) - 0.01
    found = manifold(
        ("box", (2, 1, 1), {"quaternion": turn}),
        ("box", (1, 2, 1), {"quaternion": other, "position": (0.1, 0.2, z)}),
    )
    assert len(found["gap"]) == 1
    assert found["gap"][0] == pytest.approx(-0.01, abs=1e-12)
    np.testing.assert_allclose(found["normal"][0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(found["point"][0], [0.1, 0.0, z / 2], atol=1e-12)


@pytest.mark.parametrize("flip", [False, True])
def test_collide_of_a_sphere_with_any_shape_gives_the_exact_contact(flip):
    ball = ("sphere", 0.5, {"position": (0.2, 0.1, 0.48)})
    for other, point in (
        (("plane", (0, 0, 1), {}), (0.2, 0.1, -0.01)),
        (("box", (4, 4, 1), {"position": (0, 0, -0.5)}), (0.2, 0.1, -0.01)),
        (("sphere", 1.0, {"position": (0.2, 0.1, -1.0)}), (0.2, 0.1, -0.01)),
    ):
        found = manifold(*((ball, other) if flip else (other, ball)))
        assert found["gap"] == pytest.approx(-0.02, abs=1e-15)
        np.testing.assert_allclose(found["normal"], [[0, 0, -1.0 if flip else 1.0]], atol=1e-15)
        np.testing.assert_allclose(found["point"], [point], atol=1e-15)
    corner = ("box", (1, 1, 1), {"position": (-0.5, -0.5, -0.5)})
    near = ("sphere", 0.5, {"position": (0.3, 0.3, 0.3)})
    found = manifold(corner, near)
    assert found["gap"] == pytest.approx(0.3 * np.sqrt(3) - 0.5, abs=1e-15)
    np.testing.assert_allclose(found["normal"], [[3**-0.5] * 3], atol=1e-15)


def test_collide_of_a_sphere_center_inside_a_box_leaves_by_the_nearest_face():
    found = manifold(("box", (2, 2, 2), {}), ("sphere", 0.1, {"position": (0.2, -0.9, 0.1)}))
    assert found["gap"] == pytest.approx(-0.2, abs=1e-15)
    np.testing.assert_allclose(found["normal"], [[0, -1, 0]], atol=1e-15)


# -- broad phase ------------------------------------------------------------------------------------


def pairs_of(sim):
    sim.prepare_substep()
    return {tuple(p) for p in sim.state.a["pair"][: sim.state.head[HEAD["pairs"]]].tolist()}


def overlapping(sim):
    """All pairs whose boxes of the pair list meet, tested one by one."""
    a, bodies = sim.state.a, sim.scene.bodies
    out = set()
    for i, j in itertools.combinations(range(len(bodies)), 2):
        if bodies[i].is_static and bodies[j].is_static:
            continue
        planes = [k for k in (i, j) if a["kind_of_shape"][k] == 1]
        if planes:
            k = planes[0]
            low, high = a["fat"][i + j - k, :3], a["fat"][i + j - k, 3:]
            n = a["shape"][k, :3]
            meet = n @ np.where(n > 0, low, high) <= a["shape"][k, 3]
        else:
            meet = np.all(a["fat"][i, :3] <= a["fat"][j, 3:]) and np.all(
                a["fat"][j, :3] <= a["fat"][i, 3:]
            )
        if meet:
            out.add((i, j))
    return out


@given(
    seed=st.integers(0, 10_000),
    n=st.sampled_from([5, 40, 120]),
    spread=st.floats(1.0, 30.0),
    decades=st.floats(0.0, 6.0),
)
def test_broad_phase_finds_all_pairs(seed, n, spread, decades):
    rng = np.random.default_rng(seed)
    scene = lv.Scene(gravity=0.0)
    scene.add_plane((1, 2, 3), -1.0)
    for i in range(n):
        size = 10.0 ** rng.uniform(-decades, 0.0)
        more = {"position": rng.uniform(-1, 1, 3) * spread, "static": bool(i % 7 == 0)}
        if i % 2:
            scene.add_sphere(size, **more)
        else:
            scene.add_box(size * rng.uniform(0.5, 2.0, 3), quaternion=rng.normal(size=4), **more)
    sim = lv.Simulation(scene)
    found = pairs_of(sim)
    assert found == overlapping(sim)
    listed = sim.state.a["pair"][: len(found)].tolist()
    assert listed == sorted(listed)


def test_broad_phase_time_grows_with_the_number_of_bodies():
    def work(n):
        sim = lv.Simulation(lv.Scene("pile", n=n, walls=False))
        sim.prepare_substep()
        return int(sim.state.head[HEAD["pairs"]]) / n

    # Pairs per body stay what they are: the list, and with it the time, is linear.
    assert work(2000) < 1.5 * work(200) < 20


def test_jointed_bodies_touch_only_if_enabled():
    for collide, contacts in ((False, 0), (True, 1)):
        scene = lv.Scene(gravity=0.0)
        a = scene.add_sphere(0.5)
        b = scene.add_sphere(0.5, position=(0.9, 0, 0))
        scene.add_joint("ball", a, b, anchor=(0.45, 0, 0), collide=collide)
        assert lv.Simulation(scene).step()[0]["solver"][2] == contacts


# -- cache ------------------------------------------------------------------------------------------


def test_warm_start_with_shuffled_or_false_keys_steps_as_without():
    start = after(60, "stack", n=4)
    cold = start.snapshot()
    rng = np.random.default_rng(0)
    worst = {}
    for kind in ("none", "shuffled", "false", "rotated impulses"):
        sim = lv.Simulation(start.scene)
        sim.restore(cold)
        a = sim.state.a
        n = int(sim.state.head[HEAD["cached"]])
        if kind == "shuffled":
            for i in range(0, n, 4):  # among the points of one pair: the distance guard sees it
                a["cache_key"][i : i + 4] = rng.permutation(a["cache_key"][i : i + 4])
        elif kind == "false":
            a["cache_key"][:n] ^= np.uint64(0x155)  # features that do not exist
        elif kind == "rotated impulses":
            a["cache_impulse"][:n] = np.roll(
                a["cache_impulse"][:n], 4, axis=0
            )  # those of another pair
        first = sim.step()[0]["solver"]
        for _ in range(120):
            observation = sim.step()[0]
        worst[kind] = np.abs(observation["velocities"]).max()
        assert first[3] == n  # found by key, or by place
        assert np.abs(observation["positions"][1:, :2]).max() < 0.01
    assert all(v < 1e-3 for v in worst.values())


def test_warm_start_entry_far_from_the_contact_is_dropped():
    sim = after(60, "stack", n=2, substeps=1)
    a = sim.state.a
    n = int(sim.state.head[HEAD["cached"]])
    a["cache_local"][:n] += 10.0
    assert sim.step()[0]["solver"][3] == 0
    assert sim.step()[0]["solver"][3] == n


def test_warm_start_of_a_contact_whose_key_changes_keeps_its_impulse():
    # A box slid over the corner of the one below: its corners become crossings of edges.
    scene = lv.Scene(friction=0.0, gravity=10.0, substeps=1)
    scene.add_box((2, 2, 1), position=(0, 0, -0.5), static=True)
    box = scene.add_box((1, 1, 1), position=(0.48, 0, 0.5), velocity=(0.5, 0, 0))
    sim = lv.Simulation(scene)
    keys = set()
    for step in range(12):
        observation = sim.step()[0]
        keys |= set(sim.state.a["key"][:4].tolist())
        assert observation["solver"][3] == (4 if step else 0)
    assert len(keys) > 4
    assert observation["positions"][box, 0] > 0.5


def test_warm_start_impulses_turn_with_the_contact_frame():
    # A box at rest on a slope: the cached friction acts along the slope whatever the tangents are.
    sim = lv.Simulation(lv.Scene("ramp", solver_iterations=64, substeps=1, order="given"))
    for _ in range(60):
        observation = sim.step()[0]
    problem = sim.constraint_problem()
    contacts = observation["contacts"]
    t2 = np.cross(contacts["normal"], contacts["tangent"])
    world = sum(
        i[0] * n + i[1] * t + i[2] * u
        for i, n, t, u in zip(
            contacts["impulses"], contacts["normal"], contacts["tangent"], t2, strict=True
        )
    )
    np.testing.assert_allclose(world, [0, 0, 9.81 / 120.0], atol=1e-12)
    guess = problem.guess.reshape(-1, 3)
    np.testing.assert_allclose(guess, contacts["impulses"], atol=1e-12)


@pytest.mark.parametrize(("speed", "expected"), [(5.0, 4), (15.0, 4), (100.0, 0)])
def test_warm_start_of_a_contact_that_moves_by_five_margins_is_kept(speed, expected):
    """Bars that lie crosswise: where their edges cross, contacts move on both by a fraction of `speed` / 240 m."""
    scene = lv.Scene(substeps=1)
    scene.add_box((2.0, 0.4, 0.2), position=(0.0, 0.0, 0.1), static=True)
    scene.add_box((0.4, 2.0, 0.2), position=(0.0, 0.0, 0.3), angular_velocity=(0.0, 0.0, speed))
    simulation = lv.Simulation(scene)
    at = lv.SOLVER_FIELDS.index("cache_matches")
    matches = [simulation.step()[0]["solver"][at] for _ in range(3)]
    assert matches == [0, expected, expected]


@pytest.mark.parametrize("seed", range(12))
def test_manifold_of_eight_points_keeps_the_deepest(seed):
    """A slab lies turned by 45 degrees and a little tilted on another; a linear program finds the deepest point."""
    rng = np.random.default_rng(seed)
    turn = np.pi / 4 + rng.uniform(-0.2, 0.2)
    tilt = 0.002 * rng.normal(size=2)
    q = np.array([np.cos(turn / 2), *(0.5 * tilt), np.sin(turn / 2)])
    q /= np.linalg.norm(q)
    place = np.array([*rng.uniform(-0.1, 0.1, 2), 0.395])
    found = manifold(
        ("box", (2, 2, 0.4), {}), ("box", (2.2, 2.2, 0.4), {"quaternion": q, "position": place})
    )
    r = convert_to_rotation_matrix(q)
    below = (
        place - 0.2 * r[:, 2]
    )  # the centre of the lower face, whose points are below + r[:, :2] (u, v)
    inside = np.vstack([r[:2, :2], -r[:2, :2]]), np.concatenate([1.0 - below[:2], 1.0 + below[:2]])
    deepest = linprog(r[2, :2], *inside, bounds=[(-1.1, 1.1)] * 2)
    assert len(found["gap"]) == 4
    assert found["gap"].min() == pytest.approx(
        below[2] + deepest.fun - 0.2, abs=1e-3 * abs(below[2] - 0.2)
    )
