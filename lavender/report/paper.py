"""What a paper takes from a report: PDF figures, LaTeX tables, the paragraph on the method. From records alone.

paper/over-all.pdf          error against time over all cases: medians, and bands of the middle half
paper/profile-LAW-X.pdf     performance profiles, for each problem class and level
paper/sequence-....pdf      of sequences, each step
paper/tables.tex            recommendations, mean times by law, claims against the judge (booktabs)
paper/method.tex            what was measured, how, on which machine, with its numbers
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lavender.bench.record import file_name, level_name
from lavender.bench.store import Records
from lavender.errors import InputError
from lavender.io.stored import write_figure, write_text
from lavender.report import contents, tables
from lavender.report.curves import LINES, Figure, figures
from lavender.report.draw import matplotlib_figure
from lavender.report.findings import Report
from lavender.report.style import looks
from lavender.report.table import Cell, Table, latex, tex
from lavender.report.tables.advice import NOISE
from lavender.report.text import count, seconds, without

__all__ = ["write_paper"]

INCH = (5.5, 3.4)  # of a figure: a page's width of text


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
    found = report.records
    if not len(found) or report.is_campaign:
        raise InputError("a paper's figures need runs with times; these records have none")
    folder = Path(folder)
    drawn = figures(found)
    some = [_leading(figure, report.verdict.leaders) for figure in drawn.over.get("all", ())]
    some += [
        figure for group in (drawn.profiles, drawn.sequences) for own in group.values() for figure in own
    ]
    look = looks({c.solver for figure in some for c in figure.curves})
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for figure in some:
            canvas = matplotlib_figure(replace(figure, title=""), look, INCH)
            path = folder / (file_name(figure.name.replace(" ", "-")) + ".pdf")
            write_figure(canvas, path, metadata={"CreationDate": None, "Producer": None})
        write_text(folder / "tables.tex", _tables(report))
        write_text(folder / "method.tex", _method(found))
    except OSError as error:
        raise InputError(f"cannot write {error.filename or folder} ({error.strerror or error})") from None
    return folder


def _leading(figure: Figure, leaders: Sequence[str]) -> Figure:
    """The five curves to tell apart: the leaders of the verdict, then whoever ends lowest; bands of the first two."""
    names = [*leaders, *(c.solver for c in sorted(figure.curves, key=lambda c: c.y[-1]))]
    order = sorted(figure.curves, key=lambda c: names.index(c.solver))[:LINES]
    return replace(figure, curves=(*order[:2], *(replace(c, low=(), high=()) for c in order[2:])))


# -- LaTeX ------------------------------------------------------------------------------------------------


def _tables(report: Report) -> str:
    records, shift = report.records, seconds(tables.SHIFT)
    caption = (
        "Recommended solver, its mean time, and the cases that it brings to the level where that is not all. Within "
        f"{NOISE:g} times of each other solvers count as equal."
    )
    advice, last = contents.advice_table(report), 1 + len(report.levels)
    rows: list[list[str | Cell]] = [
        [
            str(row[0]),
            f"{line.size}{without(line.left_out)}",
            *(replace(c, after="") for c in row[1:last] if isinstance(c, Cell)),
        ]
        for row, line in zip(advice.rows, report.lines, strict=True)
    ]
    made = [latex(Table(["structure", "cases", *advice.heads[1:last]], rows), caption, "recommended")]
    for law, by_level in tables.geometric_means(records).items():
        caption = (
            f"Law {law}: geometric mean of times with {shift} added, and cases brought to the level; a miss costs "
            f"{seconds(tables.limit_of(records))}. Solvers that take every case."
        )
        made.append(latex(contents.mean_table(by_level), caption, f"means-{law}"))
    caption = "Claims of solvers against the judge, who recomputes every residual from the problem's data."
    made.append(latex(contents.claim_table(records), caption, "claims"))
    return "% \\usepackage{booktabs}\n" + "\n".join(made)


def _method(records: Records) -> str:
    """The paragraph on the method, each number of it read off the records."""
    run = next(reversed(list(records.runs.values())))
    own = [r for r in records if r.run == run.run]
    ran = {r.case for r in own}
    infos = [info for name, info in records.cases.items() if name in ran]
    rows = sorted(info.rows for info in infos)
    laws = [
        f"{count(sum(i.law == law for i in infos), 'problem')} of law {law}"
        for law in sorted({i.law for i in infos})
    ]
    repeats = sorted({r.repeats for r in own if r.usable})
    levels = ", ".join(map(level_name, tables.levels_of(records)))
    budgets = sorted({r.max_iter for r in own if r.mode == "budget"})
    swept = f" and with exact budgets of {', '.join(map(str, budgets))} iterations" if budgets else ""
    versions = ", ".join(f"{name} {version}" for name, version in run.versions.items())
    least = f"the least of {repeats[0]}{f' to {repeats[-1]}' if len(repeats) > 1 else ''} repeats"
    limit, threads = seconds(tables.limit_of(records)), count(run.threads, "thread")
    solvers = count(len({r.solver for r in own}), "solver")
    lost = without(sum(map(len, records.left_out.values())))
    parts = (
        f"We ran {solvers} on {count(len(infos), 'problem')}{lost} ({', '.join(laws)}; {rows[0]} to {rows[-1]} rows),",
        f"{count(len(own), 'run')} in all, to relative residuals of {levels}{swept}. The residual of an impulse is",
        "computed from the problem's data, whatever the solver reports: the larger of its errors in energy norm and",
        "in velocity, each over that of doing nothing, so that 1 is doing nothing and 0 a solution. Times are those",
        f"of set-up and solve, {least}, within a limit of {limit}; BLAS and OpenMP had {threads}. Means of times are",
        f"geometric, with {seconds(tables.SHIFT)} added to each and a miss charged the limit. Profiles follow Dolan",
        f"and Moré (2002). Machine: {run.cpu}, {run.cores} cores, {run.platform}; lavender {run.lavender}, Python",
        f"{run.python}, {versions}; run {run.run}, {run.started}.",
    )
    return tex(" ".join(parts)) + "\n"
