"""Scenes whose motion is known, measured in every stepper and in the engines of others.

Each phenomenon is data: parameters with ranges, a truth with its derivation, quantities with bounds. An engine gives
poses over time, and the measure is taken of them, the same for all.
"""

from lavender.lab.phenomena.engines import ENGINE_VARIANTS, EngineVariant
from lavender.lab.phenomena.parts import Parameter, Phenomenon, Quantity, Record, Track
from lavender.lab.phenomena.running import PHENOMENA, chosen, run, select_variants

__all__ = [
    "ENGINE_VARIANTS",
    "PHENOMENA",
    "EngineVariant",
    "Parameter",
    "Phenomenon",
    "Quantity",
    "Record",
    "Track",
    "chosen",
    "run",
    "select_variants",
]
