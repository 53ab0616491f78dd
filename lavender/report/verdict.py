"""What a whole report comes to: one sentence, and lines of Python to copy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from shlex import quote

from lavender.bench.record import Record, level_name
from lavender.bench.store import Records
from lavender.io.stored import SUFFIXES
from lavender.registry import specs
from lavender.report import tables
from lavender.report.contenders import QUICKER, Subject, subjects
from lavender.report.moved import by_speed, speed_levels, speed_name
from lavender.report.tables import Choice
from lavender.report.tables.finals import WAYS, Final, Race, in_time, lines
from lavender.report.tables.finals import to_level as race_to_level
from lavender.report.text import count, residual, seconds
from lavender.report.text import times as times_of
from lavender.suite import FAMILIES

__all__ = ["Verdict", "verdict"]

PYTHON_SHARE = 2e-4  # s: below it what is measured is largely the way through Python, some 50 µs of it
SHAPES = ("separate", "chain", "mesh", "stack", "pile", "dense")


@dataclass(frozen=True)
class Verdict:
    """The first thing to read."""

    sentences: tuple[str, ...]
    code: tuple[str, ...]  # lines of Python
    leaders: tuple[str, ...]  # solvers that the page draws in colour, the recommended one first

    @property
    def text(self) -> str:
        """All sentences in one line."""
        return " ".join(self.sentences)


def _until(speed: float) -> str:
    return f"until no body is wrong by more than {speed_name(speed)}"


def verdict(records: Records, times: Sequence[float] = (), sweeps: Sequence[int] = ()) -> Verdict:
    """The recommendation for everything that was measured together: single cases, then sequences.

    By motion error where the plan names speed levels; where motion errors were measured beside residuals, a sentence
    says who is first by them. `times` [s] and `sweeps` that are asked for each get a sentence; those of the newest plan
    if none are given.
    """
    if tables.is_campaign(records) or not len(records):
        return Verdict((), (), ())
    newest = next(reversed(list(records.runs.values())), None)
    plan = {} if newest is None else newest.plan
    speeds = speed_levels(records)
    if speeds and plan.get("speed_levels"):
        return _by_advice(by_speed(records))
    times = tuple(times) or tuple(plan.get("times", ()))
    sweeps = tuple(sweeps) or tuple(plan.get("sweeps", ()))
    parts = [_of(records, subject, times, sweeps) for subject in subjects(records, times)]
    sentences = [s for part in parts for s in part.sentences]
    if speeds and parts:
        best = subjects(by_speed(records))[0].best.best
        if best is not None:
            reached = _until(speeds[len(speeds) // 2])
            sentences.append(f"By motion error {best.solver}: {seconds(best.score)} {reached}.")
    leaders = dict.fromkeys(name for part in parts for name in part.leaders)
    return Verdict(tuple(sentences), tuple(c for part in parts for c in part.code), tuple(leaders)[:3])


def _of(records: Records, subject: Subject, times: Sequence[float], sweeps: Sequence[int]) -> Verdict:
    """The recommendation for one subject, by the lines that were timed in turns or, without any, by those measured."""
    level, n = subject.best.target, subject.best.ranking[0].cases if subject.best.ranking else 0
    in_turns = lines(records, subject.way)
    race = race_to_level(records, in_turns or lines(records, subject.way, rounds=False), level, n)
    what, reached = _what(records, subject), f"to {level_name(level)}"
    if race is None or not race.ranking[0][1].solved:
        near = tuple(c.solver for c in subject.best.ranking[:3] if c.solved)
        return Verdict((f"Nobody brings any of {what} {reached}.",), (), near)
    final, first = race.ranking[0]
    said = [_head(first, reached, what), *_sure(race)]
    code = _told(records, final, first.score, WAYS[subject.way])
    leaders = [c.solver for _, c in race.ranking[:3] if c.solved]
    some = [
        f for f in lines(records, "batch") if f.line.solver == first.solver and set(f.runs) <= set(final.runs)
    ]
    for batch in some[:1] if len(final.runs) > 1 else ():
        code += _told(records, batch, batch.time, WAYS["batch"])
    plain = lines(records, subject.way, rounds=False)
    for t in times or [a.target for a in subject.quick if a.target <= QUICKER * first.score][-1:]:
        if first.worst <= t and first.solved == first.cases:
            continue  # there is time for the whole
        quick = in_time(records, [f for f in in_turns if f.line.mode != "tol"] or plain, t, n)
        asked = f"If you have only {seconds(t)}"
        if quick is None or not quick.ranking[0][1].solved:
            said += [f"{asked}, nobody gets any of {what} to half of the start's residual."] if times else []
            continue
        said.append(_serves(asked, *quick.ranking[0], t))
        code += _told(records, quick.ranking[0][0], quick.ranking[0][0].time, f"for {seconds(t)}")
        leaders.insert(1, quick.ranking[0][1].solver)
    for budget in sweeps:
        same = [f for f in plain if f.line.mode == "budget" and f.line.max_iter == budget]
        swept = in_time(records, same, math.inf, n)
        if swept is not None:
            said.append(_serves(f"With {count(budget, 'sweep')}", *swept.ranking[0], math.inf))
            code += _told(records, swept.ranking[0][0], swept.ranking[0][0].time, count(budget, "sweep"))
    foreign = [f"{b.solver} on {b.wins} of {b.solved} cases" for b in tables.backends(records) if b.wins]
    if foreign and subject.way == "call":
        said.append(
            f"By their own interface, on data given before, some are faster than all of ours: {', '.join(foreign)}."
        )
    if first.score < PYTHON_SHARE:
        said.append(f"Below {seconds(PYTHON_SHARE)} Python's share of a call decides as much as the solver.")
    return Verdict(tuple(said), tuple(dict.fromkeys(code)), tuple(dict.fromkeys(leaders))[:3])


def _what(records: Records, subject: Subject) -> str:
    if subject.way == "call":
        return _name(records, subject.names)
    names = subject.names
    return f"a step of {names[0]}" if len(names) == 1 else f"a step of your {count(len(names), 'sequence')}"


def _head(first: Choice, reached: str, what: str) -> str:
    said = f"Use {first.solver}: {seconds(first.score)} {reached} on {what}"
    if first.solved < first.cases:
        said += f", of which it brings {first.solved} of {first.cases} there"
    elif math.isfinite(first.worst) and first.worst > 3.0 * first.score:
        said += f" (at worst {seconds(first.worst)}: {first.hardest})"
    return f"{said}."


def _percent(share: float) -> int:
    """Rounded down: 100 is all."""
    return int(100.0 * share + 1e-9)


def _sure(race: Race) -> list[str]:
    """How often the choice wins, and which solvers are as good."""
    if len(race.ranking) < 2:
        return []
    share = f"It wins in {_percent(race.shares[0])} % of resamplings"
    if race.loss > 1.0:
        share += f" and takes {times_of(race.loss)} the best's time in the others"
    others = [f"{name} ({_percent(s)} %)" for (_, c), s in zip(race.ranking, race.shares, strict=True)
              if (name := c.solver) in race.named[1:]]  # fmt: skip
    return [f"{share}; as good: {', '.join(others)}." if others else f"{share}."]


def _serves(asked: str, final: Final, choice: Choice, limit: float) -> str:
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


def _told(records: Records, final: Final, time: float, what: str) -> list[str]:
    """Lines to copy, with what they were timed at."""
    *before, last = final.code
    timed = f"{seconds(time)}, {what}"
    timed = timed if final.line.times else f"not timed as a line: {timed}"
    line, reason, in_c = final.line, _not_in_c(records, final), []
    spec = specs().get(line.solver)
    if spec is not None and spec.own and not spec.external and line.mode == "tol" and line.way != "batch":
        made = f"lavender export c liblavender --solver {line.solver} --for {quote(records.source or 'records.jsonl')}"
        in_c = [f"# not in C: {reason}" if reason else f"# in C: {made}"]
    if final.line.start == "carried":
        return [f"{before[0]}  # {timed}", *before[1:], last, *in_c]
    return [*before, f"{last}  # {timed}", *in_c]


def _by_advice(records: Records) -> Verdict:
    """By motion error: lines are not timed for it."""
    subject = subjects(records)[0]
    best, what, reached = subject.best, _what(records, subject), _until(subject.best.target)
    leaders = tuple(c.solver for c in best.ranking[:3] if c.solved)
    first = best.best
    if first is None:
        return Verdict((f"Nobody brings any of {what} {reached}.",), (), leaders)
    ties = (f"As good within noise: {', '.join(best.ties)}.",) if best.ties else ()
    tol = _tolerance(records, first.solver, best.target)
    asked = f"tol={level_name(tol)}" if math.isfinite(tol) else f"tol=0, max_iter={first.iterations}"
    code = f'lv.solve(problem, "{first.solver}", {asked})'
    return Verdict((_head(first, reached, what), *ties), (code,), leaders)


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
