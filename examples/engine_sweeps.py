"""Experiment 4: what a sweep budget of 4 to 64 buys inside an engine.

Six boxes on each other are stepped without warm start and without friction. Every step leaves a residual
max |e_n| [N s], an approach velocity that should not be [m/s], and, summed over the steps, penetration [m].

Beside the run stands the first solve alone, from rest. The run's residual is larger where sweeps are few:
each solve starts from zero and must carry the whole weight, so the boxes sink until b is large enough
that a few sweeps get there. With G the error matrix of one sweep, that multiplies the first solve's
error by about 1/(1 - G^n).

    python examples/engine_sweeps.py [FIGURE.png]
"""

import sys

import numpy as np

import lavender as lv

BUDGETS = (4, 8, 16, 32, 64)
STEPS = 60
SETTLED = 20  # steps before the medians are taken
WHOLE = {"substeps": 1, "order": "bottom_up"}  # one solve a step, always from the ground up


def first_solve(sweeps, order="bottom_up", friction=0.0):
    """max |e_n| [N s] of the first step's problem after `sweeps` sweeps from zero."""
    scene = lv.Scene("stack", friction=friction, warm_start=False, **WHOLE)
    problem = lv.Simulation(scene).constraint_problem()
    impulse = lv.solve(problem, "sequential_impulses", tol=0, max_iter=sweeps, order=order).impulse
    return np.abs(lv.residual(problem, impulse).error[problem.cones.ptr[:-1]]).max()


def run(sweeps, friction=0.0):
    """Medians of residual [N s] and violation [m/s] over the settled steps, and the deepest penetration [m]."""
    scene = lv.Scene("stack", friction=friction, warm_start=False, solver_iterations=sweeps, **WHOLE)
    sim = lv.Simulation(scene)
    residual, violation, depth = [], [], []
    for _ in range(STEPS):
        observation, *_ = sim.step()
        values = dict(zip(lv.SOLVER_FIELDS, observation["solver"], strict=True))
        residual.append(values["residual_final"])
        violation.append(values["violation_final"])
        depth.append(observation["contacts"]["depth"].max())
    return np.median(residual[SETTLED:]), np.median(violation[SETTLED:]), max(depth)


def numbers():
    """Per budget: first solve by order, and the run."""
    return {
        "bottom_up": np.array([first_solve(n) for n in BUDGETS]),
        "top_down": np.array([first_solve(n, "top_down") for n in BUDGETS]),
        "friction": np.array([first_solve(n, friction=0.5) for n in BUDGETS]),
        "run": np.array([run(n) for n in BUDGETS]),  # (5, 3) residual, violation, depth
    }


def figure(found, path):
    """First solves and the run against the budget."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(12, 3.6), layout="constrained")
    left, middle, right = canvas.subplots(1, 3)
    for name in ("bottom_up", "top_down", "friction"):
        left.loglog(BUDGETS, found[name], "o-", label=name.replace("_", " "))
    left.loglog(BUDGETS, found["run"][:, 0], "s--", label="run, bottom up")
    left.set(xlabel="sweeps", ylabel="max $|e_n|$ [N s]", title="residual")
    left.legend(fontsize=8)
    middle.loglog(BUDGETS, found["run"][:, 1], "s--")
    middle.set(xlabel="sweeps", ylabel="[m/s]", title="violation in the run")
    right.loglog(BUDGETS, 1e3 * found["run"][:, 2], "s--")
    right.set(xlabel="sweeps", ylabel="[mm]", title="deepest penetration in the run")
    canvas.savefig(path)


def main(path="engine_sweeps.png"):
    """Print the table, save the figure."""
    found = numbers()
    print(
        f"{'sweeps':<8}{'bottom up':>12}{'top down':>12}{'friction':>12}{'run':>12}{'violation':>12}{'depth':>12}"
    )
    for i, n in enumerate(BUDGETS):
        row = [found[k][i] for k in ("bottom_up", "top_down", "friction")] + list(found["run"][i])
        print(f"{n:<8}" + "".join(f"{x:>12.3e}" for x in row))
    for name in ("bottom_up", "top_down", "friction"):
        print(f"first solve, {name.replace('_', ' ')}: falls {found[name][0] / found[name][-1]:.1f} times")
    print(f"run: residual falls {found['run'][0, 0] / found['run'][-1, 0]:.1f} times")
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
