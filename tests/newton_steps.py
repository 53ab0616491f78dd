"""A scene stepped by the solve that a browser has of `newton`: `lavender_ext.engine.newton_substep` on its arrays."""

import numpy as np

import lavender as lv
from lavender.sim.engine.layout import HEAD, SETTING
from lavender.sim.engine.stepping import TOL
from lavender_ext.engine.newton_substep import Substep

OK, NEED_CAPACITY = 0, 1


class NewtonSteps:
    """`step` after `step`; how each solve ended is in `ended` (0: short of tol), the last answer in `told`."""

    def __init__(self, name, *, warm_start=True, tol=TOL, **parameters):
        scene = lv.Scene(
            name, solver="newton", warm_start=warm_start, solver_iterations=16, **parameters
        )
        self.simulation = lv.Simulation(scene)
        self.substeps = scene.parameters.substeps
        self.tol = tol
        self.ended = []
        self.told = None
        self.trace = None
        self._take(self.simulation.state)

    def _take(self, state):
        self.state = state
        self.solver = Substep(state.size, state.real, state.index, state.keys, True)

    def step(self):
        """One step; the eight values of the solver after it."""
        for _ in range(self.substeps):
            while self.state.kernel.prepare_substep() == NEED_CAPACITY:
                self._take(self.state.with_larger_buffers())
            self.state.kernel.solve(False)
            self.told = self.solver.solve(self.tol)
            self.ended.append(self.told[0])
            self.trace = self.solver.trace
            assert self.state.kernel.finish_substep() == OK
        return self.values()

    def values(self):
        return self.state.a["setting"][SETTING["out"] : SETTING["out"] + 8].copy()

    def set_warm_start(self, flag):
        self.state.head[HEAD["warm_start"]] = bool(flag)

    def bodies(self):
        """Poses and velocities as the recordings have them."""
        return np.concatenate([self.state.a[key].ravel() for key in ("x", "q", "v")])

    def everything(self):
        return self.state.real.tobytes() + self.state.index.tobytes() + self.state.keys.tobytes()
