"""LavenderSim (not PyPI's `lavendersim`): the step loop over the compiled substep, and the problems inside it."""

from lavender.engine.film import Film
from lavender.engine.run import Trace, run, run_scene
from lavender.engine.simulation import SOLVER_FIELDS, Simulation
from lavender.engine.snapshot import Snapshot

__all__ = ["SOLVER_FIELDS", "Film", "Simulation", "Snapshot", "Trace", "run", "run_scene"]
