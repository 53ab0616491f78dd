"""A scene of MuJoCo with every kind of constraint, and a state of it at which boxes slide and stick."""

import numpy as np
import pytest

mj = pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'lavender-contact[peers]'")

SCENE = """<mujoco><option cone="{cone}" solver="{solver}" timestep="0.004" tolerance="1e-15" iterations="2000"
  jacobian="{jacobian}"/>
  <default><geom friction="0.5 0.02 0.001" condim="{condim}"/></default><worldbody>
  <geom type="plane" size="0 0 1"/>
  <body pos="0 0 .1"><freejoint/><geom name="low" type="box" size=".1 .1 .1"/></body>
  <body pos="0 0 .3"><freejoint/><geom name="high" type="box" size=".1 .1 .1" mass="40"/></body>
  <body pos="1 0 .3"><joint name="door" type="hinge" axis="0 1 0" frictionloss="0.1" limited="true" range="-20 20"/>
    <geom type="capsule" fromto="0 0 0 .5 0 0" size=".05"/>
    <body pos=".5 0 0"><joint type="ball" frictionloss="0.01"/><geom type="sphere" size=".1" pos=".1 0 0"/></body>
  </body>
  <body name="bob" pos="0 2 1"><freejoint/><geom type="sphere" size=".1"/></body>
  </worldbody><equality><connect name="string" body1="bob" anchor="0 0 .2"/></equality></mujoco>"""


def scene(cone="elliptic", solver="Newton", condim=3, jacobian="dense"):
    return SCENE.format(cone=cone, solver=solver, condim=condim, jacobian=jacobian)


def state(cone="elliptic", solver="Newton", condim=3, jacobian="dense", steps=25):
    """The upper box slides and turns on the lower one, which sticks; a hinge and a ball move. After `mj_forward`."""
    text = scene(cone, solver, condim, jacobian)
    model = mj.MjModel.from_xml_string(text)
    data = mj.MjData(model)
    for _ in range(steps):
        mj.mj_step(model, data)
    data.qvel[6:12] = 0.2, 0.1, 0.0, 0.0, 0.0, 0.5
    data.qvel[12:16] = 0.3, 1.0, -1.0, 0.5
    mj.mj_forward(model, data)
    return model, data


def get_state(model, data):
    """All that the next step reads, as `mj_setState` takes it."""
    found = np.empty(mj.mj_stateSize(model, mj.mjtState.mjSTATE_INTEGRATION))
    mj.mj_getState(model, data, found, mj.mjtState.mjSTATE_INTEGRATION)
    return found


def whole_mass(model, data):
    """M (nv, nv)."""
    whole = np.zeros((model.nv, model.nv))
    mj.mj_fullM(model, whole, data.qM) if hasattr(data, "qM") else mj.mj_fullM(model, data, whole)
    return whole
