"""Build the sentences of a report: the recommended solver with its call, its certainty, batches, and budgets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

from lavender.base.deadline import format_seconds
from lavender.io.stored import SUFFIXES
from lavender.report.bench import statistics
from lavender.report.bench.recommendation import (
    SERVED_QUANTILE,
    SHORT_TIME_RATIO,
    Advice,
    Choice,
    Subject,
    list_subjects,
)
from lavender.report.bench.record import format_tolerance
from lavender.report.bench.resampling import (
    STARTS,
    ResampledRanking,
    TimedCall,
    compute_serving_time,
    rank_calls_in_time,
    rank_calls_to_tolerance,
    select_calls_with_most_cases,
)
from lavender.report.bench.statistics import STRUCTURE_ORDER
from lavender.report.bench.store import Records
from lavender.report.engine import INSIDE, EngineAnswers, is_ranked_before, rank_engine
from lavender.report.figures import is_plug_in
from lavender.report.text import format_count, format_left_out_count, format_ratio, format_residual
from lavender.suite import FAMILIES

MAX_PLUG_INS = 2  # The sentence on plug-ins names up to this many; if there are more, it names only the best.


@dataclass(frozen=True)
class Statement:
    """A sentence, and the lines of code that it describes.

    Parameters
    ----------
    text : the sentence
    code : lines of Python, as they were timed
    requested : whether the sentence is about a time or a number of sweeps that the user requested
    one_line : whether a short report on a terminal also shows the sentence, cut to one line
    """

    text: str
    code: tuple[str, ...] = ()
    requested: bool = False
    one_line: bool = False

    @property
    def call_line(self) -> str:
        """The line of `code` with the call, without the lines of a loop around it; empty if there is no code."""
        return next((line.strip() for line in self.code if "lv.solve" in line), "")


@dataclass(frozen=True)
class Verdict:
    """All sentences of a report, the recommendation first.

    Parameters
    ----------
    statements : sentences
    leaders : solvers that the page shows in colour, the recommended one first
    ranking : for a report with one subject, the ranked calls of the first sentence with their times
    """

    statements: tuple[Statement, ...]
    leaders: tuple[str, ...]
    ranking: tuple[tuple[TimedCall, Choice], ...] = ()

    @property
    def joined_text(self) -> str:
        """All sentences in one line."""
        return " ".join(statement.text for statement in self.statements)


def build_verdict(
    records: Records,
    times: Sequence[float] = (),
    sweeps: Sequence[int] = (),
    engines: Sequence[EngineAnswers] = (),
) -> Verdict:
    """Build the recommendation for all that was measured together: single cases, then sequences.

    Each of `times` [s] and `sweeps` gets a sentence; the default are the budgets of the newest plan. The first sentence
    also ranks the solver of the engine that recorded the cases, by its answers in `engines`.
    """
    if statistics.is_campaign(records) or not len(records):
        return Verdict((), ())
    plan = next((run.plan for run in reversed(list(records.runs.values()))), {})
    times = tuple(times) or tuple(plan.get("times", ()))
    sweeps = tuple(sweeps) or tuple(plan.get("sweeps", ()))
    subjects = list_subjects(records, times)
    parts = [_recommend_solver(records, subject, times, sweeps, engines) for subject in subjects]
    statements = [statement for part in parts for statement in part.statements]
    leaders = dict.fromkeys(name for part in parts for name in part.leaders)
    return Verdict(tuple(statements), tuple(leaders)[:3], parts[0].ranking if len(parts) == 1 else ())


def _recommend_solver(
    records: Records,
    subject: Subject,
    times: Sequence[float],
    sweeps: Sequence[int],
    engines: Sequence[EngineAnswers],
) -> Verdict:
    """Recommend a solver for one subject, by interleaved calls, or by single runs if no calls were interleaved."""
    tolerance, n = subject.best.target, subject.best.ranking[0].cases if subject.best.ranking else 0
    interleaved, single = (
        select_calls_with_most_cases(records, subject.timing_mode),
        select_calls_with_most_cases(records, subject.timing_mode, interleaved=False),
    )
    resampled = rank_calls_to_tolerance(records, interleaved or single, tolerance, n)
    cases = _describe_subject(records, subject, n)
    reached = f"down to {format_tolerance(tolerance)} of the error of the zero impulse"
    engine = rank_engine(engines, records, subject.cases, tolerance)
    if resampled is None or not resampled.ranking[0][1].solved:
        near = tuple(c.solver for c in subject.best.ranking[:3] if c.solved)
        text = f"No solver brings {cases} {reached}."
        return Verdict((Statement(_add_engine_to_sentence(records, text, None, engine, cases)),), near)
    call, first = resampled.ranking[0]
    named_cases = "them" if engine is not None and is_ranked_before(engine, first) else cases
    head = _describe_recommended_choice(
        records, first, f"{STARTS[call.as_record.start]}, {reached}", named_cases
    )
    statements = [
        _make_statement_with_code(
            records, call, _add_engine_to_sentence(records, head, first, engine, cases)
        ),
        *_state_plug_ins(records, subject.best, first.solver),
        *_describe_resampled_ranking(resampled),
    ]
    leaders = [c.solver for _, c in resampled.ranking[:3] if c.solved]
    batches = [
        f
        for f in select_calls_with_most_cases(records, "batch")
        if f.as_record.solver == first.solver and set(f.runs) <= set(call.runs)
    ]
    for batch in batches[:1] if len(call.runs) > 1 else ():
        statements.append(
            _make_statement_with_code(
                records, batch, f"As a batch: {format_seconds(batch.mean_time)} for each problem."
            )
        )
    for t in times or [a.target for a in subject.quick if a.target <= SHORT_TIME_RATIO * first.score][-1:]:
        if first.worst <= t and first.solved == first.cases:
            continue  # The recommended call takes less than this time budget: a sentence on it adds nothing.
        rankings = (rank_calls_in_time(records, calls, t, n) for calls in (interleaved, single))
        quick = next(
            (r for r in rankings if r is not None and r.ranking[0][1].solves_share(SERVED_QUANTILE)), None
        )
        if quick is None:
            statements.append(Statement(_describe_shortest_serving_time(single, t), requested=bool(times)))
            continue
        best, choice = quick.ranking[0]
        text = _describe_budget_recommendation(f"If you have only {format_seconds(t)}", choice, t)
        statements.append(_make_statement_with_code(records, best, text, bool(times)))
        leaders.insert(1, choice.solver)
    statements += _state_sweep_budgets(records, single, sweeps, n)
    faster = [
        f"{b.solver} on {b.wins} of {b.solved} cases"
        for b in statistics.compare_backend_times(records)
        if b.wins
    ]
    if faster and subject.timing_mode == "call":
        head = (
            "The own interface of some other solvers, without conversion and judge, takes less time than the complete "
            "call of every solver of lavender"
        )
        statements.append(Statement(f"{head}: {', '.join(faster)}."))
    return Verdict(tuple(statements), tuple(dict.fromkeys(leaders))[:3], resampled.ranking)


# -- sentences -----------------------------------------------------------------------------------------------


def _describe_subject(records: Records, subject: Subject, n: int) -> str:
    """Describe a subject: its single cases, or the n steps of its sequences, with the number of unloaded cases."""
    names, lost = subject.names, records.left_out
    if subject.timing_mode == "call":
        return _describe_cases(records, names) + format_left_out_count(len(lost.get("", ())))
    of = names[0] if len(names) == 1 else f"your {format_count(len(names), 'sequence')}"
    n_lost = sum(len(lost.get(name, ())) for name in names)
    return f"the {format_count(n, 'step')} of {of}" + format_left_out_count(n_lost)


def _describe_cases(records: Records, cases: Sequence[str]) -> str:
    """Return words for single cases: built-in problems, or the structure that all of them have."""
    structures = [set(records.cases[c].structure) for c in cases]
    shape = next((s for s in STRUCTURE_ORDER if all(s in w for w in structures)), "")
    if all(c.partition("(")[0] in FAMILIES and not records.cases[c].source.endswith(SUFFIXES) for c in cases):
        return f"the {format_count(len(cases), 'built-in problem')}" if len(cases) > 1 else cases[0]
    if shape in ("", "separate", "dense"):
        return f"your {format_count(len(cases), 'problem')}" if len(cases) > 1 else "your problem"
    plural = {"mesh": "meshes"}.get(shape, shape + "s")
    return f"your {format_count(len(cases), shape, plural)}" if len(cases) > 1 else f"your {shape}"


def _describe_recommended_choice(records: Records, first: Choice, reached: str, cases: str) -> str:
    """Return the first sentence: the solver, its mean time, the time counted for a missed case, the slowest case."""
    has_misses = first.solved < first.cases
    idle = first.cases - len(
        {r.case for r in records if r.solver == first.solver}
    )  # Records that were merged from several runs may lack the recommended solver on some cases.
    solved = f"{first.solved} of " if has_misses else ""
    text = f"Use {first.solver}: it solves {solved}{cases} in {format_seconds(first.score)}"
    if first.cases > 1:
        text += " on average"
    if has_misses:
        no_run = f"; on {idle} it has no run" if idle > 0 else ""
        text += f" (a miss counted as {format_seconds(statistics.get_penalty_time_of_miss(records))}{no_run})"
    elif math.isfinite(first.worst) and first.worst > 3.0 * first.score:
        text += f" ({format_seconds(first.worst)} at worst, {first.hardest})"
    return f"{text}, {reached}."


def _add_engine_to_sentence(
    records: Records, head: str, first: Choice | None, engine: Choice | None, cases: str
) -> str:
    """Add the engine's own solver to the sentence `head`: at its beginning if it ranks first, else at its end."""
    if engine is None:
        return head
    has_misses = engine.solved < engine.cases
    time = format_seconds(engine.score) + (" on average" if engine.cases > 1 else "")
    if has_misses:
        time += f" (a miss counted as {format_seconds(statistics.get_penalty_time_of_miss(records))})"
    if engine.solved and (first is None or is_ranked_before(engine, first)):
        of = f"{engine.solved} of " if has_misses else ""
        here = head if first is None else f"Of the solvers here, u{head[1:]}"
        return f"First is the engine's own {engine.solver}: it solves {of}{cases} in {time}, {INSIDE}. {here}"
    if not engine.solved:
        return f"{head} The engine's own {engine.solver} solves none of them to that tolerance."
    of = f"solves {engine.solved} of them in" if has_misses else "takes"
    return f"{head} The engine's own {engine.solver} {of} {time}, {INSIDE}."


def _state_plug_ins(records: Records, advice: Advice, first: str) -> list[Statement]:
    """State place and time of the best plug-ins other than the recommended solver `first`, in one sentence."""
    ranked = [
        (place, choice)
        for place, choice in enumerate(advice.ranking, 1)
        if is_plug_in(choice.solver) and choice.solver != first
    ]
    named = ranked if len(ranked) <= MAX_PLUG_INS else ranked[:1]
    texts = []
    for place, choice in named:
        time = f" in {format_seconds(choice.score)}" if choice.solved else ""
        if 0 < choice.solved < choice.cases:
            time += f" (a miss counted as {format_seconds(statistics.get_penalty_time_of_miss(records))})"
        solved = f"{choice.solved} of {choice.cases} solved{time}"
        texts.append(f"{choice.solver}: place {place} of {len(advice.ranking)}, {solved}")
    if not texts:
        return []
    more = f" (and {len(ranked) - len(named)} more)" if len(ranked) > len(named) else ""
    return [Statement(f"Plug-in {'; '.join(texts)}{more}.", one_line=True)]


def _state_sweep_budgets(
    records: Records, calls: Sequence[TimedCall], sweeps: Sequence[int], cases: int
) -> list[Statement]:
    """State the recommended solver for each number of sweeps; consecutive budgets with one solver get one sentence."""
    firsts: list[tuple[int, TimedCall | None, Choice]] = []
    for budget in sweeps:
        some = [f for f in calls if f.as_record.mode == "budget" and f.as_record.max_iter == budget]
        swept = rank_calls_in_time(records, some, math.inf, cases)
        if swept is not None:
            call, choice = swept.ranking[0]
            firsts.append((budget, call if choice.solves_share(SERVED_QUANTILE) else None, choice))

    def get_recommendation(entry: tuple[int, TimedCall | None, Choice]) -> tuple[object, ...]:
        _, call, choice = entry
        return () if call is None else (choice.solver, choice.solved, choice.cases, call.as_record.start)

    statements = []
    for _, group in groupby(firsts, get_recommendation):
        budgets, served_by, choices = zip(*group, strict=True)
        condition = f"With {_join_names([str(n) for n in budgets])} sweep{'s' * (budgets != (1,))}"
        if served_by[0] is None:
            statements.append(Statement(f"{condition} no solver serves nine cases of ten.", requested=True))
            continue
        text = _describe_budget_recommendation(condition, choices[0], math.inf)
        if len(budgets) > 1:
            text = text.removesuffix(f"{format_residual(choices[0].score)}.")
            text += f"{_join_names([format_residual(choice.score) for choice in choices])}."
        statement = _make_statement_with_code(records, served_by[0], text, True)
        others = ", ".join(map(str, budgets[1:]))
        code = tuple(
            f"{line}  # or {others}" if others and "lv.solve" in line else line for line in statement.code
        )
        statements.append(replace(statement, code=code))
    return statements


def _join_names(names: Sequence[str]) -> str:
    """Join words with commas, and the last two with "and"."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _describe_resampled_ranking(resampled: ResampledRanking) -> list[Statement]:
    """State how often each named solver is among the fastest, with its time; empty if there is only one call."""
    if len(resampled.ranking) < 2:
        return []
    shares = [
        # Rounded down: 100 % means all.
        f"{c.solver} ({format_seconds(c.score)}) in {int(100.0 * share + 1e-9)} %"
        for (_, c), share in zip(resampled.ranking, resampled.shares, strict=True)
        if c.solver in resampled.named_calls
    ]
    text = f"Among the fastest, within noise, in resamplings of cases and repetitions: {', '.join(shares)}."
    if resampled.loss > 1.0:
        loss = format_ratio(resampled.loss)
        text += f" In the others, {resampled.named_calls[0]} takes {loss} the time of the fastest."
    return [Statement(text)]


def _describe_shortest_serving_time(calls: Sequence[TimedCall], limit: float) -> str:
    """State that no call serves enough cases within `limit` [s], and the shortest time within which some call does."""
    shortest = min(map(compute_serving_time, calls), default=math.inf)
    text = f"No solver leaves at most half of the start's residual on nine cases of ten in {format_seconds(limit)}"
    if math.isfinite(shortest):
        text += f"; the shortest time for that is {format_seconds(shortest)}"
    return f"{text}."


def _describe_budget_recommendation(condition: str, choice: Choice, limit: float) -> str:
    """State the recommended solver for a budget, and the residual that it reaches."""
    how = f", {choice.how}" if choice.how and math.isfinite(limit) else ""
    text = (
        f"{condition}, use {choice.solver}{how}: it serves {choice.solved} of {choice.cases} (at most half of the "
        f"start's residual), at the 90th percentile {format_residual(choice.score)}"
    )
    if math.isfinite(limit) and choice.overrun > 1.0:
        text += f", and takes up to {format_ratio(choice.overrun)} that time on the others"
    return f"{text}."


# -- code ----------------------------------------------------------------------------------------------------


def _make_statement_with_code(
    records: Records, call: TimedCall, text: str, requested: bool = False
) -> Statement:
    """Return a sentence with the lines of its call."""
    if not call.as_record.timing_mode:
        text += " Records of an earlier version: the call itself was not timed."
    return Statement(text, call.code_lines, requested)
