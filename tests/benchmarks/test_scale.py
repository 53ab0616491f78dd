"""`python -m benchmarks scale`: structures of the requested size, regrets and exponents from known times."""

import json

import click
import numpy as np
import pytest
from click.testing import CliRunner

import lavender as lv
from benchmarks import scale
from benchmarks.scale import build_without, command, compute_regret, fit_exponent
from benchmarks.scale_structures import STRUCTURES, build


@pytest.mark.parametrize("name", STRUCTURES)
def test_structure_at_rest_converges_with_about_the_rows_requested(name):
    problem = build(name, 1000)
    assert 500 <= problem.m <= 2000
    solution = lv.solve(problem.relaxed("cone"))
    assert solution.success
    # Every structure carries its weight: the ground receives the impulse of gravity in one step, m g h.
    rows = problem.rows
    mass, gravity = 1.0 / rows.inv_mass, -rows.v_free[:, 2]
    after = problem.velocity(solution.impulse)[:, 2]
    assert np.sum(mass * np.abs(after)) < 0.5 * np.sum(mass * gravity)


def test_structure_with_sliding_and_spread_has_these_speeds_and_masses():
    rest, moved = build("wall", 500), build("wall", 500, sliding=0.5, spread=1.0)
    assert np.allclose(np.hypot(*moved.rows.v_free[:, :2].T), 0.5)
    factor = rest.rows.inv_mass / moved.rows.inv_mass
    assert 0.5 < np.std(np.log(factor)) < 1.5  # about 15 bodies
    assert np.allclose(rest.rows.inv_inertia, moved.rows.inv_inertia * factor[:, None, None])


def test_regret_is_the_ratio_to_the_fastest_that_solved():
    def run(time, solved):
        return {"time": time, "solved": solved}

    line = {"runs": {"auto": run(3.0, True), "newton": run(2.0, True), "admm": run(1.0, False)}}
    assert compute_regret(line) == (1.5, "newton")
    line["runs"]["auto"]["solved"] = False
    assert np.isnan(compute_regret(line)[0])


def test_bench_scale_exponent_of_a_power_law_is_its_power():
    rows = np.array([3e3, 1e4, 1e5])
    assert abs(fit_exponent(rows, 2e-6 * rows**1.25) - 1.25) < 1e-12  # rounding of logarithms


@pytest.mark.parametrize(
    ("arguments", "structure"),
    [
        (["--structures", "pile", "--rows", "300", "--sliding", "0", "--spread", "0"], "pile"),
        (["--case", "granularF(n=3, sliding=0.5)"], "granularF(n=3, sliding=0.5)"),
    ],
)
def test_command_measures_auto_and_a_mix_and_writes_what_it_measured(tmp_path, arguments, structure):
    out = tmp_path / "scale.json"
    mix = ["--solvers", "sweeps, relaxed then exact", "--out", str(out)]
    done = CliRunner().invoke(command, [*arguments, *mix])
    assert done.exit_code == 0, done.output
    (line,) = json.loads(out.read_text())["lines"]
    assert line["structure"] == structure
    assert line["sliding"] == (0.5 if "sliding=0.5" in structure else 0.0)
    assert set(line["runs"]) == {"auto", "sweeps, relaxed then exact"}
    for found in line["runs"].values():
        assert found["solved"] == (found["residual"] <= 1e-6)
        assert found["time"] > 0.0
    assert line["runs"]["auto"]["solved"]


def test_command_reads_measurements_prints_their_exponent_and_draws_them(tmp_path):
    def line(m, sliding, time, solved):
        auto = {"time": time, "memory": 1.0, "residual": 1e-7 if solved else 1e-3, "solved": solved, "work": {}}
        runs = {"auto": auto, "newton": auto | {"time": 2.0 * time, "solved": True}}
        return {"structure": "wall", "m": m, "sliding": sliding, "spread": 0.0, "seed": 7, "runs": runs}

    written, figure = tmp_path / "scale.json", tmp_path / "scale.png"
    rest = [line(m, 0.0, 1e-6 * m**1.5, True) for m in (3_000, 10_000, 30_000)]
    written.write_text(json.dumps({"lines": [*rest, line(3_000, 0.5, 5.0, False)]}))
    done = CliRunner().invoke(command, ["--from", str(written), "--figure", str(figure)])
    assert done.exit_code == 0, done.output
    assert "| wall | 0 | 3000 | 30000 | 1.50 | 0 |" in done.output
    assert "median 0.50, worst 0.50; 1 of 4 problems not solved by auto" in done.output
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_copy_without_a_state_begins_no_phase_in_it(tmp_path, monkeypatch):
    root = tmp_path / "checkout"
    plan = root / scale.PLAN
    plan.parent.mkdir(parents=True)
    plan.write_text((scale.ROOT / scale.PLAN).read_text())
    (root / "setup.py").write_text("")
    monkeypatch.setattr(scale, "ROOT", root)
    name, _, copy, contestant = build_without("FIRST_FLOW", tmp_path)
    changed = [line for line in (copy / scale.PLAN).read_text().splitlines() if line not in plan.read_text()]
    assert (name, contestant, changed) == (
        "newton without FIRST_FLOW",
        "newton",
        ["        pass", "    elif state < 0:"],
    )
    with pytest.raises(click.BadParameter, match="COULOMB_END"):
        build_without("DE_SAXCE_END", tmp_path)
