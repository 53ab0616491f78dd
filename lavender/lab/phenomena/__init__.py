"""Scenes with known motion, measured in every stepper of LavenderSim and in other engines.

A phenomenon is data: parameters with ranges, an exact motion with its derivation, quantities with bounds. An engine
returns poses over time, from which the quantities are measured, in the same way for all engines.
"""

from lavender.lab.phenomena.engines import ENGINE_VARIANTS, EngineVariant
from lavender.lab.phenomena.parts import Parameter, Phenomenon, Quantity, Record, Track
from lavender.lab.phenomena.running import PHENOMENA, run, select_phenomena, select_variants

__all__ = [
    "ENGINE_VARIANTS",
    "PHENOMENA",
    "EngineVariant",
    "Parameter",
    "Phenomenon",
    "Quantity",
    "Record",
    "Track",
    "run",
    "select_phenomena",
    "select_variants",
]
