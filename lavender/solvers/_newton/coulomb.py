"""Coulomb friction by Newton's method: after sweeps on the Alart-Curnier map, then De Saxce's interior point.

1. Rounds of accelerated sweeps, each ended by a few Newton steps on the Alart-Curnier map (`_newton/sweeping.py`);
   another between any two of the following, which costs as much as all factorisations so far.
2. Proximal Newton on that map, from the start and from the solution of H z = g.
3. Interior points on De Saxce's form of the law (`_newton/desaxce.py`), each ended by the proximal Newton; first
   where the bodies are known, after it where only a matrix is, whose factors cost more.
4. Longer proximal walks from where the interior points ended, with smaller and smaller weights.
"""

from __future__ import annotations

import numpy as np

from lavender._arrays import FloatArray
from lavender.cones import ROW
from lavender.solvers._newton.desaxce import SHARES, apart, solve_desaxce, solve_desaxce_augmented
from lavender.solvers._newton.interior_point import InteriorPoint
from lavender.solvers._newton.proximal import Proximal
from lavender.solvers._newton.run import Run
from lavender.solvers._newton.sweeping import Sweeping
from lavender.solvers._newton.systems import AUGMENTED, CONVEX

ROUNDS = 2  # of sweeps before anything else: one of each kind
FEW = 20  # rows up to which a few factorisations cost less than to prepare sweeps
FIRST, SECOND = 6, 6  # factorisations of the first two walks
CONVEX_TOL = 1e-4  # of the convex answer that a walk starts from, in energy
CONVEX_STEPS = 30  # that it may cost
STRETCH = 12  # factorisations between two looks at whether a walk gets anywhere
STRETCHES = 1000  # of one walk at most, whatever its budget
SMALL, LARGE = 64, 1000  # rows up to which the first proximal weight is smaller, from which it is larger
HEAVY = 1e3  # mass ratio from which the walks are not tried from a cold start
LAST = (1e-6, 1e-7, 1e-8)  # proximal weights of the last walks
CANDIDATES = 2  # ends of interior points from which these start
LONG = 50  # Newton steps of one of their rounds: sticking changes to sliding contact by contact


def solve_coulomb(run: Run, z: FloatArray, cold: bool) -> None:
    """Sweeps, walks from the start, interior points, walks from where they ended; until the judge is content."""
    system = run.system
    m = system.sc.m
    plain = Proximal(z, AUGMENTED, 1e-5 if m <= SMALL else 1e-3 if m < LARGE else 1e-2)
    walks = not (cold and _is_heavy(run))
    sweeping = Sweeping(run, z)
    few = m <= FEW
    if few and walks:
        plain.advance(run, FIRST)
        if run.done() or run.at_floor():
            return
    if any(sweeping.round() for _ in range(ROUNDS)):
        return
    if walks and not few:
        plain.advance(run, FIRST)
        if run.done() or run.at_floor() or sweeping.round():
            return
    ends: list[tuple[float, FloatArray]] = []
    stages = [_interior, _walk] if system.form == "velocity" else [_walk, _interior]
    for stage in stages:
        if stage is _interior or walks:
            stage(run, plain, ends, sweeping)
            if run.done() or run.at_floor() or sweeping.round():
                return
    for share in SHARES[2:]:
        ends += solve_desaxce(run, (share,))
        if run.done() or run.at_floor() or sweeping.round():
            return
    ends.sort(key=lambda end: end[0])
    for _, start in ends[:CANDIDATES]:
        for alpha in LAST:
            if run.done() or run.at_floor():
                return
            walk = Proximal(start.copy(), AUGMENTED, alpha, LONG)
            start = _pursue(run, walk, 0.7)
    if not (run.done() or run.at_floor() or _has_free_rows(run)):
        solve_desaxce_augmented(run)
    if not (run.done() or run.at_floor()):
        plain.advance(run)


def _interior(run: Run, plain: Proximal, ends: list[tuple[float, FloatArray]], sweeping: Sweeping) -> None:
    ends += solve_desaxce(run, SHARES[:1])
    if run.done() or run.at_floor():
        return
    if _has_free_rows(run):
        # Closed loops of joints: their rows nearly depend on each other.
        solve_desaxce_augmented(run)
        if run.done() or run.at_floor():
            return
    if sweeping.round():
        return
    _from_convex(run)
    if run.done() or run.at_floor():
        return
    ends += solve_desaxce(run, SHARES[1:2])


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


def _walk(run: Run, plain: Proximal, ends: list[tuple[float, FloatArray]], sweeping: Sweeping) -> None:
    near = Proximal(InteriorPoint(run.system).everything, AUGMENTED, 1e-4)
    near.advance(run, SECOND)
    for method in (plain, near):
        if run.done() or run.at_floor() or sweeping.round():
            return
        _pursue(run, method)


def _pursue(run: Run, method: Proximal, share: float = 0.5) -> FloatArray:
    # As long as each stretch brings its residual down to a share of the last; its best z.
    last, z = np.inf, method.z
    for _ in range(STRETCHES):
        if run.done() or method.stuck:
            break
        best, own = apart(run, method, STRETCH)
        if best < last:
            z = own
        if best > share * last or best == np.inf or run.at_floor():
            break
        last = best
    return z


def _has_free_rows(run: Run) -> bool:
    sc = run.system.sc
    first = sc.ptr[:-1][sc.kind == ROW]
    return bool(np.any(np.isinf(sc.lower[first]) & np.isinf(sc.upper[first])))


def _is_heavy(run: Run) -> bool:
    rows = run.system.sc.problem.rows
    if rows is None:
        return False
    moving = rows.inv_mass[rows.inv_mass > 0.0]
    return len(moving) > 0 and bool(moving.max() >= HEAVY * float(moving.min()))
