"""Experiment 5 and exercise 6: warm starting inside an engine, on, off, and switched off midway.

The scene is `stack` with its defaults, at four sweeps: six boxes, friction 0.5. With warm start every contact finds
its impulse of the substep before, and the solve begins more than two orders of magnitude closer. Switched off
midway, the next step begins as far away as if there had never been one. `engine_sweeps.py` shows what that
costs: warm, the stack stands; cold, it tips over after two seconds.

Beside the eight solver values stands the judge over all rows.

    python examples/engine_warm_start.py [FIGURE.png]

The chapter shows it as start.png.
"""

import sys

import numpy as np
from panels import beside, save

import lavender as lv

STEPS = 180
SWITCH = 90  # step at which the third run loses its warm start
SWEEPS = 4


def run(warm, switch=None, order="alternating"):
    """Solver values (STEPS, 8), relative residual of all rows (STEPS,) [-] and its share of normals (STEPS,)."""
    scene = lv.Scene("stack", warm_start=warm, solver_iterations=SWEEPS, order=order)
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
    """The three runs, and warm and cold swept always from the bottom up."""
    return {
        "warm": run(True),
        "cold": run(False),
        "switched off": run(True, SWITCH),
        "warm, one way": run(True, order="bottom_up"),
        "cold, one way": run(False, order="bottom_up"),
    }


def column(solver, name):
    """One of SOLVER_FIELDS over the steps."""
    return solver[:, lv.SOLVER_FIELDS.index(name)]


def draw_start(axes, found):
    """Where the solve begins; nothing is drawn where it is 0, in the first steps."""
    # "switched off" runs on "warm" until the switch: the wider line below stays to be seen
    styles = {"warm": ("C0", 4.0), "cold": ("k", 1.0), "switched off": ("C1", 1.5)}
    for name, (color, width) in styles.items():
        begins = column(found[name][0], "residual_initial")
        shown = np.where(begins > 0.0, begins, np.nan)
        axes.plot(np.arange(1, STEPS + 1), shown, color=color, linewidth=width, label=name)
    axes.axvline(SWITCH + 0.5, color="0.7", linewidth=0.8, linestyle="--")
    axes.set(title="where the solve begins", xlabel="step", ylabel="max $|e_n|$ [N s]", yscale="log")
    beside(axes)


PANELS = {"start": draw_start}


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
    initial = {k: np.median(column(v[0], "residual_initial")[20:SWITCH]) for k, v in found.items()}
    print(
        f"before the switch warm begins {initial['cold'] / initial['warm']:.0f} times closer than cold; swept always "
        f"from the bottom up {initial['cold, one way'] / initial['warm, one way']:.0f} times"
    )
    solver = found["switched off"][0]
    begins, matches = (
        column(solver, k)[SWITCH - 1 : SWITCH + 1] for k in ("residual_initial", "cache_matches")
    )
    print(
        f"at the switch the start goes from {begins[0]:.1e} to {begins[1]:.1e} N s, {begins[1] / begins[0]:.0f} times, "
        f"and matches from {matches[0]:.0f} to {matches[1]:.0f}"
    )
    save(PANELS, found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
