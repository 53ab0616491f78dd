"""Make the page of an audit, and describe the sizes of the judged steps."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import markupsafe
from lavender.base.lazy_import import pandas as pd
from lavender.io.stored import format_json
from lavender.judge.residuals import AT_FLOOR, UNCONVERGED, VERDICTS, WRONG
from lavender.report import drawing
from lavender.report.page import DEFAULT_ERROR_LIMIT, Page, fold_table, make_shares, make_table
from lavender.report.render import print_table, write_files
from lavender.report.text import (
    format_count,
    format_number,
    format_percent,
    format_power,
    format_speed,
    split_row_unit,
)

if TYPE_CHECKING:
    from rich.console import Console

#: Largest part of the error of the worst step -> its cause, if the cause is not the solver.
OWN_CAUSES = {
    "lost digits": "Cause: the integrator. It moves the bodies by the forces, which have lost their digits, and the "
    'acceleration is exact: <option integrator="discrete"/> uses the acceleration.',
    "noslip": "Cause: noslip_iterations, a pass after the solver, which does not solve the engine's problem.",
}
ENGINE_ADVICE = "To find out whether the engine is the cause, audit again with --engine mujoco."
OUTSIDE_SOLVER = (
    "outside the constraint solver (time step, integrator, actuators or the model itself)"
)
DIVERGENCE_ADVICE = (
    'To find out whether the solver is the cause, audit again with <option solver="Newton" iterations="100" '
    'tolerance="1e-12"/>: if worlds diverge again after exact solves, the cause is the model.'
)
STOPPED_NOTE = "Stopped before the end: the numbers contain only the completed part."
QUANTILE_LINES = {"median": 0.5, "90 %": 0.9, "99 %": 0.99, "worst": 1.0}
MAX_BINS = 50  # Largest number of bins of steps of the figure over time.
MAX_STRIP_WORLDS, MAX_STRIP_STEPS = (
    240,
    400,
)  # A cell of more worlds or steps has their largest error.
SHOWN_RATIO = (
    1e-6  # Errors below this fraction of the limit lie in the strip at the bottom of the figure.
)
TREND_RATIO = (
    2.0  # Errors grow or fall if the 99 % quantile of the last quarter differs by this factor.
)
MIN_TREND_SHARE = 0.05  # Share of the steps that has to exceed it; fewer are isolated spikes.
# [-] No trend is named if the error that 1 % of the steps exceed stays below this part of the limit.
MIN_TREND_PART = 1e-6
MAX_NAMED_ROWS = 8  # Rows of the table of rows.
FORCES_NOTE = (
    "Impulse of the engine / time step, beside the exact solution's. The bodies alone determine a force of a contact, "
    "or only the sum of the normal forces between two bodies, or neither."
)
PAIR_NOTE = (
    "Sums over the contacts of two bodies: the engine's, and the difference from the solution's, where the bodies "
    "determine the sum; the contacts determined are those with a force of their own. All contacts: forces.csv."
)
CLASS_COLORS = ("var(--h4)", "var(--h3)", "var(--h1)", "var(--bad)", "var(--ink)")
ERROR_DEFINITION = (
    "The error of a step is that of its worst row: how far a row's velocity after the step is from one that the row's "
    "law allows, in m/s, or rad/s on angular rows. Rounding only: rounding explains the error, in the engine's "
    "precision. The errors are of the integrator's input for each step: the residual of forces, or the distance of an "
    "acceleration's velocities from the exact ones (Euler's method without damping, discrete, RK4). They do not add up "
    "over time. Growing: at least 5 % of the steps in the last quarter have more than twice the error that 1 % of the "
    "steps exceed in the second quarter; fewer are spikes."
)


@dataclass(frozen=True)
class ResultPage:
    """Page of a result with its files."""

    # callable (folder of the figures or None) -> Page: without a folder, no figure is drawn.
    make_page: Callable[[Path | None], Page]
    numbers: dict[str, Any]  # Contents of `numbers.json`.
    tables: Sequence[pd.DataFrame] = ()  # Tables of a terminal.
    # Whether the measurement ended early, so that all numbers describe only its completed part.
    is_stopped: bool = False
    provenance: str = ""  # Last line: versions, settings, model, date and command.

    def write(self, folder: str | os.PathLike[str]) -> Path:
        """Write `index.html`, `numbers.json` and `figures/*`; return the path of the page."""
        page = self.make_page(Path(folder) / "figures")
        page.warnings = [*page.warnings, *([STOPPED_NOTE] if self.is_stopped else [])]
        page.footer = [*filter(None, [self.provenance]), *page.footer]
        numbers = format_json(self.numbers, indent=1) + "\n"
        files = {"index.html": page.render(), "numbers.json": numbers}
        return write_files(Path(folder), files) / "index.html"

    def print_short(self, console: Console) -> None:
        """Print the head of the page and the tables."""
        self.make_page(None).print_head(console)
        for table in self.tables:
            if len(table):
                console.print()
                print_table(console, table)
        if self.provenance:
            console.print(f"\n{self.provenance}", style="dim", highlight=False, markup=False)


# -- audit -------------------------------------------------------------------------------------------------


def make_audit_page(audit: Any, folder: Path | None) -> Page:
    """Make the page of an audit: size of the error, when and where, cause, next command."""
    counts = AuditCounts(audit)
    runs = audit.runs
    model = audit.runs.name
    blocks: list[Any] = []
    if folder is not None and counts.n:
        tables = [*counts.make_sizes_table(), *counts.make_rows_table()]
        if audit.worst:
            rows: list[Any] = []
            for i, w in enumerate(audit.worst, 1):
                place = f"world {w.world}, step {w.step}"
                row = split_row_unit(w.where)[0]
                rows.append([f"worst_{i}.npz", (place, "q", ""), (row, "text", "")])
            command = shlex.join(
                ["lavender", "check", str(folder.parent / "worst" / "worst_1.npz")]
            )
            tables += [make_table(rows, title="Look at the worst steps"), {"code": command}]
        blocks.append({"pair": [[markupsafe.Markup(counts.draw_errors(folder))], tables]})
    sections = (
        (
            "The same states",
            audit.comparison,
            "Both models solve the same steps from the same states.",
        ),
        (
            "What the engine claims",
            audit.claims,
            "A wrong claim hides an error; a missing claim costs iterations.",
        ),
        ("Quantiles of the errors", audit.errors, ""),
        ("Normal forces of bodies", audit.pair_forces, f"{audit.forces_note} {PAIR_NOTE}"),
        ("Contact forces of the worst steps", audit.worst_forces, FORCES_NOTE),
        ("Rows and contacts of a step", audit.judged_sizes.table, ""),
        (
            "Worlds that diverged",
            audit.diverged,
            "The last step, and whether every solve until then was exact.",
        ),
    )
    blocks += [fold_table(title, frame, note) for title, frame, note in sections if len(frame)]
    blocks.append(
        {"folded": [{"note": ERROR_DEFINITION}], "title": "How errors are defined", "open": False}
    )
    source = (
        f"lavender audit · {model} · {audit.engine} · {runs.worlds} worlds × {runs.steps} steps"
    )
    code = []
    if counts.above and audit.engine == "mujoco" and not audit.divergences and runs.source:
        code = [format_next_command(audit, counts.limit)]
    elif counts.slides and runs.source:
        states = str(audit.folder / "slip.npz")
        code = [shlex.join(["lavender", "slip", runs.source, "--states", states])]
    starts = f"seed {runs.seed}, start velocities ± {runs.spread:g} m/s"
    files = "records.npz (every step), numbers.json, states.npz, worst/, forces.csv, figures/ (PDF, SVG, PNG)"
    footer = [f"{starts}. Files: {files}."]
    return Page(
        "lavender audit",
        source,
        counts.verdict,
        counts.sentences,
        code,
        mark=counts.mark,
        is_bad=counts.is_bad,
        warnings=audit.advice,
        blocks=blocks,
        footer=footer,
    )


def format_next_command(audit: Any, limit: float) -> str:
    """Return the command that tunes the model of an audit as it was given, with the audit's controls."""
    runs = audit.runs
    words = ["lavender", "tune", runs.source, "--max-velocity-error", f"{limit:g}"]
    words += ["--states", str(audit.folder / "states.npz")]
    if runs.control_name == "random" and runs.seed:
        words += ["--seed", str(runs.seed)]
    elif runs.control_name not in ("", "random"):
        words += ["--controls", runs.control_name]
    return shlex.join(words)


class AuditCounts:
    """Counts, sentences, figures and tables of an `Audit`, compared with its limit or the default of pages."""

    def __init__(self, audit: Any) -> None:
        self.audit = audit
        self.limit = DEFAULT_ERROR_LIMIT if audit.error_limit is None else audit.error_limit
        self.errors = np.where(audit.is_judged, audit.numbers[0], np.nan)
        at_floor = audit.verdict == VERDICTS.index(AT_FLOOR)
        self.sizes = np.where(at_floor, 0.0, self.errors)  # Steps at their floor never count.
        errors = self.errors[audit.is_judged & ~at_floor]
        # The smallest class stays below the limit.
        close_to = audit.threshold if audit.threshold < self.limit else 0.1 * self.limit
        close, within = (int((errors <= limit).sum()) for limit in (close_to, self.limit))
        with np.errstate(invalid="ignore"):
            self.is_above = self.sizes > self.limit
        self.n = audit.n_judged
        self.above = int(self.is_above.sum())
        self.classes = [
            ("rounding only", int((at_floor & audit.is_judged).sum())),
            (f"up to {format_speed(close_to)}", close),
            (f"up to {format_speed(self.limit)}: the limit", max(within - close, 0)),
            (f"more than {format_speed(self.limit)}", self.above),
        ]
        self.largest = float(np.nanmax(self.sizes)) if self.n else 0.0
        place = np.nanargmax(self.sizes) if self.n else 0
        self.world, self.step = map(int, np.unravel_index(place, self.sizes.shape))
        own = next((w for w in audit.worst if (w.world, w.step) == (self.world, self.step)), None)
        self.row, self.unit = split_row_unit("" if own is None else own.where)
        # Unit of errors of several rows.
        units = dict.fromkeys(split_row_unit(name)[1] for name in audit.where)
        self.units = " or ".join(sorted(units)) or self.unit

    # -- sentences -----------------------------------------------------------------------------------------

    @property
    def verdict(self) -> str:
        """The size of the error, with divergence first, and steps that were not judged."""
        audit = self.audit
        limit = format_speed(self.limit, self.units)
        parts = []
        if audit.divergences:
            first = min(d.step for d in audit.divergences)
            parts.append(
                f"{format_count(audit.n_diverged, 'world')} diverged, the first at step {first}"
            )
        if not self.n:
            parts.append("no step was judged")
        elif self.above:
            n = format_number(self.n)
            share = format_percent(self.above, self.n)
            worst = format_speed(self.largest, self.unit, self.limit)
            is_wrong = "is" if self.above == 1 else "are"
            parts.append(
                f"{format_number(self.above)} of {n} steps ({share}) {is_wrong} wrong by more than {limit}; "
                f"the worst by {worst}"
            )
        else:
            largest = format_speed(self.largest, self.unit, self.limit)
            by = f"by more than {largest}" if self.largest else "beyond rounding"
            parts.append(
                f"no step is wrong {by}; the limit is {format_speed(self.limit, self.units)}"
            )
        if lost := int((audit.verdict == len(VERDICTS)).sum()):
            parts.append(f"{format_count(lost, 'step')} not judged")
        if audit.n_dropped:
            parts.append(f"the engine dropped {format_count(audit.n_dropped, 'row')}")
        text = "; ".join(parts)
        return f"{text[0].upper()}{text[1:]}."

    @property
    def is_bad(self) -> bool:
        """Whether a step exceeds the limit, was not judged, or lost rows."""
        return bool(self.above or self.audit.n_unjudged or self.audit.n_dropped)

    @property
    def mark(self) -> str:
        """Result of the comparison with the limit."""
        if self.above:
            return "✗ above the limit"
        return "✗ not all judged" if self.is_bad else "✓ within the limit"

    @property
    def sentences(self) -> list[str]:
        """When and where, then the cause."""
        causes = self.audit.causes
        laws = max(causes, key=lambda x: abs(x.difference)).sentence if causes else ""
        against = self.audit.compare_in_words()
        slide = self.audit.slide
        sliding = ""
        if self.slides and slide is not None:
            sliding = (
                f"The solves are right, and contacts slide that would not by the rigid laws: {slide.contact} with "
                f"{format_speed(slide.speed)} in step {slide.step} of world {slide.world}. `lavender slip` says why."
            )
        texts = self._describe_place(), self._describe_cause(), laws, sliding, against
        return [*filter(None, texts)]

    @property
    def slides(self) -> bool:
        """Whether a contact slides faster than the limit although no error exceeds it."""
        slide = self.audit.slide
        is_fast = slide is not None and slide.speed > self.limit
        return is_fast and not self.above and not self.audit.divergences

    def _describe_place(self) -> str:
        """Return the worst step and row, the worlds above the limit, and whether errors grow with time."""
        if not self.largest:
            return ""
        row = f", {self.row}" if self.row else ""
        text = f"Worst: step {self.step} of world {self.world}{row}."
        steps = self.errors.shape[1]
        if self.above:
            worlds = int(self.is_above.any(axis=1).sum())
            first = int(np.argmax(self.is_above.any(axis=0)))
            text += f" Above the limit from step {first} on, in {worlds} of {format_count(len(self.errors), 'world')}."
        quarter = steps // 4
        if quarter < 5 or not self.n:
            return text
        parts = self.sizes[:, quarter : 2 * quarter], self.sizes[:, steps - quarter :]
        known = [part[np.isfinite(part)] for part in parts]
        if not all(map(len, known)):
            return text
        early, late = (float(np.quantile(part, 0.99, method="higher")) for part in known)
        # Isolated spikes are no trend: a share of the steps has to exceed the other part's quantile by the factor.
        shares = [
            float(np.mean(part > TREND_RATIO * other))
            for part, other in zip(known, (late, early), strict=True)
        ]
        if max(early, late) < MIN_TREND_PART * self.limit:
            return text  # Errors of rounding have no trend that matters.
        trend = "Growing" if shares[1] >= MIN_TREND_SHARE else "Steady"
        trend = "Falling" if shares[0] >= MIN_TREND_SHARE > shares[1] else trend
        sizes = [format_speed(x, self.units) for x in (early, late)]
        return (
            f"{text} {trend} with time: the error that 1 % of the steps exceed is {sizes[0]} in steps "
            f"{quarter} to {2 * quarter - 1} and {sizes[1]} in the last {quarter}."
        )

    def _describe_cause(self) -> str:
        """Return the cause of divergence or of errors above the limit, and claims of the engine that are false."""
        audit = self.audit
        texts = []
        stopped, wrong = (audit.verdict == VERDICTS.index(word) for word in (UNCONVERGED, WRONG))
        if audit.divergences:
            exact = sum(map(audit.has_exact_solves, audit.divergences))
            if exact:
                one = "Every solve until a world diverged"
                some = (
                    one
                    if exact == audit.n_diverged
                    else f"In {exact} worlds every solve until divergence"
                )
                texts.append(f"{some} was exact: the cause lies {OUTSIDE_SOLVER}.")
            if exact < audit.n_diverged:
                texts.append(DIVERGENCE_ADVICE if audit.engine == "mujoco" else ENGINE_ADVICE)
        elif self.above:
            own = audit.causes[0].own[0] if audit.causes and audit.worst else ""
            n = int((self.is_above & stopped).sum())
            if own in OWN_CAUSES:
                texts.append(OWN_CAUSES[own])
            elif n:
                these = "All these" if n == self.above else f"{format_number(n)} of these"
                texts.append(f"Cause: the solver. {these} solves stopped before convergence.")
            n_wrong = 0 if own in OWN_CAUSES else int((self.is_above & wrong).sum())
            if n_wrong:
                are = "answer of the engine is" if n_wrong == 1 else "answers of the engine are"
                texts.append(
                    f"{format_number(n_wrong)} {are} no solution of its own problem: the error is at least that of "
                    "zero impulses. A solve that stops early from a bad start, or a state or model that changes "
                    "within the step, leaves such answers."
                )
        elif n := int((stopped | wrong).sum()):
            count = f"{format_count(n, 'solve')} ({format_percent(n, self.n, 1)})"
            texts.append(f"{count} stopped before convergence, all within the limit.")
        elif self.n:
            texts.append("Every solve converged.")
        if audit.converged is not None:
            counts = list(audit.claim_counts.values())
            claimed = counts[0] + counts[1] + counts[4]
            false = counts[1] + counts[4]
            is_wrong = f"{false} {'is' if false == 1 else 'are'} wrong"
            texts.append(
                f"Of {format_count(claimed, 'solve')} that the engine calls converged, {is_wrong}."
            )
        return " ".join(texts)

    # -- figures and tables --------------------------------------------------------------------------------

    def draw_errors(self, folder: Path) -> str:
        """Draw quantiles of the errors with time, and below each world as a line of colours, the worst first."""
        audit = self.audit
        low = SHOWN_RATIO * self.limit
        worlds, steps = self.errors.shape
        bins = np.array_split(np.arange(steps), min(steps, MAX_BINS))
        x = np.array([b[0] for b in bins] + [steps])
        has_rows = audit.rows > 0

        def compute_quantiles(errors: FloatArray, quantiles: Sequence[float]) -> FloatArray:
            """Return the quantiles (quantiles, bins + 1) of the steps with rows, and low / 2 for smaller ones."""
            lines = []
            for b in bins:
                some = errors[:, b][has_rows[:, b] & np.isfinite(errors[:, b])]
                empty = np.full(len(quantiles), np.nan)
                lines.append(np.quantile(some, quantiles, method="higher") if len(some) else empty)
            q = np.array([*lines, lines[-1]]).T
            return np.where(q < low, low / 2.0, q)

        q = compute_quantiles(self.errors, list(QUANTILE_LINES.values()))

        def fill(axes: Any, strip: Any) -> str:
            high = float(np.nanmax(q)) if np.isfinite(q).any() else 0.0
            labels = drawing.mark_errors(axes, low, high, self.limit)
            last = dict(zip(QUANTILE_LINES, map(float, q[:, -1]), strict=True))
            axes.set_xlim(0, steps)
            for i, alpha in enumerate((0.38, 0.24, 0.12)):
                axes.fill_between(
                    x, q[i], q[i + 1], step="post", color=drawing.BLUE, alpha=alpha, lw=0
                )
            for i, width in ((0, 1.2), (3, 0.7)):
                axes.step(x, q[i], where="post", color=drawing.BLUE, lw=width)
            labels += [drawing.Label(y, name, drawing.BLUE) for name, y in last.items() if y == y]
            if audit.against is not None:
                other = np.where(audit.against.is_judged, audit.against.numbers[0], np.nan)
                for quantile, name, dash in ((0.99, "99 %", "--"), (1.0, "worst", "-")):
                    (y,) = compute_quantiles(other, [quantile])
                    axes.step(x, y, where="post", color=drawing.PINK, lw=1.0, ls=dash)
                    if y[-1] == y[-1]:
                        labels.append(drawing.Label(y[-1], f"against, {name}", drawing.PINK))
            axes.set_ylabel(f"velocity error [{self.units}]")
            drawing.label_ends(axes, labels)
            order = np.argsort(-np.nan_to_num(self.sizes).max(axis=1), kind="stable")
            rows = np.array_split(order, min(worlds, MAX_STRIP_WORLDS))
            columns = np.array_split(np.arange(steps), min(steps, MAX_STRIP_STEPS))
            filled = np.where(np.isnan(self.sizes), -1.0, self.sizes)
            errors = np.array([[filled[np.ix_(r, c)].max() for c in columns] for r in rows])
            errors = np.where(errors < 0.0, np.nan, errors)
            drawing.draw_error_strip(
                strip, errors, audit.threshold, self.limit, (0, steps, worlds, 0)
            )
            strip.set_ylabel(f"{worlds} worlds, worst first" if worlds > 1 else "one world")
            strip.set_xlabel("step")
            strip.set_yticks([])
            if self.largest:
                style = {"ms": 6, "color": drawing.INK, "mfc": "none", "mew": 1.2, "clip_on": False}
                strip.plot([self.step + 0.5], [max(worlds / 60.0, 0.5)], "v", **style)
            ends = ", ".join(f"{name} {format_speed(y, self.units)}" for name, y in last.items())
            return f"Velocity error against step of {worlds} worlds; in the last steps: {ends}. {self.verdict}"

        note = (
            "Above: errors of the steps that have rows, over all worlds: median, 90 %, 99 % and worst; below "
            f"{format_power(low)} m/s rounding decides. Below: each line is a world, ▽ the worst step (records.npz)."
        )
        margins = {"left": 0.13, "right": 0.75, "top": 0.985, "bottom": 0.085, "hspace": 0.1}
        return drawing.draw_figure(
            "errors",
            fill,
            (4.9, 4.9),
            margins,
            note=note,
            folder=folder,
            nrows=2,
            sharex=True,
            height_ratios=[1.45, 1.0],
        )

    def make_sizes_table(self) -> list[Any]:
        """Make the stacked bar and the table of the numbers of steps by the size of their error."""
        classes = [*self.classes]
        if lost := int((self.audit.verdict == len(VERDICTS)).sum()):
            classes.append(("not judged", lost))
        total = max(self.n + lost, 1)
        parts = []
        for i, ((name, n), color) in enumerate(zip(classes, CLASS_COLORS, strict=False)):
            css = "bad" if i >= 3 and n else "q" if i < 2 else ""
            parts.append(
                (name, color, n / total, [format_number(n), format_percent(n, total)], css)
            )
        small = f"{format_number(self.n)} steps by the error of their worst row"
        return make_shares(parts, "Shares of the steps: ", title="How wrong", small=small)

    def make_rows_table(self) -> list[Any]:
        """Make the table of the rows with the largest errors, on a logarithmic scale with the limit."""
        where = sorted(self.audit.where.items(), key=lambda entry: -entry[1][1])
        if not where:
            return []
        low = np.log10(max(self.audit.threshold, 1e-12))
        high = np.log10(max(where[0][1][1], self.limit) * 1.3)

        def place(x: float) -> float:
            return float(
                np.clip(100.0 * (np.log10(max(x, 1e-15)) - low) / (high - low), 0.0, 100.0)
            )

        rows: list[Any] = []
        for name, (n, largest) in where[:MAX_NAMED_ROWS]:
            above = ' class="above"' if largest > self.limit else ""
            dot = markupsafe.Markup(
                f'<span class="dot"><b style="left:{place(self.limit):.1f}%"></b>'
                f'<i{above} style="left:{place(largest):.1f}%"></i></span>'
            )
            row, unit = split_row_unit(name)
            size = format_speed(largest, unit)
            rows.append([(row, "text", ""), (format_number(n), "wide", ""), size, (dot, "bar", "")])
        heads = ["row", ("steps¹", "wide", ""), "largest", ("", "bar", "")]
        note = "Dashed: the limit. ¹ stopped before convergence with this worst row."
        small = f"largest error of each, {format_count(len(where), 'row')} in all"
        return [make_table(rows, heads, title="Which row", small=small, note=note, classes="full")]


# If a smaller fraction of the judged steps has contact, `tune` recommends no setting and an audit warns: mean times,
# and the error that 1 % of the steps exceed, then describe steps without contact. Examples: 6 % of the steps of
# dm_control's finger model have contact, none of its stacker model.
MIN_CONTACT_SHARE = 0.2


@dataclass(frozen=True, eq=False)
class StepSizes:
    """Rows and contacts of each judged step."""

    # (steps,) int: contacts that have rows.
    rows: np.ndarray
    contacts: np.ndarray
    # Whether the model has geoms that can collide. If not, the fraction of steps with rows decides.
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
        n = len(self.rows)
        object_name = "contact" if self.can_touch else "a constraint"
        fraction = (
            f" ({format_percent(self._n_with_contact, n, min(1, self._n_with_contact))})"
            if n
            else ""
        )
        needed = f"{100.0 * MIN_CONTACT_SHARE:g} %"
        return f"{self._n_with_contact} of {n} steps judged have {object_name}{fraction}, fewer than {needed}"

    @property
    def table(self) -> pd.DataFrame:
        """Median and maximum number of rows and contacts, and the fraction of steps that have any."""
        rows = [
            (name, f"{x['median']:g}", x["maximum"], f"{100.0 * x['share']:.1f} %")
            for name in ("rows", "contacts")
            if (x := self.as_dict[name])["median"] is not None
        ]
        return pd.DataFrame(rows, columns=["in a step", "median", "maximum", "steps with any"])

    @property
    def as_dict(self) -> dict[str, Any]:
        """The contents of `table` for numbers.json."""
        numbers: dict[str, Any] = {
            "can_touch": self.can_touch,
            "min_contact_share": MIN_CONTACT_SHARE,
        }
        for name, x in (("rows", self.rows), ("contacts", self.contacts)):
            found = (
                (float(np.median(x)), int(x.max()), float(np.mean(x > 0)))
                if len(x)
                else (None,) * 3
            )
            numbers[name] = dict(zip(("median", "maximum", "share"), found, strict=True))
        return numbers
