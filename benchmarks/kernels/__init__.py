"""Kernels and small calls: time, time per unit of work, fraction of the machine's limit.

The time of a case is the smallest CPU time of many short batches (other programs only add time). Sweeps are timed
alternately with their limit: the same mathematics in a bare loop (`microbenchmarks.pyx`, which a build in place
compiles with the kernels' flags).
"""

from benchmarks.kernels.command import command

__all__ = ["command"]
