"""Write PDF figures, LaTeX tables and a paragraph on the method of a report, for a paper.

Figures and mean times show the time of its own interface for a solver of another package.

paper/over-all.pdf          error against time over all cases: medians, and bands of the middle half
paper/class-FOLDER.pdf      the same for each folder that the cases came from, if there are several
paper/profile-LAW-X.pdf     performance profiles by time, for each problem class and tolerance
paper/work-profile-....pdf  the same by passes over A, of the solvers that do no other work
paper/sequence-....pdf      each step of a sequence
paper/figures.tex           these figures with their captions
paper/tables.tex            recommendations, mean times by law, claims against the judge (booktabs)
paper/method.tex            what was measured, how, on which machine, with its numbers
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from lavender.base.deadline import format_seconds
from lavender.base.errors import InputError
from lavender.io.stored import SUFFIXES, make_folder, write_figure, write_text
from lavender.lab.bench import statistics
from lavender.lab.bench.record import format_tolerance, make_file_name
from lavender.lab.bench.statistics import TIME_NOISE_FACTOR
from lavender.lab.bench.store import Records
from lavender.lab.report import table_specs
from lavender.lab.report.figures import Figure, Group, build_figures, build_overall_figure, select_drawn
from lavender.lab.report.findings import Report
from lavender.lab.report.plotting import assign_styles, plot_figure
from lavender.lab.report.table import Cell, Table
from lavender.lab.report.text import format_count, format_left_out

FEWEST_PASSES = (
    "the fewest passes over A (sweeps and products with A, as each solver counts them; solvers that factorise or pivot "
    "are not compared)"
)
FIGURE_SIZE = (5.5, 3.4)  # [inches] The width is the text width of a page.


def write_paper(report: Report, folder: str | Path) -> Path:
    """Write the figures, tables and the method of a paper.

    Parameters
    ----------
    report : Report
        Nothing is solved.
    folder : path
        Made if it does not exist.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        No runs with times (a campaign), or the folder cannot be written.
    """
    records = report.ranked_records
    if not len(records) or report.is_campaign:
        raise InputError("a paper's figures need runs with times; these records have none")
    own = records.with_records(
        r if r.backend_time_min is None else replace(r, time_min=r.backend_time_min) for r in records
    )
    drawn = build_figures(own)
    groups = (drawn.over, _build_folder_figures(own), drawn.profiles, drawn.sequences)
    some = [
        _select_leaders(figure, report.verdict.leaders)
        for group in groups
        for fs in group.values()
        for figure in fs
    ]
    look = assign_styles({c.solver for figure in some for c in figure.curves})
    folder = make_folder(folder)
    for figure in some:
        canvas = plot_figure(replace(figure, title=""), look, FIGURE_SIZE)
        write_figure(canvas, folder / _name_file(figure), metadata={"CreationDate": None, "Producer": None})
    write_text(folder / "figures.tex", "\n".join(_include_figure(figure, own) for figure in some))
    write_text(folder / "tables.tex", _write_tables(report, own))
    write_text(folder / "method.tex", _describe_method(report))
    return folder


def _build_folder_figures(records: Records) -> Group:
    """Build figures of error against time over the cases of each folder, if the cases come from several folders."""
    sources = {r.case: Path(records.cases[r.case].source) for r in records if r.step < 0}
    folders = sorted({p.parent for p in sources.values() if p.suffix.lower() in SUFFIXES})
    groups = {}
    for folder in folders if len(folders) > 1 else ():
        figure = build_overall_figure(
            records.with_records(r for r in records if sources.get(r.case, Path()).parent == folder)
        )
        name = folder.name if sum(f.name == folder.name for f in folders) == 1 else str(folder)
        if figure.curves:
            groups[name] = (replace(figure, name=f"class {name}", title=f"{name}: {figure.title}"),)
    return groups


def _select_leaders(figure: Figure, leaders: Sequence[str]) -> Figure:
    """Reduce a figure to plug-ins and leaders of the verdict, then those that end lowest; bands to two solvers."""
    if all(c.steps for c in figure.curves):
        return figure  # The curves of a profile are selected already.
    ends = sorted(figure.curves, key=lambda c: c.y[-1] if math.isfinite(c.y[-1]) else math.inf)
    solvers = list(dict.fromkeys(c.solver for c in ends))
    solvers.sort(key=lambda name: leaders.index(name) if name in leaders else len(leaders))
    drawn = select_drawn(solvers)
    selected = [c for name in drawn for c in figure.curves if c.solver == name]
    selected[2:] = [replace(c, low=(), high=()) for c in selected[2:]]
    return replace(figure, curves=tuple(selected), left_out=tuple(sorted(set(solvers) - set(drawn))))


# -- LaTeX ------------------------------------------------------------------------------------------------


_SPECIAL = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "µ": r"$\mu$", "≈": r"$\approx$",
    "✗": r"$\times$", "–": "--", **{c: "\\" + c for c in "&%$#_{}"},
}  # fmt: skip


def escape_tex(text: str) -> str:
    """Return text with the special characters of LaTeX escaped."""
    escaped = re.sub(r"[\\~^&%$#_{}µ≈✗–]", lambda match: _SPECIAL[match[0]], " ".join(text.split()))
    # LaTeX would read [ and * after a line end as its arguments.
    return f"{{}}{escaped}" if escaped.startswith(("[", "*")) else escaped


def format_latex(table: Table, caption: str, label: str) -> str:
    """Return a floating table (booktabs)."""
    line = " & ".join
    body = "".join(f"{line(map(escape_tex, row))} \\\\\n" for row in table.cell_texts)
    return (
        f"\\begin{{table}}\n\\centering\n\\caption{{{escape_tex(caption)}}}\n\\label{{tab:{label}}}\n"
        f"\\begin{{tabular}}{{l{'r' * (len(table.heads) - 1)}}}\n\\toprule\n{line(map(escape_tex, table.heads))} \\\\\n"
        f"\\midrule\n{body}\\bottomrule\n\\end{{tabular}}\n\\end{{table}}\n"
    )


def _name_file(figure: Figure) -> str:
    return make_file_name(figure.name.replace(" ", "-")) + ".pdf"


def _state_own_times(records: Records, solvers: Iterable[str]) -> str:
    """Return a sentence on the timing of third-party solvers among these; empty without such solvers."""
    names = sorted({r.solver for r in records if r.backend_time_min is not None}.intersection(solvers))
    if not names:
        return ""
    return f" Time in its own interface, without conversion: {', '.join(names)}."


def _state_lost_cases(records: Records) -> str:
    """Return a sentence on problems that did not load; empty if all did."""
    lost = sum(map(len, records.left_out.values()))
    return f" Left out, for it did not load: {format_count(lost, 'problem')}." if lost else ""


def _include_figure(figure: Figure, records: Records) -> str:
    """Return a floating figure with its caption."""
    own_times = _state_own_times(records, {c.solver for c in figure.curves})
    caption = f"{figure.title}.{own_times}{_state_lost_cases(records)}"
    if any(c.steps for c in figure.curves):
        cost = FEWEST_PASSES if figure.name.startswith("work ") else "the fastest solver's time"
        caption = f"Share of cases solved within a multiple of {cost}: law {caption}"
    if figure.note:
        caption += f" {figure.note}"
    if figure.left_out:
        caption += f" Not drawn: {', '.join(figure.left_out)}."
    return (
        f"\\begin{{figure}}\n\\centering\n\\includegraphics{{{_name_file(figure)}}}\n\\caption{{{escape_tex(caption)}}}\n"
        f"\\label{{fig:{_name_file(figure).removesuffix('.pdf')}}}\n\\end{{figure}}\n"
    )


def _write_tables(report: Report, own: Records) -> str:
    records, shift = report.ranked_records, format_seconds(statistics.MEAN_TIME_SHIFT)
    caption = (
        "Recommended solver, its mean time (of other packages with conversion), and the cases that it brings to the "
        f"tolerance where that is not all. Within {TIME_NOISE_FACTOR:g} times of each other solvers count as equal."
    )
    caption += _state_lost_cases(records)
    advice, last = table_specs.tabulate_advice(report), 1 + len(report.tolerances)
    rows: list[list[str | Cell]] = [
        [
            str(row[0]),
            f"{line.n_cases}{format_left_out(line.left_out)}",
            *(replace(c, after="") for c in row[1:last] if isinstance(c, Cell)),
        ]
        for row, line in zip(advice.rows, report.rankings, strict=True)
    ]
    parts = [format_latex(Table(["structure", "cases", *advice.heads[1:last]], rows), caption, "recommended")]
    for law, by_tolerance in statistics.compute_mean_times_by_law(own).items():
        solvers = set(next(iter(by_tolerance.values())))
        rest = sorted({r.solver for r in own if r.step < 0 and own.cases[r.case].law == law} - solvers)
        others = f" (not {', '.join(rest)})" if rest else ""
        caption = (
            f"Law {law}: geometric mean of times with {shift} added, and cases brought to the tolerance; a miss costs "
            f"{format_seconds(statistics.get_time_of_miss(records))}. Solvers that take every case{others}."
        )
        caption += _state_own_times(own, solvers) + _state_lost_cases(records)
        parts.append(format_latex(table_specs.tabulate_means(by_tolerance), caption, f"means-{law}"))
    caption = "Claims of solvers against the judge, which recomputes every residual from the problem's data."
    caption += _state_lost_cases(records)
    parts.append(format_latex(table_specs.tabulate_claims(records), caption, "claims"))
    return "% \\usepackage{booktabs}\n" + "\n".join(parts)


def _describe_method(report: Report) -> str:
    """Return the paragraph on the method; all of its numbers come from the records."""
    records = report.ranked_records
    run = next(reversed(list(records.runs.values())))
    own = [r for r in records if r.run == run.run]
    ran = {r.case for r in own}
    infos = [info for name, info in records.cases.items() if name in ran]
    rows = sorted(info.rows for info in infos)
    laws = [
        f"{format_count(sum(i.law == law for i in infos), 'problem')} of law {law}"
        for law in sorted({i.law for i in infos})
    ]
    repeats = sorted({r.repeats for r in own if r.is_usable})
    tolerances = ", ".join(map(format_tolerance, statistics.get_tolerances(records)))
    budgets = sorted({r.max_iter for r in own if r.mode == "budget"})
    swept = f" and with exact budgets of {', '.join(map(str, budgets))} iterations" if budgets else ""
    versions = ", ".join(f"{name} {version}" for name, version in run.versions.items())
    minimum = f"the minimum of {repeats[0]}{f' to {repeats[-1]}' if len(repeats) > 1 else ''} repeats"
    limit, threads = format_seconds(statistics.get_time_of_miss(records)), format_count(run.threads, "thread")
    solvers = format_count(len({r.solver for r in own}), "solver")
    lost = format_left_out(sum(map(len, records.left_out.values())))
    problems, runs = format_count(len(infos), "problem"), format_count(len(own), "run")
    shift = format_seconds(statistics.MEAN_TIME_SHIFT)
    own_times = _state_own_times(records, {r.solver for r in own})
    parts = (
        f"We ran {solvers} on {problems}{lost} ({', '.join(laws)}; {rows[0]} to {rows[-1]} rows),",
        f"{runs} in all, to relative residuals of {tolerances}{swept}. The residual of an impulse is",
        "computed from the problem's data, whatever the solver reports: the larger of its errors in energy norm and",
        "in velocity, each divided by that of the zero impulse: 1 is the zero impulse, 0 a solution. Times are those",
        f"of set-up and solve, {minimum}, within a limit of {limit}; BLAS and OpenMP had {threads}.",
        f"{own_times} {report.stopped_warning} {report.high_load} Means of times are",
        f"geometric, with {shift} added to each and a miss charged the limit. Profiles follow Dolan and Moré",
        f"(2002). Machine: {run.cpu}, {run.cores} cores, {run.platform}; lavender {run.lavender},",
        f"Python {run.python}, {versions}; run {run.run}, {run.started}.",
    )
    return escape_tex(" ".join(parts)) + "\n"
