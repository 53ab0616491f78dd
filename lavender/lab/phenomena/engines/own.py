"""LavenderSim with the stepper of the scene's parameters."""

from __future__ import annotations

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.lab.phenomena.engines import Stepping
from lavender.sim.engine import Simulation
from lavender.sim.scene import Scene


class Engine(Stepping):
    """Engine that steps a scene with `Simulation.step`."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.sim = scene, Simulation(scene)
        p = scene.parameters
        self.dt, self.substep = p.dt, p.dt / p.substeps
        self.observation = self.sim.reset()[0]
        work = f"{self.sim.solver_iterations} sweeps" if p.solver == "sequential_impulses" else p.solver
        self.setting = f"{1e3 * p.dt:.3g} ms in {p.substeps} of {work}"
        self.has_ended = False

    def step(self) -> None:
        """See `Stepping.step`; after a body is lost, the state no longer changes."""
        if not self.has_ended:
            self.observation, _, self.has_ended, _, _ = self.sim.step()

    def get_state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Stepping.get_state`."""
        return self.observation["positions"], self.observation["quaternions"], self.observation["velocities"]

    def measure_last_step(self) -> tuple[int, float, float]:
        """See `Stepping.measure_last_step`."""
        gap = np.abs(self.sim.state.a["joint_error"]).max(initial=0.0)
        depth = max(self.observation["contacts"]["depth"].max(initial=0.0), gap)
        return int(self.observation["solver"][2]), float(depth), float(self.sim.residual()["relative"])

    def get_joint_force(self) -> float:
        """See `Stepping.get_joint_force`; the first joint must be a ball joint with three rows."""
        rows = self.observation["joint_impulses"][:3]
        return float(np.linalg.norm(rows)) / self.substep if len(rows) == 3 else float("nan")
