"""Random problems, on which `auto` was tuned and judged, and which tests and benchmarks read.

    wild     structure, masses, law and form of nine structures
    drawn    seventeen more structures, half of them for judging alone

A seed gives the same bits in every version: published figures name their seeds.
"""

from benchmarks.random_families.drawn import drawn
from benchmarks.random_families.wild import wild

__all__ = ["drawn", "wild"]
