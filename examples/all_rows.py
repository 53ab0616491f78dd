"""Exercise 7: the published residual sees normals alone; the judge sees every row, and names the worst.

The eight values of a step hold max |e_n| over the contacts. On a bridge of hinges nearly all error is in the
joints: the normals of the load may be solved to rounding while the hinges are far from it. In a pile of boxes
that slide, up to half of it is in the friction disks. `Simulation(scene, report_residual=True)` judges all rows:
relative residual, which kind of row its energy belongs to, and the worst row by name.

    python examples/all_rows.py [FIGURE.png]

A file named after a panel holds it alone: relative.png, normals.png.
"""

import sys

import numpy as np
from panels import beside, save

import lavender as lv

SCENES = {"bridge": {}, "pile": {"n": 40, "kind": "boxes"}}
STEPS = 180
KINDS = ("joint", "normal", "disk", "spin")


def run(name):
    """Of each step: max |e_n| [N s], relative residual of all rows [-], shares (STEPS, 4) [-], worst row."""
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
    """Both runs."""
    return {name: run(name) for name in SCENES}


def draw_relative(axes, found):
    """What the judge of all rows says."""
    for i, (name, by) in enumerate(found.items()):
        axes.semilogy(np.arange(1, STEPS + 1), by["relative"], f"C{i}", label=name)
    axes.set(title="all rows, by the judge", xlabel="step", ylabel="relative residual [-]", ylim=(1e-7, 3))
    beside(axes)


def draw_normals(axes, found):
    """What the eight values say: the largest error of a normal."""
    for i, (name, by) in enumerate(found.items()):
        shown = np.where(by["normals"] > 0.0, by["normals"], np.nan)
        axes.semilogy(np.arange(1, STEPS + 1), shown, f"C{i}", label=name)
    axes.set(
        title="the normals alone, as published", xlabel="step", ylabel="max $|e_n|$ [N s]", ylim=(1e-7, 1)
    )
    beside(axes)


PANELS = {"relative": draw_relative, "normals": draw_normals}


def main(path="all_rows.png"):
    """Print what either measure says, save the figure."""
    found = numbers()
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
        f"median, {normals.max():.1e} at most;\nof the error of all rows {100 * np.median(relative[touching]):.0f} % "
        f"of doing nothing is left in the median, {100 * found['bridge']['shares'][touching, 0].min():.1f} % of it "
        f"or more in hinges"
    )
    save(PANELS, found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
