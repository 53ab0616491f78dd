"""Write PDF figures, LaTeX tables and a paragraph on the method of a report, for a paper.

All times are times of one call of `lv.solve`, also for solvers of other packages. For these solvers, a table has the
part of the time that is spent in their own interface.

paper/over-all.pdf          error against time over all cases: medians, and bands of the middle half
paper/work-over-all.pdf     error against passes over A, for solvers that do no other work
paper/class-FOLDER.pdf      these two figures for each folder that the cases came from, if there are several
paper/profile-LAW-X.pdf     performance profiles by time, for each friction law and tolerance
paper/work-profile-....pdf  performance profiles by passes over A, for solvers that do no other work
paper/sequence-....pdf      each step of a sequence
paper/figures.tex           these figures with their captions
paper/tables.tex            recommendations, mean times by law, own interfaces, claims against the judge (booktabs)
paper/method.tex            what was measured, how, on which machine, with its numbers
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lavender.base.deadline import format_seconds
from lavender.base.errors import InputError
from lavender.io.stored import SUFFIXES, make_folder, write_figure, write_text
from lavender.lab.bench import statistics
from lavender.lab.bench.machine import summarise_loads
from lavender.lab.bench.recommendation import recommend_from_single_runs
from lavender.lab.bench.record import format_tolerance, make_file_name
from lavender.lab.bench.statistics import TIME_NOISE_FACTOR
from lavender.lab.bench.stopwatch import excludes_setup
from lavender.lab.bench.store import Records
from lavender.lab.report import table_specs
from lavender.lab.report.figures import (
    PASSES_NOTE,
    Figure,
    Group,
    build_figures,
    build_overall_figure,
    select_drawn_solvers,
)
from lavender.lab.report.findings import Report
from lavender.lab.report.plotting import assign_styles, plot_figure
from lavender.lab.report.table import Cell, Table
from lavender.lab.report.text import describe_timed_code, format_count, format_left_out_count

FIGURE_SIZE = (5.5, 3.4)  # [inches] The width is the text width of a page.
FIGURES_HEAD = (
    "% \\usepackage{graphicx}\n"
    "% The figures are 5.5 in wide with text of 7 to 10 pt: use figure* in two columns.\n\n"
)
TABLES_HEAD = (
    "% \\usepackage{booktabs}\n% \\usepackage{graphicx}\n"
    "% A table that is wider than the line is scaled down: use table* in two columns.\n"
)
REFERENCE_SOLVER = "osqp"  # Figures of error against time show it if it was measured.


def write_paper(report: Report, folder: str | Path) -> Path:
    """Write the figures, tables and the method of a paper.

    Parameters
    ----------
    report : Report
        Report of a run with times.
    folder : path
        Created if it does not exist.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        The report has no times (a campaign), or the folder cannot be written.
    """
    records = report.ranked_records
    if not len(records) or report.is_campaign:
        raise InputError("a paper's figures need runs with times; these records have none")
    drawn = build_figures(records)
    by_work = build_overall_figure(records, "work")
    work = {"all": (by_work,)} if by_work.curves else {}
    groups = (drawn.over, work, _build_folder_figures(records), drawn.profiles, drawn.sequences)
    some = [
        _reduce_figure_to_leaders(figure, report.verdict.leaders)
        for group in groups
        for fs in group.values()
        for figure in fs
    ]
    look = assign_styles(records.solvers)
    folder = make_folder(folder)
    for figure in some:
        canvas = plot_figure(replace(figure, title=""), look, FIGURE_SIZE)
        write_figure(
            canvas, folder / _make_figure_file_name(figure), metadata={"CreationDate": None, "Producer": None}
        )
    text = FIGURES_HEAD + "\n".join(_include_figure(figure, report) for figure in some)
    write_text(folder / "figures.tex", text)
    write_text(folder / "tables.tex", _write_tables(report))
    write_text(folder / "method.tex", _describe_method(report))
    return folder


def _build_folder_figures(records: Records) -> Group:
    """Build figures of error against time and work over the cases of each folder, if there are several folders."""
    sources = {r.case: Path(records.cases[r.case].source) for r in records if r.step < 0}
    folders = sorted({p.parent for p in sources.values() if p.suffix.lower() in SUFFIXES})
    groups = {}
    for folder in folders if len(folders) > 1 else ():
        part = records.with_records(r for r in records if sources.get(r.case, Path()).parent == folder)
        name = folder.name if sum(f.name == folder.name for f in folders) == 1 else str(folder)
        groups[name] = tuple(
            replace(
                figure,
                name=f"{prefix}class {name}",
                title=f"Folder {name}: {figure.title[:1].lower()}{figure.title[1:]}",
            )
            for prefix, measure in (("", "time"), ("work ", "work"))
            for figure in (build_overall_figure(part, measure),)
            if figure.curves
        )
    return groups


def _reduce_figure_to_leaders(figure: Figure, leaders: Sequence[str]) -> Figure:
    """Reduce a figure to a few solvers: plug-ins, `leaders`, solvers with the lowest ends of curves, and osqp.

    Only the first two curves keep their bands.
    """
    if all(c.steps for c in figure.curves):
        # Step functions are performance profiles: `build_profile_figure` has selected their solvers.
        return figure
    ends = sorted(figure.curves, key=lambda c: c.y[-1] if math.isfinite(c.y[-1]) else math.inf)
    solvers = list(dict.fromkeys(c.solver for c in ends))
    solvers.sort(key=lambda name: leaders.index(name) if name in leaders else len(leaders))
    drawn = select_drawn_solvers(solvers, (REFERENCE_SOLVER,))
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
    """Return a floating table (booktabs), scaled down if it is wider than the line."""
    line = " & ".join
    body = "".join(f"{line(map(escape_tex, row))} \\\\\n" for row in table.cell_texts)
    return (
        f"\\begin{{table}}\n\\centering\n\\caption{{{escape_tex(caption)}}}\n\\label{{tab:{label}}}\n\\smallskip\n"
        f"\\resizebox{{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}}{{!}}{{%\n"
        f"\\begin{{tabular}}{{l{'r' * (len(table.heads) - 1)}}}\n\\toprule\n{line(map(escape_tex, table.heads))} \\\\\n"
        f"\\midrule\n{body}\\bottomrule\n\\end{{tabular}}}}\n\\end{{table}}\n"
    )


def _make_figure_file_name(figure: Figure) -> str:
    return make_file_name(figure.name.replace(" ", "-")) + ".pdf"


def _describe_unloaded_cases(records: Records) -> str:
    """Return a sentence on problems that did not load; empty if all did."""
    lost = sum(map(len, records.left_out.values()))
    return f" Left out, because they did not load: {format_count(lost, 'problem')}." if lost else ""


def _describe_times(report: Report, solvers: set[str], sequences: bool = False) -> str:
    """Return a sentence on which code the times of these solvers include, and one on a busy machine."""
    records = report.ranked_records
    runs = [
        r for r in records
        if r.solver in solvers and r.order == "given" and not r.interleave_group and (r.step >= 0) is sequences
    ]  # fmt: skip
    sentence = describe_timed_code(runs)
    busy = " The machine was busy: these times may be too long." if report.load_warning else ""
    return f" {sentence}{busy}" if sentence else ""


def _include_figure(figure: Figure, report: Report) -> str:
    """Return a floating figure with its caption."""
    records, solvers = report.ranked_records, {c.solver for c in figure.curves}
    is_time = not figure.name.startswith("work ") and any(
        "time" in x for x in (figure.x_title, figure.y_title)
    )
    sequences = figure.name.startswith("sequence ") or not any(r.step < 0 for r in records)
    times = _describe_times(report, solvers, sequences) if is_time else ""
    caption = f"{figure.title}.{times}{_describe_unloaded_cases(records)}"
    if figure.name.startswith("sequence "):
        starts = ", or from the zero impulse (thin)" if any(c.thin for c in figure.curves) else ""
        quantity = "Time of all steps so far" if is_time else "Relative residual of each step"
        caption = (
            f"Sequence {figure.title}. {quantity}, from the impulses of the previous step{starts}.{times}"
        )
        caption += _describe_unloaded_cases(records)
    if any(c.steps for c in figure.curves):
        by_work = figure.name.startswith("work ")
        cost = "the fewest passes over A of any solver" if by_work else "the fastest solver's time"
        caption = f"Share of cases solved within a multiple of {cost}: law {caption}"
        caption += f" {PASSES_NOTE}." if by_work else ""
        caption += " Only runs to a tolerance count."
    banded = list(dict.fromkeys(c.solver for c in figure.curves if c.low))
    if banded and "middle half" in figure.title:
        caption += f" Bands (middle half of the cases): {', '.join(banded)}."
    if figure.note:
        caption += f" {figure.note}"
    if figure.left_out:
        caption += f" Not drawn: {', '.join(figure.left_out)}."
    return (
        f"\\begin{{figure}}\n\\centering\n\\includegraphics[width=\\linewidth]{{{_make_figure_file_name(figure)}}}\n"
        f"\\caption{{{escape_tex(caption)}}}\n"
        f"\\label{{fig:{_make_figure_file_name(figure).removesuffix('.pdf')}}}\n\\end{{figure}}\n"
    )


def _write_tables(report: Report) -> str:
    records, shift = report.ranked_records, format_seconds(statistics.MEAN_TIME_SHIFT)
    middle = format_tolerance(report.tolerances[len(report.tolerances) // 2])
    caption = (
        "Recommended solver, its mean time, and the cases that it brings to the tolerance if it misses some, from runs "
        f"to a tolerance. ≈: other solvers take at most {TIME_NOISE_FACTOR:g} times as long, which counts as equal."
    )
    everyone = {r.solver for r in records}
    single = any(r.step < 0 for r in records)
    caption += _describe_times(report, everyone, not single) + _describe_unloaded_cases(records)
    # All tables contain minima of consecutive repeats, so that they can be compared.
    rankings = recommend_from_single_runs(records, report.recommendation_times)
    advice = table_specs.tabulate_recommended_solvers(report, rankings=rankings)
    last = 1 + len(report.tolerances)
    rows: list[list[str | Cell]] = [
        [
            str(row[0]),
            f"{line.n_cases}{format_left_out_count(line.left_out)}",
            *(replace(c, after=" ≈" * ("≈" in c.after)) for c in row[1:last] if isinstance(c, Cell)),
        ]
        for row, line in zip(advice.rows, rankings, strict=True)
    ]
    parts = [format_latex(Table(["structure", "cases", *advice.heads[1:last]], rows), caption, "recommended")]
    for law, by_tolerance in statistics.compute_mean_times_by_law(records).items():
        solvers = set(next(iter(by_tolerance.values())))
        ran = {r.solver for r in records if r.step < 0 and records.cases[r.case].law == law}
        rest = sorted(ran - solvers)
        others = f" (not {', '.join(rest)})" if rest else ""
        caption = (
            f"Law {law}: geometric mean of times with {shift} added, and cases brought to the tolerance; a miss costs "
            f"{format_seconds(statistics.get_penalty_time_of_miss(records))}. Only runs to a tolerance count, "
            f"to this or a tighter one. Solvers that take every case{others}."
        )
        caption += _describe_times(report, solvers) + _describe_unloaded_cases(records)
        parts.append(format_latex(table_specs.tabulate_mean_times(by_tolerance), caption, f"means-{law}"))
    backends = table_specs.tabulate_backends(records)
    if backends.rows:
        separate = ", ".join(sorted({s for row in backends.rows if excludes_setup(s := str(row[0]))}))  # pyright: ignore[reportArgumentType, reportCallIssue]
        caption = (
            f"Solvers of other packages, to {middle}, geometric means over the cases that each solves. Call: the time "
            "of the other tables. Own interface: its part in the package's own solve function, on converted data"
            f"{f' (without set-up: {separate})' if separate else ''}. Rest: conversion, checks, judge, Python, and "
            "set-up outside of that function. Cases faster: cases on which the own interface takes less time than the "
            "complete call of lavender's fastest solver."
        )
        parts.append(format_latex(backends, caption + _describe_unloaded_cases(records), "own-interface"))
    caption = (
        "Claims of solvers against the judge, which recomputes every residual from the problem's data. "
        f"{table_specs.explain_run_counts(records)}"
    )
    caption += _describe_unloaded_cases(records)
    parts.append(format_latex(table_specs.tabulate_claims(records), caption, "claims"))
    return TABLES_HEAD + "\n".join(parts)


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
    row_range = format_count(rows[0], "row") if rows[0] == rows[-1] else f"{rows[0]} to {rows[-1]} rows"
    repeats = sorted({r.repeats for r in own if r.is_usable})
    tolerances = ", ".join(map(format_tolerance, statistics.get_tolerances(records)))
    budgets = sorted({r.max_iter for r in own if r.mode == "budget"})
    swept = f" and with exact budgets of {', '.join(map(str, budgets))} iterations" if budgets else ""
    versions = ", ".join(f"{name} {version}" for name, version in run.versions.items())
    least = f"{repeats[0]} to " if len(repeats) > 1 else ""
    minimum = f"the minimum of {least}{format_count(repeats[-1], 'repeat')}"
    limit, threads = (
        format_seconds(statistics.get_penalty_time_of_miss(records)),
        format_count(run.threads, "thread"),
    )
    names = sorted({r.solver for r in own})
    solvers = f"{format_count(len(names), 'solver')} ({', '.join(names)})"
    loads = summarise_loads((r.load for r in own), run.cores)
    lost = format_left_out_count(sum(map(len, records.left_out.values())))
    problems, runs = format_count(len(infos), "problem"), format_count(len(own), "run")
    shift = format_seconds(statistics.MEAN_TIME_SHIFT)
    solved_at_zero = len({r.case for r in report.newest_run}) - len({r.case for r in records})
    if solved_at_zero:
        row_range += f"; left out because the zero impulse solves them: {solved_at_zero}"
    timed = describe_timed_code(r for r in own if r.order == "given" and not r.interleave_group)
    parts = (
        f"We ran {solvers} on {problems}{lost} ({', '.join(laws)}; {row_range}),",
        f"{runs} in all, to relative residuals of {tolerances}{swept}. The residual of an impulse is",
        "computed from the problem's data, whatever the solver reports: the larger of its errors in energy norm and",
        "in velocity, each divided by that of the zero impulse: 1 is the zero impulse, 0 a solution.",
        f"{timed} It is {minimum}, within a limit of {limit}, on numbers that were written just before;",
        f"BLAS and OpenMP had {threads}. {loads} {report.stopped_warning}",
        "Times to a tolerance are of runs to this tolerance or a tighter one, never of runs with a fixed budget. Means",
        f"are geometric, with {shift} added to each and a miss charged the limit. Profiles follow Dolan and Moré",
        f"(2002). Machine: {run.cpu}, {run.cores} cores, {run.platform}; lavender {run.lavender},",
        f"Python {run.python}, {versions}; run {run.run}, {run.started}.",
    )
    return escape_tex(" ".join(parts)) + "\n"
