"""Coulomb friction by Newton's method: walks on the Alart-Curnier map around De Saxce's interior points.

1. Proximal Newton on that map from the start, as long as it gets anywhere.
2. De Saxce's form of the law (`_newton/desaxce.py`), ended by the proximal Newton; closed loops of joints through the
   augmented system, too.
3. The same walk from the answer of the convex relaxation; then the other shares of phi's derivative; then the first
   walk goes on for what is left of the budget.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lavender._arrays import FloatArray
from lavender.cones import ROW
from lavender.solvers._newton.desaxce import SHARES, apart, solve_desaxce, solve_desaxce_augmented
from lavender.solvers._newton.interior_point import InteriorPoint
from lavender.solvers._newton.proximal import Proximal
from lavender.solvers._newton.run import Run
from lavender.solvers._newton.systems import AUGMENTED, CONVEX

CONVEX_TOL = 1e-4  # of the convex answer that a walk starts from, in energy
CONVEX_STEPS = 30  # that it may cost
STRETCH = 12  # factorisations between two looks at whether a walk gets anywhere
STRETCHES = 1000  # of one walk at most, whatever its budget
WEIGHT = 1e-5  # proximal weight that the first walk begins with (measured: 1e-4 to 1e-7, 2,030 to 2,530 factors of 68)


def solve_coulomb(run: Run, z: FloatArray) -> None:
    """1 to 3, until the judge is content."""
    walk = Proximal(z, AUGMENTED, WEIGHT)
    stages: list[Callable[[], None]] = [
        lambda: _pursue(run, walk),
        lambda: solve_desaxce(run, SHARES[:1]),
        lambda: _loops(run),
        lambda: _from_convex(run),
        lambda: solve_desaxce(run, SHARES[1:]),
        lambda: walk.advance(run),
    ]
    for stage in stages:
        stage()
        if run.done() or run.at_floor():
            return


def _loops(run: Run) -> None:
    """Closed loops of joints: their rows nearly depend on each other."""
    sc = run.system.sc
    first = sc.ptr[:-1][sc.kind == ROW]
    if np.any(np.isinf(sc.lower[first]) & np.isinf(sc.upper[first])):
        solve_desaxce_augmented(run)


def _from_convex(run: Run) -> None:
    system = run.system
    ip, f = InteriorPoint(system), np.empty(system.sc.m)
    start = system.natural_size(np.zeros(system.sc.m), -system.sc.g, CONVEX, f)
    for _ in range(CONVEX_STEPS):
        if run.done() or not ip.step():
            break
        run.count("convex steps")
        run.score(ip.z)
        if system.natural_size(ip.z, system.times(ip.z) - system.sc.g, CONVEX, f) <= CONVEX_TOL * start:
            break
    if not run.done():
        _pursue(run, Proximal(ip.z.copy(), AUGMENTED, 1e-3))


def _pursue(run: Run, method: Proximal) -> None:
    """As long as each stretch halves its residual."""
    last = np.inf
    for _ in range(STRETCHES):
        if run.done() or method.stuck:
            break
        best, _ = apart(run, method, STRETCH)
        if best > 0.5 * last or best == np.inf or run.at_floor():
            break
        last = best
