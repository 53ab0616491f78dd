"""Measure and draw the figure of README.

    python docs/hero.py

The left panel has the velocity error of five solvers against CPU time on one pile, the right panel the errors of all
steps of a humanoid under its own settings of MuJoCo and under the line that `lavender tune` printed for it.
`docs/static/hero.json` has the numbers of the figure and of the sentence below it.
"""

import json
import os
import tempfile
import time
from pathlib import Path

import gymnasium
import matplotlib as mpl
import mujoco
import numpy as np
from matplotlib.figure import Figure

import lavender as lv
from lavender.audit.audit import audit

STATIC = Path(__file__).resolve().parent / "static"
CASE = "granularF(n=6)"
SOLVERS = {
    "auto": "#5b4b9a",
    "newton": "#2b6cb0",
    "admm": "#2f855a",
    "nncg": "#b7791f",
    "pgs": "#c05621",
}
TOLERANCES = [10.0**-k for k in range(1, 10)]
MODEL = "humanoidstandup.xml"
#: Printed by `lavender tune` for this model, with MuJoCo 4.0.0.
TUNED = {
    "solver": mujoco.mjtSolver.mjSOL_NEWTON,
    "iterations": 100,
    "tolerance": 1e-15,
    "ls_tolerance": 0.001,
}
MAX_SECONDS = 2.0  # CPU time after which no smaller tolerance is tried
WORLDS, STEPS = 64, 200


def measure_solver(problem, name):
    """Return CPU time [s] and velocity error [m/s] of one solver at each tolerance, the smallest of three times."""
    points = []
    for tol in TOLERANCES:
        times = []
        for _ in range(3):
            begin = time.process_time()
            solution = lv.solve(problem, name, tol=tol)
            times.append(time.process_time() - begin)
        points.append((min(times), solution.residual.velocity))
        if not solution.success or min(times) > MAX_SECONDS:
            break
    return points


def measure_model(options):
    """Return the velocity error [m/s; rad/s of hinges] of every step of the model with these options."""
    path = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / MODEL
    model = mujoco.MjModel.from_xml_path(str(path))
    for name, value in options.items():
        setattr(model.opt, name, value)
    return np.sort(audit(model, worlds=WORLDS, steps=STEPS, workers=1).numbers[0].ravel())


def measure():
    """Return all numbers of the figure."""
    problem = lv.suite.case(CASE).problem
    curves = {name: measure_solver(problem, name) for name in SOLVERS}
    errors = {"your model": measure_model({}), "one line of XML later": measure_model(TUNED)}
    return {
        "case": CASE,
        "rows": problem.m,
        "curves": curves,
        "model": MODEL,
        "mujoco": mujoco.__version__,
        "steps": WORLDS * STEPS,
        "worst": {name: float(e[-1]) for name, e in errors.items()},
        "quantiles": {
            name: np.quantile(e, np.linspace(0, 1, 101)).tolist() for name, e in errors.items()
        },
    }


def draw(numbers):
    """Draw both panels."""
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, color in SOLVERS.items():
        x, y = np.array(numbers["curves"][name]).T
        left.loglog(1e3 * x, y, "o-", color=color, lw=2, ms=4)
        left.annotate(
            name,
            (1e3 * x[-1], y[-1]),
            (-16, -16) if name == "nncg" else (6, -3),
            textcoords="offset points",
            color=color,
            fontsize=12,
        )
    for limit, text in ((1e-3, "1 mm/s: a game"), (1e-6, "1 µm/s: a reference")):
        left.axhline(limit, color="#718096", lw=0.8, ls="--")
        left.text(
            0.01,
            limit,
            text,
            color="#4a5568",
            ha="left",
            va="bottom",
            transform=left.get_yaxis_transform(),
        )
    left.set(xlabel="CPU time [ms]", ylabel="largest velocity error [m/s]")
    left.set_xlim(left.get_xlim()[0] / 15, left.get_xlim()[1] * 8)
    left.set_title(f"A pile of {numbers['rows']} rows: error against time", fontsize=12, loc="left")
    share = np.linspace(100, 0, 101)
    for (name, values), color in zip(
        numbers["quantiles"].items(), ("#c05621", "#5b4b9a"), strict=True
    ):
        values = np.maximum(values, 1e-17)
        right.semilogx(values, share, color=color, lw=2.5)
        right.annotate(
            name,
            (values[40], share[40]),
            (8, 4),
            textcoords="offset points",
            color=color,
            fontsize=12,
        )
    right.axvline(1e-3, color="#718096", lw=0.8, ls="--")
    right.text(1e-3, 102, "the limit", color="#4a5568", fontsize=10, ha="center")
    right.set(
        xlabel="velocity error of a step [m/s; rad/s of hinges]",
        ylabel="steps with a larger error [%]",
        xlim=(1e-17, 1e-2),
    )
    right.set_title(
        "A humanoid in MuJoCo, before and after tuning", fontsize=12, loc="left", pad=14
    )
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def main():
    """Measure in an empty folder, and write the numbers and the figure."""
    with tempfile.TemporaryDirectory() as folder:
        here = Path.cwd()
        os.chdir(folder)
        try:
            numbers = measure()
        finally:
            os.chdir(here)
    write(numbers)


def write(numbers):
    """Write the numbers and the figure, with the same bytes for the same numbers."""
    mpl.rcParams.update({"svg.hashsalt": "lavender", "svg.fonttype": "path", "font.size": 11})
    (STATIC / "hero.json").write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
    draw(numbers).savefig(STATIC / "hero.svg", metadata={"Date": None}, facecolor="white")


if __name__ == "__main__":
    main()
