"""Motion errors: distances of velocities from those of a reference, in the units of the problem."""

import numpy as np
import pytest
from hypothesis import given
from random_problems import random_contact_problem, random_generalized_problem, random_lcp, seeds

import lavender as lv


def cone_problem(seed):
    return random_contact_problem(seed, friction="cone", spin=True)


@pytest.mark.parametrize("form", ["rows", "J and M"])
@given(seed=seeds)
def test_motion_error_is_the_energy_and_the_largest_speeds_of_the_velocity_difference(form, seed):
    p = (
        random_contact_problem(seed, friction="cone")
        if form == "rows"
        else random_generalized_problem(seed)
    )
    x = np.random.default_rng(seed).normal(size=p.m)
    e = lv.motion_error(p, x)
    if e.rows is None:
        return
    delta = x - e.reference
    if form == "rows":
        dv = p.velocity(x) - p.velocity(e.reference)
        mass = np.linalg.inv(p.rows.inverse_mass_matrix().toarray())
        speeds = np.linalg.norm(dv[:, :3], axis=1)
        assert e.spin == pytest.approx(np.linalg.norm(dv[:, 3:], axis=1).max(), rel=1e-9)
        assert e.body_name == f"body {speeds.argmax()}"
    else:
        dv = p.generalized.change(delta)
        mass = p.generalized.mass.toarray()
        speeds = np.abs(dv)
        assert e.spin is None and e.body_name == p.generalized.velocity_name(int(speeds.argmax()))
    assert e.kinetic == pytest.approx(np.sqrt(0.5 * dv.ravel() @ mass @ dv.ravel()), rel=1e-9)
    assert e.speed == pytest.approx(speeds.max(), rel=1e-9)
    assert e.rows == pytest.approx(np.abs(p.slack(x) - p.slack(e.reference)).max(), rel=1e-9)
    assert e.energy == pytest.approx(np.sqrt(0.5 * delta @ p.dense() @ delta), rel=1e-9)
    assert e.kinetic <= e.energy * (1 + 1e-12)
    unit = "rad/s" if p.angular_rows[e.row] else "m/s"
    assert f"rows {e.rows:.2g} {unit} ({e.row_name})" in str(e)
    own = p.compute_velocity_change(e.reference).ravel()
    size = np.sqrt(0.5 * own @ mass @ own)  # Without the energy in compliance, as `kinetic`.
    assert e.relative is None or e.relative == pytest.approx(e.kinetic / size, rel=1e-9)


@pytest.mark.parametrize(
    ("problem", "none", "some", "word"),
    [
        (random_lcp(4), ("kinetic", "speed"), ("energy", "rows", "relative"), ""),
        (
            lv.Problem.lcp([[2.0, 0.5], [0.0, 2.0]], [1.0, -1.0]),
            ("energy", "relative"),
            ("rows",),
            "symmetric",
        ),
        (
            lv.Problem.lcp(np.diag([1.0, -1.0]), [1.0, -1.0], 0.0, 1.0),
            ("energy",),
            ("rows",),
            "semidefinite",
        ),
        (
            lv.Problem.lcp([[1.0, -1.0], [-1.0, 1.0]], [1.0, 1.0]),
            ("energy", "rows"),
            (),
            "no estimate",
        ),
    ],
    ids=["matrix", "asymmetric", "indefinite", "infeasible"],
)
def test_motion_error_without_velocities_has_a_note(problem, none, some, word):
    e = lv.motion_error(problem, np.zeros(problem.m))
    assert [getattr(e, name) for name in none] == [None] * len(none)
    assert all(getattr(e, name) > 0.1 for name in some)
    assert word in e.note and word in str(e)


def test_motion_error_under_coulomb_law_solves_its_reference_from_the_impulse():
    problem = lv.suite.case("painleve").problem
    sticks = np.linalg.solve(problem.dense(), problem.b)
    assert lv.motion_error(problem, np.zeros(2)).rows == 0.0
    assert lv.motion_error(problem, sticks).rows < 1e-9  # not the 3 m/s to the open contact
    assert lv.motion_error(problem, sticks, reference=np.zeros(2)).rows == pytest.approx(3.0)


def test_motion_error_judges_a_given_reference_impulse_or_solution():
    p = cone_problem(6)
    own = lv.solve(p, "newton", tol=1e-12)
    errors = [lv.motion_error(p, p.start(), reference=x) for x in (own, own.impulse)]
    assert errors[0].energy == errors[1].energy > 0.0
    rough = lv.motion_error(p, p.start(), reference=0.5 * own.impulse)
    assert rough.energy is None and rough.reference_residual.relative > 0.1


@pytest.mark.parametrize("form", ["matrix", "bodies"])
def test_motion_error_of_ellipses_is_in_the_given_rows(form):
    p = lv.Problem.contact(np.eye(3), [10.0, 9.0, 9.0], mu=[(0.5, 0.005)], friction="cone")
    if form == "bodies":
        p = lv.Problem.from_jacobian(
            np.eye(3), np.eye(3), np.zeros(3), target=p.b, cones=p.cones, friction="cone"
        )
    x = lv.solve(p, tol=1e-13).impulse
    y = x.copy()
    y[2] *= 0.5
    e = lv.motion_error(p, y)
    assert e.rows == pytest.approx(np.abs(p.slack(y) - p.slack(x)).max(), rel=1e-6)
    assert (e.row, e.row_name) == (2, p.row_name(2))


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_measure_motion_of_an_engine_step_equals_motion_error(friction):
    scene = lv.Scene("stack", friction=friction, solver_iterations=4, substeps=1, order="given")
    sim = lv.Simulation(scene, report_motion=True)
    for _ in range(20):
        problem = sim.constraint_problem()
        *_, info = sim.step()
    impulse = lv.solve(problem, "sequential_impulses", tol=0, max_iter=4).impulse
    error = lv.motion_error(problem, impulse)
    # 1e-6: the references are two solves to the floor, of errors of 1e-2 of the motion.
    for key in ("relative", "speed"):
        assert info["motion"][key] == pytest.approx(getattr(error, key), rel=1e-6)
    # The plane is body 0 of the scene and no body of the rows.
    assert info["motion"]["body"] == sim.scene.bodies[1 + error.body].name


def test_motion_error_without_a_solution_as_reference_names_the_missed_limit():
    problem = lv.suite.case("box_stack(n=4)").problem
    for tol in (1e-9, 3e-10, 1e-3):
        reference = lv.solve(problem, "nncg", tol=tol).impulse
        relative = lv.residual(problem, reference).relative
        if relative <= 1e-10:
            continue
        error = lv.motion_error(problem, 0.5 * reference, reference)
        text = str(error)
        assert error.relative is None and f"{relative:.1e}" in text and "1e-10" in text
        assert text.startswith("motion error: no estimate") and ": ;" not in text
