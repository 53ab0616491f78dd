"""What was tried and lost, measured anew at each build of the pages."""

import sys
from pathlib import Path

import numpy as np

import lavender as lv
from benchmarks.output import markdown as table
from lavender import registry, suite
from lavender.bench import level_name
from lavender.report.text import residual, seconds

PLUGIN = Path(__file__).resolve().parent.parent / "examples" / "plugin"


def accelerated_gradient(levels):
    """APGD, the plug-in of the examples, beside sweeps and what accelerates them; and how often it comes first."""
    sys.path.insert(0, str(PLUGIN))
    import lavender_apgd

    lv.register(lavender_apgd.SPEC, replace=True)
    cases = (
        "stack(n=64)",
        "box_stack(n=10)",
        "pyramid(k=10)",
        "granular(n=9)",
        "random_spd(n=100, condition=1e4)",
    )
    names = ("apgd", "pgs", "nncg", "anderson", "newton")
    rows, first, fewer = [], 0, 0
    for case in cases:
        problem = suite.case(case).problem
        problem.csr  # noqa: B018  formed once, before the clocks
        for level in levels:
            cells, times, counts = [], [], []
            for name in names:
                best, solution = np.inf, None
                for _ in range(2):
                    more = {} if name == "newton" else {"max_iter": 100_000}
                    solution = lv.solve(problem, name, tol=level, time_limit=0.3, **more)
                    best = min(best, solution.setup_time + solution.solve_time)
                times.append(best if solution.success else np.inf)
                counts.append(solution.iterations if solution.success else np.inf)
                cells.append(f"{seconds(best)} ({solution.iterations:,})" if solution.success else "–")
            first += times[0] == min(times) < np.inf
            fewer += counts[0] < counts[names.index("anderson")]
            rows.append((f"`{case}`", level_name(level), *cells))
    return table(("case", "to", *names), rows), (
        f"It is the fastest of the five in {first} of {len(rows)} lines, and needs fewer iterations than "
        f"`anderson` in {fewer}."
    )


def _tangents(step, tangents, push, sweeps=2000):
    """Relative residual of one contact after `sweeps` with a tangent step; A = diag(1, tangents)."""
    mu, a = 0.5, np.eye(3)
    a[1:, 1:] = tangents
    b = np.array([1.0, *push])
    lam = np.zeros(3)
    for _ in range(sweeps):
        lam[0] = max(0.0, lam[0] - (a[0] @ lam - b[0]) / a[0, 0])
        lam[1:] = step(a[1:, 1:], a[1:] @ lam - b[1:], lam[1:], mu * lam[0])
    return residual(lv.residual(lv.Problem.contact(a, b, mu), lam).relative)


def _radial(t, radius):
    size = np.hypot(*t)
    return t * (radius / size) if size > radius else t


def tangent_steps():
    """Four steps for the two tangents of a contact, all followed by radial projection on the disk."""

    def one_by_one(a, w, t, radius):
        t = t.copy()
        w = w.copy()
        for i in range(2):
            change = -w[i] / a[i, i]
            t[i] += change
            w += a[:, i] * change
        return _radial(t, radius)

    def exact(a, w, t, radius):
        return _radial(t - np.linalg.lstsq(a, w, rcond=None)[0], radius)

    def mean(a, w, t, radius):
        return _radial(t - w / (0.5 * np.trace(a)), radius)

    def largest(a, w, t, radius):
        return _radial(t - w / np.linalg.eigvalsh(a)[-1], radius)

    steps = {
        "one tangent after the other, 1/d each": one_by_one,
        "exact 2 × 2 solve": exact,
        "one scalar step, 1/mean of the diagonal": mean,
        "one scalar step, 1/λ_max (what a sweep does)": largest,
    }
    sliding = np.diag([1.0, 10.0]), (1.0, 4.0)
    rank_1 = np.ones((2, 2)), (0.2, 0.2)  # sticks: A_tt is singular, and b_t in its range
    rows = [(name, _tangents(step, *sliding), _tangents(step, *rank_1)) for name, step in steps.items()]
    return table(
        ("step, then radial projection", "sliding, A_tt = diag(1, 10)", "sticking, A_tt of rank 1"), rows
    )


def forms():
    """QP backends in impulse and in velocity form."""
    rows = []
    for name in (
        "box_stack(n=10)",
        "box_stack(n=10, mass_ratio=1e6)",
        "pyramid(k=10, mass_ratio=1e6)",
        "granular(n=4)",
    ):
        problem = suite.case(name).problem
        for solver in ("osqp", "clarabel", "piqp"):
            if registry.specs()[solver].missing() is not None:
                continue
            cells = []
            for form in ("impulse", "velocity"):
                s = lv.solve(problem, solver, tol=1e-9, time_limit=0.5, form=form)
                cells += [residual(s.residual.relative), seconds(s.setup_time + s.solve_time)]
            rows.append((f"`{name}`", solver, *cells))
    return table(("case", "backend", "impulse form", "time", "velocity form", "time"), rows)


PAGE = """# What was tried and lost

A solver stays in the registry where error against time shows a family of problems on which nothing else
there beats it. What follows was tried and is not what `lavender` does by default. Every number is measured
when these pages are built.

## Accelerated projected gradients

Nesterov's method on the bounded quadratic program, with restart, is the plug-in of [Add a
solver](../plugin.md). Its step is one product with A; a sweep costs about the same and uses each new
impulse at once. Time to a relative residual, and iterations:

{apgd}

{verdict} Written with NumPy and SciPy, it pays a price to the interpreter in every iteration; the counts
are free of that.

## Other steps for the tangents

One contact with two tangents. Each step is followed by the radial projection on the disk of radius μ λ_n;
after 2,000 sweeps the judge says:

{tangents}

A step of its own for each direction, or the exact one, turns the direction before it is projected: the
sweep stands still at a point that is not the solution. The mean of the diagonal is too long a step where
one eigenvalue holds the whole trace.

## One form for every backend

The same quadratic program over impulses (A is the Hessian) or over body velocities (J is a constraint and
is never squared). Relative residual and time at tol 1e-9, at most half a second:

{forms}

Neither form is the faster one everywhere, which is why `form="auto"` looks at sizes and mass ratio.
"""


def page(levels):
    """The page, measured now."""
    apgd, verdict = accelerated_gradient(levels)
    return PAGE.format(apgd=apgd, verdict=verdict, tangents=tangent_steps(), forms=forms())


if __name__ == "__main__":
    print(page((1e-3, 1e-6, 1e-9)))
