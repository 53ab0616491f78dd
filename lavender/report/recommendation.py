"""Build the sentences of a report: the recommended solver with its call, ties, misses, the load of the machine."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pandas as pd

from lavender.base.deadline import format_seconds
from lavender.io.stored import SUFFIXES
from lavender.report.render import Statement
from lavender.report.tables import (
    INSIDE,
    STRUCTURE_ORDER,
    Contents,
    is_plug_in,
    rank_solvers,
    select_ranked_runs,
)
from lavender.report.text import format_count, format_residual, format_tolerance
from lavender.report.timing import format_call
from lavender.suite import FAMILIES

MAX_NAMED = 2  # A sentence names up to this many ties, misses or plug-ins.
PLURALS = {"mesh": "meshes"}


def recommend(report: Contents) -> tuple[Statement, ...]:
    """Recommend a solver for all single cases together, then for the steps of all sequences.

    A campaign, which has no times, has no recommendation.
    """
    if report.is_campaign:
        return ()
    if not len(report.frame):
        stopped = report.is_stopped and len(report.records)
        return (Statement("Stopped: no problem was measured with every solver."),) if stopped else ()
    if report.has_passes_only:
        return (
            Statement(f"Stopped: the tables have the finished passes of {report.frame['solver'].iloc[0]}."),
        )
    single = report.frame["step"] < 0
    return tuple(
        _recommend_for(report, some) for some in (report.frame[single], report.frame[~single]) if len(some)
    )


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
            if (rank := e.rank(report.records, cases, report.tolerance)) is not None
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
    guessed = any(report.records.cases[c].guess for c in cases)
    return Statement(_add_engine(" ".join(sentences), engine, first), format_call(call, guessed))


def _describe_start(frame: pd.DataFrame, runs: pd.DataFrame) -> str:
    """Describe the start of runs; of carried impulses, count the runs that differ from the cold ones."""
    if not (runs["start"] == "carried").any():
        return "cold"
    names = ["case", "solver", "tol", "iterations", "solution_hash"]
    cold = set(frame.loc[frame["start"] == "cold", names].itertuples(index=False, name=None))
    n = sum(run not in cold for run in runs[names].itertuples(index=False, name=None))
    return f"with the impulses of the previous recorded step as start (it changed {n} of {len(runs)} solves)"


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
        if x != x and report.records.cases[str(case)].sequence in sequences:
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
    infos, lost = [report.records.cases[c] for c in names], report.records.left_out
    sequences = list(dict.fromkeys(i.sequence for i in infos if i.sequence))
    if sequences:
        of = sequences[0] if len(sequences) == 1 else f"your {format_count(len(sequences), 'sequence')}"
        n_lost = sum(len(lost.get(name, ())) for name in sequences)
        return f"the {format_count(len(names), 'step')} of {of}{_format_left_out_count(n_lost)}"
    left_out = _format_left_out_count(len(lost.get("", ())))
    many, n = len(names) > 1, len(names)
    if report.is_stopped:
        return f"the {format_count(n, 'problem')} measured so far{left_out}"
    if all(
        c.partition("(")[0] in FAMILIES and not i.source.endswith(SUFFIXES)
        for c, i in zip(names, infos, strict=True)
    ):
        return (f"the {n} built-in problems" if many else names[0]) + left_out
    common = set.intersection(*(set(i.structure) for i in infos))
    shape = next((s for s in STRUCTURE_ORDER[1:5] if s in common), "problem")
    return (f"your {format_count(n, shape, PLURALS.get(shape, ''))}" if many else f"your {shape}") + left_out


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
