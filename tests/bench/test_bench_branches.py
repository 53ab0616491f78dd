"""`python -m benchmarks branches`: which motion a warm-started engine is on."""

import math
from dataclasses import replace

import numpy as np

from benchmarks import branches
from benchmarks.branches import table


def crossing(run="a", motions=2, **words):
    values = {"warm": "nearest", "cold": "another", "newton": "another", **words}
    return branches.Crossing(
        run=run,
        step=0,
        rows=9,
        motions=motions,
        spread=0.1 * (motions > 1),
        unique="",
        nearest=0.1,
        warm_distance=0.1,
        cold_distance=0.2,
        newton_distance=0.3,
        **(values if motions > 1 else dict.fromkeys(values, "")),
    )


def test_the_table_counts_steps_with_several_motions_alone():
    text = table([crossing(), crossing(warm="another"), crossing(motions=1), crossing("b", 1)])
    assert "| a | 3 | 0 | 2 | 0.1, 0.1 m/s | 1 of 2 | 0 of 2 | 0 of 2 | 1 |" in text
    assert "| b | 1 | 0 | 0 |" in text
    assert "| all | 4 | 0 | 2 |" in text
    assert "| 0.1 | 0.1 | 0.2 | 0.3 |" in text
    lost = replace(crossing(), warm="", warm_distance=math.nan)
    assert "|  | 0 of 1 | 0 of 1 | 0 |" in table([lost])  # sweeps that led to no solution do not count


def test_bodies_are_pushed_sideways_each_in_a_direction_of_its_own():
    scene = branches.pushed("stack", 2.0, n=3)
    v = np.array([b.velocity for b in scene.bodies if not b.is_static])
    assert np.allclose(np.linalg.norm(v, axis=1), 2.0)
    assert np.all(v[:, 2] == 0.0)
    assert len(np.unique(v.round(9), axis=0)) == 3


def test_a_run_tells_where_each_way_leads():
    """The pyramid that bodies are pushed apart in has several motions at its first steps."""
    found = branches.follow("pyramid", 2.0, base=4, steps=9, every=4)
    assert [one.step for one in found] == [0, 4, 8][-len(found) :]
    several = [one for one in found if one.motions > 1]
    assert several
    for one in several:
        assert one.spread > 0.0
        assert {one.warm, one.cold, one.newton} <= {"nearest", "another", ""}
        assert (
            one.nearest
            <= min(
                d for d in (one.warm_distance, one.cold_distance, one.newton_distance) if not math.isnan(d)
            )
            * 1.5
            + one.spread
        )  # nearest in energy, told in m/s
