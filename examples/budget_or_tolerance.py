"""Exercise 5: stop at a tolerance, or after a fixed number of sweeps? Cost and error over a sequence of steps.

The problems of 60 steps of the scene `stack` (six boxes of 1 kg, friction 0.5, steps of 1/120 s) are solved by
sequential impulses in two ways, each step from the impulses of the step before: until the relative residual is at
most TOL, and with a fixed number of sweeps, the mean of the first way. On average both cost the same. The tolerance
bounds the error and lets the cost vary; the budget bounds the cost and lets the error vary.

    python examples/budget_or_tolerance.py [FIGURE.png]

A file named after a panel shows it alone: cost.png, error.png.
"""

import sys

import numpy as np
from panels import Numbers, put_legend_right, show

import lavender as lv
from lavender.report import carry_impulses
from lavender.sim.engine import Simulation

SCENE = "stack"
STEPS = 60
TOL = 3e-2  # relative residual
SOLVER = "sequential_impulses"
MAX_SWEEPS = 10_000


def record_problems():
    """Return the velocity problem of each step."""
    simulation = Simulation(SCENE)
    out = []
    for _ in range(STEPS):
        out.append(simulation.constraint_problem())
        simulation.step()
    return out


def solve_steps(steps, **budget):
    """Return sweeps and residual of each step, each started from the impulses of the step before."""
    before = None
    sweeps = []
    residuals = []
    for problem in steps:
        start = problem.start() if before is None else carry_impulses(*before, problem)
        solution = lv.solve(problem, SOLVER, impulse=start, **budget)
        before = (problem, solution.impulse)
        sweeps.append(solution.iterations)
        residuals.append(solution.residual.relative)
    return np.array(sweeps), np.array(residuals)


def numbers():
    """Return sweeps and residuals of every step by either rule."""
    found = Numbers(
        steps=record_problems,
        tolerance=lambda: solve_steps(found["steps"], tol=TOL, max_iter=MAX_SWEEPS),
        budget=lambda: max(1, round(float(found["tolerance"][0].mean()))),
        fixed=lambda: solve_steps(found["steps"], tol=0.0, max_iter=found["budget"]),
    )
    return found


def draw_cost(axes, found):
    """Draw the sweeps of every step."""
    for name, style in (("tolerance", "o"), ("fixed", "x")):
        axes.plot(found[name][0], style, label=name, markersize=4)
    axes.set(title="cost", xlabel="step", ylabel="sweeps", yscale="symlog")
    put_legend_right(axes)


def draw_error(axes, found):
    """Draw the error of every step."""
    for name, style in (("tolerance", "o"), ("fixed", "x")):
        axes.semilogy(found[name][1], style, label=name, markersize=4)
    axes.axhline(TOL, color="0.6", linewidth=0.8, label=f"tolerance {TOL:g}")
    axes.set(title="error", xlabel="step", ylabel="relative residual [-]")
    put_legend_right(axes)


PANELS = {"cost": draw_cost, "error": draw_error}


def print_numbers(found):
    """Print the distributions."""
    print(f"{SCENE}, {STEPS} steps; tolerance {TOL:g} against {found['budget']} sweeps every step")
    print(
        f"{'':<10} {'sweeps: mean':>13} {'median':>8} {'max':>6} {'residual: median':>18} {'95 %':>9} {'worst':>9}"
    )
    for name in ("tolerance", "fixed"):
        sweeps, residuals = found[name]
        print(
            f"{name:<10} {sweeps.mean():>13.1f} {np.median(sweeps):>8.0f} {sweeps.max():>6} "
            f"{np.median(residuals):>18.1e} {np.quantile(residuals, 0.95):>9.1e} {residuals.max():>9.1e}"
        )


def main(path="budget_or_tolerance.png"):
    """Print the distributions and draw the figure."""
    show(PANELS, numbers(), print_numbers, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
