"""Scenes whose motion is known, measured in every stepper and in the engines of others.

Each phenomenon is data: parameters with ranges, a truth with its derivation, quantities with bounds. An engine gives
poses over time, and the measure is taken of them, the same for all.
"""

from lavender.lab.phenomena.engines import WAYS, Way
from lavender.lab.phenomena.parts import Parameter, Phenomenon, Quantity, Record, Track
from lavender.lab.phenomena.running import PHENOMENA, chosen, run, ways

__all__ = [
    "PHENOMENA",
    "WAYS",
    "Parameter",
    "Phenomenon",
    "Quantity",
    "Record",
    "Track",
    "Way",
    "chosen",
    "run",
    "ways",
]
