"""Choose settings of an engine: measured on worlds of a model (`sweep`), and recommended as lines to copy."""

from lavender.lab.tune.measured import Measured, Setting
from lavender.lab.tune.recommendation import Tuning
from lavender.lab.tune.sweep import TUNE_ENGINES, tune

__all__ = ["TUNE_ENGINES", "Measured", "Setting", "Tuning", "tune"]
