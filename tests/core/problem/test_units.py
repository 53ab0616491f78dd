"""Units of rows: which velocities are angular, and which errors the weight nu converts to m/s."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from random_problems import CONTACTS, random_contact_problem, seeds
from units import UNITS

import lavender as lv


@pytest.mark.parametrize("units", UNITS.values(), ids=UNITS)
@pytest.mark.parametrize("kind", sorted(CONTACTS))
@given(seed=seeds)
def test_every_error_changes_with_the_units_as_its_own_unit_says(kind, units, seed):
    problem = CONTACTS[kind](seed)
    # One body that only turns: the error of its angular rows is not converted, so that no unit of length is common.
    if is_mixed := kind != "ellipses" and seed % 2 == 1:
        inv_mass = problem.rows.inv_mass.copy()
        inv_mass[problem.rows.joint_body[0]] = 0.0
        problem = replace(problem, rows=replace(problem.rows, inv_mass=inv_mass))
    impulse = np.random.default_rng(seed).normal(size=problem.m)
    scaled, factor = units.scale(problem)
    before = lv.residual(problem, impulse)
    after = lv.residual(scaled, factor * impulse)
    if not is_mixed:
        assert after.relative == pytest.approx(before.relative, rel=1e-9)
    for name in ("energy", "energy_at_zero", "floor_energy"):
        expected = units.factor("sqrt(J)") * getattr(before, name)
        assert getattr(after, name) == pytest.approx(expected, rel=1e-9), name
    named = [problem.row_unit(i) for i in range(problem.m)]
    assert [scaled.row_unit(i) for i in range(problem.m)] == named
    speed = np.array([units.factor(unit) for unit in named])
    # Rounding of a row's own terms: sums with mixed units round differently.
    for name in ("velocity_by_row", "slack"):
        expected = getattr(before, name) * (
            speed
            if name == "velocity_by_row"
            else np.where(problem.angular_rows, units.factor("rad/s"), units.factor("m/s"))
        )
        np.testing.assert_allclose(
            getattr(after, name), expected, rtol=1e-9, atol=1e-12 * abs(expected).max()
        )


@pytest.mark.parametrize("units", UNITS.values(), ids=UNITS)
@pytest.mark.parametrize("kind", ["rolling and spin", "boxes"])
def test_motion_errors_and_forces_change_with_the_units_as_their_own_unit_says(kind, units):
    problem = CONTACTS[kind](4)
    impulse = np.random.default_rng(4).normal(size=problem.m)
    reference = lv.solve(problem, tol=1e-12).impulse
    scaled, factor = units.scale(problem)
    before = lv.motion_error(problem, impulse, reference)
    after = lv.motion_error(scaled, factor * impulse, factor * reference)
    for name, unit in (("kinetic", "sqrt(J)"), ("energy", "sqrt(J)"), ("speed", "m/s"), ("spin", "rad/s")):  # fmt: skip
        expected = units.factor(unit) * getattr(before, name)
        assert getattr(after, name) == pytest.approx(expected, rel=1e-9), name
    dt = 0.01
    force = lv.contact_forces(problem, impulse, dt=dt, reference=reference)
    other = lv.contact_forces(
        scaled, factor * impulse, dt=units.time * dt, reference=factor * reference
    )
    for name in ("normal", "tangential"):
        expected = units.factor("N") * np.asarray(getattr(force, name))
        size = np.nanmax(abs(expected))
        np.testing.assert_allclose(getattr(other, name), expected, rtol=1e-9, atol=1e-12 * size)


@pytest.mark.parametrize("units", UNITS.values(), ids=UNITS)
@pytest.mark.parametrize("solver", ["pgs", "sequential_impulses", "jacobi", "newton", "auto"])
def test_solver_takes_the_same_iterations_in_other_units(solver, units):
    problem = CONTACTS["rolling and spin"](4)
    scaled, factor = units.scale(problem)
    before = lv.solve(problem, solver, max_iter=30)
    after = lv.solve(scaled, solver, max_iter=30)
    assert (after.iterations, after.status) == (before.iterations, before.status)
    expected = factor * before.impulse
    np.testing.assert_allclose(after.impulse, expected, rtol=1e-6, atol=1e-9 * abs(expected).max())


@given(seed=seeds)
def test_rows_of_j_and_m_declare_which_are_angular(seed):
    bodies = random_contact_problem(seed)
    mass = np.linalg.inv(bodies.rows.inverse_mass_matrix().toarray())
    problem = lv.Problem.from_jacobian(
        bodies.jacobian,
        mass,
        bodies.rows.v_free.ravel(),
        cones=bodies.cones,
        angular=bodies.angular_rows,
    )
    joints = np.flatnonzero(bodies.angular_rows & ~bodies.cones.contact_rows)
    assert len(joints) and {problem.row_unit(i) for i in joints} == {"rad/s"}
    assert {problem.row_unit(i) for i in np.flatnonzero(bodies.cones.contact_rows)} == {"m/s"}
    for copy in (problem.relaxed(), problem.updated(target=0.0), problem.boxed(1.0)):
        np.testing.assert_array_equal(copy.angular, problem.angular_rows)


def test_texts_of_an_angular_row_have_its_unit(tmp_path):
    cones = lv.Cones.bounded([0.0, 0.0], [9.0, 9.0])
    problem = lv.Problem.from_jacobian(
        np.eye(2), np.eye(2), [-1.0, -2.0], cones=cones, angular=[False, True]
    )
    judged = lv.residual(problem, np.zeros(2))
    assert (judged.worst_row, judged.velocity_unit, judged.worst_label) == (
        1,
        "rad/s",
        "row 1 [rad/s]",
    )
    assert "worst row 1 (2 rad/s)" in str(judged)
    assert "worst row 0 (1 m/s)" in str(lv.residual(problem, [0.0, 2.0]))
    assert "rows 2 rad/s (row 1)" in str(lv.motion_error(problem, np.zeros(2)))
    problem.save(tmp_path / "a.npz")
    assert lv.load(tmp_path / "a.npz") == problem


MODEL = """<mujoco><option cone="elliptic"/><worldbody><geom type="plane" size="5 5 1"/>
<body name="a" pos="0 0 1"><joint name="hinge" type="hinge" range="-1 1" limited="true" frictionloss="1"/>
  <geom size="0.1"/><body name="b" pos="1 0 0"><joint name="slide" type="slide" range="-1 1" limited="true"
  frictionloss="1"/><geom size="0.1"/></body></body>
<body name="c" pos="0 0 3"><joint name="ball" type="ball" range="0 1" limited="true"/><geom size="0.1"/></body>
<body name="d" pos="3 0 0.05"><joint name="free" type="free" frictionloss="1"/><geom size="0.1" condim="6"/></body>
<body name="e" pos="5 0 5"><freejoint/><geom size="0.1"/></body>
</worldbody><equality><connect body1="a" body2="c" anchor="0 0 0"/><weld body1="d" body2="e"/>
<joint joint1="hinge" joint2="slide"/><joint joint1="slide"/></equality></mujoco>"""


def test_from_mujoco_rows_of_every_kind_have_the_unit_of_their_velocity():
    mujoco = pytest.importorskip(
        "mujoco", reason="needs MuJoCo: pip install 'lavender-contact[mujoco]'"
    )
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    data.qpos[:2] = 1.5, 1.5
    data.qpos[2:6] = np.cos(1.0), np.sin(1.0), 0.0, 0.0  # Turned by 2 rad.
    mujoco.mj_forward(model, data)
    problem = lv.io.from_mujoco(model, data)
    units = {}
    for i in range(problem.m):
        units.setdefault(problem.block_name(problem.block_of(i)), []).append(problem.row_unit(i)[0])
    assert {name: "".join(x) for name, x in units.items() if not name.startswith("contact")} == {
        "equality 0": "mmm",
        "equality 1": "mmmrrr",
        "equality 2": "r",
        "equality 3": "m",
        "friction of joint hinge": "r",
        "friction of joint slide": "m",
        **{f"friction of joint free, axis {k}": "m" if k < 3 else "r" for k in range(6)},
        "limit of joint hinge": "r",
        "limit of joint slide": "m",
        "limit of joint ball": "r",
    }
    spin = [
        i
        for i in range(problem.m)
        if "spin" in problem.row_name(i) or "roll" in problem.row_name(i)
    ]
    assert len(spin) == 3 and {problem.row_unit(i) for i in spin} == {"m/s"}  # nu of the normal.
