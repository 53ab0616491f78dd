"""What `auto` loses against the best of our own solvers, and the rates of its cost model.

regret    `auto` beside every other solver of ours, timed in turn
curves    what each candidate of `auto` does alone, turn by turn
replay    the schedule of `auto` on such curves, by other rates too
rates     least squares of the rates on such curves
"""

from benchmarks.auto.command import command

__all__ = ["command"]
