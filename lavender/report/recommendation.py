"""Build the sentences of a report: the recommended solver with its call, ties, misses, the load of the machine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd

from lavender.base.deadline import format_seconds
from lavender.io.stored import SUFFIXES
from lavender.report.render import Statement
from lavender.report.tables import (
    INSIDE,
    PLAIN_SWEEPS,
    STRUCTURE_ORDER,
    Contents,
    is_plug_in,
    rank_solvers,
    select_ranked_runs,
    tabulate_sweeps,
)
from lavender.report.text import format_count, format_residual, format_tolerance
from lavender.report.timing import format_call
from lavender.suite import FAMILIES

MAX_NAMED = 2  # A sentence names up to this many ties, misses or plug-ins.
MAX_SWEEP_ERROR = 1e-3  # [m/s] A number of sweeps is recommended if no velocity error is larger.
PLURALS = {"mesh": "meshes"}


def recommend(report: Contents) -> tuple[Statement, ...]:
    """Recommend a solver for all single cases together, then for the steps of all sequences.

    A campaign, which has no times, has no recommendation.
    """
    if report.is_campaign:
        return ()
    if not len(report.frame):
        stopped = report.is_stopped and len(report.runs)
        return (Statement("Stopped: no problem was measured with every solver."),) if stopped else ()
    if report.has_passes_only:
        return (
            Statement(f"Stopped: the tables have the finished passes of {report.frame['solver'].iloc[0]}."),
        )
    single = report.frame["step"] < 0
    parts = [some for some in (report.frame[single], report.frame[~single]) if len(some)]
    sweeps = _recommend_sweeps(report)
    if (report.frame["mode"] == "budget").all():
        return sweeps or tuple(_recommend_for(report, some) for some in parts)
    return (*(_recommend_for(report, some) for some in parts), *sweeps)


def _recommend_sweeps(report: Contents) -> tuple[Statement, ...]:
    """State for each sequence the smallest number of sweeps that keeps every velocity error below the limit."""
    table, statements = tabulate_sweeps(report), []
    limit = f"{1e3 * MAX_SWEEP_ERROR:g} mm/s"
    for name, own in table.groupby("sequence", sort=False) if len(table) else ():
        steps, counts = own["steps"].max(), {}
        for start in ("carried", "cold"):
            errors = own.get(f"velocity error, {start} [m/s]")
            good = (
                own[(errors <= MAX_SWEEP_ERROR) & (own["steps"] == steps)]
                if errors is not None
                else own.iloc[:0]
            )
            good = (
                good[good["solver"].isin(PLAIN_SWEEPS)] if good["solver"].isin(PLAIN_SWEEPS).any() else good
            )
            counts[start] = good.sort_values("sweeps", kind="stable").iloc[:1].to_dict("records")
        if counts["carried"]:
            (best,) = counts["carried"]
            sweeps, error = format_count(best["sweeps"], "sweep"), best["velocity error, carried [m/s]"]
            cold = [f"cold: {x['sweeps']} of {x['solver']}" for x in counts["cold"]] or ["cold: not reached"]
            text = (
                f"{name}: {sweeps} of {best['solver']} with warm starts keep every velocity error below {limit} "
                f"({format_residual(error)} m/s; {cold[0]})"
            )
        else:
            column = next(
                c for c in ("velocity error, carried [m/s]", "velocity error, cold [m/s]") if c in own
            )
            best = own.loc[own[column].idxmin()].to_dict()
            text = (
                f"{name}: no measured number of sweeps keeps every velocity error below {limit}; the smallest is "
                f"{format_residual(best[column])} m/s, after {best['sweeps']} sweeps of {best['solver']}"
            )
        statements.append(Statement(f"{text}{_describe_own_sweeps(report, str(name))}."))
    return tuple(statements)


def _describe_own_sweeps(report: Contents, sequence: str) -> str:
    """Return the largest velocity error of the engine's own answers to a sequence, if it was recorded."""
    sources = report.cases.loc[report.cases["sequence"] == sequence, "source"]
    for engine in report.engines:
        files = [Path(source).name for source in sources if engine.contains(source)]
        lines = engine.lines[engine.lines["file"].isin(files)]
        error, counts = lines["velocity"].max(), lines["iterations"].dropna()
        if len(lines) and math.isfinite(error):
            own = f" {counts.max():.0f} iterations" if len(counts) else " answers"
            return f"; the engine's own{own} ({engine.solver}): {format_residual(error)} m/s"
    return ""


def _recommend_for(report: Contents, frame: pd.DataFrame) -> Statement:
    """Recommend the first solver of the ranking on some cases, and name ties, misses, engine and plug-ins."""
    ranking = rank_solvers(frame, report.tolerance)
    cases = list(frame["case"].unique())
    named = _describe_cases(report, cases)
    reached = f"down to {format_tolerance(report.tolerance)} of the error of the zero impulse"
    engine = next(
        (
            rank
            for e in report.engines
            if (rank := e.rank(report.cases.loc[cases], report.tolerance)) is not None
        ),
        None,
    )
    if not len(ranking) or not ranking["solved"].iloc[0]:
        stopped = "Stopped: no" if report.is_stopped else "No"
        return Statement(_add_engine(f"{stopped} solver brings {named} {reached}.", engine, None))
    solver, first = str(ranking.index[0]), ranking.iloc[0]
    runs = select_ranked_runs(frame)
    own = runs[(runs["solver"] == solver) & (runs[["tol", "relative"]].max(axis=1) <= report.tolerance)]
    missed, unreached = _list_unsolved_cases(report, runs, cases, solver)
    solved = f"{first['solved']} of " if missed or unreached else ""
    time = format_seconds(first["mean"]) + (" on average" if first["solved"] > 1 else "")
    if first["worst"] > 3.0 * first["mean"]:
        time += f" ({format_seconds(first['worst'])} at worst, {first['hardest']})"
    loosest = own[own["tol"] == own["tol"].max()]
    use = f"Stopped: {solver} solves" if report.is_stopped else f"Use {solver}: it solves"
    sentences = [f"{use} {solved}{named} in {time}, {_describe_start(frame, loosest)}, {reached}."]
    if report.unfinished:
        sentences.append(f"Not measured to the end: {_shorten_list(report.unfinished)}.")
    ties = ranking.loc[ranking["tie"], "mean"].iloc[1:]
    if len(ties):
        names = _shorten_list([f"{name} ({format_seconds(t)})" for name, t in ties.items()])
        sentences.append(f"As fast within the noise of the repetitions: {names}.")
    if missed:
        sentences.append(f"It misses {_shorten_list(missed)}.")
    if unreached:
        steps = format_count(unreached, "step")
        sentences.append(f"Not reached within the time of a pass (--sequence-time-limit): {steps}.")
    sentences += _describe_plug_ins(ranking, solver)
    call = SimpleNamespace(**loosest.loc[loosest["iterations"].idxmax()].to_dict())
    guessed = bool((report.cases.loc[cases, "guess"] != "").any())
    return Statement(_add_engine(" ".join(sentences), engine, first), format_call(call, guessed))


def _describe_start(frame: pd.DataFrame, runs: pd.DataFrame) -> str:
    """Describe the start of runs; of carried impulses, count the runs that differ from the cold ones."""
    if not (runs["start"] == "carried").any():
        return "cold"
    names = ["case", "solver", "tol", "iterations", "solution_hash"]
    cold = set(frame.loc[frame["start"] == "cold", names].itertuples(index=False, name=None))
    n = sum(run not in cold for run in runs[names].itertuples(index=False, name=None))
    carrying = format_seconds(runs["carry_time"].mean()) if runs["carry_time"].notna().any() else ""
    apart = f"mapping them takes {carrying} a step, not included; " if carrying else ""
    return f"with the impulses of the previous recorded step as start ({apart}it changed {n} of {len(runs)} solves)"


def _list_unsolved_cases(
    report: Contents, runs: pd.DataFrame, cases: Sequence[str], solver: str
) -> tuple[list[str], int]:
    """Return the cases that a solver misses, each with its smallest residual, and the number of steps not reached.

    A step is not reached if the pass to the tolerance ended before it, and no pass to a larger tolerance missed it.
    """
    own = runs[runs["solver"] == solver]
    is_run = (own["tol"] <= report.tolerance) | (own["relative"] > own["tol"])
    left = own[is_run].groupby("case", observed=True)["relative"].min().reindex(list(cases))
    sequences = set(own["sequence"].astype(str)) - {""}
    missed, unreached = [], 0
    for case, x in left[~(left <= report.tolerance)].items():
        if x != x and report.cases.loc[str(case), "sequence"] in sequences:
            unreached += 1
        else:
            missed.append(f"{case} ({'not accepted' if x != x else f'residual {format_residual(x)}'})")
    return missed, unreached


def _describe_plug_ins(ranking: pd.DataFrame, first: str) -> list[str]:
    """Return the sentence on place and time of plug-ins other than the recommended solver."""
    texts = [
        f"{name}: place {place} of {len(ranking)}, {row['solved']} of {row['cases']} solved"
        + (f" in {format_seconds(row['mean'])}" if row["solved"] else "")
        for place, (name, row) in enumerate(ranking.iterrows(), 1)
        if is_plug_in(str(name)) and name != first
    ]
    return [f"Plug-in {_shorten_list(texts, '; ')}."] if texts else []


def _shorten_list(texts: Sequence[str], separator: str = ", ") -> str:
    """Join up to `MAX_NAMED` texts, and the number of the others."""
    more = len(texts) - MAX_NAMED
    return separator.join(texts[:MAX_NAMED]) + (f" and {more} more" if more > 0 else "")


def _describe_cases(report: Contents, names: Sequence[str]) -> str:
    """Return words for cases: steps of sequences, built-in problems, or the structure that all of them have."""
    infos, lost, n = report.cases.loc[list(names)], report.left_out, len(names)
    sequences = [name for name in infos["sequence"].unique() if name]
    if sequences:
        of = sequences[0] if len(sequences) == 1 else f"your {format_count(len(sequences), 'sequence')}"
        n_lost = sum(len(lost.get(name, ())) for name in sequences)
        return f"the {format_count(n, 'step')} of {of}{_format_left_out_count(n_lost)}"
    left_out = _format_left_out_count(len(lost.get("", ())))
    if report.is_stopped:
        return f"the {format_count(n, 'problem')} measured so far{left_out}"
    is_file = infos["source"].astype(str).str.endswith(SUFFIXES)
    if not is_file.any() and all(name.partition("(")[0] in FAMILIES for name in names):
        return (f"the {n} built-in problems" if n > 1 else names[0]) + left_out
    common = set.intersection(*(set(words.split(", ")) for words in infos["structure"]))
    shape = next((s for s in STRUCTURE_ORDER[1:5] if s in common), "problem")
    return (f"your {format_count(n, shape, PLURALS.get(shape, ''))}" if n > 1 else f"your {shape}") + left_out


def _add_engine(text: str, engine: Any, first: Any) -> str:
    """Add the engine's own solver to the sentence: at its beginning if it ranks first, else at its end."""
    if engine is None:
        return text
    if not engine["solved"]:
        return f"{text} The engine's own {engine['solver']} solves none of them to that tolerance."
    missed = f" (misses {engine['cases'] - engine['solved']})" if engine["solved"] < engine["cases"] else ""
    time = format_seconds(engine["mean"]) + (" on average" if engine["solved"] > 1 else "")
    solves = f"solves {engine['solved']} of {engine['cases']}{missed} in {time}, {INSIDE}"
    if first is None or (-engine["solved"], engine["mean"]) < (-first["solved"], first["mean"]):
        return f"First is the engine's own {engine['solver']}: it {solves}. {text}"
    return f"{text} The engine's own {engine['solver']} {solves}."


def _format_left_out_count(lost: int) -> str:
    """Return a remark in parentheses that `lost` cases are left out of a number; empty if none is left out."""
    return f" ({lost} left out)" if lost else ""
