"""Stops before convergence planted in a float32 Newton over steps of robots, and what the judge says of them.

Two Newton's methods of this file alone, all of them in float32, on bounded soft rows (pyramidal friction).
**velocities** goes over x = v+ - v* and reads impulses off it, as engines do:

    min 1/2 x.M x + sum s_i(y_i),   y = J x - b,   lambda_i = -s_i'(y_i) = clip(-y_i / theta_i, lower, upper)      (1)

**impulses** solves for lambda on the rows that are off their bounds, and chooses these anew. Each runs to its end, the
first far past it: the last iterate is the answer **at the floor**. An iterate is **unfinished** where its impulse
(|lambda - lambda*|_A, lambda* by the first in float64) is ten times further off than any of the last ten (of impulses:
than the last). The judge sees the impulse alone and says which is which. The planted stops are unfinished iterates, one
drawn from each step, and last steps of which a line search left a share out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.errors import InputError
from lavender.judge.residuals import Residual, is_solved_by_zero, residual
from lavender.problem import Problem
from lavender.problem.cones import ROW

ITERATIONS = 30  # of Newton, twice and more what any step here takes
LAST = 10  # iterates in which nothing comes nearer any more
FURTHER = 10.0  # than the worst of these: unfinished
LEFT_OUT = (1e-1, 1e-2, 1e-3)  # share of the way of a last step that a line search left out
CUT = "iterations cut"
FLOOR = "run to its end"

Iterate = tuple[Any, Any]  # x (nv,) and lambda (m,)


@dataclass(frozen=True)
class Stop:
    """One answer and what the judge says of it."""

    step: str
    kind: str  # FLOOR, CUT, or "x of the last step left out"
    relative: float  # -
    floor: float  # -, of float32
    verdict: str


def _rows(problem: Problem, number: type) -> tuple[Any, Any, Any]:
    """theta, lower, upper (m,); a normal without friction is a row from 0 up."""
    c = problem.cones
    normal = np.repeat(c.kind != ROW, np.diff(c.ptr))
    if np.any(np.diff(c.ptr)[c.kind != ROW] > 1):
        raise InputError(f"{problem.name}: friction cones; bounded rows are needed (pyramidal cones)")
    given = (problem.compliance, np.where(normal, 0.0, c.lower), np.where(normal, np.inf, c.upper))
    theta, lower, upper = (np.asarray(x).astype(number) for x in given)
    return theta, lower, upper


def _impulse(y: Any, theta: Any, lower: Any, upper: Any) -> Any:
    return np.minimum(np.maximum(-y / theta, lower), upper)  # (1)


def newton(problem: Problem, number: type, iterations: int = ITERATIONS) -> list[Iterate]:
    """Iterates of Newton's method on (1), every operation in `number`."""
    general = problem.generalized
    if general is None or np.any(problem.compliance == 0.0):
        raise InputError(f"{problem.name}: J, M and soft rows are needed")
    jac, mass = (x.toarray().astype(number) for x in (general.jac, general.mass))
    b, (theta, lower, upper) = problem.b.astype(number), _rows(problem, number)
    x, out = np.zeros(general.nv, number), []
    for _ in range(iterations):
        y = jac @ x - b
        impulse = _impulse(y, theta, lower, upper)
        out.append((x, impulse))
        bent = (-y / theta > lower) & (-y / theta < upper)
        hessian = mass + jac[bent].T @ (jac[bent] / theta[bent, None])
        step = np.linalg.solve(hessian, jac.T @ impulse - mass @ x)
        x = x + _length(x, step, mass, jac, y, (theta, lower, upper), number) * step
    return out


def _length(x: Any, step: Any, mass: Any, jac: Any, y: Any, rows: Any, number: type) -> Any:
    """Where the slope of (1) along the step vanishes, by bisection."""
    along, push = jac @ step, mass @ step
    slope, bend = x @ push, step @ push

    def rises(t: Any) -> bool:
        return bool(slope + t * bend > _impulse(y + t * along, *rows) @ along)

    low, high = number(0), number(1)
    if not rises(high * number(1.001)):
        return high
    for _ in range(24):  # bits of float32
        middle = number(0.5) * (low + high)
        low, high = (low, middle) if rises(middle) else (middle, high)
    return low if rises(number(0.999)) else number(1)


def exchange(problem: Problem, iterations: int = 40) -> list[Any]:
    """Iterates lambda (m,) of Newton on impulses in float32: the rows off their bounds are solved, then chosen anew."""
    a, b, d = (np.asarray(x).astype(np.float32) for x in (problem.dense(), problem.b, problem.d))
    _, lower, upper = _rows(problem, np.float32)
    impulse, out, seen = problem.start().astype(np.float32), [], set()
    for _ in range(iterations):
        out.append(impulse)
        moved = impulse - (a @ impulse - b) / d
        free = (moved > lower) & (moved < upper)
        chosen = free.tobytes() + (moved >= upper).tobytes()
        if chosen in seen:
            break
        seen.add(chosen)
        impulse = np.where(moved <= lower, lower, np.where(moved >= upper, upper, np.float32(0)))
        fixed = a[np.ix_(free, ~free)] @ impulse[~free]
        impulse[free] = np.linalg.solve(a[np.ix_(free, free)], b[free] - fixed)
    return out


def planted(problem: Problem, rng: np.random.Generator) -> list[Stop]:
    """Answers at their floor, unfinished iterates, and last steps cut short; nothing where there is nothing to do."""
    if problem.m == 0 or is_solved_by_zero(problem):
        return []
    found, exact = newton(problem, np.float32), newton(problem, np.float64)[-1][1]
    impulses = [impulse for _, impulse in found]
    out = [_judged(problem, f"velocities: {FLOOR}", impulses[-1])]
    unfinished = _unfinished(problem, impulses, exact, LAST)
    if unfinished:
        out.append(_judged(problem, f"velocities: {CUT}", impulses[rng.choice(unfinished)]))
        before, end = found[unfinished[-1]][0], found[-1][0]
        rows, general = _rows(problem, np.float32), problem.generalized
        assert general is not None
        for share in LEFT_OUT:
            x = end + np.float32(share) * (before - end)
            y = general.jac.astype(np.float32) @ x - problem.b.astype(np.float32)
            out.append(
                _judged(problem, f"velocities: {share:g} of the last step left out", _impulse(y, *rows))
            )
    impulses = exchange(problem)
    out.append(_judged(problem, f"impulses: {FLOOR}", impulses[-1]))
    unfinished = _unfinished(problem, impulses, exact, 1)
    if unfinished:
        out.append(_judged(problem, f"impulses: {CUT}", impulses[rng.choice(unfinished)]))
    return out


def _unfinished(problem: Problem, impulses: Sequence[Any], exact: Any, last: int) -> list[int]:
    """Iterates that are further off than ten times any of the last ones, in |.|_A."""
    off = [float(np.sqrt(max(0.0, (x - exact) @ (problem.csr @ (x - exact))))) for x in impulses]
    return [k for k, e in enumerate(off) if e > FURTHER * max(off[-last:])]


def _judged(problem: Problem, kind: str, impulse: Any) -> Stop:
    r: Residual = residual(problem, impulse, precision="float32")
    return Stop(problem.name, kind, r.relative, r.roundoff_floor, r.verdict)
