"""Many states of MuJoCo in arrays: the problems and answers of one at a time, in float64 and in float32."""

import ctypes
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from mujoco_scene import get_state, mj, scene, whole_mass

import lavender as lv
from lavender.io import mujoco as single


def states_of(model, n, steps=40, seed=0):
    rng = np.random.default_rng(seed)
    out = []
    data = mj.MjData(model)
    while len(out) < n:
        mj.mj_resetData(model, data)
        data.qvel[:] = 0.5 * rng.standard_normal(model.nv)
        for _ in range(int(rng.integers(1, steps))):
            mj.mj_step(model, data)
        out.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(out)


def forwarded(model, state):
    data = mj.MjData(model)
    data.qpos[:], data.qvel[:] = state[: model.nq], state[model.nq :]
    mj.mj_forward(model, data)
    return data


@pytest.mark.parametrize("jacobian", ["dense", "sparse"])
@pytest.mark.parametrize(
    ("cone", "condim"), [("elliptic", 3), ("elliptic", 6), ("pyramidal", 3), ("elliptic", 1)]
)
def test_from_mujoco_many_of_a_state_equals_from_mujoco(cone, condim, jacobian):
    model = mj.MjModel.from_xml_string(scene(cone=cone, condim=condim, jacobian=jacobian))
    states = states_of(model, 6)
    batch, impulse = lv.io.from_mujoco_many(model, states, threads=2)
    found = lv.residual_many(batch, impulse)
    for i, state in enumerate(states):
        data = forwarded(model, state)
        problem = lv.io.from_mujoco(model, data)
        own = batch[i]
        # Of an equality each row has a name of its own here, and a normal alone needs no word for it.
        held = int(np.count_nonzero(data.efc_type == mj.mjtConstraint.mjCNSTR_EQUALITY))
        words = [
            [p.row_name(k).removesuffix(", normal") for k in range(p.m)] for p in (problem, own)
        ]
        assert words[0][held:] == words[1][held:] and all(
            "equality" in word for word in words[1][:held]
        )
        # Rows of an equality are blocks of their own here, and a normal alone is a row: the same bounds.
        for name in ("lower", "upper", "friction_rows"):
            assert getattr(own.cones, name).tolist() == getattr(problem.cones, name).tolist(), name
        assert (
            own.cones.mu[own.cones.mu > 0.0].tolist()
            == problem.cones.mu[problem.cones.mu > 0.0].tolist()
        )
        # Sums of a few terms in another order.
        size = abs(problem.generalized.jac).max()
        assert abs(own.generalized.jac - problem.generalized.jac).max() <= 1e-13 * size
        np.testing.assert_allclose(own.b, problem.b, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(own.compliance, problem.compliance, rtol=1e-12)
        np.testing.assert_allclose(
            own.generalized.mass.toarray(),
            problem.generalized.mass.toarray(),
            rtol=1e-12,
            atol=1e-15,
        )
        one = lv.residual(problem, single.impulse(model, data))
        assert found.velocity_error[i] == pytest.approx(one.velocity, rel=1e-3, abs=1e-9)


def test_from_mujoco_many_with_scratch_has_the_bits_of_calls_without_it():
    """Controls, warm starts and clamped numbers of an earlier call, and of one that failed, do not reach the next."""
    model = mj.MjModel.from_xml_string(scene())
    scratch = lv.io.MujocoScratch(model)
    states = states_of(model, 6)
    data = forwarded(model, states[0])
    data.qfrc_applied[:], data.xfrc_applied[:], data.qacc_warmstart[:] = 3.0, 2.0, 7.0
    whole = np.tile(get_state(model, data), (2, 1))
    kept = scratch.take_data()
    scratch.keep_data(kept)
    for some in (states[:1], whole, states, whole * np.nan, states[2:], states[:1]):
        expected = lv.io.from_mujoco_many(model, some, errors="status")
        batch, impulse = lv.io.from_mujoco_many(model, some, errors="status", scratch=scratch)
        assert impulse.tobytes() == expected.impulse.tobytes()
        assert all(
            batch[i] == expected.batch[i] for i in range(len(some)) if np.isfinite(some[i]).all()
        )
    assert scratch.take_data() is kept  # Every call used the same MjData.


def test_scratch_of_a_model_of_another_size_is_made_anew():
    model = mj.MjModel.from_xml_string("<mujoco><size nuserdata='77'/></mujoco>")
    scratch = lv.io.MujocoScratch(model)
    first = scratch.take_data()
    scratch.keep_data(first)
    assert scratch.take_data() is first and len(first.userdata) == 77
    scratch.keep_data(first)
    sizes = (ctypes.c_int32 * 200).from_address(model._address)  # noqa: SLF001
    sizes[[*sizes].index(77)] = 78  # As mj_recompile of MuJoCo's C library does.
    assert len(scratch.take_data().userdata) == 78


def test_scratch_leaves_the_data_of_the_caller_unchanged():
    model = mj.MjModel.from_xml_string(scene())
    own = forwarded(model, states_of(model, 1)[0])
    state = get_state(model, own)[None]

    def list_arrays():
        values = {name: getattr(own, name) for name in dir(own) if not name.startswith("_")}
        return {name: x.tobytes() for name, x in values.items() if isinstance(x, np.ndarray)}

    before = list_arrays()
    scratch = lv.io.MujocoScratch(model)
    for _ in range(2):
        lv.io.from_mujoco_many(model, state + 0.01, errors="status", scratch=scratch)
    assert len(before) > 100 and list_arrays() == before


def test_two_scratches_in_two_threads_have_the_results_of_one_thread():
    model = mj.MjModel.from_xml_string(scene())
    states = states_of(model, 12)
    expected = lv.io.from_mujoco_many(model, states)

    def convert(part):
        scratch = lv.io.MujocoScratch(model)
        return [lv.io.from_mujoco_many(model, states[i : i + 1], scratch=scratch) for i in part]

    with ThreadPoolExecutor(2) as pool:
        found = [one for part in pool.map(convert, (range(6), range(6, 12))) for one in part]
    assert np.concatenate([one.impulse for one in found]).tobytes() == expected.impulse.tobytes()
    assert all(one.batch[0] == expected.batch[i] for i, one in enumerate(found))


@pytest.mark.parametrize("jacobian", ["dense", "sparse"])
def test_from_mujoco_many_keeps_rows_of_zeros(jacobian):
    """A tendon along the arm that it holds: dense, MuJoCo counts its row, allots room and leaves it out."""
    model = mj.MjModel.from_xml_string(f"""<mujoco><option jacobian="{jacobian}"/><worldbody>
      <site name="a" pos="1 0 0"/>
      <body><joint type="hinge" axis="0 1 0" frictionloss="0.1"/><geom size="0.1" pos="0.5 0 0"/>
        <site name="b" pos="0.5 0 0"/></body></worldbody>
      <tendon><spatial frictionloss="0.1"><site site="a"/><site site="b"/></spatial></tendon></mujoco>""")
    data = forwarded(model, np.zeros(2))
    batch, impulse = lv.io.from_mujoco_many(model, np.zeros((3, 2)))
    for i in range(3):
        np.testing.assert_array_equal(
            impulse.reshape(3, -1)[i], model.opt.timestep * data.efc_force
        )
        assert batch[i].row_name(0) == "friction of joint 0"


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_from_mujoco_many_of_moving_surfaces_has_their_speed(cone):
    """A conveyor: its speed is in efc_vel and in aref, not in J v."""
    try:
        model = mj.MjModel.from_xml_string(f"""<mujoco><option cone="{cone}" tolerance="0"/><worldbody>
          <geom type="plane" size="9 9 1" surfacevel="1 0 0 0 0 0"/>
          <body pos="0 0 0.1"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body></worldbody></mujoco>""")
    except ValueError:
        pytest.skip("this MuJoCo's surfaces do not move")
    states = np.tile(np.r_[model.qpos0, np.zeros(model.nv)], (4, 1))
    states[:, 2] -= 0.001
    states[:, 7:9] = np.random.default_rng(0).standard_normal((4, 2))
    batch, impulse = lv.io.from_mujoco_many(model, states)
    found = lv.residual_many(batch, impulse)
    dt = model.opt.timestep
    for i, state in enumerate(states):
        data = forwarded(model, state)
        problem = lv.io.from_mujoco(model, data)
        assert problem.m > 0
        np.testing.assert_allclose(batch[i].b, problem.b, rtol=1e-9, atol=1e-12)
        # MuJoCo's Newton to its end, where its own impulses are an answer to rounding.
        assert (
            max(found.velocity_error[i], lv.residual(problem, single.impulse(model, data)).velocity)
            < 1e-9
        )
        after = problem.velocity(lv.solve(problem, tol=1e-12).impulse)
        np.testing.assert_allclose(after, data.qvel + dt * data.qacc, atol=1e-9, rtol=0)


def stacked(model, states, dtype):
    """Arrays as MJX and Warp hold them: room for the most rows of all, in float32."""
    datas = [forwarded(model, s) for s in states]
    m = max(d.nefc for d in datas) + 3
    n = len(datas)
    nv = model.nv
    jac = np.zeros((n, m, nv), dtype)
    of = np.zeros((n, m), int)
    rows = {
        name: np.ones((n, m), dtype)
        for name in ("efc_D", "efc_aref", "efc_frictionloss", "efc_force")
    }
    mass = np.zeros((n, nv, nv))
    contacts = [[], [], [], []]
    for i, d in enumerate(datas):
        jac[i, : d.nefc] = d.efc_J.reshape(-1, nv)
        of[i, : d.nefc] = d.efc_type
        for name, x in rows.items():
            x[i, : d.nefc] = getattr(d, name)
        mass[i] = whole_mass(model, d)
        for c in range(d.ncon):
            parts = (i, d.contact.efc_address[c], d.contact.dim[c], d.contact.friction[c])
            for held, x in zip(contacts, parts, strict=True):
                held.append(x)
    each = {
        name: np.array([getattr(d, name) for d in datas]).astype(dtype)
        for name in ("qvel", "qacc_smooth", "qfrc_smooth")
    }
    return {
        "efc_J": jac,
        "efc_type": of,
        **rows,
        "M": mass.astype(dtype),
        **each,
        "timestep": model.opt.timestep,
        "nefc": [d.nefc for d in datas],
        "contacts": tuple(np.array(x) for x in contacts),
    }


@pytest.mark.parametrize(("cone", "condim"), [("elliptic", 3), ("elliptic", 6), ("pyramidal", 3)])
def test_from_efc_in_float32_is_judged_by_its_own_floor(cone, condim):
    model = mj.MjModel.from_xml_string(scene(cone=cone, condim=condim))
    states = states_of(model, 12)
    exact, rough = (
        lv.io.from_efc(**stacked(model, states, dtype)) for dtype in (np.float64, np.float32)
    )
    assert (exact.batch.precision, rough.batch.precision) == ("float64", "float32")
    ragged = lv.io.from_mujoco_many(model, states)
    ragged.batch.engine_motions = {}  # Without qacc, `from_efc` judges forces.
    want = lv.residual_many(ragged.batch, ragged.impulse)
    got = lv.residual_many(exact.batch, exact.impulse)
    np.testing.assert_allclose(got.velocity_error, want.velocity_error, rtol=1e-3, atol=1e-9)
    answered = lv.residual_many(rough.batch, rough.impulse)
    early = lv.residual_many(rough.batch, 0.9 * rough.impulse)
    assert np.isin(answered.verdict, ["at its floor", "close enough"]).mean() >= 0.9
    assert (early.verdict == "stopped before convergence").mean() >= 0.9
    assert lv.solve_many(rough.batch, tol=1e-6).success.all()


def test_from_efc_of_a_triangle_of_m_or_an_array_of_the_step_makes_the_same_worlds():
    model = mj.MjModel.from_xml_string(scene())
    given = stacked(model, states_of(model, 3), np.float32)
    ptr = np.append(model.M_rowadr, len(model.M_colind))
    row = np.repeat(np.arange(model.nv), model.M_rownnz)
    triangle = given["M"][:, row, model.M_colind], model.M_colind, ptr
    whole = lv.io.from_efc(**given)
    other = lv.io.from_efc(**given | {"M": triangle, "timestep": np.array([given["timestep"]])})
    assert all(whole.batch[i] == other.batch[i] for i in range(3))
    np.testing.assert_array_equal(whole.impulse, other.impulse)
    with pytest.raises(lv.InputError, match="timestep"):
        lv.io.from_efc(**given | {"timestep": np.array([0.1, 0.2])})


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("junk", [np.nan, np.inf])
def test_from_efc_does_not_read_rows_above_nefc(junk):
    model = mj.MjModel.from_xml_string(scene())
    given = stacked(model, states_of(model, 3), np.float32)
    clean = lv.io.from_efc(**given)
    for i, m in enumerate(given["nefc"]):
        for name in ("efc_J", "efc_D", "efc_aref", "efc_frictionloss", "efc_force"):
            given[name][i, m:] = junk
    batch, impulse = lv.io.from_efc(**given)
    for i, m in enumerate(given["nefc"]):
        np.testing.assert_array_equal(
            impulse[i], np.r_[clean.impulse[i, :m], np.zeros(len(impulse[i]) - m)]
        )
    many = lv.solve_many(batch, impulse=impulse)
    same = lv.solve_many(clean.batch, impulse=clean.impulse)
    np.testing.assert_array_equal(many.impulse, same.impulse)


def test_from_efc_with_coulomb_law_changes_the_law_alone():
    model = mj.MjModel.from_xml_string(scene(cone="elliptic", condim=3))
    given = stacked(model, states_of(model, 4), np.float64)
    relaxed = lv.io.from_efc(**given)
    rigid = lv.io.from_efc(**given, friction="coulomb")
    assert (relaxed.batch.friction, rigid.batch.friction) == ("cone", "coulomb")
    np.testing.assert_array_equal(relaxed.impulse, rigid.impulse)
    for i in range(len(rigid.batch)):  # only the law differs
        np.testing.assert_array_equal(rigid.batch[i].b, relaxed.batch[i].b)
        np.testing.assert_array_equal(rigid.batch[i].dense(), relaxed.batch[i].dense())
        assert rigid.batch[i].friction == "coulomb"


@pytest.mark.parametrize("bad", [np.nan, np.inf, -3e10])
def test_from_efc_of_a_world_with_a_bad_acceleration_has_no_answer(bad):
    model = mj.MjModel.from_xml_string(scene())
    arrays = stacked(model, states_of(model, 3), np.float32)
    arrays["qacc"] = np.zeros_like(arrays["qacc_smooth"])
    fine = lv.io.from_efc(**arrays)
    arrays["qacc"][1, 0] = bad
    found = lv.io.from_efc(**arrays)
    assert np.isnan(found.impulse[1]).all()
    np.testing.assert_array_equal(
        np.delete(found.impulse, 1, axis=0), np.delete(fine.impulse, 1, axis=0)
    )
    judged = lv.residual_many(found.batch, found.impulse).velocity_error
    assert np.isfinite(judged).tolist() == [True, False, True]


def test_from_efc_of_coulomb_law_on_unsupported_contacts_raises():
    model = mj.MjModel.from_xml_string(scene(cone="elliptic", condim=4))
    given = stacked(model, states_of(model, 2), np.float64)
    with pytest.raises(lv.CapabilityError, match="torsional or rolling"):
        lv.io.from_efc(**given, friction="coulomb")
    with pytest.raises(lv.InputError, match="friction"):
        lv.io.from_efc(**given, friction="ccp")
    model = mj.MjModel.from_xml_string(scene(cone="elliptic", condim=3))
    given = stacked(model, states_of(model, 2), np.float64)
    given["contacts"][3][:, 1] *= 2.0
    with pytest.raises(lv.CapabilityError, match="different coefficients of its tangents"):
        lv.io.from_efc(**given, friction="coulomb")


def test_scratch_of_a_call_that_raised_makes_other_data(monkeypatch):
    """MuJoCo may have left its stack as it was when it raised an error."""
    model = mj.MjModel.from_xml_string(scene())
    scratch = lv.io.MujocoScratch(model)
    states = states_of(model, 1)
    lv.io.from_mujoco_many(model, states, scratch=scratch)
    used = scratch.take_data()
    scratch.keep_data(used)

    def fail(model, data):
        raise mj.FatalError("stack overflow")

    monkeypatch.setattr(mj, "mj_forward", fail)
    with pytest.raises(lv.InputError, match="state 0: MuJoCo raised an error, stack overflow"):
        lv.io.from_mujoco_many(model, states, scratch=scratch)
    assert scratch.take_data() is not used


def test_from_mujoco_many_with_a_state_that_is_not_finite_reads_the_others():
    model = mj.MjModel.from_xml_string(scene())
    states = states_of(model, 5)
    clean = lv.io.from_mujoco_many(model, states)
    spoiled = states.copy()
    spoiled[1, -1], spoiled[3, 0] = np.nan, np.inf
    with pytest.raises(lv.InputError, match="states"):
        lv.io.from_mujoco_many(model, spoiled)
    batch, impulse = lv.io.from_mujoco_many(model, spoiled, errors="status")
    with pytest.raises(lv.InputError, match="world 1: v_free"):
        lv.solve_many(batch)
    many = lv.solve_many(batch, errors="status")
    found = lv.residual_many(batch, impulse, errors="status")
    assert sorted(many.faults) == sorted(found.faults) == [1, 3]
    for i in (0, 2, 4):
        assert batch[i] == clean.batch[i]
