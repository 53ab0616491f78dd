"""LavenderSim as an engine of the comparison."""

from __future__ import annotations

import numpy as np

from benchmarks.engines import Stepping
from lavender.base.arrays import FloatArray
from lavender.sim.engine import Simulation
from lavender.sim.scene import Scene


class Engine(Stepping):
    """Engine that steps a scene with `Simulation.step`."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.sim = Simulation(scene)
        self.dt = scene.parameters.dt
        self.observation = self.sim.reset()[0]
        self.has_ended = False

    def step(self) -> None:
        """See `Stepping.step`; after a body is lost, the state no longer changes."""
        if not self.has_ended:
            self.observation, _, self.has_ended, _, _ = self.sim.step()

    def get_state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Stepping.get_state`."""
        return (
            self.observation["positions"],
            self.observation["quaternions"],
            self.observation["velocities"],
        )

    def measure_last_step(self) -> tuple[int, float, float]:
        """See `Stepping.measure_last_step`."""
        gap = np.abs(self.sim.state.a["joint_error"]).max(initial=0.0)
        depth = max(self.observation["contacts"]["depth"].max(initial=0.0), gap)
        return (
            int(self.observation["solver"][2]),
            float(depth),
            float(self.sim.residual()["relative"]),
        )
