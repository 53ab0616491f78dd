"""`from_genesis` on recorded arrays, against arithmetic in the engine's terms; test_readers.py asks the rest."""

from types import SimpleNamespace

import numpy as np
import pytest
from recorded_engines import make_genesis, replace_genesis

import lavender as lv

MODELS = {"arm": "coulomb", "convex": "cone", "pyramids": "cone"}


@pytest.fixture(autouse=True)
def genesis(monkeypatch):
    replace_genesis(monkeypatch)


def array_of(scene, path):
    at = scene.sim.rigid_solver
    for name in path.split("."):
        at = getattr(at, name)
    return at.array.astype(float)


@pytest.mark.parametrize("model", MODELS)
def test_problem_has_the_engines_rows_and_law(model):
    scene = make_genesis(model)
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


class Plane:
    """The morph of a ground plane."""


class Box:
    """The morph of a box."""


@pytest.mark.parametrize(
    ("plane", "box", "is_hidden"), [(None, 0.2, True), (0.3, 0.2, False), (None, 1.5, False), (None, None, False)]
)
def test_from_genesis_with_friction_below_the_default_of_a_plane_warns(plane, box, is_hidden):
    scene = make_genesis("convex")
    pairs = ((Plane(), plane), (Box(), box))
    scene.entities = [SimpleNamespace(morph=m, material=SimpleNamespace(friction=x)) for m, x in pairs]
    if is_hidden:
        with pytest.warns(UserWarning, match=r"friction 0\.2, and a plane the default of 1"):
            lv.io.from_genesis(scene)
    else:
        lv.io.from_genesis(scene)
