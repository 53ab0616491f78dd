"""Readers of MJX and MuJoCo Warp on arrays of MuJoCo itself, under the engines' names: the records are MuJoCo's own."""

from types import SimpleNamespace

import numpy as np
import pytest
from recorded_engines import Recorded

pytest.importorskip("mujoco", minversion="4.0")
import mujoco as mj
import planted_changes as planted

import lavender as lv

MODELS = ("gripper", "sliding", "arm", "loop", "tendon")
ROWS = ("pos", "margin", "aref", "force", "frictionloss", "D", "vel", "type", "id")
FORCES = ("qfrc_smooth", "qfrc_actuator", "qfrc_bias", "qacc")
CONTACTS = ("dim", "dist", "friction", "solref", "solreffriction", "solimp", "geom", "pos", "frame")
EQUALITIES = {"CONNECT": 3, "WELD": 6, "JOINT": 1, "TENDON": 1}


def read_step(name, integrator, cone):
    """Return model, data before the step, data of the forward pass, and data after the step."""
    model, before = planted.load(name, integrator, cone)
    model.opt.jacobian = mj.mjtJacobian.mjJAC_DENSE
    forward, after = mj.MjData(model), mj.MjData(model)
    for data in (forward, after):
        mj.mj_copyData(data, model, before)
    mj.mj_forward(model, forward)
    mj.mj_step(model, after)
    return model, before, forward, after


def list_rows(model, data):
    """Return the rows of MuJoCo and their J (m, nv)."""
    rows = {x: np.array(getattr(data, f"efc_{x}")) for x in ROWS}
    return rows, data.efc_J.reshape(data.nefc, model.nv)


def make_mjx(model, before, forward, after):
    """Return both data of MJX: every constraint of the model has its rows, which are 0 if it is not active."""
    own, jac = list_rows(model, forward)
    wanted = []  # (type, id, rows) in the order of MJX.
    for kind, size in EQUALITIES.items():
        ids = np.flatnonzero(model.eq_type == int(getattr(mj.mjtEq, f"mjEQ_{kind}")))
        wanted += [(0, i, size) for i in ids]
    wanted += [(1, i, 1) for i in np.flatnonzero(model.dof_frictionloss > 0)]
    wanted += [(2, i, 1) for i in np.flatnonzero(model.tendon_frictionloss > 0)]
    limited = np.flatnonzero(model.jnt_limited)
    is_ball = model.jnt_type[limited] == int(mj.mjtJoint.mjJNT_BALL)
    wanted += [(3, i, 1) for i in [*limited[is_ball], *limited[~is_ball]]]
    wanted += [(4, i, 1) for i in np.flatnonzero(model.tendon_limited)]
    arrays = {x: [] for x in ("type", "J", *ROWS[:6])}
    for kind, which, size in wanted:
        at = np.flatnonzero((own["type"] == kind) & (own["id"] == which))
        assert len(at) in (0, size)
        arrays["type"] += [kind] * size
        for name in ("J", *ROWS[:6]):
            values = jac if name == "J" else own[name]
            arrays[name] += (
                list(values[at]) if len(at) else list(np.zeros((size, *values.shape[1:])))
            )
    address = []
    for i in range(forward.ncon):
        at = np.flatnonzero((own["type"] >= 5) & (own["id"] == i))
        address.append(len(arrays["type"]))
        arrays["type"] += list(own["type"][at])
        for name in ("J", *ROWS[:6]):
            arrays[name] += list((jac if name == "J" else own[name])[at])
    fields = {f"efc_{k}": np.array(v) for k, v in arrays.items()}
    fields["efc_J"] = np.reshape(fields["efc_J"], (-1, model.nv))
    contact = SimpleNamespace(
        efc_address=np.array(address, int),
        **{x: np.array(getattr(forward.contact, x)) for x in CONTACTS},
    )
    mass = np.zeros((model.nv, model.nv))
    mj.mj_fullM(model, forward, mass)
    inner = SimpleNamespace(contact=contact, M=mass, **fields)
    forces = {x: np.array(getattr(forward, x)) for x in FORCES}
    start = {x: np.array(getattr(before, x)) for x in ("qpos", "qvel", "ctrl", "act")}
    return SimpleNamespace(**start), SimpleNamespace(
        _impl=inner, qvel=np.array(after.qvel), **forces
    )


def make_warp(model, forward, after):
    """Return the data of MuJoCo Warp: two worlds, of which the second is MuJoCo's, with memory for more rows."""
    own, jac = list_rows(model, forward)
    m = forward.nefc

    def stack(values, fill=7.0):
        padded = np.full((m + 5, *np.shape(values)[1:]), fill, np.asarray(values).dtype)
        padded[:m] = values
        return Recorded(np.stack([padded + 1, padded]))

    efc = SimpleNamespace(J=stack(jac), **{x: stack(own[x]) for x in ROWS})
    contact = SimpleNamespace(**{x: Recorded(getattr(forward.contact, x)) for x in CONTACTS})
    forces = {
        x: Recorded(np.stack([getattr(forward, x)] * 2))
        for x in (*FORCES, "qfrc_damper", "ctrl", "act")
    }
    mass = np.zeros((model.nv, model.nv))
    mj.mj_fullM(model, forward, mass)
    return SimpleNamespace(
        nefc=Recorded(np.array([m, m])), nacon=Recorded(np.array([forward.ncon])), efc=efc, contact=contact,
        M=Recorded(np.stack([mass] * 2)), qvel=Recorded(np.stack([after.qvel] * 2)), **forces,
    )  # fmt: skip


def check(found, own, tolerance):
    """Assert that a record has the step, the rows and the settings of MuJoCo's own one."""
    comparison = lv.compare(own, found)
    assert not comparison.pairing.list_unmatched(0) and not comparison.pairing.list_unmatched(1)
    assert not comparison.facts
    size = max(1.0, np.abs(own.velocity_after).max())
    for name, part in comparison.parts.items():
        assert np.abs(part.changes).max() <= tolerance * size, name
    own_forces, forces = (
        {x.key: x.force.tolist() for x in r.blocks if x.role != "contact"} for r in (own, found)
    )
    assert forces == own_forces  # MJX has the limits of ball joints first.


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize(("integrator", "cone"), [("Euler", "pyramidal"), ("Euler", "elliptic")])
def test_step_of_mjx_is_read_as_the_step_of_mujoco(name, integrator, cone):
    model, before, forward, after = read_step(name, integrator, cone)
    own = lv.io.step_from_mujoco(model, before)
    found = lv.io.step_from_mjx(model, *make_mjx(model, before, forward, after))
    assert found.precision == "float64"
    check(found, own, 1e-9)  # H of MuJoCo is the inverse of a measured inverse.


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize(
    ("integrator", "cone"), [("Euler", "pyramidal"), ("implicitfast", "elliptic")]
)
def test_step_of_mujoco_warp_is_read_as_the_step_of_mujoco(name, integrator, cone):
    model, before, forward, after = read_step(name, integrator, cone)
    own = lv.io.step_from_mujoco(model, before)
    position, velocity = ([np.full(len(x), 9.0), x] for x in (before.qpos, before.qvel))
    data = make_warp(model, forward, after)
    found = lv.io.step_from_warp(model, data, position, velocity, world=1)
    assert found.precision == "float32"
    check(found, own, 1e-9)  # H of MuJoCo is the inverse of a measured inverse.


def test_step_of_newton_has_the_time_step_of_its_call():
    model, before, forward, after = read_step("sliding", "Euler", "pyramidal")
    dt = model.opt.timestep
    warp = SimpleNamespace(opt=SimpleNamespace(timestep=Recorded(np.array([dt]))))
    data = make_warp(model, forward, after)
    model.opt.timestep = 3.0 * dt  # newton's model keeps the one that it was built with.
    solver = SimpleNamespace(mj_model=model, mjw_model=warp, mjw_data=data)
    position, velocity = ([np.full(len(x), 9.0), x] for x in (before.qpos, before.qvel))
    found = lv.io.step_from_newton_mujoco(solver, position, velocity, world=1)
    assert found.dt == dt and model.opt.timestep == 3.0 * dt


@pytest.mark.parametrize(("call", "error", "words"), [
    (lambda m, b, a, w: lv.io.step_from_mjx(1, b, a), lv.InputError, "mujoco.MjModel"),
    (lambda m, b, a, w: lv.io.step_from_mjx(m, SimpleNamespace(qpos=b.qpos[None], qvel=b.qvel), a),
     lv.InputError, "of one world"),
    (lambda m, b, a, w: lv.io.step_from_mjx(m, b, 1), lv.CapabilityError, "attribute"),
    (lambda m, b, a, w: lv.io.step_from_warp(m, 1, [b.qpos], [b.qvel]), lv.InputError, "mujoco_warp"),
    (lambda m, b, a, w: lv.io.step_from_warp(m, w, [b.qpos[1:]], [b.qvel]), lv.InputError, "position"),
    (lambda m, b, a, w: lv.io.step_from_genesis(1), lv.InputError, "genesis.Scene"),
])  # fmt: skip
def test_wrong_arguments_of_engines_are_named(call, error, words):
    model, before, forward, after = read_step("gripper", "Euler", "pyramidal")
    first, second = make_mjx(model, before, forward, after)
    with pytest.raises(error, match=words):
        call(model, first, second, make_warp(model, forward, after))


def test_integrators_that_the_engines_lack_are_refused():
    model, before, forward, after = read_step("arm", "implicit", "elliptic")
    with pytest.raises(lv.CapabilityError, match="Euler or implicitfast"):
        lv.io.step_from_mjx(model, *make_mjx(model, before, forward, after))
