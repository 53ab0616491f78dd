"""Draw the figures of scorecard.md, write its tables and the file of settings, from `python -m benchmarks score`.

python docs/scorecard.py
"""

import csv
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

from benchmarks.score.causes import PARTS, read_causes
from benchmarks.score.records import read_records
from benchmarks.score.run import COLUMNS, CURVE_FACTOR, LIMIT
from benchmarks.score.scenes import FRICTION, HEADINGS, RATES, SCENES, classify
from benchmarks.score.settings import ENGINES, NOT_RUN, RULE
from benchmarks.score.simulate import split_requirement

CAUSES_RANGE = (-2.5, 3.5)  # [-]
LARGE_SHARE = 0.1  # [-]
N_COLORS = 64  # Number of colours of a picture.
STATIC = ROOT / "docs" / "static" / "scorecard"
COLORS = ("#2166ac", "#92c5de", "#f4a582", "#b2182b")  # good, fair, poor, wrong
NONE, FAILED = "#dddddd", "#9e9ac8"
mpl.rcParams.update({"font.size": 9})


def markdown(head, lines):
    """Return a table without spaces at the bars."""
    return "\n".join(
        f"|{'|'.join(map(str, line))}|" for line in (head, ["---"] * len(head), *lines)
    )


def find(rows, engine, column, scene):
    """Return the row of a cell, or None; a scene with rates of its own is measured in one column of a level."""
    level, rate = column
    rate = 240 if SCENES[scene].own_rates else rate
    return rows.get((engine, level, rate, scene))


def get_engines(rows, columns=COLUMNS):
    """Return the names of the rows whose cells of some columns have all been run."""
    return [
        name
        for name in ENGINES
        if all(find(rows, name, column, scene) for column in columns for scene in SCENES)
    ]


def write_column(column):
    """Return the name of a column."""
    return f"{column[0]} settings, 1/{column[1]} s"


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


def draw_heat(rows, column):
    """Draw the errors of all engines and scenes in a column, coloured by class."""
    names = get_engines(rows, (column,))
    figure = Figure(figsize=(11, 0.3 * len(names) + 1.2), layout="constrained")
    axes = figure.subplots()
    for i, engine in enumerate(names):
        for j, scene in enumerate(SCENES):
            text, color = describe(find(rows, engine, column, scene), scene)
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
    axes.set(xlim=(0, len(SCENES)), ylim=(len(names), 0))
    axes.set_xticks(
        np.arange(len(SCENES)) + 0.5,
        [f"{n}\n[{s.unit}]" for n, s in SCENES.items()],
        fontsize=8,
        rotation=40,
    )
    axes.xaxis.tick_top()
    axes.set_yticks(np.arange(len(names)) + 0.5, [ENGINES[name].title for name in names])
    axes.tick_params(length=0)
    axes.set_frame_on(False)
    axes.set_title(write_column(column))
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
    for k, column in enumerate(COLUMNS[:2]):
        axes = figure.add_subplot(1, 2, k + 1, projection="polar")
        for name, style in get_styles(get_engines(rows, COLUMNS[:1])).items():
            row = find(rows, name, column, "heading")
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
        axes.set_title(write_column(column))
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc="outside right center", fontsize=8
    )
    return figure


def draw_rates(rows):
    """Draw the first rebound against the rate of steps."""
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    for axes, column in zip(figure.subplots(1, 2, sharey=True), COLUMNS[:2], strict=True):
        axes.axhline(0.64, color="k", lw=4, alpha=0.25, label="truth, e² h")
        for name, style in get_styles(get_engines(rows, COLUMNS[:1])).items():
            row = find(rows, name, column, "rates")
            if row and row.values:
                axes.semilogx(RATES, row.values, ms=4, lw=1, label=ENGINES[name].title, **style)
        axes.set(xlabel="steps a second", title=f"{column[0]} settings", ylim=(-0.05, 1.0))
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
        for name, style in get_styles(get_engines(rows, COLUMNS[:1])).items():
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
    for name, style in get_styles(get_engines(rows, COLUMNS[:1])).items():
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


def write_options(options):
    """Return options as text."""
    return ", ".join(
        f"{k}={v:g}" if isinstance(v, float) else f"{k}={v}" for k, v in options.items()
    )


def make_rule_table():
    """Return the rule of the accurate columns."""
    return markdown(("knob", "accurate columns"), RULE.items())


def make_settings_file():
    """Return what each row sets of each kind of knob, with sources, and why other kinds are not set, as CSV text."""
    lines = [("row", "version", "knob", "set to", "source, or reason")]
    for entry in ENGINES.values():
        version = split_requirement(entry.packages[0])[1] if entry.packages else ""
        lines += [
            (entry.title, version, knob.kind, write_options(knob.options), knob.source)
            for knob in entry.knobs
        ]
        same = {}
        for kind, reason in entry.unset.items():
            same.setdefault(reason, []).append(kind)
        lines += [
            (entry.title, version, ", ".join(kinds), "–", reason) for reason, kinds in same.items()
        ]
        if entry.common:
            lines.append(
                (entry.title, version, "solver", write_options(entry.common), "in all columns")
            )
    written = io.StringIO()
    csv.writer(written, lineterminator="\n").writerows(lines)
    return written.getvalue()


def make_reason_table():
    """Return the reasons of the classes' limits, one line for the scenes with the same."""
    scenes = {}
    for name, s in SCENES.items():
        limits = ", ".join(f"{x:g}" for x in s.limits) + f" {s.unit}"
        scenes.setdefault((limits, s.reason), []).append(name)
    lines = [(", ".join(names), *key) for key, names in scenes.items()]
    return markdown(("scenes", "good, fair, poor up to", "reason"), lines)


def make_missing_table(rows):
    """Return the engines that were tried and are not in the table, and rows without cells."""
    whole, default = get_engines(rows), get_engines(rows, COLUMNS[:1])
    parts = {
        "adapters and settings exist; the cells have not been run": [
            name for name in ENGINES if name not in default
        ],
        "the accurate columns have not all been run": [n for n in default if n not in whole],
    }
    lines = [
        (", ".join(ENGINES[name].title for name in names), reason)
        for reason, names in parts.items()
        if names
    ]
    return markdown(("engine", "reason"), [*lines, *NOT_RUN.items()])


def join_names(names, rows):
    """Return titles of rows as text, the engine's alone if it has all of its rows."""
    titles = []
    for name in names:
        siblings = [
            n for n in get_engines(rows, COLUMNS[:1]) if ENGINES[n].engine == ENGINES[name].engine
        ]
        title = ENGINES[name].title
        titles.append(title.split(" (")[0] if set(siblings) <= set(names) else title)
    titles = list(dict.fromkeys(titles))
    return " and ".join(filter(None, (", ".join(titles[:-1]), titles[-1]))) if titles else "none"


def get_class(row):
    """Return the class of a cell, 4 if it is too slow, None if it cannot be expressed or is missing."""
    if row is None or row.note.startswith("cannot"):
        return None
    return 4 if row.note else classify(row.scene, row.error)


def count_changes(rows, before, after):
    """Return how many cells have a better and a worse class in the second of two columns, without slow ones."""
    pairs = [
        [get_class(find(rows, name, column, scene)) for column in (before, after)]
        for name in get_engines(rows, (before, after))
        for scene in SCENES
        if not (SCENES[scene].own_rates and before[0] == after[0])
    ]
    pairs = [pair for pair in pairs if None not in pair and 4 not in pair]
    return sum(b < a for a, b in pairs), sum(b > a for a, b in pairs)


def count_passed(rows, name, column):
    """Return in how many scenes a row is good or fair, and how many it can express."""
    found = [get_class(find(rows, name, column, scene)) for scene in SCENES]
    return sum(c is not None and c < 2 for c in found), sum(c is not None for c in found)


def make_findings(rows):
    """Return the sentences of the page that have numbers or names of engines, one item each."""
    default, accurate, fine = COLUMNS
    names = get_engines(rows, COLUMNS[:1])

    def error(name, scene, column):
        row = find(rows, name, column, scene)
        return math.nan if row is None or row.note else row.error

    def count(name, column):
        return count_passed(rows, name, column)[0]

    def get_best(column):
        most = max(count(name, column) for name in names)
        return most, join_names([name for name in names if count(name, column) == most], rows)

    slip = 9.81 * (
        math.sin(math.atan(FRICTION) + math.radians(1))
        - FRICTION * math.cos(math.atan(FRICTION) + math.radians(1))
    )
    asleep = [n for n in names if abs(error(n, "slip", default) - slip) < 0.01 * slip]
    awake = [n for n in asleep if get_class(find(rows, n, accurate, "slip")) == 0]
    apart = [
        n
        for n in names
        if get_class(find(rows, n, accurate, "spin")) == 3
        and get_class(find(rows, n, accurate, "slide")) == 0
    ]
    better, worse = count_changes(rows, default, accurate)
    finer, coarser = count_changes(rows, accurate, fine)
    most, best = get_best(default)
    most_accurate, best_accurate = get_best(accurate)
    soft, hard, noslip = (
        error(n, "stick", accurate) for n in ("mujoco-soft", "mujoco", "mujoco-noslip")
    )
    repeated = [row for row in rows.values() if row.runs >= 3 and not row.note]
    differ = sum(row.spread != 0.0 for row in repeated)
    verb = "are" if " and " in best else "is"
    own = f"{count('lavender', default)} and {count('lavender', accurate)}"
    shared = f"{most} and {most_accurate}"
    found = {
        "Settings against time step": f"accurate settings change the class of {better} cells for the better and of "
        f"{worse} for the worse; the finer step then {finer} and {coarser}.",
        "By default": f"{best} {verb} good or fair in most scenes, {most} of {len(SCENES)}; with accurate settings at "
        f"the same step {best_accurate}, {most_accurate}."
        + (f" LavenderSim: {own}." if "lavender" in names and own != shared else ""),
        "MuJoCo": f"by default a slab below the friction angle slides at {error('mujoco', 'stick', default):.2g} m/s: "
        f"its friction is a pyramid. A round cone with impratio 100 leaves {soft:.1g} m/s, stiff contacts as well "
        f"{hard:.1g}, noslip as well {noslip:.1g}.",
        "Rest": f"{join_names(asleep, rows)} leave the slab of `slip` at rest by default; {join_names(awake, rows)} "
        f"{'is' if len(awake) == 1 else 'are'} right with accurate settings.",
        "Slide and turn": f"{join_names(apart, rows)} stop the cube of `slide` rightly and that of `spin`, which "
        "turns as well, wrongly.",
        "Repeated cells": f"equal errors in {len(repeated) - differ} of {len(repeated)}.",
    }
    return "\n".join(f"- **{head}:** {line}" for head, line in found.items())


def make_limits(rows):
    """Return the sentences on the rows, on what the engines cannot express, and on times."""
    names = get_engines(rows, COLUMNS[:1])
    why = {}
    for name in names:
        row = find(rows, name, COLUMNS[0], "bounce")
        if row and row.note.startswith("cannot: no "):
            why.setdefault(row.note.removeprefix("cannot: "), []).append(name)
    without = set().union(*why.values())

    def shorten(name):
        """Return the title of an engine, or of a row if another row of the engine bounces."""
        others = {other for other in names if ENGINES[other].engine == ENGINES[name].engine}
        title = ENGINES[name].title
        return title.split(" (")[0] if others <= without else title

    engines = [
        (sorted({shorten(name) for name in same}), reason.split(", ")[-1])
        for reason, same in why.items()
    ]
    bounce = "; ".join(f"{', '.join(titles)}: {reason}" for titles, reason in engines)
    curves = ", ".join(f"`{name}`" for name, scene in SCENES.items() if scene.curve)
    patient = [name for name in names if ENGINES[name].patience > 1.0]
    times = {ENGINES[name].patience for name in patient}
    assert len(times) <= 1, "the sentence on slow engines names one limit"
    longer = f"; {times.pop():g} times that for {join_names(patient, rows)}" if patient else ""
    partial = [name for name in names if name not in get_engines(rows)]
    count = len({ENGINES[name].engine for name in names})
    return (
        f"{count} engines in {len(names)} rows: several solvers of one engine are rows. Violet: more than "
        f"{LIMIT:g} s of CPU time, {CURVE_FACTOR * LIMIT:g} s for {curves}{longer}. No coefficient of restitution: "
        f"{bounce}." + (f" By default only: {join_names(partial, rows)}." if partial else "")
    )


def draw_causes(causes):
    """Draw the shares of the causes of the cells that are not good: a panel for each column, a bar for each cell."""
    shown = [part for part in PARTS if any(abs(cell[part]) >= 0.005 for cell in causes)]
    columns = COLUMNS[:2]
    cells = {
        column: [cell for cell in causes if (cell["level"], cell["rate"]) == column]
        for column in columns
    }
    longest = max(map(len, cells.values()))
    figure = Figure(figsize=(13, 0.17 * longest + 1.2), layout="constrained")
    colors = mpl.colormaps["tab10"].colors
    for axes, column in zip(figure.subplots(1, 2), columns, strict=True):
        for i, cell in enumerate(cells[column]):
            ends = {1: 0.0, -1: 0.0}
            for part in shown:
                share = cell[part]
                side = 1 if share >= 0 else -1
                axes.barh(i, share, left=ends[side], height=0.8, color=colors[PARTS.index(part)])
                ends[side] += share
        labels = [
            f"{ENGINES[c['engine']].title}: {c['scene']}, {c['error']:.2g} {SCENES[c['scene']].unit}"
            for c in cells[column]
        ]
        axes.set_yticks(range(len(labels)), labels, fontsize=7)
        axes.set(
            xlim=CAUSES_RANGE,
            ylim=(longest - 0.4, -0.6),
            xlabel="share of the difference to the rigid laws [-]; a bar that reaches the border is longer",
            title=write_column(column),
        )
        axes.axvline(0.0, color="k", lw=0.8)
        axes.axvline(1.0, color="k", lw=0.8, ls=":")
    handles = [mpl.patches.Patch(color=colors[PARTS.index(part)], label=part) for part in shown]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(shown), fontsize=8)
    return figure


def get_main_part(cell):
    """Return the part with the largest share of a cell."""
    return max(PARTS, key=lambda part: abs(cell[part]))


def make_causes(causes):
    """Return the sentences on the causes of cells that are not good."""
    engines = dict.fromkeys(ENGINES[cell["engine"]].title.split(" (")[0] for cell in causes)
    by_solver = {}
    for cell in causes:
        if abs(cell["solver"]) >= LARGE_SHARE:
            title = ENGINES[cell["engine"]].title.split(" (")[0]
            by_solver[title] = by_solver.get(title, 0) + 1
    solver = ", ".join(f"{title} {count}" for title, count in by_solver.items())
    stick = next(
        c for c in causes if (c["engine"], c["level"], c["scene"]) == ("mujoco", "default", "stick")
    )
    parts = ", ".join(f"{part} {stick[part]:+.2f}" for part in PARTS if abs(stick[part]) >= 0.005)
    counts = {part: sum(get_main_part(cell) == part for cell in causes) for part in PARTS}
    largest = ", ".join(
        f"{part} {count}"
        for part, count in sorted(counts.items(), key=lambda item: -item[1])
        if count
    )
    return (
        f"{len(causes)} cells of {len(engines)} engines ({', '.join(engines)}), by the largest share: {largest}. The "
        f"solver's share is {LARGE_SHARE:.0%} or more in {sum(by_solver.values())} of them ({solver}): a better solver "
        f"changes none of the others. MuJoCo's slab of `stick` is {parts}."
    )


def make_tables(rows):
    """Return the parts of the page that are made from the records."""
    return {
        "findings": make_findings(rows),
        "limits": make_limits(rows),
        "scenes": make_scene_table(),
        "causes": make_causes(read_causes()),
    }


def make_settings(rows):
    """Return the parts of the page of settings."""
    return {
        "rule": make_rule_table(),
        "reasons": make_reason_table(),
        "missing": make_missing_table(rows),
    }


def main():
    """Draw all figures and write all tables."""
    rows = read_records()
    STATIC.mkdir(exist_ok=True)
    heats = {f"heat-{level}-{rate}": (level, rate) for level, rate in COLUMNS}
    figures = {name: draw_heat(rows, column) for name, column in heats.items()}
    figures |= {
        "headings": draw_headings(rows),
        "rates": draw_rates(rows),
        "costs": draw_costs(rows),
        "causes": draw_causes(read_causes()),
    }
    for name, figure in figures.items():
        drawn = io.BytesIO()
        figure.savefig(drawn, dpi=85)
        Image.open(drawn).convert("RGB").quantize(N_COLORS, dither=Image.Dither.NONE).save(
            STATIC / f"{name}.png", optimize=True
        )
    replace_tables(ROOT / "docs" / "scorecard.md", make_tables(rows))
    replace_tables(ROOT / "docs" / "scorecard-settings.md", make_settings(rows))
    (STATIC / "settings.csv").write_text(make_settings_file(), encoding="utf-8")


if __name__ == "__main__":
    main()
