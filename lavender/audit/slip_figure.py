"""Draw the division of slip by its causes.

figure = draw_slip(explanations)                # results of explain_slip_of_states, or [explain_slip(...)]
figure.savefig("slip.png")
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from lavender.audit.slip import CAUSES, SlipExplanation, average_slip
from lavender.base.errors import InputError, require_packages
from lavender.report.text import format_count

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Colours of Okabe and Ito, which colour-blind readers can distinguish, in the order of `CAUSES`.
CAUSE_COLORS = ("#D55E00", "#CC79A7", "#56B4E9", "#E69F00", "#999999")
MAX_DRAWN_CONTACTS = 20  # Of more contacts, only this many with the largest sliding speeds are drawn.
WIDTH, BAR_HEIGHT, MARGIN_HEIGHT = 8.0, 0.45, 1.7  # [inches]


def draw_slip(explanations: Iterable[SlipExplanation]) -> Figure:
    """Draw the mean parts of each contact's slip as bars, and its mean sliding speed in the engine's answer as a mark.

    Parameters
    ----------
    explanations : iterable of SlipExplanation
        One for each step.

    Returns
    -------
    matplotlib.figure.Figure
        One bar for each of the contacts that slide fastest, at most 20. The parts of a bar are norms of vector
        differences. By the triangle inequality their sum is at least the sliding speed in the engine's answer.

    Raises
    ------
    InputError
        There are no explanations, or none has a contact.
    """
    require_packages("a figure", "matplotlib")
    from matplotlib.figure import Figure

    averages = average_slip(explanations)
    if not averages:
        raise InputError(
            "the explanations have no contact to draw: at least one step with a contact is needed"
        )
    fastest = sorted(averages, key=lambda a: -a.speed)[:MAX_DRAWN_CONTACTS]
    figure = Figure(figsize=(WIDTH, MARGIN_HEIGHT + BAR_HEIGHT * len(fastest)), layout="constrained")
    axes = figure.add_subplot()
    labels = [f"{a.contact}\n{format_count(a.count, 'point')}".replace("$", r"\$") for a in fastest]
    left = [0.0] * len(fastest)
    for cause, color in zip(CAUSES.values(), CAUSE_COLORS, strict=True):
        parts = [a.parts[cause] for a in fastest]
        axes.barh(labels, parts, left=left, color=color, label=cause, height=0.6)
        left = [x + part for x, part in zip(left, parts, strict=True)]
    speeds = [a.speed for a in fastest]
    axes.plot(speeds, labels, "|k", markersize=18, markeredgewidth=2, label="speed in the engine's answer")
    axes.invert_yaxis()
    axes.set_xlim(0.0, 1.05 * max(*left, *speeds) or 1.0)
    axes.set_xlabel("mean sliding speed after a step [m/s]")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper left", ncols=3, frameon=False, fontsize="small")
    return figure
