"""What `auto` loses against the best of its solvers, what each line of its tree gains, and the rates of its counts.

record    what each solver does alone, turn by turn, and `auto` beside them, in one run
replay    the tree on such records, with a line put in or taken out
"""

from benchmarks.auto.command import command

__all__ = ["command"]
