"""`python -m benchmarks scale`: structures of the requested size, regrets and exponents from known times."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

import lavender as lv
from benchmarks.scale import command, compute_regret, fit_exponent
from benchmarks.scale_structures import STRUCTURES, build


@pytest.mark.parametrize("name", STRUCTURES)
def test_structure_at_rest_converges_with_about_the_rows_requested(name):
    problem = build(name, 1000)
    assert 500 <= problem.m <= 2000
    solution = lv.solve(problem.relaxed("cone"))
    assert solution.success
    # Every structure carries its weight: the ground receives the impulse of gravity in one step, m g h.
    rows = problem.rows
    mass = 1.0 / rows.inv_mass
    gravity = -rows.v_free[:, 2]
    after = problem.velocity(solution.impulse)[:, 2]
    assert np.sum(mass * np.abs(after)) < 0.5 * np.sum(mass * gravity)


def test_structure_with_sliding_and_spread_has_these_speeds_and_masses():
    rest = build("wall", 500)
    moved = build("wall", 500, sliding=0.5, spread=1.0)
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
def test_command_measures_auto_and_a_mix_and_writes_what_it_measured(
    tmp_path, arguments, structure
):
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
