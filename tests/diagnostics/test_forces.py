"""Contact forces in newtons, their errors, and what of them the bodies determine."""

import numpy as np
import pytest

import lavender as lv

DT, WEIGHT = 0.01, 98.1  # s, N: the step, and the weight of 10 kg


def make_table(feet, friction=0.0, top=False):
    """Return a table of 10 kg that rests on its feet, and optionally a box of 10 kg on its centre."""
    n = 1 + top
    builder = lv.RowBuilder(
        [0.1] * n,
        np.multiply.outer([10.0] * n, np.eye(3)),
        np.array([[0.0, 0.0, -9.81 * DT, 0.0, 0.0, 0.0]] * n),
        DT,
        np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 1.5]][:n]),
    )
    for x, y in feet:
        builder.contact(-1, 0, (x, y, 0.0), (0.0, 0.0, 1.0), mu=friction)
    if top:
        builder.contact(0, 1, (0.0, 0.0, 1.0), (0.0, 0.0, 1.0), mu=friction)
    return builder.problem("coulomb")


FOUR = [(-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)]
THREE = [(-0.5, -0.5), (0.5, -0.5), (0.0, 0.5)]


def test_table_on_four_feet_has_only_the_sum_of_its_forces():
    problem = make_table(FOUR, top=True)
    exact = lv.solve(problem, tol=1e-12).impulse
    null = np.zeros(problem.m)
    null[:4] = [1.0, -1.0, -1.0, 1.0]  # Moves nothing: the forces of two diagonals.
    for amount in (0.0, 0.1):
        forces = lv.contact_forces(problem, exact + amount * null, dt=DT)
        assert forces.determined == ("pair",) * 4 + ("contact",)
        table = forces.table.set_index("bodies")
        assert table.loc["ground and body 0", "normal force [N]"] == pytest.approx(2.0 * WEIGHT)
        assert table.loc["ground and body 0", "error [N]"] < 1e-6
        assert table.loc["body 0 and body 1", "normal force [N]"] == pytest.approx(WEIGHT)
        assert table.loc["body 0 and body 1", "share of the load [%]"] == 100.0


def test_forces_of_three_feet_are_determined_and_share_the_load():
    problem = make_table(THREE)
    exact = lv.solve(problem, tol=1e-12)
    forces = lv.contact_forces(problem, 0.9 * exact.impulse, dt=DT, reference=exact)
    assert forces.determined == ("contact",) * 3
    np.testing.assert_allclose(forces.exact, WEIGHT * np.array([0.25, 0.25, 0.5]), rtol=1e-9)
    np.testing.assert_allclose(forces.share, [0.25, 0.25, 0.5], rtol=1e-9)
    np.testing.assert_allclose(forces.error, 0.1 * forces.exact, rtol=1e-9)
    np.testing.assert_allclose(forces.normal, 0.9 * forces.exact, rtol=1e-12)


def test_tables_of_forces_are_sums_over_the_contacts_of_each_pair():
    """Brute force over the contacts of two tables beside each other, each on four feet."""
    builder = lv.RowBuilder(
        [0.1, 0.05],
        np.multiply.outer([10.0, 10.0], np.eye(3)),
        np.array([[0.0, 0.0, -9.81 * DT, 0.0, 0.0, 0.0]] * 2),
        DT,
        np.array([[0.0, 0.0, 0.5], [9.0, 0.0, 0.5]]),
    )
    for body, away in ((0, 0.0), (1, 9.0)):
        for x, y in FOUR:
            builder.contact(-1, body, (x + away, y, 0.0), (0.0, 0.0, 1.0), mu=0.0)
    problem = builder.problem("coulomb")
    impulse = np.arange(1.0, 1.0 + problem.m)
    forces = lv.contact_forces(problem, impulse, dt=DT)
    assert set(forces.determined) == {"pair"}
    pairs = np.array(forces.pairs)
    for row in forces.table.to_dict("records"):
        own = pairs == row["bodies"]
        assert row["contact"] == "4 contacts" and own.sum() == 4
        assert row["normal force [N]"] == pytest.approx(forces.normal[own].sum())
        assert row["exact normal force [N]"] == pytest.approx(forces.exact[own].sum())
    assert len(forces.table) == 2
    for k, row in enumerate(forces.by_contact.to_dict("records")):
        own = pairs == pairs[k]
        total, exact = forces.normal[own].sum(), forces.exact[own].sum()
        assert row["pair force [N]"] == pytest.approx(total)
        assert row["pair error [N]"] == pytest.approx(abs(total - exact))


@pytest.mark.parametrize(
    "friction", [None, lambda name: (0.4, 0.8)], ids=["rows", "scaled tangents"]
)
def test_friction_force_and_its_error_are_vectors(friction):
    """A box that slides on one point: friction is determined, and friction in the wrong direction has an error."""
    rng = np.random.default_rng(0)
    jac = np.eye(3)
    cones = lv.Cones.contacts(0.5)
    problem = lv.Problem.from_jacobian(jac, np.eye(3), [-1.0, 2.0, 3.0], cones=cones)
    exact = lv.solve(problem, tol=1e-13).impulse
    impulse = exact * [1.0, *rng.choice([-1.0, 1.0], 2)]
    impulse[1] *= -1.0
    forces = lv.contact_forces(problem, impulse, dt=DT, reference=exact, friction=friction)
    assert forces.determined == ("contact",)
    scale = np.array([1.0, 1.0 if friction is None else 2.0]) / DT
    assert forces.tangential[0] == pytest.approx(np.linalg.norm(scale * impulse[1:]))
    assert forces.error[0] == pytest.approx(np.linalg.norm(scale * (impulse - exact)[1:]))


def test_two_bodies_between_which_a_load_is_not_determined_have_no_number():
    """A beam on two fixed bodies and a third in between: no pair's force is determined."""
    builder = lv.RowBuilder(
        [0.0, 0.0, 0.0, 0.1],
        np.multiply.outer([0.0, 0.0, 0.0, 10.0], np.eye(3)),
        np.array([[0.0] * 6] * 3 + [[0.0, 0.0, -9.81 * DT, 0.0, 0.0, 0.0]]),
        DT,
        np.array([[-0.5, 0.0, -0.1], [0.0, 0.0, -0.1], [0.5, 0.0, -0.1], [0.0, 0.0, 0.1]]),
    )
    for body, x in enumerate((-0.5, 0.0, 0.5)):
        builder.contact(body, 3, (x, 0.0, 0.0), (0.0, 0.0, 1.0), mu=0.0)
    problem = builder.problem("coulomb")
    forces = lv.contact_forces(problem, lv.solve(problem, tol=1e-12).impulse, dt=DT)
    assert forces.determined == ("not determined",) * 3
    assert forces.table["normal force [N]"].isna().all() and "not determined" in str(forces)


def test_three_feet_with_friction_determine_their_normal_forces_only():
    problem = make_table(THREE, friction=0.5)
    exact = lv.solve(problem, tol=1e-12)
    forces = lv.contact_forces(problem, exact.impulse, dt=DT)
    assert forces.determined == ("contact",) * 3 and np.isnan(forces.tangential).all()
    np.testing.assert_allclose(forces.exact, WEIGHT * np.array([0.25, 0.25, 0.5]), rtol=1e-9)
    squeezed = exact.impulse.copy()
    squeezed[1:3], squeezed[4:6] = [0.01, 0.0], [-0.01, 0.0]  # Along the line of two feet.
    assert lv.contact_forces(problem, squeezed, dt=DT, reference=exact).error.max() < 1e-9


@pytest.mark.parametrize("turned", [0.0, 1e-4, 1e-3])
def test_gripped_box_has_the_force_of_each_finger(turned):
    """Friction on a box that is turned a little changes the forces of the fingers by less than 1 %."""
    mujoco = pytest.importorskip(
        "mujoco", reason="needs MuJoCo: pip install 'lavender-contact[mujoco]'"
    )
    model = mujoco.MjModel.from_xml_string("""<mujoco><option timestep="0.002"/><worldbody>
      <body name="left" pos="-.05 0 1"><joint name="l" type="slide" axis="1 0 0"/>
      <geom type="box" size=".01 .02 .02" mass=".1"/></body>
      <body name="right" pos=".05 0 1"><joint name="r" type="slide" axis="-1 0 0"/>
      <geom type="box" size=".01 .02 .02" mass=".1"/></body><body name="can" pos="0 0 1"><freejoint/>
      <geom type="box" size=".0402 .01 .01" mass=".2"/></body></worldbody>
      <actuator><motor joint="l" gear="20"/><motor joint="r" gear="20"/></actuator></mujoco>""")
    data = mujoco.MjData(model)
    data.ctrl[:] = 1.0
    for _ in range(200):
        mujoco.mj_step(model, data)
    data.qpos[6] += turned / 2.0
    mujoco.mj_forward(model, data)
    problem, impulse = lv.io.from_mujoco(model, data), lv.io.mujoco.impulse(model, data)
    forces = lv.contact_forces(
        problem, impulse, dt=model.opt.timestep, pairs=lambda name: name[-2:]
    )
    assert len(forces.contacts) >= 8 and set(forces.determined) == {"pair"}
    wanted = np.zeros(6)
    for pair, own in forces.by_contact.groupby("bodies"):
        total = 0.0
        for k in own.index:
            mujoco.mj_contactForce(model, data, k, wanted)
            total += wanted[0]
        np.testing.assert_allclose(own["pair force [N]"], total, rtol=1e-9)
        assert own["pair error [N]"].max() < 1e-3 * total, pair


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_forces_of_mujoco_are_those_of_mj_contact_force(cone):
    mujoco = pytest.importorskip(
        "mujoco", reason="needs MuJoCo: pip install 'lavender-contact[mujoco]'"
    )
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option cone="{cone}"/><worldbody>
      <geom name="floor" type="plane" size="0 0 1"/><body pos="0 0 .1"><freejoint/>
      <geom name="ball" type="sphere" size=".1" mass="2"/></body></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    for _ in range(500):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    problem, impulse = lv.io.from_mujoco(model, data), lv.io.mujoco.impulse(model, data)
    forces = lv.contact_forces(problem, impulse, dt=model.opt.timestep)
    wanted = np.zeros(6)
    mujoco.mj_contactForce(model, data, 0, wanted)
    assert forces.normal == pytest.approx([wanted[0]], rel=1e-9)
    assert forces.determined == ("contact",) and forces.pairs == ("floor and ball",)
    assert forces.normal[0] == pytest.approx(2.0 * 9.81, rel=1e-3)


@pytest.mark.parametrize("condim", [3, 4, 6])
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize("pair", [False, True])
def test_friction_force_of_mujoco_is_that_of_mj_contact_force(cone, condim, pair):
    """A pushed ball; pyramids have friction in their edges, and tangents of a pair two coefficients."""
    mujoco = pytest.importorskip(
        "mujoco", reason="needs MuJoCo: pip install 'lavender-contact[mujoco]'"
    )
    own = f'<pair geom1="ball" geom2="floor" condim="{condim}" friction="0.8 0.4 .01 .002 .002"/>'
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option cone="{cone}"/><worldbody>
      <geom name="floor" type="plane" size="0 0 1" friction="0.3"/><body pos="0 0 .1"><freejoint/>
      <geom name="ball" type="sphere" size=".1" mass="2" condim="{condim}" friction="0.6 .01 .002"/></body></worldbody>
      <contact>{own if pair else ""}</contact></mujoco>""")
    data = mujoco.MjData(model)
    for _ in range(100):
        mujoco.mj_step(model, data)
    data.xfrc_applied[1, :2] = 3.0, -5.0
    mujoco.mj_forward(model, data)
    problem, impulse = lv.io.from_mujoco(model, data), lv.io.mujoco.impulse(model, data)
    forces = lv.contact_forces(problem, impulse, dt=model.opt.timestep)
    wanted = np.zeros(6)
    mujoco.mj_contactForce(model, data, 0, wanted)
    assert forces.determined == ("contact",) and forces.normal == pytest.approx([wanted[0]])
    assert np.linalg.norm(wanted[1:3]) > 1.0
    assert forces.tangential == pytest.approx([np.linalg.norm(wanted[1:3])], rel=1e-9)
    unknown = lv.contact_forces(problem, impulse, dt=model.opt.timestep, friction=lambda name: None)
    assert np.isnan(unknown.tangential).all() == (cone == "pyramidal")


def test_contact_forces_refuse_wrong_arguments():
    problem = make_table(THREE)
    impulse = lv.solve(problem).impulse
    for dt in (0.0, -1.0, np.nan):
        with pytest.raises(lv.InputError, match="dt"):
            lv.contact_forces(problem, impulse, dt=dt)
    with pytest.raises(lv.InputError, match="3 contacts"):
        lv.contact_forces(problem, impulse, dt=DT, pairs=["one"])
    bad = lv.Problem.lcp([[1.0, -1.0], [-1.0, 1.0]], [2.0, -1.0])
    with pytest.raises(lv.InputError, match="reference has a relative residual"):
        lv.contact_forces(bad, np.zeros(2), dt=DT)
