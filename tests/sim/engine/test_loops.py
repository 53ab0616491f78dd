"""A joint is in a loop if its bodies remain connected without it."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

import lavender as lv
from lavender.sim.engine.loops import find_loop_joints


def connects(ends, a, b, n):
    rows, columns = np.array(ends, int).reshape(-1, 2).T + 1
    graph = coo_matrix((np.ones(len(ends)), (rows, columns)), (n + 1, n + 1))
    label = connected_components(graph, directed=False)[1]
    return label[a + 1] == label[b + 1]


@pytest.mark.parametrize("seed", range(40))
def test_joint_is_in_a_loop_if_its_bodies_remain_connected_without_it(seed):
    rng = np.random.default_rng(seed)
    n, k = rng.integers(1, 12), rng.integers(0, 16)
    ends = rng.integers(-1, n, (k, 2)).tolist()
    rigid = rng.random(k) < 0.8
    found = find_loop_joints(ends, rigid)
    kept = [pair for pair, stiff in zip(ends, rigid, strict=True) if stiff]
    expected = []
    for (a, b), stiff in zip(ends, rigid, strict=True):
        rest = list(kept)
        if stiff:
            rest.remove([a, b])
        expected.append(stiff and connects(rest, a, b, n))
    np.testing.assert_array_equal(found, np.array(expected, bool))


def measure_compliance(static_ends):
    """Return the compliance of two balls that hold a body at two static bodies, or at one and nothing."""
    scene = lv.Scene(solver="newton")
    body = scene.add_box((0.4, 0.1, 0.2), position=(0, 0, 1))
    for x in (-0.5, 0.5)[:static_ends]:
        wall = scene.add_box((0.1, 0.1, 0.1), 0.0, position=(x, 0, 1), static=True)
        scene.add_joint("ball", wall, body, anchor=(0.4 * x, 0, 1))
    sim = lv.Simulation(scene)
    sim.step()
    rows = 3 * static_ends
    return sim.state.a["compliance"][:rows] / sim.state.a["d"][:rows].mean()


def test_only_joints_of_loops_are_compliant_and_static_bodies_are_one():
    np.testing.assert_array_equal(measure_compliance(1), 0.0)
    np.testing.assert_allclose(measure_compliance(2), 1e-5, rtol=1e-4)
