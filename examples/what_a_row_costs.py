"""What a scene does not declare costs nothing: a tall stack with and without friction, spin and rolling.

A contact has a row for its normal, two more with friction, one more where a patch resists spinning, and two more where
it resists rolling. Rows that no body asks for are not there: the same boxes are stepped with the same sweeps, and what
differs is what was declared.

    python examples/what_a_row_costs.py [FIGURE.png]

The chapter shows it as step.png. One of these stacks by itself:

    lavender run stack --set n=20 --iterations 64 --set friction=0
"""

import sys
from time import perf_counter

from panels import save

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
    """Rows, and the time of each step (ROUNDS * STEPS,) [s], by what is declared; taken in turns."""
    scenes = {
        name: lv.Scene("stack", n=BOXES, solver_iterations=SWEEPS, **more) for name, more in DECLARED.items()
    }
    found = {
        name: {"rows": lv.Simulation(scene).constraint_problem().m, "times": []}
        for name, scene in scenes.items()
    }
    for _ in range(ROUNDS):
        for name, scene in scenes.items():
            simulation = lv.Simulation(scene)
            for _ in range(STEPS):
                start = perf_counter()
                simulation.step()
                found[name]["times"].append(perf_counter() - start)
    return found


def least(found):
    """The least time of a step [s] by what is declared: what else ran on the machine only adds to it."""
    return {name: min(one["times"]) for name, one in found.items()}


def draw_step(axes, found):
    """Time of a step."""
    times = least(found)
    axes.barh(list(times), [1e3 * t for t in times.values()], color="C4")
    for name, one in found.items():
        axes.text(0.0, name, f"  {one['rows']} rows", va="center", color="white")
    axes.set(title=f"a step of {BOXES} boxes, {SWEEPS} sweeps", xlabel="time [ms]")
    axes.invert_yaxis()


PANELS = {"step": draw_step}


def main(path="what_a_row_costs.png"):
    """Print the table, save the figure."""
    found = numbers()
    times = least(found)
    print(f"{'declared':<26}{'rows':>6}{'ms a step':>12}{'of friction alone':>20}")
    for name, t in times.items():
        print(f"{name:<26}{found[name]['rows']:>6}{1e3 * t:>12.3f}{t / times['friction']:>20.2f}")
    save(PANELS, found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
