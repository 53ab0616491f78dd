"""Contacts that keep their rows for the substeps of a step: errors as without, at rest and at speed."""

import numpy as np
import pytest

import lavender as lv
from lavender.sim.engine.layout import HEAD
from lavender.sim.engine.problem import build_problem

DT = 1 / 60  # s, 4 substeps
BUDGET = {"solver_iterations": 4}


def tower(n, **parameters):
    scene = lv.Scene(**BUDGET, **parameters)
    scene.add_plane()
    for i in range(n):
        scene.add_box(position=(0, 0, i + 0.5))
    return scene


def pyramid(n, **parameters):
    scene = lv.Scene(**BUDGET, **parameters)
    scene.add_plane()
    for i in range(n):
        for j in range(i, n):
            scene.add_box(position=(0.5 * i + j - i, 0, i + 0.5))
    return scene


def substeps_and_short_steps(make, **parameters):
    """Return the same scene in steps of four substeps and in steps of one substep, each a quarter as long."""
    return (
        lv.Simulation(make(dt=DT, substeps=4, **parameters)),
        lv.Simulation(make(dt=DT / 4, substeps=1, **parameters)),
    )


def displacement(simulation, steps):
    """Return the largest lateral and vertical displacement [m] after some steps."""
    start = simulation.reset()[0]["positions"]
    moved = simulation.run(steps)[0]["positions"] - start
    return np.array([np.hypot(moved[:, 0], moved[:, 1]).max(), np.abs(moved[:, 2]).max()])


# A third more, and 0.1 mm: the drift of a tower is a slow sway, whose last tenth of a millimetre is chance.
@pytest.mark.parametrize(("make", "n"), [(tower, 10), (tower, 15), (pyramid, 6)])
def test_resting_bodies_move_as_little_as_in_short_steps(make, n):
    kept, anew = substeps_and_short_steps(lambda **more: make(n, **more))
    assert (displacement(kept, 300) <= 1.33 * displacement(anew, 1200) + 1e-4).all()
    assert not kept.state.head[HEAD["rebuilt"]]  # The last substep kept all rows.


def test_body_that_moves_gets_new_contacts_in_every_substep():
    scene = tower(3, dt=DT, substeps=4)
    simulation = lv.Simulation(scene)
    simulation.run(20)
    assert not simulation.state.head[HEAD["rebuilt"]]
    simulation.set_velocity(3, (1.0, 0.0, 0.0))
    simulation.run(2)
    assert simulation.state.head[HEAD["rebuilt"]]


# 30 m/s are 125 mm in a substep, more than the margin: both sink in, and by the same.
@pytest.mark.parametrize("speed", [3.0, 10.0, 30.0])
@pytest.mark.parametrize("spin", [(0.0, 0.0, 0.0), (3.0, 8.0, 1.0)])
@pytest.mark.parametrize("shape", ["box", "sphere"])
def test_body_at_speed_sinks_in_no_more_than_in_short_steps(shape, speed, spin):
    def make(**parameters):
        scene = lv.Scene(**BUDGET, **parameters)
        scene.add_plane()
        more = {"position": (0, 0, 1.7), "velocity": (2.0, 1.0, -speed), "angular_velocity": spin}
        scene.add_box(**more) if shape == "box" else scene.add_sphere(0.5, **more)
        return scene

    depths = []
    for simulation, n in zip(substeps_and_short_steps(make), (1, 4), strict=True):
        deepest = []
        for _ in range(60):
            contacts = simulation.run(n)[0]["contacts"]
            deepest.append(contacts["depth"].max(initial=0.0))
        depths.append(max(deepest))
    assert depths[0] <= 1.05 * depths[1] + 1e-4  # m


@pytest.mark.parametrize("speed", [1.0, 10.0, 30.0])
@pytest.mark.parametrize("shapes", ["boxes", "spheres"])
def test_bodies_that_pass_each_other_at_speed_do_not_touch(shapes, speed):
    # They pass at a distance of 20 mm, twice the margin; a plane tangent to the first normal would stop them.
    scene = lv.Scene(dt=DT, substeps=4, gravity=0.0, **BUDGET)
    for side in (-1, 1):
        more = {"position": (-0.9 * side, 0.51 * side, 0), "velocity": (speed * side, 0, 0)}
        scene.add_box(**more) if shapes == "boxes" else scene.add_sphere(0.5, **more)
    velocities = lv.Simulation(scene).run(round(3.0 / (speed * DT)) + 1)[0]["velocities"]
    np.testing.assert_allclose(velocities[:, 0], (-speed, speed), rtol=1e-12)
    np.testing.assert_allclose(velocities[:, 1:], 0.0, atol=1e-12)


@pytest.mark.parametrize("order", ["alternating", "given"])
def test_other_bodies_far_away_change_no_bit(order):
    # A spinning ball drops and a box tumbles at the same time, so that other contacts are renewed in all substeps.
    results = []
    for crowded in (False, True):
        scene = tower(5, dt=DT, substeps=4, order=order)
        if crowded:
            scene.add_sphere(
                0.4, position=(30, 0, 1.0), velocity=(3, 0, 0), angular_velocity=(9, 0, 4)
            )
            scene.add_box(position=(-30, 0, 2.0), angular_velocity=(2, 3, 1), velocity=(1, 0, 0))
        results.append(lv.Simulation(scene).run(90)[0])
    for key in ("positions", "quaternions", "velocities"):
        assert results[0][key].tobytes() == results[1][key][:6].tobytes()


@pytest.mark.parametrize("mixed", [False, True])
def test_capacities_of_the_buffers_change_no_bit(mixed):
    # A heap falls: contacts of one and of three rows come and go in all substeps, and the buffers grow between them.
    results = []
    for ample in (False, True):
        scene = lv.Scene(dt=DT, substeps=4, **BUDGET)
        scene.add_plane()
        for i in range(27):
            at = np.array([i % 3, i // 3 % 3, i // 9]) * 1.04 + (
                0.03 * (i % 5),
                0.02 * (i % 7),
                0.7,
            )
            scene.add_box(position=tuple(at), friction=0.0 if mixed and i % 2 else 0.5)
        simulation = lv.Simulation(scene)
        if ample:
            for name in ("need_pairs", "need_contacts"):
                simulation.state.head[HEAD[name]] = 5000
            simulation.state = simulation.state.with_larger_buffers()
        results.append(simulation.run(60)[0])
    for key in ("positions", "quaternions", "velocities", "solver"):
        assert results[0][key].tobytes() == results[1][key].tobytes()


def test_sliding_and_spinning_cube_stops_as_by_friction_at_its_corners():
    # 3 m/s and 5 rad/s, mu 0.5: Coulomb's law at four corners with equal loads gives 1.138 m and 1.282 rad by steps of
    # 1e-5 s; the loads differ while it brakes. As if each motion were alone: 0.917 m and 0.601 rad.
    scene = lv.Scene(dt=DT, substeps=4, **BUDGET)
    scene.add_plane()
    scene.add_box(position=(0, 0, 0.5), velocity=(3, 0, 0), angular_velocity=(0, 0, 5))
    state = lv.Simulation(scene).run(120)[0]
    turn = 2 * np.arctan2(state["quaternions"][1, 3], state["quaternions"][1, 0])
    assert 1.13 < state["positions"][1, 0] < 1.20
    assert 1.27 < turn < 1.38


@pytest.mark.parametrize("solver", ["newton", "pgs"])
def test_other_solvers_keep_rows_too(solver):
    scene = tower(3, dt=DT, substeps=4).with_parameters(solver=solver, solver_iterations=200)
    simulation = lv.Simulation(scene)
    assert (displacement(simulation, 30) < 1.5e-3).all()  # the slop, and half of it
    assert not simulation.state.head[HEAD["rebuilt"]]


def test_gap_of_a_kept_contact_is_that_of_its_bodies():
    # 0.8 mm in a step, below half the margin: the observation has the gap at the beginning of the last substep.
    scene = lv.Scene(dt=DT, substeps=4, gravity=0.0, **BUDGET)
    scene.add_plane()
    scene.add_sphere(0.5, position=(0, 0, 0.505), velocity=(0.01, 0, -0.05))
    simulation = lv.Simulation(scene)
    observation = simulation.step()[0]
    assert not simulation.state.head[HEAD["rebuilt"]]
    gap = observation["positions"][1, 2] + 0.05 * DT / 4 - 0.5
    assert observation["contacts"]["depth"] == pytest.approx([-gap], abs=1e-12)


def test_rows_of_kept_contacts_stay_theirs_when_others_come_and_go():
    # A heap of boxes, every other one without friction, so that contacts have one row or three; the diagonal of A is
    # computed again from the arms and normals of the last substep.
    scene = lv.Scene(dt=DT, substeps=4, **BUDGET)
    scene.add_plane()
    for i in range(18):
        at = np.array([i % 3, i // 3 % 3, i // 9]) * 1.04 + (0.03 * (i % 5), 0.02 * (i % 7), 0.7)
        scene.add_box(position=tuple(at), friction=0.0 if i % 2 else 0.5)
    simulation = lv.Simulation(scene)
    rebuilt = set()
    for _ in range(50):
        simulation.step()
        problem = build_problem(
            simulation.state, [b.name for b in scene.bodies], [], "the last substep"
        )
        np.testing.assert_allclose(simulation.state.a["d"][: problem.m], problem.d, rtol=1e-9)
        rebuilt.add(int(simulation.state.head[HEAD["rebuilt"]]))
    assert 1 in rebuilt  # Contacts were renewed in the middle of steps.
