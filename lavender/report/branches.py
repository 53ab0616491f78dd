"""The table of `lavender bench branches`."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lavender.bench.branches import WAYS, Crossing

__all__ = ["table"]

HEAD = (
    *("run", "steps searched", "proved unique", "several motions", "median, largest spread"),
    *("warm", "cold", "`newton`", "by chance"),
)


def table(found: Sequence[Crossing]) -> str:
    """For each run, as markdown: steps with several motions, and how often each way ends at the nearest one.

    By chance: how many of them would, if each way ended at any motion of a step alike.
    """
    lines = [
        f"| {' | '.join(HEAD)} |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    groups: dict[str, list[Crossing]] = {}
    for one in found:
        groups.setdefault(one.run, []).append(one)
        groups.setdefault("all", []).append(one)
    for run, group in sorted(groups.items(), key=lambda item: item[0] == "all"):
        several = [one for one in group if one.motions > 1]
        spread = [one.spread for one in several]
        text = f"{np.median(spread):.2g}, {max(spread):.2g} m/s" if spread else ""
        ways = []
        for way in WAYS:
            told = [getattr(one, way) for one in several if getattr(one, way)]
            ways.append(f"{sum(word == 'nearest' for word in told)} of {len(told)}" if told else "")
        proved = sum(bool(one.unique) for one in group)
        chance = f"{sum(1.0 / one.motions for one in several):.0f}" if several else ""
        cells = (str(len(group)), str(proved), str(len(several)), text, *ways, chance)
        lines.append(f"| {run} | {' | '.join(cells)} |")
    several = [one for one in found if one.motions > 1]
    if several:
        lines += [
            "",
            "Distance from where the step comes from, median over steps with several motions [m/s]:",
            "",
        ]
        lines += ["| to the nearest motion | warm | cold | `newton` |", "|---|---|---|---|"]
        columns = ("nearest", *(f"{way}_distance" for way in WAYS))
        middles: list[str] = []
        for column in columns:
            told = [x for one in several if not math.isnan(x := getattr(one, column))]
            middles.append(f"{np.median(told):.2g}" if told else "")
        lines.append("| " + " | ".join(middles) + " |")
    return "\n".join(lines)
