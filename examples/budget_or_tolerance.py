"""Exercise 5: stop at a tolerance, or after a fixed number of sweeps? Cost and error over a sequence of steps.

A scene of the gallery is recorded step by step; each step is solved by projected Gauss-Seidel from the
impulses of the step before, twice: until the relative residual is at most TOL, and with the same number of sweeps
every step, the mean of what the tolerance took. On average both cost the same. The tolerance bounds the error and
lets the cost vary, which a frame time may not allow; the budget bounds the cost and lets the error vary.

    python examples/budget_or_tolerance.py [FIGURE.png]

A file named after a panel holds it alone: cost.png, error.png.
"""

import sys

import numpy as np
from panels import beside, save

import lavender as lv
from lavender.lab.bench import carry
from lavender.sim.engine import Simulation

SCENE = "stack"
STEPS = 60
TOL = 3e-2  # relative residual
SOLVER = "sequential_impulses"
MOST = 10_000  # sweeps


def problems():
    """The velocity problem of each step."""
    simulation = Simulation(SCENE)
    out = []
    for _ in range(STEPS):
        out.append(simulation.constraint_problem())
        simulation.step()
    return out


def walk(steps, **budget):
    """Sweeps and residual of each step, impulses carried along."""
    before, sweeps, residuals = None, [], []
    for problem in steps:
        start = problem.start() if before is None else carry(*before, problem)
        solution = lv.solve(problem, SOLVER, impulse=start, **budget)
        before = (problem, solution.impulse)
        sweeps.append(solution.iterations)
        residuals.append(solution.residual.relative)
    return np.array(sweeps), np.array(residuals)


def numbers():
    """Sweeps and residuals by either rule."""
    steps = problems()
    sweeps, residuals = walk(steps, tol=TOL, max_iter=MOST)
    budget = max(1, round(float(sweeps.mean())))
    return {
        "budget": budget,
        "tolerance": (sweeps, residuals),
        "fixed": walk(steps, tol=0.0, max_iter=budget),
    }


def draw_cost(axes, found):
    """Sweeps of every step."""
    for name, style in (("tolerance", "o"), ("fixed", "x")):
        axes.plot(found[name][0], style, label=name, markersize=4)
    axes.set(title="cost", xlabel="step", ylabel="sweeps", yscale="symlog")
    beside(axes)


def draw_error(axes, found):
    """Error of every step."""
    for name, style in (("tolerance", "o"), ("fixed", "x")):
        axes.semilogy(found[name][1], style, label=name, markersize=4)
    axes.axhline(TOL, color="0.6", linewidth=0.8, label=f"tolerance {TOL:g}")
    axes.set(title="error", xlabel="step", ylabel="relative residual [-]")
    beside(axes)


PANELS = {"cost": draw_cost, "error": draw_error}


def main(path="budget_or_tolerance.png"):
    """Print the distributions, save the figure."""
    found = numbers()
    print(f"{SCENE}, {STEPS} steps; tolerance {TOL:g} against {found['budget']} sweeps every step")
    print(
        f"{'':<10} {'sweeps: mean':>13} {'median':>8} {'most':>6} {'residual: median':>18} {'95 %':>9} {'worst':>9}"
    )
    for name in ("tolerance", "fixed"):
        sweeps, residuals = found[name]
        print(
            f"{name:<10} {sweeps.mean():>13.1f} {np.median(sweeps):>8.0f} {sweeps.max():>6} "
            f"{np.median(residuals):>18.1e} {np.quantile(residuals, 0.95):>9.1e} {residuals.max():>9.1e}"
        )
    save(PANELS, found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
