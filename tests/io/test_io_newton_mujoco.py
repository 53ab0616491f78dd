"""`from_newton_mujoco` on a stand-in whose arrays are those of MuJoCo itself, in float32 and padded."""

from types import SimpleNamespace

import numpy as np
import pytest
from mujoco_scene import mj, scene

import lavender as lv

MAX_ROWS = 64


class Array:
    def __init__(self, array):
        self.array = np.asarray(array)
        self.shape = self.array.shape

    def __len__(self):
        return len(self.array)

    def numpy(self):
        return self.array


def stand_in(cone="elliptic", n=3, max_rows=MAX_ROWS):
    """Return a solver with the arrays of n states of a model, and the velocities before the step."""
    model = mj.MjModel.from_xml_string(scene(cone=cone))
    rng, worlds = np.random.default_rng(0), []
    efc = {name: [] for name in ("J", "D", "aref", "type", "frictionloss", "force")}
    contact = {name: [] for name in ("worldid", "efc_address", "dim", "friction")}
    rest = {name: [] for name in ("qacc_smooth", "qfrc_smooth", "qacc", "M", "qvel")}
    for i in range(n):
        data = mj.MjData(model)
        data.qvel[:] = 0.3 * rng.standard_normal(model.nv)
        for _ in range(5 * i + 1):
            mj.mj_step(model, data)
        mj.mj_forward(model, data)
        worlds.append(data.nefc)
        for name, values in efc.items():
            x = data.efc_J.reshape(data.nefc, -1) if name == "J" else getattr(data, f"efc_{name}")
            padded = np.full((max_rows, *x.shape[1:]), 6, x.dtype)  # what an earlier step left
            padded[: data.nefc] = x[:max_rows]
            values.append(padded)
        for name, values in contact.items():
            x = np.full(data.ncon, i) if name == "worldid" else getattr(data.contact, name)
            values.append(np.repeat(x[:, None], 4, axis=1) if name == "efc_address" else x)
        for name, values in rest.items():
            values.append(np.array(getattr(data, name)))
    kinds = {"type": np.int32, "worldid": np.int32, "efc_address": np.int32, "dim": np.int32}
    arrays = {k: Array(np.array(v).astype(kinds.get(k, np.float32))) for k, v in efc.items()}
    contacts = {k: Array(np.concatenate(v).astype(kinds.get(k, np.float32))) for k, v in contact.items()}
    others = {k: Array(np.array(v, np.float32)) for k, v in rest.items()}
    data = SimpleNamespace(
        nefc=Array(np.array(worlds, np.int32)), nacon=Array([len(contacts["dim"])]), efc=SimpleNamespace(**arrays),
        contact=SimpleNamespace(**contacts), solver_niter=Array([2] * n), **others,
    )  # fmt: skip
    option = SimpleNamespace(timestep=Array([model.opt.timestep]), iterations=100)
    solver = SimpleNamespace(mjw_data=data, mj_model=model, mjw_model=SimpleNamespace(opt=option))
    return solver, others["qvel"].numpy()


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_answers_of_mujoco_are_right_in_float32(cone):
    solver, velocity = stand_in(cone)
    step = lv.io.from_newton_mujoco(solver, velocity)
    assert step.batch.row_counts.tolist() == solver.mjw_data.nefc.numpy().tolist()
    assert step.batch.precision == "float32"
    verdicts = lv.residual_many(step.batch, step.impulse, threshold=1e-4).verdict
    assert set(verdicts.tolist()) <= {"at its floor", "close enough"}
    assert step.claims.converged.all()
    assert not any(dropped.any() for dropped in step.claims.residuals.values())


def test_iterations_that_are_used_up_are_not_converged():
    solver, velocity = stand_in()
    solver.mjw_data.solver_niter = Array([2, 100, 3])
    assert lv.io.from_newton_mujoco(solver, velocity).claims.converged.tolist() == [True, False, True]


@pytest.mark.parametrize("bad", [np.nan, -1e12])
def test_from_newton_mujoco_of_a_world_with_a_bad_acceleration_has_no_answer(bad):
    solver, velocity = stand_in()
    acceleration = solver.mjw_data.qacc.numpy().copy()
    acceleration[1, 0] = bad
    solver.mjw_data.qacc = Array(acceleration)
    step = lv.io.from_newton_mujoco(solver, velocity)
    judged = lv.residual_many(step.batch, step.impulse).velocity_error
    assert np.flatnonzero(~np.isfinite(judged)).tolist() == [1]


def test_rows_without_memory_are_counted():
    solver, velocity = stand_in("pyramidal")
    solver.mjw_data.nefc = Array(solver.mjw_data.nefc.numpy() + MAX_ROWS)
    step = lv.io.from_newton_mujoco(solver, velocity)
    assert (step.batch.row_counts == MAX_ROWS).all()
    assert step.claims.residuals["dropped_rows"].tolist() == (solver.mjw_data.nefc.numpy() - MAX_ROWS).tolist()


def test_contacts_without_memory_are_counted():
    solver, velocity = stand_in()
    stored = int(solver.mjw_data.nacon.numpy()[0])
    solver.mjw_data.nacon = Array([stored + 5])
    dropped = lv.io.from_newton_mujoco(solver, velocity).claims.residuals["dropped_contacts"]
    assert dropped.tolist() == [5.0, 5.0, 5.0]


def test_from_newton_mujoco_of_other_solvers_or_versions_raises():
    with pytest.raises(lv.InputError, match="SolverMuJoCo"):
        lv.io.from_newton_mujoco(object(), np.zeros((1, 1)))
    solver, velocity = stand_in()
    del solver.mjw_data.qfrc_smooth
    with pytest.raises(lv.CapabilityError, match="qfrc_smooth"):
        lv.io.from_newton_mujoco(solver, velocity)
    solver, velocity = stand_in()
    solver.mjw_data.efc.J = Array(np.zeros((3, 1, 500), np.float32))
    with pytest.raises(lv.CapabilityError, match="sparse"):
        lv.io.from_newton_mujoco(solver, velocity)
