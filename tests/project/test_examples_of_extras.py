"""Examples that need another package run on a stand-in of it: the calls of lavender in them are the real ones."""

import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock, create_autospec

import numpy as np
import pytest
from worked import ROOT, example

import lavender as lv

GRAVITY = np.array([0.0, 0.0, -9.81, 0.0, 0.0, 0.0])  # m/s2, and rad/s2


@pytest.mark.parametrize("name", sorted(path.stem for path in (ROOT / "examples").glob("*.py")))
def test_every_example_can_be_imported(name):
    module = example(name)
    assert Path(module.__file__).stem == name and module.__doc__


def make_box_problem(mass, size, dt, v):
    """Return the problem of a step of a box whose four lower corners touch the ground; v (6,) at its centre."""
    rows = []
    for x in (-0.5 * size, 0.5 * size):
        for y in (-0.5 * size, 0.5 * size):
            arm = np.array([x, y, -0.5 * size])
            rows += [np.concatenate([axis, np.cross(arm, axis)]) for axis in np.roll(np.eye(3), 1, axis=0)]
    inertia = mass * size**2 / 6.0
    cones = lv.Cones.contacts([0.5] * 4)
    return lv.Problem.from_jacobian(np.array(rows), np.diag([mass] * 3 + [inertia] * 3), v + dt * GRAVITY, cones=cones)


def test_the_box_of_pinocchio_runs_on_a_stand_in(monkeypatch, capsys):
    module, pin = example("pinocchio_box"), MagicMock()
    model = pin.Model.return_value
    model.nv, model.addJoint.return_value = 6, 1
    place = SimpleNamespace(act=lambda corner: corner + np.array([0.0, 0.0, 0.1]), rotation=np.eye(3))
    model.createData.return_value.oMi = {1: place}
    pin.neutral.return_value = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    pin.Quaternion.return_value.coeffs.return_value = np.array([0.0, 0.0, 0.0, 1.0])
    pin.integrate.side_effect = lambda model, q, change: q + np.append(change, 0.0)

    def convert(model, data, models, datas, dt, *, q, v, correction):
        assert len(models) == len(datas) == 8 and (dt, correction) == (module.DT, 0.1)
        return make_box_problem(module.MASS, module.SIZE, dt, v)

    monkeypatch.setitem(sys.modules, "pinocchio", pin)
    monkeypatch.setattr(lv.io, "from_pinocchio", create_autospec(lv.io.from_pinocchio, side_effect=convert))
    heights, speeds, force, worst = module.run(5)
    assert heights == pytest.approx(0.25, abs=1e-6) and speeds.max() < 1e-6 and worst <= 1e-8
    assert force == pytest.approx(9.81 * module.MASS, rel=1e-6)
    monkeypatch.setattr(module, "run", lambda: (heights, speeds, force, worst))
    module.main()
    assert "weight 19.62 N" in capsys.readouterr().out


def test_the_box_of_drake_runs_on_a_stand_in(monkeypatch, capsys):
    module = example("drake_box")
    packages = ("geometry", "math", "multibody.plant", "multibody.tree", "systems.framework", "systems.analysis")
    for name in ("pydrake", *(f"pydrake.{package}" for package in packages)):
        monkeypatch.setitem(sys.modules, name, MagicMock())
    plant = MagicMock()
    adder = MagicMock(return_value=(plant, None))
    sys.modules["pydrake.multibody.plant"].AddMultibodyPlantSceneGraph = adder
    problem = make_box_problem(module.MASS, module.SIZE, module.DT, np.zeros(6))
    answer = lv.solve(problem, tol=1e-12).impulse
    monkeypatch.setattr(lv.io, "from_drake", create_autospec(lv.io.from_drake, return_value=problem))
    monkeypatch.setattr(lv.io.drake, "impulse", create_autospec(lv.io.drake.impulse, return_value=answer))
    found, force = module.run(3)
    assert adder.call_args.kwargs == {"time_step": module.DT}
    assert plant.RegisterCollisionGeometry.call_count == 5  # The ground and four corners.
    assert found.shape == (3, 3) and found.max() < 1e-9
    assert force == pytest.approx(9.81 * module.MASS, rel=1e-6)
    monkeypatch.setattr(module, "run", lambda: (found, force))
    module.main()
    assert "3 steps with contacts" in capsys.readouterr().out
