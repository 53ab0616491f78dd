"""The examples run, and the relations that they show hold."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from worked import example, python

import lavender as lv
from lavender.sim.engine.layout import HEAD

DOCS = Path(__file__).resolve().parent.parent.parent / "docs"
EXAMPLES = DOCS.parent / "examples"


@pytest.fixture
def drawn(tmp_path, capsys):
    """An example by name that has printed its numbers and saved its figure; those of the chapter: test_chapter.py."""

    def draw(name):
        path = tmp_path / f"{name}.png"
        example(name).main(str(path))
        assert path.read_bytes().startswith(b"\x89PNG")
        assert str(path) in capsys.readouterr().out
        return example(name)

    return draw


def test_example_scene_has_only_declared_rows(drawn):
    module = drawn("what_a_row_costs")
    contacts = 4 * module.BOXES
    rows = {
        name: lv.Simulation(lv.Scene("stack", n=module.BOXES, **more)).constraint_problem().m
        for name, more in module.DECLARED.items()
    }
    assert list(rows.values()) == [contacts * n for n in (1, 3, 4, 5, 6)]


def test_solvers_of_every_kind_agree_with_osqp():
    module = example("cross_check")
    for table in module.numbers().values():
        assert table.reference == "osqp"
        assert table["gauss_seidel"].ran == "pgs"
        backends = [row for row in table if row.solver not in module.OURS]
        assert backends and {row.solver for row in table.agreed} >= set(module.OURS)
        for row in table:
            assert row.distance <= row.allowed
            # a backend that does not agree says that it failed, as quadprog does on a singular A
            assert row.verdict in ("agrees", "not solved"), str(table)
            assert row.verdict == "agrees" or row.status not in ("CONVERGED", "ROUNDOFF_LIMIT"), (
                str(table)
            )


def test_sweeps_with_any_order_within_a_color_have_the_same_bits():
    """The statements of the exercise on colours: one result in bits for every order within them, and more sweeps."""
    module = example("jacobi")
    found = module.numbers()
    assert found["orders"] == {"colours": 2, "within": 1, "every": module.SHUFFLES}
    sweeps = {name: solution.work["sweeps"] for name, solution in found["stack"].items()}
    assert sweeps["Gauss-Seidel"] < sweeps["Gauss-Seidel, coloured"] < sweeps["Jacobi, undamped"]
    stages = {name: n * module.STAGES[name] for name, n in sweeps.items()}
    assert stages["Gauss-Seidel, coloured"] < 0.1 * stages["Gauss-Seidel"]


def test_example_friction_bounds_are_met_and_right_ones_give_coulomb():
    module = example("friction_bounds")
    found = module.numbers()
    none, *rounds = found["rounds"]
    assert np.all(none[1::2] == 0.0)
    # Two rounds give the same: the tangents do not change the normals.
    np.testing.assert_allclose(rounds[0], rounds[-1], rtol=0.0, atol=1e-12)
    normal, tangent = rounds[-1][0::2], rounds[-1][1::2]
    assert np.all(np.abs(tangent) <= module.MU * normal + 1e-12)
    assert abs(tangent[-1]) == pytest.approx(
        module.MU * normal[-1], rel=1e-9
    )  # the top contact slides
    assert np.abs(found["glued"][1::2]).max() > 2 * module.MU * normal[-1]
    # tol 1e-9 relative of impulses below 1 N s, times the conditioning of six boxes (about 50).
    for name in ("osqp", "pgs"):
        np.testing.assert_allclose(found[name], rounds[-1], rtol=0.0, atol=1e-7)
    assert found["coulomb"].success
    np.testing.assert_allclose(found["coulomb"].impulse, rounds[-1], rtol=0.0, atol=1e-8)


def test_example_residual_and_motion_error_follow_the_theory(drawn):
    module = drawn("residual_or_motion")
    found = module.numbers()
    factors = []
    for n in module.HEIGHTS[:2]:
        values = found["curves"][f"stack(n={n})"]
        late = values[values[:, 1] < 5e-2]
        factors.append(np.median(late[:, 2] / late[:, 1]))
        # 2 sqrt(2 n) / pi for a stack without end; a finite one stays some percent below.
        assert 0.85 < factors[-1] / (2.0 * np.sqrt(2.0 * n) / np.pi) < 1.05
    hang = found["curves"]["hang(n=33, tip_mass=1e4)"]
    assert (
        hang[-1, 1] < 0.2 and hang[-1, 2] > 0.9
    )  # nearly content, and the weight falls all the same
    residual, error = found["gram"]
    assert residual.relative == pytest.approx(1.0)
    # Its share of the energy: sqrt(1e-3 / (3000 + 1e-3)), at equal speeds.
    assert error.relative == pytest.approx(np.sqrt(1e-3 / 3000.001), rel=1e-6)


def test_worlds_of_a_training_loop_have_a_verdict_each(capsys, monkeypatch):
    pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'lavender-contact[mujoco]'")
    module = example("vector_worlds")
    sound = module.numbers(8, 40)
    hasty = module.numbers(8, 40, iterations=1)
    assert sound["errors"].shape == (40, 8) and not sound["refused"].any()
    assert hasty["refused"].any()
    monkeypatch.setattr("sys.argv", ["vector_worlds.py", "4", "3"])
    module.main()
    assert "12 steps, not to learn from" in capsys.readouterr().out


def test_every_motion_of_the_example_is_a_solution_and_solvers_find_two_of_them():
    module = example("two_motions")
    found = module.numbers()
    problem, motions = found["problem"], found["motions"]
    assert set(motions) == {"open", "sticks", "slides forwards"}
    for impulse in motions.values():
        judged = lv.residual(problem, impulse)
        assert judged.relative <= max(1e-15, 2.0 * judged.roundoff_floor)
    assert {"open", "sticks"} <= set(found["picks"].values())
    # Away from the paradox the rod leaves the ground, whatever the start.
    assert set(module.motions(lv.suite.case("painleve(slide=0.5)").problem)) == {"open"}


def test_example_drift_follows_the_motion_error(monkeypatch):
    module = example("motion_over_a_run")
    monkeypatch.setattr(module, "STEPS", 12)
    monkeypatch.setattr(module, "SWEEPS", (4, 64))
    found = module.numbers()
    assert all(value > 0.8 for value in module.ranks(found).values())
    by = {(run["sweeps"], run["order"], run["warm"]): run for run in found}
    assert by[4, "bottom_up", False]["drift"][-1] > 10 * by[64, "bottom_up", True]["drift"][-1]


def test_a_box_of_pinocchio_comes_to_rest_on_its_corners():
    pytest.importorskip(
        "pinocchio", reason="needs Pinocchio 4: pip install 'lavender-contact[pinocchio]'"
    )
    module = example("pinocchio_box")
    heights, speeds, force, worst = module.run()
    assert worst <= 1e-8  # what was asked for
    assert heights.min() > 0.5 * module.SIZE - 1e-4  # it never sinks in
    assert heights[-1] == pytest.approx(0.5 * module.SIZE, abs=1e-4)
    assert speeds.max() > 1.0 > 1e-6 > speeds[-1]  # it fell, and rests
    assert force == pytest.approx(9.81 * module.MASS, rel=1e-6)


def test_saps_impulses_on_a_box_of_drake_are_near_the_rigid_ones():
    pytest.importorskip("pydrake", reason="needs Drake: pip install 'lavender-contact[drake]'")
    module = example("drake_box")
    found, force = module.run()
    assert len(found) > 0.9 * module.STEPS
    theirs, apart = np.median(found[:, [0, 2]], axis=0)
    assert (
        found[:, 1].max() <= 1e-9 < theirs < 1e-3
    )  # asked for; SAP's contacts are soft, and little
    assert apart < 1e-5
    assert force == pytest.approx(9.81 * module.MASS, rel=1e-3)


def test_example_identification_finds_mass_and_friction_within_the_noise(drawn):
    module = drawn("recorded_slide")
    mass, mu, left = module.numbers()["way"][-1]
    # 60 speeds of 0.01 m/s noise determine either to a percent; the fit leaves less than the noise does.
    assert abs(mass / module.TRUE["mass"] - 1.0) < 0.02 and abs(mu / module.TRUE["mu"] - 1.0) < 0.02
    assert left < 0.5 * module.NOISE**2


def test_example_push_crosses_the_switch_only_with_the_distance_to_it(drawn):
    found = drawn("planned_push").numbers()
    assert (
        found["gradient descent"]["errors"][-1] == found["gradient descent"]["errors"][0]
    )  # the derivative is 0 all the way
    crossing = found["with the distance to the switch"]
    assert crossing["errors"][-1] < 1e-9 and crossing["crossed"] > 0


def test_the_sensitivity_of_a_step_agrees_with_differences(drawn):
    found = drawn("which_contact").numbers()
    row, block = found["at"]
    assert found["d"].exists
    assert found["target"][row] == pytest.approx(found["differences"][0], rel=1e-6)
    assert found["mu"][block] == pytest.approx(found["differences"][1], rel=1e-6)


def test_the_planar_engine_holds_its_joints_and_its_circles(drawn):
    module = drawn("engine_2d")
    found = module.numbers()
    frames, speeds, residual = found["run"]
    assert residual < 1e-5 and found["drift"] < 1e-6
    assert found["depth"].max() < 0.1 * module.RADIUS and found["depth"][-1] < 0.005
    assert (
        np.abs(frames[-1, 1:, 0]).max() < 2.0 and np.abs(frames[-1] - frames[-2]).max() < 0.01
    )  # in the box
    assert (
        speeds[0] == pytest.approx(module.SPEED) and speeds.min() < 0.0
    )  # more than the motor's torque


def test_the_planar_engine_runs_when_it_is_copied_alone(tmp_path):
    copy = tmp_path / "engine_2d.py"
    copy.write_text(example("engine_2d").__loader__.get_source("engine_2d"), encoding="utf-8")
    output = python(copy, cwd=tmp_path).stdout
    assert (
        "bar: 1.50 rad/s wanted" in output
        and "no figure: the folder examples/panels is missing" in output
    )


def test_warm_starts_keep_their_matches_for_ten_minutes():
    sim = lv.Simulation(lv.Scene("stack", solver_iterations=4))
    for _ in range(600):
        status, done = sim.state.kernel.run_substeps(240)
        assert (status, done) == (0, 240)
        head = sim.state.head
        assert head[HEAD["contacts"]] == head[HEAD["matches"]] == 24


def test_comparison_of_models_names_the_values_that_a_converter_lost(capsys):
    mujoco = pytest.importorskip("mujoco")
    module = example("compare_models")
    texts = 'frictionloss="0.2" range="-1 1" actuatorfrcrange="-30 30"', 'range="-1 1"'
    source, other = (
        mujoco.MjModel.from_xml_string(module.PENDULUM.format(f'{text} limited="true"'))
        for text in texts
    )
    module.compare(source, other)
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["hinge: friction 0.2, converted 0.0", "hinge: effort 30.0, converted inf"]
    assert not any("damping" in line or "limits" in line for line in lines)
    module.compare(source, source)
    assert "hinge" not in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")  # of osqp
def test_backends_leave_the_path_of_an_arm_alone_and_keep_it_through_lavender(drawn):
    """The bounds of quadratic-programs.md; how far a backend alone goes depends on version and machine."""
    pytest.importorskip("quadprog")
    found = drawn("inverse_kinematics").numbers()
    page = (DOCS / "quadratic-programs.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"leaves quadprog's path by .*?`lavender.qp.solve_qp`", page, re.DOTALL)
    alone, through = (float(number) for number in re.findall(r"([\d.e-]+) rad", text))
    for name, distances in found.items():
        assert distances["alone"].max() > alone, name
        assert distances["lavender"].max() < through, name


def read_left_over(folder):
    """Return the velocities without a cause of the recorded steps [m/s]."""
    return [
        json.loads(line)["left_over"] for line in (folder / "engine.jsonl").read_text().splitlines()
    ]


@pytest.mark.parametrize("engine", ["pybullet", "pymunk", "box2d"])
def test_recording_of_an_engine_has_errors_that_its_iterations_remove(engine, tmp_path):
    """Direction of the normal, positions, v* and position correction are right: a wrong one leaves an error."""
    pytest.importorskip("Box2D" if engine == "box2d" else engine)
    record = example(f"read_{engine}").record
    few, many = (np.array(record(tmp_path / str(n), n)) for n in (10, 500))
    assert len(few) == len(many) == 30
    assert np.median(many) < 0.1 * np.median(few)
    # pymunk's friction exceeds the cone in few steps.
    assert np.median(read_left_over(tmp_path / "10")) < 1e-3 * np.median(few)


@pytest.mark.parametrize(
    "name, package",
    [("rapier", "rapier3d"), ("dart", "dartpy"), ("box3d", "robox3d"), ("jolt", "")],
)
def test_impulses_of_contacts_that_are_read_rightly_explain_the_step_of_an_engine(
    name, package, tmp_path
):
    """With bodies a and b swapped, contacts pull: gravity of a step, 0.16 m/s, is left over."""
    arguments = ()
    if package:
        pytest.importorskip(package)
    else:
        if shutil.which("node") is None or not (EXAMPLES / "node_modules").is_dir():
            pytest.skip("the example steps Jolt in Node")
        command = ["node", str(EXAMPLES / "jolt_step.mjs")]
        run = subprocess.run(command, capture_output=True, text=True, check=True)
        arguments = (tmp_path / "jolt-steps.jsonl",)
        arguments[0].write_text(run.stdout)
    errors = example(f"read_{name}").record(tmp_path / "steps", *arguments)
    assert len(errors) >= 30
    assert np.median(read_left_over(tmp_path / "steps")) < 1e-6  # single precision
    text = (EXAMPLES / f"read_{name}.py").read_text(encoding="utf-8")
    swapped = re.sub(r"builder\.contact\((\s*)a,(\s+)b,", r"builder.contact(\1b,\2a,", text)
    assert swapped != text
    names = {"__name__": "swapped"}
    exec(compile(swapped, f"read_{name}.py", "exec"), names)
    names["record"](tmp_path / "swapped", *arguments)
    assert np.median(read_left_over(tmp_path / "swapped")) > 0.1


@pytest.mark.parametrize("name", sorted(path.stem for path in EXAMPLES.glob("*.py")))
def test_every_example_can_be_imported(name):
    module = example(name)
    assert Path(module.__file__).stem == name and module.__doc__
