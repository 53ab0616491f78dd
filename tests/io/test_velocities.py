"""Impulses from velocities alone: exact motions, closed forms, and what no impulse explains."""

import json

import numpy as np
import pytest
from hypothesis import given
from random_problems import FORMS, random_contact_problem, seeds

import lavender as lv


@pytest.mark.parametrize("form", ["rows", "J and M"])
@given(seed=seeds)
def test_reconstruct_of_impulses_within_the_cones_leaves_nothing_over(form, seed):
    problem = FORMS[form](random_contact_problem(seed))
    impulse = lv.solve(problem, tol=1e-8).impulse
    velocity = problem.velocity(impulse)
    found = lv.io.reconstruct(problem, velocity)
    size = np.abs(velocity).max() + np.abs(problem.velocity(np.zeros(problem.m))).max()
    assert found.left_over <= 1e-6 * size  # The impulses themselves are not unique.
    np.testing.assert_allclose(problem.velocity(found.impulse), velocity, atol=1e-6 * size)


def test_reconstruct_is_the_projection_of_the_motion_on_the_cone():
    """A particle of 2 kg: (1) is the projection of its momentum on the friction cone in closed form."""
    cones = lv.Cones.contacts(0.5, tangents=1)
    problem = lv.Problem.from_jacobian(
        np.eye(2), 2.0 * np.eye(2), [-1.0, 3.0], cones=cones, compliance=1.0
    )
    ray = np.array([1.0, -0.5]) / np.hypot(1.0, 0.5)  # Boundary of the cone against the sliding.
    for after, impulse in (
        ([0.0, 2.9], [2.0, -0.2]),
        ([1.0, 3.0], [4.0, 0.0]),
        ([-1.0, 0.0], ray * (ray @ [0.0, -6.0])),
        ([-2.0, 3.0], [0.0, 0.0]),
    ):
        found = lv.io.reconstruct(problem, after)
        np.testing.assert_allclose(found.impulse, impulse, atol=1e-8)
        left = np.array(after) - [-1.0, 3.0] - np.array(impulse) / 2.0
        assert found.left_over == pytest.approx(np.abs(left).max(), abs=1e-8)


def test_reconstruct_reads_planar_velocities():
    free = [(0.0, -1.0, 0.0), (1.0, -0.5, 0.2)]
    builder = lv.RowBuilder([1.0, 2.0], [6.0, 6.0], free, 0.01, [(0.0, 0.5), (0.0, 1.5)])
    for a, b, y in ((-1, 0, 0.0), (0, 1, 1.0)):
        for x in (-0.5, 0.5):
            builder.contact(a, b, (x, y), (0.0, 1.0), mu=0.5)
    problem = builder.problem()
    velocity = problem.velocity(lv.solve(problem, tol=1e-10).impulse)
    planar = velocity[:, [0, 1, 5]]
    assert np.abs(planar).max() > 0.1
    for known in (velocity, planar):
        found = lv.io.reconstruct(problem, known)
        np.testing.assert_allclose(problem.velocity(found.impulse), velocity, atol=1e-8)
    with pytest.raises(lv.InputError, match="velocity"):
        lv.io.reconstruct(problem, planar[:1])


def test_recorder_with_velocities_stores_impulses_and_marks_them(tmp_path):
    problem = random_contact_problem(3)
    answer = lv.solve(problem, tol=1e-10)
    with lv.io.Recorder(tmp_path / "a", every=1, solver="game") as recorder:
        (verdict,) = recorder.add(problem, velocity=problem.velocity(answer.impulse), seconds=0.002)
        velocity = problem.velocity(answer.impulse)
        velocity[0, 0] += 1.0  # A force that the problem does not have.
        recorder.add(problem, velocity=velocity)
        with pytest.raises(lv.InputError, match="velocity replaces the impulse"):
            recorder.add(problem, answer.impulse, velocity=velocity)
    lines = [
        json.loads(line) for line in (tmp_path / "a" / "engine.jsonl").read_text().splitlines()
    ]
    assert [line["reconstructed"] for line in lines] == [True, True]
    assert (
        lines[0]["seconds"] == 0.002 and lines[0]["left_over"] < 1e-6 < 1e-3 < lines[1]["left_over"]
    )
    stored = lv.io.read(tmp_path / "a" / lines[0]["file"])
    np.testing.assert_allclose(
        problem.velocity(stored.impulse), problem.velocity(answer.impulse), atol=1e-6
    )
    assert verdict.velocity_error == lv.residual(problem, stored.impulse).velocity
