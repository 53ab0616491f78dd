"""A cold interior point: Mehrotra's predictor-corrector on the scaled problem, for every convex law."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from lavender._arrays import FloatArray
from lavender.cones import ROW
from lavender.solvers._newton.systems import DAMPING, DELTA, System

START = 1e-6  # W of the first point: nearly H z = g
DUAL_START = 0.01  # size of the first duals, relative to the first impulses (measured: 0.001 to 1)
MARGIN = 0.1  # distance of a first point from its cones' boundaries, of mean sizes (measured: 0.03 to 1)


@dataclass
class InteriorPoint:
    """Iterates of a Mehrotra predictor-corrector; `step()` takes one, `z` is the current point."""

    compiled: ClassVar[bool] = True  # the system's compiled steps are its own

    system: System
    delta: float = DELTA
    apart: bool = False  # the first point leaves each boundary by what that one needs, not all by the worst
    z: FloatArray = field(init=False)
    everything: FloatArray = field(init=False)
    gap: float = field(init=False, default=np.inf)  # G z . u / degree
    lowest_gap: float = field(init=False, default=np.inf)  # before this step
    first_gap: float = field(init=False, default=0.0)
    length: float = field(init=False, default=1.0)
    error: tuple[float, float] | None = field(init=False, default=None)  # of z, where a step has it anyway

    def __post_init__(self) -> None:
        sy, sc = self.system, self.system.sc
        m = sc.m
        self.u1, self.u2 = np.zeros(m), np.zeros(m)
        self.inner: Any = sy.interior(self.u1, self.u2, self.delta) if self.compiled else None
        if self.inner is not None:
            sy.factorisations += 1
            self.inner.first(START, DELTA)
            self.z = self.inner.z
            self.everything = self.z.copy()
            self.degree = self.inner.begin(MARGIN if self.apart else DUAL_START, self.apart)
            return
        size = np.diff(sc.ptr)
        free = (
            (sc.kind == ROW) & np.isinf(sc.lower[sc.ptr[:-1]]) & np.isinf(sc.upper[sc.ptr[:-1]])
            if m
            else np.zeros(0, bool)
        )
        diagonal = np.repeat(sc.wptr[:-1], size) + (np.arange(m) - np.repeat(sc.ptr[:-1], size)) * (
            np.repeat(size, size) + 1
        )
        sy.v[:] = 0.0
        sy.v[diagonal] = 1.0 / (sc.theta + np.where(np.repeat(free, size), DELTA, START))
        if sy.bt is not None:
            sy.bt[:] = np.sqrt(sy.v)
        self.t1, self.t2, self.r = np.zeros(m), np.zeros(m), np.zeros(m)
        sy.factor_barrier()
        self.z = sy.solve_barrier(sc.g)
        self.everything = self.z.copy()  # nearly H z = g on every row: where all of them hold, the answer
        shift = MARGIN if self.apart else DUAL_START
        self.degree = sy.elements.start(sy.times(self.z), shift, self.z, self.u1, self.u2, self.apart)

    def step(self) -> bool:
        """One predictor-corrector step; False where the factorisation or the step fails."""
        sy, sc, e = self.system, self.system.sc, self.system.elements
        if self.inner is not None:
            sy.factorisations += 1
            went, self.length, mu, energy, velocity = self.inner.step()
            self.error = energy, velocity
            self.lowest_gap = min(self.lowest_gap, self.gap)
            self.gap = mu
            self.first_gap = max(self.first_gap, mu)
            return went
        z, u1, u2 = self.z, self.u1, self.u2
        hz = sy.times(z)
        gap = e.scale(z, u1, u2, self.delta, sy.v, sy.bt)
        if not sy.factor_barrier() and not np.isfinite(gap):
            return False
        da = sy.solve_barrier(sc.g - hz)
        mu = gap / max(self.degree, 1.0)
        if self.degree > 0:
            _, after = e.affine(z, u1, u2, da)
            sigma = min(1.0, max(after / gap, 0.0)) ** 3 if gap > 0 else 0.0
        else:
            sigma = 0.0
        e.rhs(z, u1, u2, hz, da, sigma * mu, self.r)
        dz = sy.solve_barrier(self.r)
        if not np.isfinite(dz).all():
            return False
        self.length = e.step(z, u1, u2, dz, da, sigma * mu, DAMPING, self.t1, self.t2)
        self.lowest_gap = min(self.lowest_gap, self.gap)
        self.gap = mu
        self.first_gap = max(self.first_gap, mu)
        return self.length > 0.0
