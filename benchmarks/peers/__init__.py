"""Engines of others on the same scenes, solvers of others on the same problems: error beside time.

`engines.measure_scene` steps a scene in each engine that is installed, `race.race` gives problems to the contestants
of `adapters`, both in turns. Times of a machine that others use say nothing by
themselves: ratios to ours do.
"""

from benchmarks.peers.command import command

__all__ = ["command"]
