"""`from_genesis` on recorded arrays, against arithmetic in the engine's terms; test_readers.py asks the rest."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from recorded_engines import Recorded, make_genesis, replace_genesis

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
            np.testing.assert_allclose(
                problem.dense(), matrix, rtol=1e-6, atol=1e-6 * np.abs(matrix).max()
            )
            np.testing.assert_allclose(problem.b, b, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("integrator", "is_compatible", "moved_by"),
    [
        ("approximate_implicitfast", True, "acceleration"),
        ("Euler", False, "acceleration"),
        ("Euler", True, "acceleration"),
        ("implicitfast", True, "forces"),
    ],
)
def test_from_genesis_takes_the_velocity_before_from_the_acceleration_of_the_integrator(
    integrator, is_compatible, moved_by
):
    """The arrays are those of the default integrator.

    With Euler and damping, the velocity after genesis-world 1.4.5's step differs from that by qacc by 5e-3 m/s.
    """
    scene = make_genesis("arm")
    names = SimpleNamespace(approximate_implicitfast=1, Euler=0, implicitfast=2)
    sys.modules["genesis"].integrator = names
    solver = scene.sim.rigid_solver
    solver.rigid_config.integrator = getattr(names, integrator)
    solver.rigid_config.enable_mujoco_compatibility = is_compatible
    solver.dyn_info = SimpleNamespace(dofs=SimpleNamespace(damping=Recorded(np.zeros(3))))
    acc, vel, smooth = (
        array_of(scene, f"dyn_state.dofs.{name}") for name in ("acc", "vel", "acc_smooth")
    )
    solver.dyn_state.dofs.acc = Recorded(0.5 * acc)
    step = lv.io.from_genesis(scene)
    dt = solver.substep_dt
    for i in range(len(step.batch)):
        expected = vel[:, i] - 0.5 * dt * acc[:, i] + dt * smooth[:, i]
        np.testing.assert_allclose(step.batch[i].generalized.v_free, expected, rtol=1e-5, atol=1e-6)
        motion = step.batch.engine_motions.get(i)
        assert (motion.moved_by if motion is not None else "forces") == moved_by
    if is_compatible and integrator == "Euler":  # Only trees with damping are moved by forces.
        solver.dyn_info.dofs.damping = Recorded(np.array([0.0, 0.3]))
        with pytest.raises(lv.CapabilityError, match="enable_mujoco_compatibility with Euler"):
            lv.io.from_genesis(scene)


class Plane:
    """The morph of a ground plane."""


class Box:
    """The morph of a box."""


@pytest.mark.parametrize(
    ("plane", "box", "is_hidden"),
    [(None, 0.2, True), (0.3, 0.2, False), (None, 1.5, False), (None, None, False)],
)
def test_from_genesis_with_friction_below_the_default_of_a_plane_warns(plane, box, is_hidden):
    scene = make_genesis("convex")
    pairs = ((Plane(), plane), (Box(), box))
    scene.entities = [
        SimpleNamespace(morph=m, material=SimpleNamespace(friction=x)) for m, x in pairs
    ]
    if is_hidden:
        with pytest.warns(UserWarning, match=r"friction 0\.2, and a plane the default of 1"):
            lv.io.from_genesis(scene)
    else:
        lv.io.from_genesis(scene)
