"""Contacts that are kept over steps, `recycle`: nothing but small errors of their gaps changes."""

import numpy as np
import pytest

import lavender as lv
from lavender.sim.engine.layout import HEAD, SIZE

DT = 1 / 60  # s
MM = 1e-3


def build(kind, **parameters):
    """Return a simulation of a tower, a wall, tumbling boxes, or spheres, on a plane."""
    given = {"dt": DT, "substeps": 4, "solver_iterations": 4, "recycle": MM} | parameters
    scene = lv.Scene(**given)
    scene.add_plane()
    name, n = kind.split()
    rng = np.random.default_rng(5)
    for i in range(int(n)):
        if name == "tower":
            scene.add_box(position=(0, 0, i + 0.5))
        elif name == "wall":
            for j in range(i, int(n)):
                scene.add_box(position=(0.5 * i + j - i, 0, i + 0.5))
        elif name == "spheres":
            scene.add_sphere(0.3, position=(*rng.uniform(-1, 1, 2), 0.4 + 0.4 * i))
        else:
            place = (*rng.uniform(-0.5, 0.5, 2), 0.5 + 0.8 * i)
            spin = tuple(rng.normal(0, 2, 3))
            scene.add_box(tuple(rng.uniform(0.3, 0.9, 3)), position=place, angular_velocity=spin)
    return lv.Simulation(scene)


def displacement(simulation, steps):
    """Return the largest lateral and vertical displacement [m] after some steps."""
    start = simulation.reset()[0]["positions"]
    moved = simulation.run(steps)[0]["positions"] - start
    return np.array([np.hypot(moved[:, 0], moved[:, 1]).max(), np.abs(moved[:, 2]).max()])


def count_rebuilt(simulation, steps):
    """Return the number of steps in whose first substep contacts were built."""
    rebuilt = 0
    for _ in range(steps):
        problem = simulation.state.copy()
        problem.kernel.prepare_substep()
        rebuilt += int(problem.head[HEAD["rebuilt"]])
        simulation.step()
    return rebuilt


# A third more, and 0.1 mm: the drift of a tower is a slow sway.
@pytest.mark.parametrize("kind", ["tower 6", "tower 12", "wall 8", "boxes 1"])
def test_what_stands_stands_as_well_with_kept_contacts(kind):
    kept, anew = build(kind), build(kind, recycle=0.0)
    assert (displacement(kept, 400) <= 1.33 * displacement(anew, 400) + 1e-4).all()
    assert count_rebuilt(anew, 20) == 20
    assert count_rebuilt(kept, 20) <= 10


@pytest.mark.parametrize("kind", ["boxes 12", "spheres 12"])
def test_pile_comes_to_rest_no_deeper_than_without(kind):
    rest = []
    for recycle in (0.0, MM):
        simulation = build(kind, recycle=recycle)
        contacts = simulation.run(400)[0]["contacts"]
        state = simulation.run(1)[0]
        rest.append((contacts["depth"].max(), np.abs(state["velocities"]).max()))
    assert rest[1][0] <= rest[0][0] + 0.2 * MM
    assert rest[1][1] <= rest[0][1] + 0.05  # m/s


@pytest.mark.parametrize("kind", ["wall 6", "boxes 6"])
def test_gaps_of_kept_contacts_are_those_of_the_poses(kind):
    """A gap that follows its bodies to first order misses r theta^2 / 2, 1e-6 m for 1 mm of path and 0.5 m."""
    simulation = build(kind)
    simulation.run(300)
    compared = 0
    for _ in range(30):
        simulation.step()
        kept, anew = simulation.state.copy(), simulation.state.copy()
        anew.head[HEAD["kept"]] = 0
        for state in (kept, anew):
            state.kernel.prepare_substep()
        gap = [
            dict(zip(s.a["key"][: s.head[0]].tolist(), s.a["gap"][: s.head[0]], strict=True))
            for s in (kept, anew)
        ]
        # A corner that crosses an edge has a new key, and another point of the same face.
        shared = gap[0].keys() & gap[1].keys()
        compared += len(shared)
        assert len(shared) >= 0.8 * len(gap[1])
        assert all(abs(gap[0][key] - gap[1][key]) < 0.02 * MM for key in shared)
    assert compared > 100


@pytest.mark.parametrize(
    ("kind", "more"),
    [
        ("tower 8", {}),
        ("wall 5", {}),
        ("boxes 12", {}),
        ("boxes 12", {"order": "given", "substeps": 3}),
        ("wall 4", {"order": "random"}),
        ("wall 4", {"solver": "newton", "substeps": 1}),
        ("spheres 9", {"warm_start": False}),
    ],
)
def test_calls_and_snapshots_do_not_change_the_bits(kind, more):
    one, many, restored = (build(kind, **more) for _ in range(3))
    for _ in range(60):
        one.step()
    many.run(40)
    many.run(20)
    restored.run(33)
    shot = restored.snapshot()
    restored.reset()
    restored.restore(shot)
    restored.run(27)
    expected = one.step()[0]
    for simulation in (many, restored):
        found = simulation.step()[0]
        for name in ("positions", "quaternions", "velocities"):
            np.testing.assert_array_equal(found[name], expected[name])


@pytest.mark.parametrize("kind", ["wall 4", "boxes 8"])
def test_problem_of_the_next_substep_has_its_bits(kind):
    simulation = build(kind, substeps=1, dt=DT / 4, order="given")
    for step in range(80):
        problem = simulation.constraint_problem()
        expected = lv.solve(problem, "sequential_impulses", order="given", tol=0, max_iter=4)
        simulation.step()
        if step >= 40:
            found = simulation.state.a["impulse"][: problem.m]
            np.testing.assert_array_equal(found, expected.impulse)


def test_contacts_of_a_sliding_body_are_built_after_the_given_path():
    """At 11 mm/s a step is 0.18 mm, so that contacts are built in every sixth step."""
    scene = lv.Scene(dt=DT, substeps=4, recycle=MM, friction=0.0)
    scene.add_plane()
    scene.add_box(position=(0, 0, 0.5), velocity=(0.011, 0, 0))
    assert count_rebuilt(lv.Simulation(scene), 60) in (10, 11)


def test_pushed_body_stops_at_what_comes_within_the_margin():
    """Built for a gap of 10.3 mm, beyond the margin, no contact is kept for the 9.8 mm at which the push begins."""
    scene = lv.Scene(dt=1 / 120, substeps=2, recycle=MM, gravity=0.0)
    box = scene.add_box(position=(0, 0, 0), velocity=(0.012, 0, 0))
    scene.add_box(position=(1.0103, 0, 0), mass=1000.0)
    simulation = lv.Simulation(scene)
    simulation.run(5)
    simulation.set_velocity(box, (8.0, 0, 0))
    places = simulation.step()[0]["positions"]
    assert places[1, 0] - places[0, 0] >= 1.0 - MM  # In the first substep it would move by 33 mm.


def test_impossible_values_name_the_remedy():
    with pytest.raises(lv.InputError, match="at most half of margin"):
        lv.Scene(recycle=0.006)
    with pytest.raises(lv.InputError, match="even number"):
        lv.Scene(recycle=MM, dt=1 / 240, substeps=1)
    with pytest.raises(lv.InputError, match="recycle"):
        lv.Scene(recycle=-MM)
    lv.Scene(recycle=MM, dt=1 / 240, substeps=1, order="given")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("gap", np.nan, "gap is not finite"),
        ("normal", np.inf, "normal is not finite"),
        ("local", np.nan, "local is not finite"),
        ("impulse", np.nan, "impulse is not finite"),
        ("moved", -1.0, "moved"),
        ("key", 2**63, "key names other bodies"),
        ("contact_pair", 3, "key names other bodies|does not have"),
    ],
)
def test_damaged_contacts_of_a_snapshot_are_refused(name, value, message):
    simulation = build("tower 3")
    simulation.run(30)
    assert simulation.state.head[HEAD["kept"]]
    simulation.state.a[name][0] = value
    shot = simulation.snapshot()
    with pytest.raises(lv.InputError, match=message):
        build("tower 3").restore(shot)


def test_snapshot_of_a_scene_without_recycling_keeps_no_contacts():
    simulation = build("tower 3", recycle=0.0)
    simulation.run(5)
    assert simulation.state.size[SIZE["bodies"]] == 4
    simulation.state.head[HEAD["kept"]] = 1
    with pytest.raises(lv.InputError, match="kept is 1"):
        build("tower 3", recycle=0.0).restore(simulation.snapshot())
