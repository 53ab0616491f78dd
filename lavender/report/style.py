"""One look for every figure: a solver keeps its colour, dash and mark wherever it appears in one report.

Colours are Okabe and Ito's (distinct under the common colour-vision deficiencies), the darker ones
readable on white and on near-black; dashes and marks tell apart what shares a colour, also in grey print.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

__all__ = ["Look", "looks"]

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C6D31", "#7F7F7F")
# Names of dashes and marks, ours and matplotlib's.
DASHES = (("solid", "-"), ("dash", "--"), ("dot", ":"), ("dashdot", "-."))
MARKS = (
    ("circle", "o"),
    ("square", "s"),
    ("triangle-up", "^"),
    ("diamond", "D"),
    ("x", "X"),
    ("star", "*"),
    ("triangle-down", "v"),
)


@dataclass(frozen=True)
class Look:
    """Colour, dash and mark of a saved figure."""

    color: str
    dash: str
    mark: str
    line: str  # matplotlib
    marker: str  # matplotlib


# These come first, so that what is compared most often never shares a colour.
FIRST = ("pgs", "direct", "block_gauss_seidel", "osqp", "newton", "clarabel", "jacobi", "sequential_impulses")


def looks(solvers: Iterable[str]) -> dict[str, Look]:
    """A look for each solver: by its place in `FIRST`, then among the sorted names."""
    out = {}
    names = set(solvers)
    rest = sorted(names - set(FIRST))
    place = {name: i for i, name in enumerate((*FIRST, *rest))}
    for name in sorted(names):
        i = place[name]
        dash, mark = DASHES[i // len(COLORS) % len(DASHES)], MARKS[i % len(MARKS)]
        out[name] = Look(COLORS[i % len(COLORS)], dash[0], mark[0], dash[1], mark[1])
    return out
