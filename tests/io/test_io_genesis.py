"""`from_genesis` on arrays that `record_genesis.py` recorded, against own arithmetic in the engine's terms."""

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import lavender as lv

RECORDED = Path(__file__).parent / "genesis_1.4.5.npz"
MODELS = {"arm": "coulomb", "convex": "cone", "pyramids": "cone"}


class Recorded:
    """An array of the engine, and what `qd_to_torch` returns of it."""

    def __init__(self, array):
        self.array = array

    def __getitem__(self, index):
        return Recorded(self.array[index])

    def cpu(self):
        return self

    def numpy(self):
        return self.array


class LegacyCoupler:
    """The default coupler of a scene."""


@pytest.fixture(autouse=True)
def engine_without_engine(monkeypatch):
    """Replace the engine's function that copies arrays to the host."""
    misc = ModuleType("genesis.utils.misc")
    misc.qd_to_torch = lambda value, copy=None: value
    for name, module in (("genesis", ModuleType("genesis")), ("genesis.utils", ModuleType("genesis.utils"))):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, "genesis.utils.misc", misc)


def load(model, **changes):
    """Return a stand-in of the scene with the recorded attributes, some of them replaced."""
    scene = SimpleNamespace(is_built=True)
    with np.load(RECORDED) as file:
        for key in file.files:
            if key.startswith(f"{model}/"):
                *path, last = key.split("/")[1].split(".")
                at = scene
                for name in path:
                    at.__dict__.setdefault(name, SimpleNamespace())
                    at = getattr(at, name)
                array = changes.get(last, lambda x: x)(file[key].copy())
                setattr(at, last, array.item() if array.ndim == 0 else Recorded(array))
    scene.sim.coupler = LegacyCoupler()
    scene.sim.rigid_solver._options = SimpleNamespace(noslip_iterations=0)
    return scene


def array_of(scene, path):
    at = scene.sim.rigid_solver
    for name in path.split("."):
        at = getattr(at, name)
    return at.array.astype(float)


@pytest.mark.parametrize("model", MODELS)
def test_problem_has_the_engines_rows_and_law(model):
    scene = load(model)
    step = lv.io.from_genesis(scene)
    state = "constraint_solver.constraint_state."
    counts = array_of(scene, f"{state}n_constraints").astype(int)
    assert step.batch.row_counts.tolist() == counts.tolist()
    assert len(set(counts.tolist())) > 1  # worlds of different sizes
    assert step.batch.friction == MODELS[model] and step.batch.precision == "float32"
    assert step.claims.converged.shape == counts.shape
    dt = scene.sim.rigid_solver.substep_dt
    for i, m in enumerate(counts):
        problem = step.batch[i]
        jac = array_of(scene, f"{state}jac")[:m, :, i]
        mass = array_of(scene, "rigid_info.mass_mat")[:, :, i]
        soft = 1.0 / array_of(scene, f"{state}efc_D")[:m, i]
        smooth = array_of(scene, "dyn_state.dofs.acc_smooth")[:, i]
        matrix = jac @ np.linalg.solve(mass, jac.T) + np.diag(soft)
        b = dt * (array_of(scene, f"{state}aref")[:m, i] - jac @ smooth)
        if model != "convex":  # With torsion, rows are scaled by their coefficients.
            np.testing.assert_allclose(problem.dense(), matrix, rtol=1e-6, atol=1e-6 * np.abs(matrix).max())
            np.testing.assert_allclose(problem.b, b, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("model", MODELS)
def test_velocity_after_the_step_is_the_engines(model):
    scene = load(model)
    step = lv.io.from_genesis(scene)
    after = array_of(scene, "dyn_state.dofs.vel")
    for i, m in enumerate(step.batch.row_counts):
        velocity = step.batch[i].velocity(step.impulse[i, :m])
        assert np.abs(velocity - after[:, i]).max() <= 1e-4  # float32


def test_nan_of_an_environment_touches_no_other():
    def spoil(velocity):
        velocity[0, 1] = np.nan
        return velocity

    clean, spoiled = lv.io.from_genesis(load("arm")), lv.io.from_genesis(load("arm", vel=spoil))
    a = lv.residual_many(clean.batch, clean.impulse, errors="status").relative
    b = lv.residual_many(spoiled.batch, spoiled.impulse, errors="status")
    assert set(b.faults) == {1}
    np.testing.assert_array_equal(a[[0, 2]], b.relative[[0, 2]])


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda s: setattr(s.sim.rigid_solver._options, "noslip_iterations", 3), "noslip_iterations"),
        (lambda s: setattr(s.sim.rigid_solver.rigid_config, "use_hibernation", True), "use_hibernation"),
        (lambda s: setattr(s.sim, "coupler", type("SAPCoupler", (), {})()), "SAPCoupler"),
        (lambda s: setattr(s.sim.rigid_solver.rigid_config, "enable_rolling_friction", True), "rolling"),
        (lambda s: delattr(s.sim.rigid_solver.rigid_info, "mass_mat"), "mass_mat"),
    ],
)
def test_other_configurations_are_rejected_by_name(change, match):
    scene = load("arm")
    change(scene)
    with pytest.raises(lv.CapabilityError, match=match):
        lv.io.from_genesis(scene)


def test_other_objects_and_another_mass_matrix_are_rejected():
    with pytest.raises(lv.InputError, match="a list; a built"):
        lv.io.from_genesis([])
    with pytest.raises(lv.CapabilityError, match="qacc_smooth differs from qfrc_smooth"):
        lv.io.from_genesis(load("arm", mass_mat=lambda x: 1.01 * x))


@pytest.mark.parametrize("bad", [np.nan, 1e12])
def test_from_genesis_of_an_environment_with_a_bad_acceleration_has_no_answer(bad):
    def spoil(acceleration):
        acceleration[0, 1] = bad
        return acceleration

    step = lv.io.from_genesis(load("convex", qacc=spoil))
    judged = lv.residual_many(step.batch, step.impulse, errors="status").velocity_error
    assert np.flatnonzero(~np.isfinite(judged)).tolist() == [1]


class Plane:
    """The morph of a ground plane."""


class Box:
    """The morph of a box."""


@pytest.mark.parametrize(
    ("plane", "box", "is_hidden"), [(None, 0.2, True), (0.3, 0.2, False), (None, 1.5, False), (None, None, False)]
)
def test_friction_below_the_default_of_a_plane_is_warned_of(plane, box, is_hidden):
    scene = load("convex")
    pairs = ((Plane(), plane), (Box(), box))
    scene.entities = [SimpleNamespace(morph=m, material=SimpleNamespace(friction=x)) for m, x in pairs]
    if is_hidden:
        with pytest.warns(UserWarning, match=r"friction 0\.2, and a plane the default of 1"):
            lv.io.from_genesis(scene)
    else:
        lv.io.from_genesis(scene)
