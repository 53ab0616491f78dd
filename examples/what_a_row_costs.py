"""What a scene does not declare costs nothing: a tall stack with and without friction, spin and rolling.

A contact has a row for its normal, two more with friction, one more where a patch resists spinning, and two more where
it resists rolling. Rows that no body asks for are not there: the same boxes are stepped with the same sweeps, and what
differs is what was declared.

    python examples/what_a_row_costs.py [FIGURE.png]

The time of one declaration: lavender run stack --set n=20 --iterations 64 --set friction=0
"""

import sys
from time import perf_counter

import numpy as np

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


def figure(found, path):
    """Time a step and time a row."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(8, 4), layout="constrained")
    left, right = canvas.subplots(1, 2, sharey=True)
    names = list(found)[::-1]
    least = np.array([1e3 * min(found[name]["times"]) for name in names])  # ms
    rows = np.array([found[name]["rows"] for name in names])
    left.barh(names, least, color="C4")
    left.set(title=f"a step of {BOXES} boxes, {SWEEPS} sweeps", xlabel="time [ms]")
    for i, n in enumerate(rows):
        left.text(0.02 * least.max(), i, f"{n} rows", va="center", color="white")
    right.barh(names, 1e6 * least / (rows * SWEEPS * lv.Scene("stack").parameters.substeps), color="C2")
    right.set(title="the same for each row and sweep", xlabel="time [ns]")
    canvas.savefig(path)


def main(path="what_a_row_costs.png"):
    """Print the table, save the figure."""
    found = numbers()
    plain = min(found["friction"]["times"])
    print(f"{'declared':<26}{'rows':>6}{'ms a step':>12}{'of friction alone':>20}")
    for name, one in found.items():
        least = min(one["times"])
        print(f"{name:<26}{one['rows']:>6}{1e3 * least:>12.3f}{least / plain:>20.2f}")
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
