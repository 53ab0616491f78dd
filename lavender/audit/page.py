"""Write the page of an audit or a tuning, print its short form, and describe the sizes of the judged steps."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lavender.io.stored import format_json
from lavender.report.page import Page, tabulate_frame
from lavender.report.render import print_table, write_files
from lavender.report.text import format_count, format_percent

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Console


class Section(NamedTuple):
    """A heading with tables, functions that draw figures into a folder, lines to copy, and rows for a terminal."""

    title: str
    frames: Sequence[pd.DataFrame] = ()
    note: str = ""
    figures: Sequence[Any] = ()
    code: Sequence[str] = ()
    short: int = 0
    short_frame: pd.DataFrame | None = None


STOPPED_NOTE = "Stopped before the end: the numbers contain only the completed part."


@dataclass(frozen=True)
class ResultPage:
    """Contents of a page.

    Parameters
    ----------
    title : str
    headline : list of str
        Up to three sentences with the result, one on each line.
    sections : list of Section
    numbers : dict
        Contents of `numbers.json`.
    notes : list of str
        Sentences with advice and warnings; a terminal shows them below its tables.
    is_stopped : bool
        Whether the measurement ended early, so that all numbers describe only its completed part.
    provenance : str
        Last line: versions, settings, model, date and command.
    """

    title: str
    headline: Sequence[str]
    sections: Sequence[Section]
    numbers: dict[str, Any]
    notes: Sequence[str] = ()
    is_stopped: bool = False
    provenance: str = ""

    def write(self, folder: str | os.PathLike[str]) -> Path:
        """Write `index.html`, `numbers.json` and `figures/*`; return the path of the page."""
        from markupsafe import Markup

        blocks: list[Any] = []
        for section in self.sections:
            drawn = [Markup(draw(Path(folder) / "figures")) for draw in section.figures]
            code = [{"code": "\n".join(section.code)}] if section.code else []
            frames = [tabulate_frame(frame, note=section.note) for frame in section.frames if len(frame)]
            if drawn or code or frames:
                blocks.append({"folded": [*code, *frames, *drawn], "title": section.title, "open": True})
        notes = [*self.notes, *([STOPPED_NOTE] if self.is_stopped else []), *filter(None, [self.provenance])]
        page = Page(self.title, "", self.headline[0], self.headline[1:], warnings=notes, blocks=blocks)
        numbers = format_json(self.numbers, indent=1) + "\n"
        return (
            write_files(Path(folder), {"index.html": page.render(), "numbers.json": numbers}) / "index.html"
        )

    def print_short(self, console: Console) -> None:
        """Print the headline, the first rows of each section's first table, and the notes."""
        Page("", "", self.headline[0], self.headline[1:]).print_head(console)
        for section in self.sections:
            for line in section.code:
                console.print(f"    {line}", highlight=False, markup=False, soft_wrap=True)
            if section.code and section.note:
                console.print(section.note, highlight=False, markup=False)
            rows = section.frames[0].head(section.short) if section.frames else None
            frame = rows if section.short_frame is None else section.short_frame
            if frame is not None and len(frame):
                console.print()
                print_table(console, frame)
        for i, note in enumerate(self.notes):
            console.print(f"{'' if i else chr(10)}{note}", style="yellow", highlight=False, markup=False)
        if self.provenance:
            console.print(f"\n{self.provenance}", style="dim", highlight=False, markup=False)


# If a smaller fraction of the judged steps has contact, `tune` recommends no setting and an audit warns: mean times,
# and the error that 1 % of the steps exceed, then describe steps without contact. Examples: 6 % of the steps of
# dm_control's finger model have contact, none of its stacker model.
MIN_CONTACT_SHARE = 0.2


@dataclass(frozen=True, eq=False)
class StepSizes:
    """Rows and contacts of each judged step.

    Parameters
    ----------
    rows, contacts : (steps,) int
        Contacts that have rows.
    can_touch : bool
        Whether the model has geoms that can collide. If not, the fraction of steps with rows decides.
    """

    rows: np.ndarray
    contacts: np.ndarray
    can_touch: bool

    @property
    def has_enough_contact(self) -> bool:
        """Whether enough of the steps have contact to recommend a setting."""
        return self._n_with_contact >= MIN_CONTACT_SHARE * len(self.rows)

    @property
    def _n_with_contact(self) -> int:
        """Number of steps with contact, or with rows if the model has no geoms that can collide."""
        return int(np.count_nonzero(self.contacts if self.can_touch else self.rows))

    @property
    def contact_phrase(self) -> str:
        """Phrase with the number of steps that have contact and the fraction that is needed."""
        n, object_name = len(self.rows), "contact" if self.can_touch else "a constraint"
        fraction = f" ({format_percent(self._n_with_contact, n, min(1, self._n_with_contact))})" if n else ""
        needed = f"{100.0 * MIN_CONTACT_SHARE:g} %"
        return f"{self._n_with_contact} of {n} steps judged have {object_name}{fraction}, fewer than {needed}"

    @property
    def table(self) -> pd.DataFrame:
        """Median and maximum number of rows and contacts, and the fraction of steps that have any."""
        import pandas as pd

        rows = [
            (name, f"{np.median(counts):g}", counts.max(),
             format_percent(int(np.count_nonzero(counts)), len(counts), 1))
            for name, counts in (("rows", self.rows), ("contacts", self.contacts)) if len(counts)
        ]  # fmt: skip
        return pd.DataFrame(rows, columns=["in a step", "median", "maximum", "steps with any"])

    @property
    def as_dict(self) -> dict[str, Any]:
        """The contents of `table` for numbers.json."""
        numbers: dict[str, Any] = {"can_touch": self.can_touch, "min_contact_share": MIN_CONTACT_SHARE}
        for name, x in (("rows", self.rows), ("contacts", self.contacts)):
            values = (
                (float(np.median(x)), int(x.max()), float(np.mean(x > 0))) if len(x) else (None, None, None)
            )
            numbers[name] = dict(zip(("median", "maximum", "share"), values, strict=True))
        return numbers


def describe_exceedance(n_worlds: int) -> str:
    """Return a sentence on the probability that a further world has a larger error than all worlds measured.

    If n + 1 worlds are drawn from one distribution, each has the largest error with probability 1 / (n + 1), whatever
    the distribution. This does not hold for steps, because the steps of one world depend on each other.
    """
    if not n_worlds:
        return ""
    return (
        f"The maximum is that of {format_count(n_worlds, 'world')} and not a bound: a further world that is drawn "
        f"alike exceeds it with a probability of up to 1/{n_worlds + 1}."
    )
