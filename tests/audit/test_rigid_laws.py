"""The causes that an audit names: of errors against the engine's own problem, and against the rigid laws."""

import shlex

import numpy as np
import pytest

from lavender.audit.audit import audit
from lavender.audit.idle_settings import list_idle_settings
from lavender.audit.settings import MujocoSetting
from lavender.audit.slip_states import explain_slip_of_states

mujoco = pytest.importorskip("mujoco", minversion="4.0")

LEVER = """<mujoco><option timestep="0.002" integrator="{}" tolerance="0" iterations="300" ls_iterations="100"/>
<worldbody><geom type="box" size=".05 .05 .02" pos=".2 0 -.035"/><body><joint type="hinge" axis="0 1 0" damping=".01"/>
<geom type="box" size=".3 .03 .02" mass=".2"/></body></worldbody></mujoco>"""
HINGE = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body>
<joint name="j" axis="0 0 1" frictionloss="100" damping="100"/><geom type="cylinder" size=".1 .05" mass="1"/></body>
</worldbody></mujoco>"""
STOPPED = """<mujoco><option timestep="0.002" gravity="3 0 -9" solver="PGS" iterations="1" tolerance="0"/><worldbody>
<geom type="plane" size="9 9 1"/><body pos="0 0 .0998"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
</worldbody></mujoco>"""


def read(xml, **options):
    """Return the headline of an audit of a model."""
    result = audit(mujoco.MjModel.from_xml_string(xml), worlds=2, steps=60, **options)
    return result, " ".join(result.headline)


def test_forces_without_digits_are_the_fault_of_the_integrator():
    result, text = read(LEVER.format("implicitfast"), spread=0.2)
    assert "Cause: the integrator" in text and "Cause: the solver" not in text
    assert result.causes[0].own[0] == "lost digits"
    _, text = read(LEVER.format("discrete"), spread=0.2)
    assert "Cause" not in text


def test_solver_that_stops_early_is_the_cause():
    result, text = read(STOPPED)
    assert "Cause: the solver" in text
    assert result.causes[0].own[0] == "solver"


def test_exact_step_that_damping_pushes_on_names_integrator_and_softness_with_intervals():
    result, text = read(HINGE, spread=1.0)
    assert "From the rigid laws, the velocity of j" in text
    assert "integrator +" in text and "softness +" in text and "by order" in text
    (cause,) = result.causes
    assert cause.causes == ("integrator", "softness") and cause.own == ("", 0.0)
    total = sum(mean for _, mean, _, _ in cause.parts)
    assert total == pytest.approx(cause.difference, rel=1e-6)


# A box slides along both axes of the plane.
PUSHED = """<mujoco><option cone="pyramidal"/><worldbody><geom type="plane" size="3 3 .1" condim="{condim}"/>
<body pos="0 0 .0499"><freejoint/><geom type="box" size=".05 .05 .05" condim="{condim}"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize(("condim", "expected"), [(1, {"cone", "impratio"}), (3, set())])
def test_only_settings_that_hardly_change_the_step_are_idle(condim, expected):
    """Without friction, neither the cone nor the ratio of impedances matters; in a slide, both do."""
    model = mujoco.MjModel.from_xml_string(PUSHED.format(condim=condim))
    data = mujoco.MjData(model)
    data.qvel[:2] = 0.7, 0.4
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    changed = {
        "cone": MujocoSetting((("cone", "elliptic"),)).apply_to(mujoco, model),
        "impratio": MujocoSetting((("impratio", 10.0),)).apply_to(mujoco, model),
    }
    found = list_idle_settings(mujoco, model, state, changed)
    assert set(found) == expected
    own, other = (step_velocity(m, state, kind) for m in (model, changed["cone"]))
    assert (np.abs(own - other).max() > 1e-3) == ("cone" not in found)


def step_velocity(model, state, kind):
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, state, kind)
    mujoco.mj_step(model, data)
    return np.array(data.qvel)


@pytest.mark.parametrize("friction", [0.4, 0.1])
def test_audit_names_slip_if_a_contact_creeps_although_every_solve_is_right(friction, tmp_path):
    """A box on a slope creeps by softness; above the friction angle it slides by the rigid laws, too."""
    path = tmp_path / "my models" / "slope.xml"
    path.parent.mkdir()
    path.write_text(f"""<mujoco><option timestep="0.002" cone="elliptic" gravity="2 0 -9.6"/><worldbody>
      <geom name="slope" type="plane" size="9 9 .1" friction="{friction} 0.005 0.0001"/>
      <body pos="0 0 .05"><freejoint/><geom name="box" type="box" size=".2 .2 .05"
      friction="{friction} 0.005 0.0001"/></body></worldbody></mujoco>""")
    result = audit(path, worlds=1, steps=200, workers=1, max_velocity_error=1e-5)
    out = tmp_path / "out"
    result.write(out)
    page = result.page.make_page(None)
    text = " ".join(page.sentences)
    assert not result.is_unconverged.any()
    if friction < 0.2:
        assert "lavender slip" not in text and not page.code and not (out / "slip.npz").exists()
        return
    assert "The solves are right, and contacts slide" in text and "slope, box" in text
    (command,) = page.code
    words = shlex.split(command)
    assert words[:3] == ["lavender", "slip", str(path)]
    found = explain_slip_of_states(words[2], words[4])
    assert f"{result.slide.speed:.6e}" == f"{found.explanations[0].speeds.max():.6e}"
    assert found.slips["cause"][0] == "softness"
