"""Residual, motion error and drift: compare both error measures with the drift of a simulation.

Six boxes on each other without friction are stepped with 4, 16 and 64 sweeps, in two orders, with and without a warm
start. Each step gives the relative residual and the motion error. The drift is the distance of the bodies from a run of
the same scene in which every step is solved to the round-off floor. The residual measures impulses, the motion error
velocities, and a run adds up velocities. Within one scene both measures rank runs in the same order, since they
differ by a nearly constant factor. The factor depends on the scene (`residual_or_motion.py`).

    python examples/motion_over_a_run.py [FIGURE.png]
"""

import sys

import numpy as np
from scipy.stats import spearmanr

import lavender as lv

STEPS = 90
SWEEPS = (4, 16, 64)
ORDERS = ("bottom_up", "top_down")


def positions(**parameters):
    """Return positions (STEPS, n, 3) [m], and residual, motion error and speed error [m/s] of each step (STEPS,)."""
    sim = lv.Simulation(
        lv.Scene("stack", friction=0.0, **parameters), report_residual=True, report_motion=True
    )
    where, told = [], []
    for _ in range(STEPS):
        observation, *_, info = sim.step()
        where.append(observation["positions"])
        residual = info["residual"]["relative"] if "residual" in info else 0.0
        moved = info.get("motion", {"relative": 0.0, "speed": 0.0})
        told.append((residual, moved["relative"], moved["speed"]))
    return np.array(where), *np.array(told).T


def numbers():
    """Return for each run its parameters, residual, motion error, speed error and drift (STEPS,)."""
    exact = positions(solver="direct", solver_options={"tol": 1e-13})[0]
    found = []
    for sweeps in SWEEPS:
        for order in ORDERS:
            for warm in (True, False):
                where, residual, motion, speed = positions(
                    solver_iterations=sweeps, order=order, warm_start=warm
                )
                found.append(
                    {
                        "sweeps": sweeps,
                        "order": order,
                        "warm": warm,
                        "residual": residual,
                        "motion": motion,
                        "speed": speed,
                        "drift": np.linalg.norm(where - exact, axis=2).max(axis=1),
                    }
                )
    return found


def ranks(found):
    """Return the rank correlation of the mean of each measure with the final drift, over the runs."""
    drift = [run["drift"][-1] for run in found]
    return {
        name: float(spearmanr([run[name][1:].mean() for run in found], drift).statistic)
        for name in ("residual", "motion", "speed")
    }


def figure(found, path):
    """Draw one warm and one cold run over time, and residual and motion error of all runs against drift."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(7.2, 6.2), layout="constrained")
    panels = canvas.subplot_mosaic("AB;CC")
    left, middle, right = (panels[name] for name in "ABC")
    for run, style in ((_run(found, 16, True), "-"), (_run(found, 16, False), "--")):
        name = "warm" if run["warm"] else "cold"
        left.semilogy(np.maximum(run["residual"], 1e-16), "C0" + style, label=f"residual, {name}")
        left.semilogy(np.maximum(run["motion"], 1e-16), "C1" + style, label=f"motion error, {name}")
        middle.semilogy(1e3 * np.maximum(run["drift"], 1e-16), "C2" + style, label=name)
    left.set(xlabel="step", ylabel="relative [-]", title="16 sweeps, bottom up", ylim=(1e-13, 3))
    middle.set(
        xlabel="step",
        ylabel="drift [mm]",
        title="from the run solved to the floor",
        ylim=(1e-2, 1e3),
    )
    for name, mark in (("residual", "o"), ("motion", "^")):
        x = [run[name][1:].mean() for run in found]
        right.loglog(x, [1e3 * run["drift"][-1] for run in found], mark, label=f"mean {name}")
    rank = ranks(found)
    right.set(
        xlabel="mean over the run [-]",
        ylabel="drift at the end [mm]",
        title=f"rank correlation: {rank['residual']:.2f} and {rank['motion']:.2f}",
    )
    for ax, place in ((left, "lower right"), (middle, "upper right"), (right, "upper left")):
        ax.legend(fontsize=9, loc=place)
    canvas.savefig(path, dpi=150)


def _run(found, sweeps, warm):
    return next(
        r for r in found if (r["sweeps"], r["order"], r["warm"]) == (sweeps, "bottom_up", warm)
    )


def main(path="motion_over_a_run.png"):
    """Print a line per run and the rank correlations, and save the figure."""
    found = numbers()
    head = (
        "sweeps",
        "order",
        "start",
        "residual",
        "motion error",
        "speed error",
        "drift at the end",
    )
    print("".join(f"{word:>18}" for word in head))
    for run in found:
        means = (run["residual"][1:].mean(), run["motion"][1:].mean())
        values = [f"{x:.2e}" for x in means]
        values += [f"{1e3 * run['speed'][1:].mean():.3g} mm/s", f"{1e3 * run['drift'][-1]:.3g} mm"]
        words = (run["sweeps"], run["order"], "warm" if run["warm"] else "cold", *values)
        print("".join(f"{word:>18}" for word in words))
    for name, value in ranks(found).items():
        print(f"rank correlation of the mean {name} with the drift: {value:.2f}")
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
