"""Choose settings of MuJoCo: measured on worlds of a model (`sweep`), and recommended as lines to copy."""

from lavender.audit.settings import MujocoSetting
from lavender.audit.tune.mujoco_settings import Measured
from lavender.audit.tune.recommendation import Tuning
from lavender.audit.tune.sweep import tune

__all__ = ["Measured", "MujocoSetting", "Tuning", "tune"]
