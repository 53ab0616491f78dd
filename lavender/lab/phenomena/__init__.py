"""Scenes with known motion, measured in every stepper of LavenderSim and in other engines.

A phenomenon (`Phenomenon`) is a scene with an exact motion, its derivation, parameters with ranges, and quantities
with bounds. An engine returns poses over time. The quantities are computed from them in the same way for all engines.
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
