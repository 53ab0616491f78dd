"""Problems drawn by a seed, that `auto` is tuned and judged on; importing them makes them families of the suite.

    wild     structure, masses, law and form of nine structures
    drawn    seventeen more, half of them for judging alone

A seed gives the same bits in every version: published figures name their seeds.
"""

from lavender.lab.suite.lots.drawn import drawn
from lavender.lab.suite.lots.wild import wild

__all__ = ["drawn", "wild"]
