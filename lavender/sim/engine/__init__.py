"""LavenderSim (not PyPI's `lavendersim`): the step loop over the compiled substep, and its constraint problems."""

from lavender.sim.engine.run import Trace, run
from lavender.sim.engine.simulation import Simulation
from lavender.sim.engine.snapshot import Snapshot
from lavender.sim.engine.values import SOLVER_FIELDS

__all__ = ["SOLVER_FIELDS", "Simulation", "Snapshot", "Trace", "run"]
__dir__ = sorted(__all__).copy  # Completion shows public names only.
