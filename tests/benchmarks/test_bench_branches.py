"""`python -m benchmarks branches`: which motion a warm-started engine is on."""

import math

from benchmarks import branches


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
