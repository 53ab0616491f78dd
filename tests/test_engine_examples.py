"""The engine's examples run, and the relations that they show hold."""

import importlib.util
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parent.parent / "examples"


def example(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["engine_sweeps", "engine_warm_start", "two_particles", "all_rows"])
def test_prints_its_numbers_and_saves_its_figure(name, tmp_path, capsys):
    path = tmp_path / "figure.png"
    example(name).main(str(path))
    assert path.read_bytes().startswith(b"\x89PNG")
    assert str(path) in capsys.readouterr().out


def test_more_sweeps_help_in_the_first_solve_and_in_the_run():
    found = example("engine_sweeps").numbers()
    for name in ("bottom_up", "top_down", "friction"):
        assert all(b < a for a, b in pairwise(found[name]))
    # The law of six unit boxes on 24 points, to its three digits.
    assert found["bottom_up"][0] / found["bottom_up"][-1] == pytest.approx(32.1, abs=0.06)
    assert found["top_down"][0] / found["top_down"][-1] == pytest.approx(46.1, abs=0.06)
    assert 20 < found["friction"][0] / found["friction"][-1] < 50
    for column in found["run"].T:
        assert all(b < a for a, b in pairwise(column))
    # A cold solve of few sweeps must carry the weight, so the run is further off than the first solve.
    assert found["run"][0, 0] > 2 * found["bottom_up"][0]
    assert found["run"][-1, 0] == pytest.approx(found["bottom_up"][-1], rel=0.25)


def test_warm_starts_begin_closer_and_are_missed_when_switched_off():
    module = example("engine_warm_start")
    found = module.numbers()
    initial = {k: module.column(v[0], "residual_initial") for k, v in found.items()}
    matches = {k: module.column(v[0], "cache_matches") for k, v in found.items()}
    assert np.all(matches["warm"][1:] == 24) and np.all(matches["cold"] == 0)
    assert np.median(initial["cold"][20:90]) > 30 * np.median(initial["warm"][20:90])
    at = module.SWITCH
    np.testing.assert_array_equal(found["switched off"][0][:at], found["warm"][0][:at])
    assert np.all(matches["switched off"][at:] == 0)
    assert initial["switched off"][at] > 30 * initial["switched off"][at - 1]
    # The judge over all rows sees the same: without friction they are the normal rows.
    for _, relative, share in found.values():
        assert np.all(share[relative > 0] == pytest.approx(1.0))
    medians = {k: np.median(v[1][20:90]) for k, v in found.items()}
    assert medians["cold"] > 30 * medians["warm"]


def test_two_particles_agree_with_the_closed_form():
    module = example("two_particles")
    found = module.numbers()
    assert found["impulse"] == pytest.approx(-1.5, rel=1e-15)  # -2 m/s over 4/3 kg^-1
    assert found["engine"] == pytest.approx(found["impulse"], rel=1e-15)
    assert found["problem"].m == 1 and found["problem"].law == "linear"
    assert found["problem"].row_name(0) == "distance 0"
    assert found["after"][0, 0] == found["after"][1, 0] == pytest.approx(1.5, rel=1e-15)
    # A substep turns the pair by 1/240 rad: (1/240)^2 / 2 of 1 m, a fifth of the error removed each time.
    assert np.abs(found["apart"] - 1.0).max() < 5 * 0.5 / 240**2
    np.testing.assert_allclose(
        found["momentum"], np.tile(module.MASS @ module.SPEED, (module.STEPS, 1)), atol=1e-12
    )


def test_the_judge_sees_what_the_normals_do_not():
    module = example("all_rows")
    found = module.numbers()
    bridge, pile = found["bridge"], found["pile"]
    touching = bridge["normals"] > 0.0
    # With the load on the planks: normals at 5e-4 N s and less, half of the error left, and all of it in the hinges.
    assert touching.sum() > 20
    assert np.median(bridge["normals"][touching]) < 5e-4
    assert np.median(bridge["relative"]) > 0.2
    assert bridge["shares"][20:, module.KINDS.index("joint")].min() > 0.9
    assert all(name.startswith("hinge ") for name in bridge["worst"][20:])
    disk = pile["shares"][:, module.KINDS.index("disk")]
    assert disk.max() > 0.4 and np.median(disk[20:]) > 0.1
    np.testing.assert_allclose(bridge["shares"][1:].sum(axis=1), 1.0, rtol=1e-12)


def test_lavender_run_shows_a_line_and_writes_what_was_asked_for(tmp_path, capsys):
    from lavender.cli import main
    from lavender.io import load

    paths = [tmp_path / name for name in ("trace.csv", "figure.svg", "problems")]
    words = [
        "run",
        "stack",
        "--iterations",
        "8",
        "--no-warm-start",
        "--steps",
        "12",
        "--set",
        "n=2",
        "--residual",
    ]
    files = ["--trace", paths[0], "--plot", paths[1], "--record", paths[2], "--skip", "9"]
    with pytest.raises(SystemExit) as code:
        main([*words, *map(str, files)])
    assert not code.value.code
    printed = capsys.readouterr().out
    assert "step     12" in printed and "contacts     8  matches     0" in printed and "worst" in printed
    table = np.genfromtxt(paths[0], delimiter=",", names=True)
    assert table.shape == (12,) and np.all(table["iterations"] == 8) and np.all(table["contacts"] == 8)
    assert table["residual_final"].max() < table["residual_initial"].max()
    assert paths[1].read_text().lstrip().startswith("<?xml")
    assert [load(p).n_blocks for p in sorted(paths[2].iterdir())] == [8, 8, 8]


@pytest.mark.parametrize(
    "words",
    [
        ["run", "stac"],
        ["run", "stack", "--set", "n"],
        ["run", "stack", "--set", "mu=1"],
        ["run", "stack", "--iterations", "3"],
    ],
)
def test_lavender_run_refuses_what_it_cannot_do(words, capsys):
    from lavender.cli import main

    with pytest.raises(SystemExit) as code:
        main(words)
    assert code.value.code == 2
    assert "Traceback" not in capsys.readouterr().err
