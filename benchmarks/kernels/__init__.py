"""Kernels and small calls: time, time per unit of work, share of the machine's limit.

Every case is timed as the least CPU time of many short batches (other programs only add time); sweeps beside their
limit, in turns: the same mathematics in a bare loop with nothing else around it (`microbenchmarks.pyx`, which a build
in place compiles with the kernels' flags). Instructions are counted by valgrind's callgrind where it is asked for and
installed.
"""

from benchmarks.kernels.command import command

__all__ = ["command"]
