"""`python -m benchmarks peers`: engines on the same scenes, solvers on the same problems, error beside time.

Everything runs in one go and in turns, and is given as a ratio to ours: times of a machine that others use say
nothing by themselves. What is not installed is named; where another is faster, it is said.
"""

from benchmarks.peers.command import command

__all__ = ["command"]
