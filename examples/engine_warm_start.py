"""Experiment 5: warm starting inside an engine, on and off, and switched off midway.

Six boxes without friction at four sweeps a step. With warm start every contact finds its impulse of the
step before, and the solve begins about two orders of magnitude closer; switched off midway, the next step
begins as far away as the very first. Beside the eight solver values stands the judge over all rows.

    python examples/engine_warm_start.py [FIGURE.png]
"""

import sys

import numpy as np

import lavender as lv

STEPS = 180
SWITCH = 90  # step at which the third run loses its warm start
SWEEPS = 4


def run(warm, switch=None):
    """Solver values (STEPS, 8), relative residual of all rows (STEPS,) [-] and its share of normals (STEPS,)."""
    scene = lv.Scene("stack", friction=0.0, warm_start=warm, solver_iterations=SWEEPS)
    sim = lv.Simulation(scene, report_residual=True)
    solver, relative, share = [], [], []
    for step in range(STEPS):
        if step == switch:
            sim.set_warm_start(False)
        observation, *_, info = sim.step()
        solver.append(observation["solver"])
        relative.append(info["residual"]["relative"])
        share.append(info["residual"]["share"]["normal"])
    return np.array(solver), np.array(relative), np.array(share)


def numbers():
    """The three runs."""
    return {"warm": run(True), "cold": run(False), "switched off": run(True, SWITCH)}


def column(solver, name):
    """One of SOLVER_FIELDS over the steps."""
    return solver[:, lv.SOLVER_FIELDS.index(name)]


def figure(found, path):
    """Initial residual, matched contacts, and the judge over all rows."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(12, 3.6), layout="constrained")
    left, middle, right = canvas.subplots(1, 3)
    for name, (solver, relative, _) in found.items():
        left.semilogy(np.maximum(column(solver, "residual_initial"), 1e-12), label=name)
        middle.plot(column(solver, "cache_matches"), label=name)
        right.semilogy(relative, label=name)
    left.set(xlabel="step", ylabel="max $|e_n|$ before the first sweep [N s]")
    middle.set(xlabel="step", ylabel="contacts found in the cache")
    right.set(xlabel="step", ylabel="relative residual of all rows [-]")
    left.legend(fontsize=8)
    canvas.savefig(path)


def main(path="engine_warm_start.png"):
    """Print medians before and after the switch, save the figure."""
    found = numbers()
    print(f"{'run':<14}{'steps':>12}{'matches':>9}{'initial':>12}{'final':>12}{'all rows':>12}")
    for name, (solver, relative, _) in found.items():
        for first, last in ((20, SWITCH), (SWITCH, STEPS)):
            values = [
                np.median(column(solver, k)[first:last]) for k in ("residual_initial", "residual_final")
            ]
            matches = int(np.median(column(solver, "cache_matches")[first:last]))
            print(
                f"{name:<14}{f'{first}-{last}':>12}{matches:>9}"
                + "".join(f"{x:>12.2e}" for x in (*values, np.median(relative[first:last])))
            )
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
