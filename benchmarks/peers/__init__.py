"""Other engines on the same scenes, other solvers on the same problems: time and error.

`engines.measure_scene` steps a scene in each installed engine, `race.race` gives problems to the contestants of
`adapters`; both alternate between contestants. On a shared machine only ratios of times are meaningful.
"""

from benchmarks.peers.command import command

__all__ = ["command"]
