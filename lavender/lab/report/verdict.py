"""What a whole report comes to: one sentence and a line of Python to copy, then what is asked next."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from shlex import quote

from lavender.base.deadline import seconds
from lavender.io.stored import SUFFIXES
from lavender.lab.bench.record import Record, level_name
from lavender.lab.bench.store import Records
from lavender.lab.report import tables
from lavender.lab.report.choices import QUANTILE, Choice
from lavender.lab.report.contenders import QUICKER, Subject, subjects
from lavender.lab.report.engine import INSIDE, Contestant, engine_choice, is_ahead
from lavender.lab.report.finals import STARTS, Final, Race, in_time, lines, serves_in
from lavender.lab.report.finals import to_level as race_to_level
from lavender.lab.report.moved import by_speed, speed_levels, speed_name
from lavender.lab.report.tables import SHAPES
from lavender.lab.report.text import count, residual, without
from lavender.lab.report.text import times as times_of
from lavender.lab.suite import FAMILIES
from lavender.solvers.registry import specs


@dataclass(frozen=True)
class Told:
    """A sentence, and the lines that do what it says."""

    text: str
    code: tuple[str, ...] = ()  # Python, as it was timed
    in_c: str = ""  # the command that exports it to C, or why there is none
    asked: bool = False  # for a time or a number of sweeps that somebody asked for

    @property
    def line(self) -> str:
        """The call alone, without the loop around it; empty where there is none."""
        return next((line.strip() for line in self.code if "lv.solve" in line), "")


@dataclass(frozen=True)
class Verdict:
    """What the whole comes to: the first thing to read, then what may be asked of it."""

    told: tuple[Told, ...]
    leaders: tuple[str, ...]  # solvers that the page draws in colour, the recommended one first
    # Of the only subject, the lines that the first sentence was chosen from, with the times that it tells.
    raced: tuple[tuple[Final, Choice], ...] = ()

    @property
    def text(self) -> str:
        """All sentences in one line."""
        return " ".join(t.text for t in self.told)


def _until(speed: float) -> str:
    return f"until no body is wrong by more than {speed_name(speed)}"


def verdict(
    records: Records,
    times: Sequence[float] = (),
    sweeps: Sequence[int] = (),
    engines: Sequence[Contestant] = (),
) -> Verdict:
    """The recommendation for everything that was measured together: single cases, then sequences.

    By motion error where the plan names speed levels; where motion errors were measured beside residuals, a sentence
    says who is first by them. `times` [s] and `sweeps` that are asked for each get a sentence; those of the newest plan
    if none are given. The first sentence also ranks the solver of the engine that recorded the cases, by its answers in
    `engines`.
    """
    if tables.is_campaign(records) or not len(records):
        return Verdict((), ())
    plan = next((run.plan for run in reversed(list(records.runs.values()))), {})
    speeds = speed_levels(records)
    if speeds and plan.get("speed_levels"):
        return _by_advice(by_speed(records))
    times = tuple(times) or tuple(plan.get("times", ()))
    sweeps = tuple(sweeps) or tuple(plan.get("sweeps", ()))
    parts = [_of(records, subject, times, sweeps, engines) for subject in subjects(records, times)]
    told = [t for part in parts for t in part.told]
    if speeds and parts:
        best = subjects(by_speed(records))[0].best.best
        if best is not None:
            reached = _until(speeds[len(speeds) // 2])
            told.append(Told(f"By motion error {best.solver}: {seconds(best.score)} {reached}."))
    leaders = dict.fromkeys(name for part in parts for name in part.leaders)
    return Verdict(tuple(told), tuple(leaders)[:3], parts[0].raced if len(parts) == 1 else ())


def _of(
    records: Records,
    subject: Subject,
    times: Sequence[float],
    sweeps: Sequence[int],
    engines: Sequence[Contestant],
) -> Verdict:
    """The recommendation for one subject, by the lines that were timed in turns or, without any, by those measured."""
    level, n = subject.best.target, subject.best.ranking[0].cases if subject.best.ranking else 0
    in_turns = lines(records, subject.way)
    race = race_to_level(records, in_turns or lines(records, subject.way, rounds=False), level, n)
    what, reached = _what(records, subject, n), f"down to {level_name(level)} of the error of doing nothing"
    engine = engine_choice(engines, records, subject.cases, level)
    if race is None or not race.ranking[0][1].solved:
        near = tuple(c.solver for c in subject.best.ranking[:3] if c.solved)
        said = f"No solver brings {what} {reached}."
        return Verdict((Told(_add_engine(records, said, None, engine, what)),), near)
    final, first = race.ranking[0]
    of = "them" if engine is not None and is_ahead(engine, first) else what
    head = _head(records, first, f"{STARTS[final.line.start]}, {reached}", of)
    told = [
        _told(records, final, _add_engine(records, head, first, engine, what)),
        *_sure(race),
    ]
    leaders = [c.solver for _, c in race.ranking[:3] if c.solved]
    some = [
        f for f in lines(records, "batch") if f.line.solver == first.solver and set(f.runs) <= set(final.runs)
    ]
    for batch in some[:1] if len(final.runs) > 1 else ():
        told.append(_told(records, batch, f"As a batch: {seconds(batch.time)} for each problem."))
    plain = lines(records, subject.way, rounds=False)
    for t in times or [a.target for a in subject.quick if a.target <= QUICKER * first.score][-1:]:
        if first.worst <= t and first.solved == first.cases:
            continue  # there is time for the whole
        races = (in_time(records, some, t, n) for some in (in_turns, plain))
        quick = next((r for r in races if r is not None and r.ranking[0][1].is_for(QUANTILE)), None)
        if quick is None:
            told.append(Told(_nothing(plain, t), asked=bool(times)))
            continue
        best, choice = quick.ranking[0]
        told.append(_told(records, best, _serves(f"If you have only {seconds(t)}", choice, t), bool(times)))
        leaders.insert(1, choice.solver)
    for budget in sweeps:
        same = [f for f in plain if f.line.mode == "budget" and f.line.max_iter == budget]
        swept = in_time(records, same, math.inf, n)
        if swept is not None and swept.ranking[0][1].is_for(QUANTILE):
            best, choice = swept.ranking[0]
            said = _serves(f"With {count(budget, 'sweep')}", choice, math.inf)
            told.append(_told(records, best, said, True))
        elif swept is not None:
            told.append(Told(f"With {count(budget, 'sweep')} nothing serves nine cases of ten.", asked=True))
    foreign = [f"{b.solver} on {b.wins} of {b.solved} cases" for b in tables.backends(records) if b.wins]
    if foreign and subject.way == "call":
        said = f"By their own interface, on data given before, some are faster than all of ours: {', '.join(foreign)}."
        told.append(Told(said))
    return Verdict(tuple(told), tuple(dict.fromkeys(leaders))[:3], race.ranking)


def _what(records: Records, subject: Subject, n: int) -> str:
    names, lost = subject.names, records.left_out
    if subject.way == "call":
        return _name(records, names) + without(len(lost.get("", ())))
    of = names[0] if len(names) == 1 else f"your {count(len(names), 'sequence')}"
    return f"the {count(n, 'step')} of {of}" + without(sum(len(lost.get(name, ())) for name in names))


def _head(records: Records, first: Choice, reached: str, what: str) -> str:
    missed = first.solved < first.cases
    idle = first.cases - len({r.case for r in records if r.solver == first.solver})  # records of several runs
    said = f"Use {first.solver}: it solves {f'{first.solved} of ' if missed else ''}{what} in {seconds(first.score)}"
    if first.cases > 1:
        said += " on average"
    if missed:
        never = f"; on {idle} it has no run" if idle > 0 else ""
        said += f" (a miss counted as {seconds(tables.limit_of(records))}{never})"
    elif math.isfinite(first.worst) and first.worst > 3.0 * first.score:
        said += f" ({seconds(first.worst)} at worst, {first.hardest})"
    return f"{said}, {reached}."


def _add_engine(records: Records, head: str, first: Choice | None, engine: Choice | None, what: str) -> str:
    """Add the engine's own solver to the first sentence: before it if it ranks first, else after it."""
    if engine is None:
        return head
    missed = engine.solved < engine.cases
    time = seconds(engine.score) + (" on average" if engine.cases > 1 else "")
    if missed:
        time += f" (a miss counted as {seconds(tables.limit_of(records))})"
    if engine.solved and (first is None or is_ahead(engine, first)):
        of = f"{engine.solved} of " if missed else ""
        here = head if first is None else f"Of the solvers here, u{head[1:]}"
        return f"First is the engine's own {engine.solver}: it solves {of}{what} in {time}, {INSIDE}. {here}"
    if not engine.solved:
        return f"{head} The engine's own {engine.solver} solves none of them to that level."
    of = f"solves {engine.solved} of them in" if missed else "takes"
    return f"{head} The engine's own {engine.solver} {of} {time}, {INSIDE}."


def _sure(race: Race) -> list[Told]:
    """How often the choice is among the fastest, and who else is, with the time of each."""
    if len(race.ranking) < 2:
        return []
    shares = [
        f"{c.solver} ({seconds(c.score)}) in {int(100.0 * share + 1e-9)} %"  # rounded down: 100 is all
        for (_, c), share in zip(race.ranking, race.shares, strict=True)
        if c.solver in race.named
    ]
    said = f"Among the fastest, within noise, in resamplings of cases and repetitions: {', '.join(shares)}."
    if race.loss > 1.0:
        said += f" Where {race.named[0]} is not, it takes {times_of(race.loss)} the fastest's time."
    return [Told(said)]


def _nothing(some: Sequence[Final], limit: float) -> str:
    """That nobody serves enough of the cases in a time, and in what time somebody does."""
    least = min(map(serves_in, some), default=math.inf)
    said = f"Nothing serves in {seconds(limit)}"
    if math.isfinite(least):
        said += f": to leave at most half of the start's residual on nine cases of ten takes {seconds(least)}"
    return f"{said}."


def _serves(asked: str, choice: Choice, limit: float) -> str:
    how = f", {choice.how}" if choice.how and math.isfinite(limit) else ""
    said = (
        f"{asked}, take {choice.solver}{how}: it serves {choice.solved} of {choice.cases} (at most half of the start's "
        f"residual), at the 90th percentile {residual(choice.score)}"
    )
    if math.isfinite(limit) and choice.overrun > 1.0:
        said += f", and takes up to {times_of(choice.overrun)} that time on the others"
    return f"{said}."


def _not_in_c(records: Records, final: Final) -> str:
    """Why the C library does not take what a line was measured on; empty where it does."""
    for case, record in final.runs.items():
        info = records.cases[case]
        if "ellipses" in info.structure:
            return "the library has no ellipses: give it problem.disk"
        if record.solver in ("direct", "lemke") and info.law not in ("linear", "lcp"):
            return f"{record.solver} takes bounded rows alone there"
        if record.solver in ("pgs", "jacobi") and info.bodies and record.form != "whitened J":
            return f"{record.solver} takes no bodies there: give it the matrix, problem.csr"
    return ""


def _told(records: Records, final: Final, said: str, asked: bool = False) -> Told:
    """A sentence with its lines, of Python and, as the command that exports them, of C."""
    if not final.line.times:
        said += " Records of an earlier version: the line itself was not timed."
    line, reason, in_c = final.line, _not_in_c(records, final), ""
    spec = specs().get(line.solver)
    if spec is not None and spec.own and not spec.external and line.mode == "tol" and line.way != "batch":
        made = f"lavender export c liblavender --solver {line.solver} --for {quote(records.source or 'records.jsonl')}"
        in_c = f"not in C: {reason}" if reason else made
    return Told(said, final.code, in_c, asked)


def _by_advice(records: Records) -> Verdict:
    """By motion error: lines are not timed for it."""
    subject = subjects(records)[0]
    best, n = subject.best, subject.best.ranking[0].cases if subject.best.ranking else 0
    what, reached = _what(records, subject, n), _until(subject.best.target)
    leaders = tuple(c.solver for c in best.ranking[:3] if c.solved)
    first = best.best
    if first is None:
        return Verdict((Told(f"No solver brings {what} so far {reached}."),), leaders)
    ties = (Told(f"As good within noise: {', '.join(best.ties)}."),) if best.ties else ()
    tol = _tolerance(records, first.solver, best.target)
    asked = f"tol={level_name(tol)}" if math.isfinite(tol) else f"tol=0, max_iter={first.iterations}"
    code = f'lv.solve(problem, "{first.solver}", {asked})'
    start = STARTS["carried" if "carried" in first.how else "cold"]
    return Verdict((Told(_head(records, first, f"{start}, {reached}", what), (code,)), *ties), leaders)


def _tolerance(records: Records, solver: str, level: float) -> float:
    """The residual to ask for: the tightest that the quickest runs to this speed were asked for, over the cases."""
    quickest: dict[str, Record] = {}
    for r in records:
        if r.solver != solver or r.mode != "tol" or r.relative > level:
            continue
        if r.case not in quickest or r.time_min < quickest[r.case].time_min:
            quickest[r.case] = r
    tightest = min((r.tol for r in quickest.values()), default=math.nan)
    if not tightest > 0.0:
        return math.nan
    power = math.floor(math.log10(tightest))
    return float(f"{math.floor(tightest / 10.0**power + 1e-9)}e{power}")  # rounded down: it still gets there


def _name(records: Records, cases: Sequence[str]) -> str:
    words = [set(records.cases[c].structure) for c in cases]
    shape = next((s for s in SHAPES if all(s in w for w in words)), "")
    if all(c.partition("(")[0] in FAMILIES and not records.cases[c].source.endswith(SUFFIXES) for c in cases):
        return f"the {count(len(cases), 'built-in problem')}" if len(cases) > 1 else cases[0]
    if shape in ("", "separate", "dense"):
        return f"your {count(len(cases), 'problem')}" if len(cases) > 1 else "your problem"
    plural = {"mesh": "meshes"}.get(shape, shape + "s")
    return f"your {count(len(cases), shape, plural)}" if len(cases) > 1 else f"your {shape}"
