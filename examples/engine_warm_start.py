"""Experiment 5 and exercise 6: warm starting inside an engine: on, off, and switched off during the run.

The scene is `stack` with its defaults at four sweeps: six boxes of 1 kg, friction 0.5, steps of 1/120 s in two
substeps. With a warm start every contact finds its impulse of the previous substep, and the solve starts more than
two orders of magnitude closer. If it is switched off during the run, the next step starts as far away as a cold run
does. How many times further that is depends on the step, because the start of the warm run swings.
`engine_sweeps.py` shows the consequence: the warm stack stands, and the cold one falls.

Besides the eight solver values, the judge's residual over all rows is printed.

    python examples/engine_warm_start.py [FIGURE.png]

A file named after a panel shows it alone: start.png, matches.png.
"""

import sys

import numpy as np
from panels import Numbers, put_legend_right, show

import lavender as lv

STEPS = 180
FIRST = 21  # first step of which medians are taken
SWITCH = 90  # number of steps after which the third run loses its warm start
SWITCHES = range(80, 101)  # the same, in runs that differ in nothing else
SWEEPS = 4


def run(warm, switch=None, order="alternating", judge=False, steps=STEPS):
    """Return solver values (steps, 8) and, if asked for, the relative residual of all rows (steps,) [-]."""
    scene = lv.Scene("stack", warm_start=warm, solver_iterations=SWEEPS, order=order)
    sim = lv.Simulation(scene, report_residual=judge)
    solver, relative = [], []
    for step in range(steps):
        if step == switch:
            sim.set_warm_start(False)
        observation, *_, info = sim.step()
        solver.append(observation["solver"])
        if judge:
            relative.append(info["residual"]["relative"])
    return np.array(solver), np.array(relative)


RUNS = {
    "warm": {"warm": True},
    "cold": {"warm": False},
    "switched off": {"warm": True, "switch": SWITCH},
    "warm, one direction": {"warm": True, "order": "bottom_up"},
    "cold, one direction": {"warm": False, "order": "bottom_up"},
}


def numbers():
    """Return the solver values of each run, and the judge's residuals."""
    return Numbers(
        values=lambda: {name: run(**options)[0] for name, options in RUNS.items()},
        judged=lambda: {name: run(**options, judge=True)[1] for name, options in RUNS.items()},
        switches=measure_switches,
    )


def measure_switches():
    """Return by how much the residual at the start rises if warm starts end after each step of SWITCHES [-]."""
    warm = get_column(run(True)[0], "residual_initial")
    return [
        get_column(run(True, n, steps=n + 1)[0], "residual_initial")[n] / warm[n - 1]
        for n in SWITCHES
    ]


def get_column(solver, name):
    """Return one of SOLVER_FIELDS over the steps."""
    return solver[:, lv.SOLVER_FIELDS.index(name)]


# The run "switched off" equals "warm" up to the switch: the wider line below remains visible.
STYLES = {"warm": ("C0", 4.0), "cold": ("k", 1.0), "switched off": ("C1", 1.5)}


def draw_over_steps(axes, found, field):
    """Draw one solver value of the three runs over the steps; zeros are left out on a logarithmic axis."""
    for name, (color, width) in STYLES.items():
        values = get_column(found["values"][name], field)
        if field.startswith("residual"):
            values = np.where(values > 0.0, values, np.nan)
        axes.plot(np.arange(1, STEPS + 1), values, color=color, linewidth=width, label=name)
    axes.axvline(SWITCH + 0.5, color="0.7", linewidth=0.8, linestyle="--")
    axes.set_xlabel("step")
    put_legend_right(axes)


def draw_start(axes, found):
    """Draw the residual before the first sweep."""
    draw_over_steps(axes, found, "residual_initial")
    axes.set(title="residual before the first sweep", ylabel="max $|e_n|$ [N s]", yscale="log")


def draw_matches(axes, found):
    """Draw the number of contacts that were found in the cache."""
    draw_over_steps(axes, found, "cache_matches")
    axes.set(
        title="contacts found in the cache, of 24",
        ylabel="matches",
        ylim=(-1, 26),
        yticks=(0, 8, 16, 24),
    )


PANELS = {"start": draw_start, "matches": draw_matches}


def print_numbers(found):
    """Print medians before and after the switch, and the two steps around it."""
    print(f"{'run':<20}{'steps':>9}{'matches':>9}{'initial':>12}{'final':>12}{'all rows':>12}")
    for name, solver in found["values"].items():
        for first, last in ((FIRST, SWITCH), (SWITCH + 1, STEPS)):
            values = [
                np.median(get_column(solver, k)[first - 1 : last])
                for k in ("residual_initial", "residual_final")
            ]
            matches = int(np.median(get_column(solver, "cache_matches")[first - 1 : last]))
            print(
                f"{name:<20}{f'{first}-{last}':>9}{matches:>9}"
                + "".join(
                    f"{x:>12.2e}"
                    for x in (*values, np.median(found["judged"][name][first - 1 : last]))
                )
            )
    initial = {
        k: np.median(get_column(v, "residual_initial")[FIRST - 1 : SWITCH])
        for k, v in found["values"].items()
    }
    one_way = initial["cold, one direction"] / initial["warm, one direction"]
    print(
        f"in steps {FIRST} to {SWITCH} warm starts {initial['cold'] / initial['warm']:.0f} times closer than cold; "
        f"always swept from the bottom up {one_way:.0f} times"
    )
    solver = found["values"]["switched off"]
    starts, matches = (
        get_column(solver, k)[SWITCH - 1 : SWITCH + 1]
        for k in ("residual_initial", "cache_matches")
    )
    print(
        f"at the switch the start goes from {starts[0]:.1e} to {starts[1]:.1e} N s, {starts[1] / starts[0]:.0f} times, "
        f"and the matches from {matches[0]:.0f} to {matches[1]:.0f}"
    )
    print(
        f"after one of the steps {SWITCHES[0]} to {SWITCHES[-1]} it rises {min(found['switches']):.0f} to "
        f"{max(found['switches']):.0f} times"
    )


def main(path="engine_warm_start.png"):
    """Print the numbers and draw the figure."""
    show(PANELS, numbers(), print_numbers, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
