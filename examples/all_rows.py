"""Exercise 7: the published residual sees normals alone; the judge sees every row, and names the worst.

The eight values of a step hold max |e_n| over the contacts. On a bridge of hinges nearly all error is in the
joints: the normals of the load may be solved to rounding while the hinges are far from it. In a pile of boxes
that slide, up to half of it is in the friction disks. `Simulation(scene, report_residual=True)` judges all rows:
relative residual, which kind of row its energy belongs to, and the worst row by name.

    python examples/all_rows.py [FIGURE.png]
"""

import sys

import numpy as np

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


def beside(axes):
    """The legend beside the axes, where it covers nothing."""
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)


def figure(found, path):
    """Both measures over the steps, and whose the error is."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(8, 9), layout="constrained")
    axes = canvas.subplots(2 * len(found), 1, sharex=True)
    steps = np.arange(1, STEPS + 1)
    for i, (name, by) in enumerate(found.items()):
        top, bottom = axes[2 * i], axes[2 * i + 1]
        top.semilogy(steps, by["relative"], "k", label="all rows,\nrelative")
        top.semilogy(
            steps, np.where(by["normals"] > 0.0, by["normals"], np.nan), "C1", label="max $|e_n|$ [N s]"
        )
        top.set(title=f"{name}: worst row at the end is {by['worst'][-1]}", ylabel="residual")
        beside(top)
        bottom.stackplot(steps, by["shares"].T, labels=KINDS, colors=("C0", "C1", "C2", "C3"))
        bottom.set(ylabel="share of the error", ylim=(0, 1))
        beside(bottom)
    axes[-1].set_xlabel("step")
    canvas.savefig(path)


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
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
