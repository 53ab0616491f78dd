"""Exercise 7: the published residual covers the normals only; the judge covers every row and names the worst.

The eight values of a step hold max |e_n| over the contacts. On a bridge of hinges nearly all of the error is in the
joints: the normals of the load may be solved to rounding while the hinges are not. In a pile of sliding boxes up to
half of it is in the friction disks. `Simulation(scene, report_residual=True)` judges all rows: relative residual, the
share of its energy by kind of row, and the worst row by name. Energies, sqrt(sum d e^2) [sqrt J], can be added over
rows of different units; impulses in N s and N m s cannot.

Scenes: `bridge` (16 planks, 85 joint rows, a load) and `pile` (40 boxes), both with their defaults: steps of 1/120 s
in two substeps, 16 warm sweeps, friction 0.5.

    python examples/all_rows.py [FIGURE.png]

A file named after a panel shows it alone: relative.png, normals.png.
"""

import sys

import numpy as np
from panels import Numbers, put_legend_right, show

import lavender as lv

SCENES = {"bridge": {}, "pile": {"n": 40, "kind": "boxes"}}
STEPS = 180
KINDS = ("joint", "normal", "disk", "spin")


def run(name):
    """Return for each step max |e_n| [N s], relative residual of all rows [-], shares (STEPS, 4) [-], worst row."""
    sim = lv.Simulation(lv.Scene(name, **SCENES[name]), report_residual=True)
    normals, relative, shares, worst = [], [], [], []
    for _ in range(STEPS):
        observation, *_, info = sim.step()
        normals.append(observation["solver"][lv.SOLVER_FIELDS.index("residual_final")])
        relative.append(info["residual"]["relative"])
        shares.append([info["residual"]["share"][kind] for kind in KINDS])
        worst.append(info["residual"]["worst"])
    return {
        "normals": np.array(normals),
        "relative": np.array(relative),
        "shares": np.array(shares),
        "worst": worst,
    }


def numbers():
    """Return the run of each scene."""
    return Numbers(**{name: (lambda name=name: run(name)) for name in SCENES})


def draw_relative(axes, found):
    """Draw the relative residual of all rows."""
    for i, (name, by) in enumerate(found.items()):
        axes.semilogy(np.arange(1, STEPS + 1), by["relative"], f"C{i}", label=name)
    axes.set(
        title="all rows, by the judge",
        xlabel="step",
        ylabel="relative residual [-]",
        ylim=(1e-7, 3),
    )
    put_legend_right(axes)


def draw_normals(axes, found):
    """Draw the published residual: the largest error of a normal."""
    for i, (name, by) in enumerate(found.items()):
        shown = np.where(by["normals"] > 0.0, by["normals"], np.nan)
        axes.semilogy(np.arange(1, STEPS + 1), shown, f"C{i}", label=name)
    axes.set(
        title="the normals alone, as published",
        xlabel="step",
        ylabel="max $|e_n|$ [N s]",
        ylim=(1e-7, 1),
    )
    put_legend_right(axes)


PANELS = {"relative": draw_relative, "normals": draw_normals}


def print_numbers(found):
    """Print both measures."""
    print(f"{'scene':<8}{'step':>6}{'max |e_n|':>12}{'all rows':>12}   shares: " + ", ".join(KINDS))
    for name, by in found.items():
        for step in (20, 60, 120, STEPS):
            shares = "  ".join(f"{x:.2f}" for x in by["shares"][step - 1])
            print(
                f"{name:<8}{step:>6}{by['normals'][step - 1]:>12.1e}{by['relative'][step - 1]:>12.1e}   {shares}"
                f"   worst {by['worst'][step - 1]}"
            )
    normals, relative = found["bridge"]["normals"], found["bridge"]["relative"]
    touching = normals > 0.0
    print(
        f"bridge, {touching.sum()} steps with the load on it: normals {np.median(normals[touching]):.1e} N s in the "
        f"median, {normals.max():.1e} at most;\nthe relative residual of all rows is "
        f"{np.median(relative[touching]):.2f} in the median, "
        f"at least {100 * found['bridge']['shares'][touching, 0].min():.1f} % of its energy in hinges"
    )


def main(path="all_rows.png"):
    """Print the tables and draw the figure."""
    show(PANELS, numbers(), print_numbers, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
