"""`python -m benchmarks calibration`: what its tables count."""

import pytest
from click.testing import CliRunner

import lavender as lv
from benchmarks import calibration
from lavender import suite


def sample(relative, motion, law="lcp", structure="stack + redundant"):
    return calibration.Sample(
        "c", law, structure, "pgs", 4, relative, relative, relative / 2, relative, motion, 0.1, motion, motion
    )


def test_factors_are_those_of_the_samples():
    found = [sample(1e-3, 2e-3), sample(1e-3, 4e-3), sample(1e-2, 9e-2, structure="stack")]
    rows = {row.structure: row for row in calibration.calibration(found)}
    assert set(rows) == {"stack", "redundant", "law lcp", "all"}
    assert rows["all"].iterates == 3
    assert rows["all"].median == pytest.approx(4.0)
    assert rows["all"].largest == pytest.approx(9.0)
    assert rows["redundant"].iterates == 2
    names = {name: (median, spread) for name, _, median, spread in calibration.predictors(found)}
    assert names["V / V0 alone"][0] == pytest.approx(2 * names["E / E0 alone"][0])
    assert "median 1" in calibration.table(found)


def test_samples_are_iterates_with_both_errors():
    p = suite.case("stack(n=8)").problem
    found = list(calibration.samples("stack", p, "stack"))
    assert {s.solver for s in found} >= {"pgs", "jacobi"}
    for s in found:
        again = lv.solve(p, s.solver, tol=0.0, max_iter=s.iterations)
        assert again.residual.relative == s.relative
        assert again.motion_error().relative == s.motion
        assert s.relative == max(s.energy, s.velocity)
        assert s.found <= s.bound


def test_the_command_writes_the_table_and_the_figure(tmp_path):
    path = tmp_path / "figure.png"
    args = ["stack(n=8)", "box_stackF(n=2)"]
    result = CliRunner().invoke(calibration.command, [*args, "--figure", str(path)])
    assert result.exit_code == 0, result.output
    assert path.read_bytes().startswith(b"\x89PNG")
    assert "| all |" in result.output
