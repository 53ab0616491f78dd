"""Units of rows: which velocities are angular, and which errors the weight nu converts to m/s."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from random_problems import CONTACTS, random_contact_problem, seeds

import lavender as lv

LENGTH = 8.0  # Lengths are measured in a unit that is smaller by this factor; a power of two, so that nothing rounds.


def scale_lengths(problem):
    """Return a problem of bodies in the smaller unit of length, and the factor of the unit of each impulse (m,)."""
    rows = problem.rows
    angular = problem.angular_rows
    split = len(problem.rows.jac)
    jac = rows.jac.reshape(-1, 4, 3).copy()
    jac[:, 1::2] *= np.where(angular[:split], 1.0, LENGTH)[:, None, None]
    velocity = rows.v_free.copy()
    velocity[:, :3] *= LENGTH
    scaled = replace(
        rows,
        jac=jac.reshape(-1, 12),
        v_free=velocity,
        arm_a=LENGTH * rows.arm_a,
        arm_b=LENGTH * rows.arm_b,
        inv_inertia=rows.inv_inertia / LENGTH**2,
    )
    cones = problem.cones
    has_patch = cones.spin_rows >= 0  # For boxes and ellipses this number is a ratio without unit.
    factor = np.where(angular, LENGTH**2, LENGTH)
    cones = replace(
        cones,
        patch_radius=np.where(has_patch, LENGTH, 1.0) * cones.patch_radius,
        rolling=LENGTH * cones.rolling,
        lower=factor * cones.lower,
        upper=factor * cones.upper,
    )
    return replace(
        problem,
        rows=scaled,
        cones=cones,
        b=np.where(angular, 1.0, LENGTH) * problem.b,
        guess=None,
        compliance=problem.compliance / np.where(angular, LENGTH**2, 1.0),
    ), factor


@pytest.mark.parametrize("kind", sorted(CONTACTS))
@given(seed=seeds)
def test_velocity_errors_change_with_the_unit_of_length_as_their_units_say(kind, seed):
    problem = CONTACTS[kind](seed)
    impulse = np.random.default_rng(seed).normal(size=problem.m)
    scaled, factor = scale_lengths(problem)
    relative = lv.residual(scaled, factor * impulse).relative
    assert relative == pytest.approx(lv.residual(problem, impulse).relative, rel=1e-9)
    if (
        kind != "ellipses"
    ):  # One body that only turns: the error of its angular rows is not converted.
        inv_mass = problem.rows.inv_mass.copy()
        inv_mass[problem.rows.joint_body[0]] = 0.0
        problem = replace(problem, rows=replace(problem.rows, inv_mass=inv_mass))
    scaled, factor = scale_lengths(problem)
    before = lv.residual(problem, impulse)
    after = lv.residual(scaled, factor * impulse)
    units = np.array([problem.row_unit(i) for i in range(problem.m)])
    expected = np.where(units == "m/s", LENGTH, 1.0) * before.velocity_by_row
    # Rounding of a row's own terms: sums with mixed units round differently.
    np.testing.assert_allclose(
        after.velocity_by_row, expected, rtol=1e-9, atol=1e-12 * expected.max()
    )


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
