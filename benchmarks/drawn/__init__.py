"""Problems drawn by a seed, that `auto` is tuned and judged on; importing them makes them families of the suite.

    wild          structure, masses, law and form of nine structures
    foreign       fourteen structures that `wild` has not, half of them for judging alone
    foreign_new   ten more of the same kind
    drawn         twelve more

A seed gives the same bits in every version: published figures name their seeds.
"""

from benchmarks.drawn.drawn import drawn
from benchmarks.drawn.foreign import foreign
from benchmarks.drawn.foreign_new import foreign_new
from benchmarks.drawn.wild import wild

__all__ = ["drawn", "foreign", "foreign_new", "wild"]
