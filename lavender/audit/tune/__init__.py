"""Choose settings of an engine: measured on worlds of a model (`sweep`), and recommended as lines to copy."""

from lavender.audit.settings import Setting
from lavender.audit.tune.measured import Measured
from lavender.audit.tune.recommendation import Tuning
from lavender.audit.tune.sweep import TUNE_ENGINES, tune

__all__ = ["TUNE_ENGINES", "Measured", "Setting", "Tuning", "tune"]
