"""LavenderSim with a stepper; the scene says which."""

from __future__ import annotations

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.lab.phenomena.engines import Stepping
from lavender.sim.engine import Simulation
from lavender.sim.scene import Scene


class Engine(Stepping):
    """`Simulation.step` with its observation."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.sim = scene, Simulation(scene)
        p = scene.parameters
        self.dt, self.substep = p.dt, p.dt / p.substeps
        self.seen = self.sim.reset()[0]
        work = f"{self.sim.solver_iterations} sweeps" if p.solver == "sequential_impulses" else p.solver
        self.setting = f"{1e3 * p.dt:.3g} ms in {p.substeps} of {work}"
        self.over = False

    def step(self) -> None:
        """See `Stepping.step`; after a body was lost nothing follows."""
        if not self.over:
            self.seen, _, self.over, _, _ = self.sim.step()

    def state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Stepping.state`."""
        return self.seen["positions"], self.seen["quaternions"], self.seen["velocities"]

    def left(self) -> tuple[int, float, float]:
        """See `Stepping.left`."""
        gap = np.abs(self.sim.state.a["joint_error"]).max(initial=0.0)
        depth = max(self.seen["contacts"]["depth"].max(initial=0.0), gap)
        return int(self.seen["solver"][2]), float(depth), float(self.sim.residual()["relative"])

    def force(self) -> float:
        """See `Stepping.force`; the first joint is a ball's three rows."""
        rows = self.seen["joint_impulses"][:3]
        return float(np.linalg.norm(rows)) / self.substep if len(rows) == 3 else float("nan")
