"""Rows that a scene does not declare cost nothing: a tall stack with and without friction, spin and rolling.

A contact has a row for its normal, two more with friction, one more if a patch resists spinning, and two more if it
resists rolling. Rows that no body declares do not exist. The same twenty boxes are stepped with the same 64 sweeps;
only the declared rows differ.

    python examples/what_a_row_costs.py [FIGURE.png]

The chapter shows it as step.png. One of these stacks by itself:

    lavender run stack --set n=20 --iterations 64 --set friction=0
"""

import sys
from time import perf_counter

from panels import Numbers, show

import lavender as lv

BOXES, SWEEPS, STEPS, ROUNDS = 20, 64, 40, 5
DECLARED = {
    "no friction": {"friction": 0.0},
    "friction": {},
    "friction, spin": {"patch_radius": 0.1},
    "friction, rolling": {"rolling_radius": 0.05},
    "friction, spin, rolling": {"patch_radius": 0.1, "rolling_radius": 0.05},
}


def numbers():
    """Return the number of rows and the times of the steps (ROUNDS * STEPS,) [s] by declared rows."""
    return Numbers(measured=measure)


def measure():
    """Measure all scenes alternately."""
    scenes = {
        name: lv.Scene("stack", n=BOXES, solver_iterations=SWEEPS, **more)
        for name, more in DECLARED.items()
    }
    rows = {name: lv.Simulation(scene).constraint_problem().m for name, scene in scenes.items()}
    times = {name: [] for name in scenes}
    for _ in range(ROUNDS):
        for name, scene in scenes.items():
            simulation = lv.Simulation(scene)
            for _ in range(STEPS):
                start = perf_counter()
                simulation.step()
                times[name].append(perf_counter() - start)
    return {name: {"rows": rows[name], "times": times[name]} for name in scenes}


def get_shortest_times(found):
    """Return the shortest time of a step [s] by declared rows; other programs on the machine only add to it."""
    return {name: min(one["times"]) for name, one in found["measured"].items()}


def draw_step(axes, found):
    """Draw the time of a step."""
    times = get_shortest_times(found)
    axes.barh(list(times), [1e3 * t for t in times.values()], color="C4")
    for name, one in found["measured"].items():
        axes.text(0.0, name, f"  {one['rows']} rows", va="center", color="white")
    axes.set(title=f"a step of {BOXES} boxes, {SWEEPS} sweeps", xlabel="time [ms]")
    axes.invert_yaxis()


PANELS = {"step": draw_step}


def print_numbers(found):
    """Print the table."""
    times = get_shortest_times(found)
    print(f"{'declared':<26}{'rows':>6}{'ms a step':>12}{'over friction alone':>20}")
    for name, t in times.items():
        print(
            f"{name:<26}{found['measured'][name]['rows']:>6}{1e3 * t:>12.3f}{t / times['friction']:>20.2f}"
        )


def main(path="what_a_row_costs.png"):
    """Print the table and draw the figure."""
    show(PANELS, numbers(), print_numbers, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
