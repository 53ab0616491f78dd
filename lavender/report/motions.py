"""What a residual tells of the motion, and how many motions a problem has: tables and a figure of both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lavender.bench.motions import LARGEST, SMALLEST, Branches, Sample
from lavender.io.stored import write_figure

__all__ = ["calibration", "figure", "predictors", "several_table", "table"]


def calibration(found: Sequence[Sample]) -> list[tuple[str, int, float, float, float, str]]:
    """Motion error over residual by structure and of all: (structure, iterates, median, 95 %, largest, where)."""
    groups: dict[str, list[Sample]] = {}
    for sample in found:
        for word in dict.fromkeys((*sample.structure.split(" + "), f"law {sample.law}", "all")):
            groups.setdefault(word, []).append(sample)
    rows = []
    for word, group in groups.items():
        ratio = np.array([s.motion / s.relative for s in group])
        worst = group[int(np.argmax(ratio))]
        where = f"{worst.case}, {worst.solver} {worst.iterations}"
        rows.append(
            (
                word,
                len(group),
                float(np.median(ratio)),
                float(np.quantile(ratio, 0.95)),
                float(ratio.max()),
                where,
            )
        )
    return sorted(rows, key=lambda row: (row[0] == "all", row[0].startswith("law "), -row[1]))


def predictors(found: Sequence[Sample]) -> list[tuple[str, int, float, float]]:
    """How well each residual predicts the motion error: (name, iterates, median factor, spread of its log10)."""
    rows = []
    same = [s for s in found if math.isfinite(s.plain) and s.plain > 0.0]
    measures = (
        ("max(E / E0, V / V0)", [s.relative for s in same]),
        ("E / E0 alone", [s.energy for s in same]),
        ("V / V0 alone", [s.velocity for s in same]),
        ("unit step, lambda - Pi(lambda - w)", [s.plain for s in same]),
    )
    for name, values in measures:
        kept = [(s.motion, v) for s, v in zip(same, values, strict=True) if s.motion > 0.0 and v > 0.0]
        if kept:
            log = np.log10([m / v for m, v in kept])
            rows.append((name, len(kept), float(10.0 ** np.median(log)), float(np.std(log))))
    return rows


def table(found: Sequence[Sample]) -> str:
    """The calibration as markdown."""
    lines = [
        "| structure | iterates | median | 95 % below | largest | where |",
        "|---|---|---|---|---|---|",
        *(
            f"| {word} | {n} | {median:.2g} | {high:.2g} | {most:.2g} | {where} |"
            for word, n, median, high, most, where in calibration(found)
        ),
        "",
        "| residual | iterates | median factor to the motion error | spread (decades, one standard deviation) |",
        "|---|---|---|---|",
        *(f"| {name} | {n} | {median:.2g} | {spread:.2f} |" for name, n, median, spread in predictors(found)),
    ]
    bounded = [s for s in found if math.isfinite(s.bound) and s.found > 0.0]
    if bounded:
        ratio = np.array([s.bound / s.found for s in bounded])
        lines += [
            "",
            f"Bound / motion error: {len(ratio)} iterates, median {np.median(ratio):.3g}, largest {ratio.max():.3g}.",
        ]
    return "\n".join(lines)


def several_table(found: Sequence[Branches]) -> str:
    """Share of Coulomb problems with several motions, by structure, friction and sliding, as markdown."""
    coulomb = [b for b in found if b.law == "coulomb"]
    groups: list[tuple[str, list[Branches]]] = [("all", coulomb)]
    words = dict.fromkeys(word for b in coulomb for word in b.structure.split(" + "))
    groups += [(word, [b for b in coulomb if word in b.structure.split(" + ")]) for word in words]
    for low, high in ((0.0, 0.3), (0.3, 0.6), (0.6, math.inf)):
        name = f"friction from {low:g}" + (f" to {high:g}" if high < math.inf else "")
        groups.append((name, [b for b in coulomb if low <= b.friction < high]))
    # Relative to nothing: m/s as they are; a thousandth of a millimetre per second is at rest.
    for name, low, high in (
        ("nothing slides", -1.0, 1e-6),
        ("slides below 0.1 m/s", 1e-6, 0.1),
        ("slides faster", 0.1, math.inf),
    ):
        groups.append((name, [b for b in coulomb if low < b.sliding <= high]))
    lines = [
        "| Coulomb problems | count | proved unique | one found | several | largest spread | where |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, group in groups:
        if not group:
            continue
        proved = sum(bool(b.unique) for b in group)
        several = [b for b in group if b.motions > 1]
        one = sum(b.motions == 1 and not b.unique for b in group)
        worst = max(several, key=lambda b: b.spread, default=None)
        last = "| |" if worst is None else f"{worst.spread:.2g} m/s | {worst.case} |"
        lines.append(
            f"| {name} | {len(group)} | {proved} | {one} | {len(several)} ({len(several) / len(group):.0%}) | {last}"
        )
    warm = [b.warm for b in coulomb if b.warm]
    if warm:
        stay = sum(word == "nearest" for word in warm)
        lines += [
            "",
            f"Warm starts where there are several: sweeps from {stay} of {len(warm)} end at the motion nearest to it.",
        ]
    none = sum(b.motions == 0 for b in coulomb)
    if none:
        lines += ["", f"No run ended at a solution of {none} of them; they count in the first column alone."]
    return "\n".join(lines)


def figure(found: Sequence[Sample], path: str | Path) -> None:
    """Relative motion error over relative residual, a dot an iterate, a colour a law.

    Raises
    ------
    InputError
        A path that cannot be written, or a suffix that matplotlib does not know.
    """
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(6.4, 5.2), layout="constrained")
    ax = canvas.subplots()
    for law in dict.fromkeys(s.law for s in found):
        own = [s for s in found if s.law == law]
        ax.loglog(
            [s.relative for s in own], [max(s.motion, 1e-16) for s in own], ".", ms=4, alpha=0.5, label=law
        )
    line = np.array([SMALLEST, LARGEST])
    ax.loglog(line, line, "k-", lw=0.8)
    for factor in (10.0, 100.0):
        ax.loglog(line, factor * line, "k:", lw=0.6)
        ax.annotate(f"{factor:g} times", (line[0] * 30, factor * line[0] * 40), fontsize=7, color="0.3")
    ax.set(
        xlabel="relative residual [-]",
        ylabel="relative motion error [-]",
        xlim=(SMALLEST, LARGEST),
        ylim=(1e-12, 10),
    )
    ax.legend(fontsize=8)
    write_figure(canvas, path, dpi=150)
