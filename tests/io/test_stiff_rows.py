"""Rows of MuJoCo with R near 1e-15: the acceleration is judged, because the forces have no digits."""

import json
from fractions import Fraction

import numpy as np
import pytest
from mujoco_scene import get_state, mj

import lavender as lv
from lavender.io import mujoco as adapter
from lavender.report.store import make_lines
from lavender.report.tables import read_engine_answers

# A lever whose centre of mass lies on its axle, so that MuJoCo's estimate of its translational inverse mass is 0.
LEVER_MODEL = """<mujoco><option timestep="0.002"/><worldbody>
<geom type="box" size=".01 .02 .02" pos=".12 .028 0" condim="{condim}"/>
<geom type="box" size=".01 .02 .02" pos=".12 -.028 0" condim="{condim}"/>
<body><joint name="axle" axis="0 0 1"/><inertial pos="0 0 0" mass=".2" diaginertia="1e-4 1e-4 1e-4"/>
<geom type="capsule" fromto="0 0 0 .15 0 0" size=".01" condim="{condim}"/></body></worldbody>
<actuator><motor joint="axle"/></actuator></mujoco>"""


def iterate_pressed_states(condim):
    """Yield MuJoCo's model and data in each step in which the lever touches a stop."""
    model = mj.MjModel.from_xml_string(LEVER_MODEL.format(condim=condim))
    data = mj.MjData(model)
    data.ctrl[:] = 0.5
    for _ in range(10):
        mj.mj_forward(model, data)
        if data.nefc:
            yield model, data
        mj.mj_step(model, data)


def compute_exact_acceleration(model, data):
    """Return the minimiser of MuJoCo's cost for one velocity and one-sided rows, by bisection in exact fractions."""
    jac = [Fraction(float(x)) for x in adapter.jacobian(model, data).toarray().ravel()]
    weight = [1 / Fraction(float(r)) for r in data.efc_R]
    aref = [Fraction(float(x)) for x in data.efc_aref]
    smooth = Fraction(float(data.qacc_smooth[0]))
    mass = Fraction(float(data.M[0]))

    def slope(a):
        rows = zip(jac, weight, aref, strict=True)
        return mass * (a - smooth) + sum(j * w * min(0, j * a - r) for j, w, r in rows)

    low = Fraction(-(10**6))
    high = Fraction(10**6)
    for _ in range(100):  # To 2e6 / 2^100 rad/s^2.
        middle = (low + high) / 2
        low, high = (middle, high) if slope(middle) < 0 else (low, middle)
    return float(middle)


@pytest.mark.parametrize("condim", [1, 3, 6])
def test_residual_of_exact_acceleration_without_digits_in_forces_is_at_floor(condim):
    judged = 0
    for model, data in iterate_pressed_states(condim):
        exact = compute_exact_acceleration(model, data)
        assert abs(data.qacc[0] - exact) * model.opt.timestep < 1e-13  # rad/s
        problem = lv.io.from_mujoco(model, data)
        impulse = adapter.impulse(model, data)
        found = lv.residual(problem, impulse)
        assert found.verdict in ("at its floor", "close enough")
        assert found.at_floor == found.rounds
        assert found.velocity < 1e-13
        if found.lost_digits:
            judged += 1
            assert "the forces lose" in str(found)
            # The same impulse in another problem has no acceleration and is judged itself.
            assert lv.residual(problem, 1.01 * impulse).lost_digits == 0.0
    assert judged >= 3


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize("change", [1e-3, -1.0])
def test_residual_of_changed_acceleration_is_the_change_of_the_row_velocities(cone, change):
    for model, data in iterate_pressed_states(3):
        model.opt.cone = getattr(mj.mjtCone, f"mjCONE_{cone.upper()}")
        mj.mj_forward(model, data)
        exact = lv.residual(lv.io.from_mujoco(model, data), adapter.impulse(model, data))
        data.qacc[0] += change
        found = lv.residual(lv.io.from_mujoco(model, data), adapter.impulse(model, data))
        if exact.lost_digits and found.lost_digits:
            arm = np.abs(adapter.jacobian(model, data).toarray()).max()
            # Rows at the boundary of their cone see a part of the change.
            assert 0.3 < found.velocity / (arm * abs(change) * model.opt.timestep) < 1.01


def test_stiff_rows_of_many_worlds_equal_those_of_single_ones():
    states, single = [], []
    for model, data in iterate_pressed_states(3):
        states.append(get_state(model, data))
        mj.mj_forward(model, data)
        single.append(lv.residual(lv.io.from_mujoco(model, data), adapter.impulse(model, data)))
    imported = lv.io.from_mujoco_many(model, np.array(states))
    many = lv.residual_many(imported.batch, imported.impulse)
    assert many.verdict.tolist() == [x.verdict for x in single]
    np.testing.assert_allclose(many.velocity_error, [x.velocity for x in single], atol=1e-14)
    assert [many[i].lost_digits > 0 for i in range(len(many))] == [
        x.lost_digits > 0 for x in single
    ]


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_from_efc_with_acceleration_judges_the_acceleration(dtype):
    for model, data in iterate_pressed_states(3):
        mass = np.array([[data.M[0]]])
        arrays = {
            "efc_J": adapter.jacobian(model, data).toarray(),
            "efc_D": data.efc_D,
            "efc_aref": data.efc_aref,
            "M": mass,
            "qvel": data.qvel,
            "qacc_smooth": data.qacc_smooth,
            "qacc": data.qacc,
            "efc_force": data.efc_force,
        }
        stacked = {name: np.asarray(x)[None].astype(dtype) for name, x in arrays.items()}
        imported = lv.io.from_efc(
            **stacked, efc_type=data.efc_type[None], timestep=model.opt.timestep, nefc=[data.nefc]
        )
        found = lv.residual_many(imported.batch, imported.impulse)
        assert found.verdict[0] in ("at its floor", "close enough")


def test_auto_on_contradictory_stiff_rows_converges():
    for model, data in iterate_pressed_states(3):
        problem = lv.io.from_mujoco(model, data)
        found = lv.solve(problem)
        assert found.success
        change = problem.generalized.change(found.impulse)
        exact = (compute_exact_acceleration(model, data) - data.qacc_smooth) * model.opt.timestep
        # The tolerance 1e-6 of velocities of about 10 rad/s.
        np.testing.assert_allclose(change, exact, atol=1e-4)


def test_report_of_recorded_stiff_rows_keeps_the_error_of_the_acceleration(tmp_path):
    with lv.io.Recorder(tmp_path / "lever", every=1, solver="mujoco") as recorder:
        for model, data in iterate_pressed_states(1):
            recorder.add(lv.io.from_mujoco(model, data), adapter.impulse(model, data))
    lines = [
        json.loads(line) for line in (tmp_path / "lever" / "engine.jsonl").read_text().splitlines()
    ]
    answers = read_engine_answers([str(tmp_path / "lever")], make_lines([]))
    assert any("lost_digits" in line for line in lines)
    assert answers["relative"].tolist() == [line["relative"] for line in lines]
