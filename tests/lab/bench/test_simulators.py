"""Our Newton beside MuJoCo's on models of one's own: the command, its table, and what is left out."""

import pytest

from lavender.lab.bench import simulators
from lavender.lab.report import simulators as tables

mj = pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'lavender-contact[peers]'")


def test_both_sides_solve_every_step_to_the_same_residual(boxes):
    steps = simulators.measure_model(mj, boxes(), 3, 10)
    assert len(steps) == 3
    for s in steps:
        assert s.model == "boxes"
        assert s.rows > 0
        assert max(s.residual, s.engine_residual) <= simulators.TARGET_RESIDUAL
        assert s.strict <= simulators.STRICT_RESIDUAL
        assert min(s.engine, s.ours, s.many, s.prepared, s.imported) > 0.0


def test_ratios_are_geometric_means_by_the_number_of_rows():
    def step(rows, engine, ours, tolerance=1e-8):
        return simulators.Step(
            "m", 0, rows, engine, ours, 0.0, 0.0, nv=3, law="lcp", tolerance=tolerance, many=ours / 2, prepared=ours,
            imported=3.0 * ours, strict=0.0,
            coulomb=None,
        )  # fmt: skip

    text = tables.format_time_ratio_table(
        [step(4, 1e-6, 2e-6), step(5, 1e-6, 8e-6), step(400, 1e-3, 5e-4, 0.0)]
    )
    assert "| under 10 | 1 | 2 | 1.0 | 4.00 | 4.00 | 2.00 | 12.00 |" in text
    assert "| 300 and more | 1 | 1 | 1000.0 | 0.50 | 0.50 | 0.25 | 1.50 |" in text
    assert "1 are not solved to" in text
