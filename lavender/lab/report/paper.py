"""What a paper takes from a report: PDF figures, LaTeX tables, the paragraph on the method. From records alone.

Solvers of other packages stand in figures and mean times with the time of their own interface.

paper/over-all.pdf          error against time over all cases: medians, and bands of the middle half
paper/class-FOLDER.pdf      the same for each folder that the cases came from, where there are several
paper/profile-LAW-X.pdf     performance profiles, for each problem class and level
paper/sequence-....pdf      of sequences, each step
paper/figures.tex           these figures with their captions
paper/tables.tex            recommendations, mean times by law, claims against the judge (booktabs)
paper/method.tex            what was measured, how, on which machine, with its numbers
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from lavender.base.deadline import seconds
from lavender.base.errors import InputError
from lavender.io.stored import SUFFIXES, make_folder, write_figure, write_text
from lavender.lab.bench.record import file_name, level_name
from lavender.lab.bench.store import Records
from lavender.lab.report import contents, tables
from lavender.lab.report.curves import LINES, Figure, Group, figures, overall_figure
from lavender.lab.report.draw import looks, matplotlib_figure
from lavender.lab.report.findings import Report
from lavender.lab.report.table import Cell, Table, latex, tex
from lavender.lab.report.tables import NOISE
from lavender.lab.report.text import count, without

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
    own = found.having(r if r.own_min is None else replace(r, time_min=r.own_min) for r in found)
    drawn = figures(own)
    groups = (drawn.over, _classes(own), drawn.profiles, drawn.sequences)
    some = [
        _leading(figure, report.verdict.leaders) for group in groups for fs in group.values() for figure in fs
    ]
    look = looks({c.solver for figure in some for c in figure.curves})
    folder = make_folder(folder)
    for figure in some:
        canvas = matplotlib_figure(replace(figure, title=""), look, INCH)
        write_figure(canvas, folder / _file(figure), metadata={"CreationDate": None, "Producer": None})
    write_text(folder / "figures.tex", "\n".join(_included(figure, own) for figure in some))
    write_text(folder / "tables.tex", _tables(report, own))
    write_text(folder / "method.tex", _method(report))
    return folder


def _classes(records: Records) -> Group:
    """Error against time over the cases of each folder, where they came from several."""
    sources = {r.case: Path(records.cases[r.case].source) for r in records if r.step < 0}
    folders = sorted({p.parent for p in sources.values() if p.suffix.lower() in SUFFIXES})
    found = {}
    for folder in folders if len(folders) > 1 else ():
        figure = overall_figure(
            records.having(r for r in records if sources.get(r.case, Path()).parent == folder)
        )
        name = folder.name if sum(f.name == folder.name for f in folders) == 1 else str(folder)
        if figure.curves:
            found[name] = (replace(figure, name=f"class {name}", title=f"{name}: {figure.title}"),)
    return found


def _leading(figure: Figure, leaders: Sequence[str]) -> Figure:
    """The five solvers to tell apart: the leaders of the verdict, then whoever ends lowest; bands of the first two."""
    if all(c.steps for c in figure.curves):
        return figure  # of a profile they are chosen already
    ends = sorted(figure.curves, key=lambda c: c.y[-1] if math.isfinite(c.y[-1]) else math.inf)
    solvers = list(dict.fromkeys(c.solver for c in ends))
    solvers.sort(key=lambda name: leaders.index(name) if name in leaders else len(leaders))
    kept = [c for name in solvers[:LINES] for c in figure.curves if c.solver == name]
    kept[2:] = [replace(c, low=(), high=()) for c in kept[2:]]
    return replace(figure, curves=tuple(kept), left_out=tuple(sorted(solvers[LINES:])))


# -- LaTeX ------------------------------------------------------------------------------------------------


def _file(figure: Figure) -> str:
    return file_name(figure.name.replace(" ", "-")) + ".pdf"


def _own(records: Records, solvers: Iterable[str]) -> str:
    """A sentence on how solvers of other packages among these were timed; empty where there are none."""
    names = sorted({r.solver for r in records if r.own_min is not None}.intersection(solvers))
    if not names:
        return ""
    return f" Time of its own interface, on data given before, without conversion: {', '.join(names)}."


def _lost(records: Records) -> str:
    """A sentence on what did not load; empty where all did."""
    lost = sum(map(len, records.left_out.values()))
    return f" Left out, for it did not load: {count(lost, 'problem')}." if lost else ""


def _included(figure: Figure, records: Records) -> str:
    """A floating figure with its caption."""
    caption = f"{figure.title}.{_own(records, {c.solver for c in figure.curves})}{_lost(records)}"
    if any(c.steps for c in figure.curves):
        caption = f"Share of cases solved within a multiple of the fastest solver's time: law {caption}"
    if figure.left_out:
        caption += f" Not drawn: {', '.join(figure.left_out)}."
    return (
        f"\\begin{{figure}}\n\\centering\n\\includegraphics{{{_file(figure)}}}\n\\caption{{{tex(caption)}}}\n"
        f"\\label{{fig:{_file(figure).removesuffix('.pdf')}}}\n\\end{{figure}}\n"
    )


def _tables(report: Report, own: Records) -> str:
    records, shift = report.records, seconds(tables.SHIFT)
    caption = (
        "Recommended solver, its mean time (of other packages with conversion), and the cases that it brings to the "
        f"level where that is not all. Within {NOISE:g} times of each other solvers count as equal.{_lost(records)}"
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
    for law, by_level in tables.geometric_means(own).items():
        told = set(next(iter(by_level.values())))
        rest = sorted({r.solver for r in own if r.step < 0 and own.cases[r.case].law == law} - told)
        others = f" (not {', '.join(rest)})" if rest else ""
        caption = (
            f"Law {law}: geometric mean of times with {shift} added, and cases brought to the level; a miss costs "
            f"{seconds(tables.limit_of(records))}. Solvers that take every case{others}.{_own(own, told)}"
        )
        caption += _lost(records)
        made.append(latex(contents.mean_table(by_level), caption, f"means-{law}"))
    caption = "Claims of solvers against the judge, who recomputes every residual from the problem's data."
    caption += _lost(records)
    made.append(latex(contents.claim_table(records), caption, "claims"))
    return "% \\usepackage{booktabs}\n" + "\n".join(made)


def _method(report: Report) -> str:
    """The paragraph on the method, each number of it read off the records."""
    records = report.records
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
        f"of set-up and solve, {least}, within a limit of {limit}; BLAS and OpenMP had {threads}.",
        f"{_own(records, {r.solver for r in own})} {report.stopped} {report.busy} Means of times are",
        f"geometric, with {seconds(tables.SHIFT)} added to each and a miss charged the limit. Profiles follow Dolan",
        f"and Moré (2002). Machine: {run.cpu}, {run.cores} cores, {run.platform}; lavender {run.lavender}, Python",
        f"{run.python}, {versions}; run {run.run}, {run.started}.",
    )
    return tex(" ".join(parts)) + "\n"
