"""Kernels, small calls and whole jobs: time, time per unit of work, bytes per unit, share of the machine's limit.

Every case is timed beside its limit, in turns, as the least CPU time of many short batches (other programs only
add time). The limit is measured in the same run (`microbenchmarks.pyx`, which a build in place compiles with the
kernels' flags):

    bare     the same mathematics in a loop with nothing else around it
    stream   the bytes that a unit needs at the speed of the memory they fit in

Instructions are counted by valgrind's callgrind where it is asked for and installed.
"""

from benchmarks.kernels.cases import CASES, Row, run, scaling
from benchmarks.kernels.command import command, limits_table, scaling_table, table
from benchmarks.kernels.instructions import COUNTED, counted, instructions
from benchmarks.kernels.limits import FOOTPRINTS, Limit, least, measure_limits, stream_time
from benchmarks.kernels.problems import bare_contacts, contact_bytes, csr_bytes, lattice_pile, tridiagonal

__all__ = [
    "CASES",
    "COUNTED",
    "FOOTPRINTS",
    "Limit",
    "Row",
    "bare_contacts",
    "command",
    "contact_bytes",
    "counted",
    "csr_bytes",
    "instructions",
    "lattice_pile",
    "least",
    "limits_table",
    "measure_limits",
    "run",
    "scaling",
    "scaling_table",
    "stream_time",
    "table",
    "tridiagonal",
]
