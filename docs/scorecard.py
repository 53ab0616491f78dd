"""Draw the figures of scorecard.md and write its tables, from the table of `python -m benchmarks score`.

python docs/scorecard.py
"""

import io
import math
import sys
from pathlib import Path

import matplotlib as mpl
import matplotlib.ticker
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

from generate import replace_tables

from benchmarks.score.records import read_records
from benchmarks.score.scenes import FRICTION, HEADINGS, RATES, SCENES, classify
from benchmarks.score.settings import ENGINES
from benchmarks.score.simulate import split_requirement

N_COLORS = 64  # Number of colours of a picture.
STATIC = ROOT / "docs" / "static" / "scorecard"
COLORS = ("#2166ac", "#92c5de", "#f4a582", "#b2182b")  # good, fair, poor, wrong
NONE, FAILED = "#dddddd", "#9e9ac8"
COLUMNS = {"default": 240, "accurate": 1000}  # level -> steps a second of the heat map
mpl.rcParams.update({"font.size": 9})


def markdown(head, lines):
    """Return a table without spaces at the bars."""
    return "\n".join(
        f"|{'|'.join(map(str, line))}|" for line in (head, ["---"] * len(head), *lines)
    )


def find(rows, engine, level, scene):
    """Return the row of a cell of the heat map, or None; curves are measured at one rate."""
    return rows.get((engine, level, 240 if SCENES[scene].curve else COLUMNS[level], scene))


def describe(row, scene):
    """Return text and colour of a cell."""
    if row is None:
        return "", "white"
    if row.note:
        kind = row.note.split(":")[0]
        return {"cannot": "–", "too slow": "slow"}.get(
            kind, kind
        ), NONE if kind == "cannot" else FAILED
    error = row.error
    text = (
        "lost"
        if not math.isfinite(error)
        else "0"
        if error == 0
        else f"{error:.2g}"
        if error >= 1e-3
        else f"{error:.0e}"
    )
    return text.replace("e-0", "e-"), COLORS[classify(scene, error)]


def draw_heat(rows):
    """Draw the errors of all engines and scenes, coloured by class."""
    figure = Figure(figsize=(17, 0.36 * len(ENGINES) + 1.4), layout="constrained")
    for axes, level in zip(figure.subplots(1, 2, sharey=True), COLUMNS, strict=True):
        for i, engine in enumerate(ENGINES):
            for j, scene in enumerate(SCENES):
                text, color = describe(find(rows, engine, level, scene), scene)
                axes.add_patch(mpl.patches.Rectangle((j, i), 1, 1, fc=color, ec="white", lw=1.5))
                dark = color in (COLORS[0], COLORS[3])
                axes.text(
                    j + 0.5,
                    i + 0.52,
                    text,
                    ha="center",
                    va="center",
                    fontsize=8,
                    color="w" if dark else "k",
                )
        axes.set(xlim=(0, len(SCENES)), ylim=(len(ENGINES), 0))
        axes.set_xticks(
            np.arange(len(SCENES)) + 0.5,
            [f"{n}\n[{s.unit}]" for n, s in SCENES.items()],
            fontsize=8,
            rotation=40,
        )
        axes.xaxis.tick_top()
        axes.set_yticks(np.arange(len(ENGINES)) + 0.5, [entry.title for entry in ENGINES.values()])
        axes.tick_params(length=0)
        axes.set_frame_on(False)
        last = "" if COLUMNS[level] == 240 else " (heading, rates, ratios: 1/240 s)"
        axes.set_title(f"{level} settings, 1/{COLUMNS[level]} s{last}")
    return figure


def get_styles(names):
    """Return a colour and a marker for each engine."""
    colors = mpl.colormaps["tab20"].colors
    markers = "osD^v<>Pp*hX"
    return {
        name: {"color": colors[i % 20], "marker": markers[i % 12]} for i, name in enumerate(names)
    }


def draw_headings(rows):
    """Draw the effective friction coefficient against the direction of the slope."""
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    turns = np.radians([*HEADINGS, *(90 - h for h in HEADINGS[-2::-1])])
    angles = np.concatenate([turns + k * math.pi / 2 for k in range(4)])
    for k, level in enumerate(COLUMNS):
        axes = figure.add_subplot(1, 2, k + 1, projection="polar")
        for name, style in get_styles(ENGINES).items():
            row = find(rows, name, level, "heading")
            if row and row.values:
                values = [*row.values, *row.values[-2::-1]] * 4
                lavender = name == "lavender"
                axes.plot(
                    angles,
                    values,
                    color="k" if lavender else style["color"],
                    lw=3 if lavender else 1.4,
                    alpha=0.35 if lavender else 1.0,
                    label=ENGINES[name].title,
                )
        axes.set(ylim=(0, 0.8), yticks=(0.25, FRICTION, 0.75))
        axes.set_title(f"{level} settings")
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=8
    )
    return figure


def draw_rates(rows):
    """Draw the first rebound against the rate of steps."""
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    for axes, level in zip(figure.subplots(1, 2, sharey=True), COLUMNS, strict=True):
        axes.axhline(0.64, color="k", lw=4, alpha=0.25, label="truth, e² h")
        for name, style in get_styles(ENGINES).items():
            row = find(rows, name, level, "rates")
            if row and row.values:
                axes.semilogx(RATES, row.values, ms=4, lw=1, label=ENGINES[name].title, **style)
        axes.set(xlabel="steps a second", title=f"{level} settings", ylim=(-0.05, 1.0))
        axes.set_xticks(RATES, RATES)
        axes.minorticks_off()
    figure.axes[0].set_ylabel("first rebound [m]")
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=8
    )
    return figure


def draw_costs(rows):
    """Draw error against CPU time of a step for each scene."""
    figure = Figure(figsize=(13, 10.5), layout="constrained")
    panels = figure.subplots(4, 5).ravel()
    for axes, (scene, data) in zip(panels, SCENES.items(), strict=False):
        for name, style in get_styles(ENGINES).items():
            for row in rows.values():
                if (
                    (row.engine, row.scene) == (name, scene)
                    and not row.note
                    and math.isfinite(row.error)
                ):
                    face = style["color"] if row.level == "accurate" else "none"
                    axes.loglog(
                        row.cost,
                        max(row.error, 1e-9),
                        style["marker"],
                        mec=style["color"],
                        mfc=face,
                        ms=5,
                    )
        for limit, color in zip(data.limits, COLORS[1:], strict=True):
            axes.axhline(limit, color=color, lw=1)
        axes.set_title(f"{scene} [{data.unit}]", fontsize=9)
        axes.xaxis.set_minor_formatter(mpl.ticker.NullFormatter())
    for name, style in get_styles(ENGINES).items():
        panels[-1].plot(
            [], [], style["marker"], color=style["color"], ls="", label=ENGINES[name].title
        )
    for axes in panels[len(SCENES) :]:
        axes.set_axis_off()
    panels[-1].legend(loc="center", fontsize=8, ncols=2, bbox_to_anchor=(0.1, 0.5))
    figure.supxlabel("CPU time of a step [µs]")
    figure.supylabel("error, at least 1e-9; hollow: default settings, filled: accurate settings")
    return figure


def make_scene_table():
    """Return the table of scenes, truths and classes."""

    def write_floor(scene):
        floors = [scene.floor(1 / rate) for rate in (240, 1000)]
        return ", ".join(f"{floor:.2g}" for floor in floors) if max(floors) else "0"

    lines = [
        (name, s.truth, f"{', '.join(f'{x:g}' for x in s.limits)} {s.unit}", write_floor(s))
        for name, s in SCENES.items()
    ]
    return markdown(("scene", "truth", "good, fair, poor up to", "integrator alone"), lines)


def make_settings_table():
    """Return the table of engines, versions and settings."""

    def write(entry):
        return ", ".join(
            f"{k} {v:g}" if isinstance(v, float) else f"{k} {v}" for k, v in entry.accurate.items()
        )

    lines = [
        (e.title, split_requirement(e.packages[0])[1] if e.packages else "", write(e))
        for e in ENGINES.values()
    ]
    return markdown(("engine", "version", "accurate settings"), lines)


def make_residual_table(rows):
    """Return errors beside the largest residual of the engines that lavender reads."""
    lines = []
    for scene in ("stick", "slip", "grip", "stack", "ratio", "cards"):
        cells = []
        for name, level in (
            ("mujoco", "default"),
            ("mujoco", "accurate"),
            ("mujoco-pgs", "default"),
            ("lavender", "default"),
        ):
            row = find(rows, name, level, scene)
            cells.append(f"{row.error:.1e}, {row.residual:.0e}" if row and not row.note else "–")
        lines.append((f"{scene} [{SCENES[scene].unit}]", *cells))
    heads = (
        "scene",
        "MuJoCo, Newton, default",
        "MuJoCo, Newton, accurate",
        "MuJoCo, PGS, default",
        "LavenderSim, default",
    )
    return markdown(heads, lines)


def main():
    """Draw all figures and write all tables."""
    rows = read_records()
    STATIC.mkdir(exist_ok=True)
    for name, draw in (
        ("heat", draw_heat),
        ("headings", draw_headings),
        ("rates", draw_rates),
        ("costs", draw_costs),
    ):
        drawn = io.BytesIO()
        draw(rows).savefig(drawn, dpi=85)
        Image.open(drawn).convert("RGB").quantize(N_COLORS, dither=Image.Dither.NONE).save(
            STATIC / f"{name}.png", optimize=True
        )
    tables = {
        "scenes": make_scene_table(),
        "settings": make_settings_table(),
        "residuals": make_residual_table(rows),
    }
    replace_tables(ROOT / "docs" / "scorecard.md", tables)


if __name__ == "__main__":
    main()
