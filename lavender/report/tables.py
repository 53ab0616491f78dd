"""Rank the runs of a report and make its tables: group-bys of its frame of runs, with units in the names of columns.

The time of a solver to a tolerance on a case is the shortest time of its runs to this or a tighter tolerance with a
judged residual of at most the tolerance; of a case without a solution, of its checked proofs. Runs with a fixed budget
do not count, since a reader cannot choose the budget in advance. Single cases count from a cold start, steps of a
sequence with carried impulses if the solver takes a start.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from lavender import io
from lavender.base.arrays import check_choice
from lavender.base.deadline import format_seconds
from lavender.base.errors import LavenderError
from lavender.base.lazy_import import pandas as pd
from lavender.io.stored import SUFFIXES
from lavender.judge.residuals import DEFAULT_THRESHOLD, at_floor
from lavender.judge.solution import CONFIRMED, CONTRADICTED
from lavender.problem.derived import cached_property
from lavender.report import machine
from lavender.report.case_kinds import compute_energy_gain
from lavender.report.cases import read_engine_lines
from lavender.report.drawing import FILE_KINDS
from lavender.report.page import DEFAULT_ERROR_LIMIT, check_columns
from lavender.report.store import (
    Row,
    describe_target,
    select_cases,
    select_machines,
    select_runs,
    select_skips,
)
from lavender.report.text import escape_unprintable, format_count, format_tolerance
from lavender.solvers import registry

Frame: TypeAlias = pd.DataFrame
ENGINE_NAME = "your engine"  # Name of the engine's own solver among the solvers.
SERVED_RESIDUAL = 0.5  # A case is served if at most this fraction of the start's residual remains.
# A solver is recommended for a time or budget if it serves at least this share of the cases.
SERVED_QUANTILE = 0.9
RESIDUAL_NOISE_FACTOR = 2.0  # Residuals within this factor count as equal.
DEATHS = ("ERROR", "KILLED", "CRASHED")
PROOFS = ("INFEASIBLE", "UNBOUNDED")  # Statuses that a checked certificate makes an answer.
# An exponent is fitted to at least so many cases and ratio of rows.
MIN_FIT_CASES, MIN_FIT_SIZE_RATIO = 4, 4.0
# [s] Added to times in geometric means. In shorter calls, the overhead of Python dominates.
MEAN_TIME_SHIFT = 1e-5
# Times within noise count as equal. Noise is twice the difference of median and minimum of the repetitions, relative to
# the minimum, and within these bounds.
MIN_NOISE, MAX_NOISE = 0.05, 0.25
# Entries of an engine's answer: texts, and numbers, which are nan if they are missing.
ANSWER_TEXTS = ("file", "verdict", "solver", "worst")
ANSWER_NUMBERS = ("rows", "relative", "seconds", "velocity", "iterations", "energy_gain")
LEFT_OUT = "left out"  # The verdict on a step that could not be recorded.
ENGINE_SWEEPS = (
    "sequential_impulses",
    "pgs",
)  # Methods of most engines, listed before other plain sweeps.
MAX_TIES = 3  # A cell names up to this many solvers.
PREFERRED_SOLVER = (
    "auto"  # Listed first among equally good solvers, as its users need not choose a method.
)
STRUCTURE_ORDER = (
    "separate",
    "chain",
    "mesh",
    "stack",
    "pile",
    "dense",
    "redundant",
    "friction",
    "large mass ratio",
    "asymmetric",
)


# -- ranking -----------------------------------------------------------------------------------------------


def is_proof(runs: Frame) -> pd.Series[bool]:
    """Return whether each run has proven, and the judge has checked, that its case has no solution or no optimum."""
    return runs["status"].isin(PROOFS) & (runs["claim_check"] == CONFIRMED)


def select_starts(runs: Frame) -> Frame:
    """Return the runs from the start that counts: cold, or carried over the steps of a sequence."""
    single = runs["step"] < 0
    carries = runs["solver"].isin(runs.loc[runs["start"] == "carried", "solver"].unique())
    start = runs["start"].astype(str)
    return runs[np.where(single | ~carries, start == "cold", start == "carried")]


def group_cases_by_structure(frame: Frame) -> dict[str, list[str]]:
    """Group single cases by structure, and steps by their sequence. A case is in the group of each of its words.

    If the cases of a word have several laws, each law is a group: "pile, coulomb". Words of the same cases form one
    group: "stack / friction".
    """
    cases = frame.drop_duplicates("case")[["case", "structure", "law", "sequence"]].astype(str)
    single = cases[cases["sequence"] == ""]
    words = single.assign(word=single["structure"].str.split(", ")).explode("word")
    names: dict[tuple[str, ...], list[str]] = {}
    order = {word: i for i, word in enumerate(STRUCTURE_ORDER)}
    for word, some in sorted(
        words.groupby("word"), key=lambda x: (order.get(x[0], len(order)), x[0])
    ):
        laws = some["law"].value_counts().index
        for law in laws:
            members = tuple(some.loc[some["law"] == law, "case"])
            names.setdefault(members, []).append(word if len(laws) == 1 else f"{word}, {law}")
    groups = {" / ".join(words): list(members) for members, words in names.items()}
    steps = cases[cases["sequence"] != ""].groupby("sequence")["case"].agg(list)
    return {**groups, **{f"sequence {name}": members for name, members in steps.items()}}


def compute_mean(times: Any, axis: int = 0) -> Any:
    """Compute the geometric mean, shifted by `MEAN_TIME_SHIFT`, of the times [s] of a frame or series without nan."""
    return np.exp(np.log(np.add(times, MEAN_TIME_SHIFT)).mean(axis=axis)) - MEAN_TIME_SHIFT


def compute_ratios(times: Frame, best: str = "") -> list[float]:
    """Return the mean time of each row divided by that of the row `best`, over the cases that both have, or nan."""
    if best not in times.index:
        return [math.nan] * len(times)
    shared = times.notna() & times.loc[best].notna()
    return [
        compute_mean(own[both]) / compute_mean(times.loc[best][both]) if both.any() else math.nan
        for (_, own), (_, both) in zip(times.iterrows(), shared.iterrows(), strict=True)
    ]


def rank_solvers(report: Contents, tolerance: float, cases: Iterable[str] | None = None) -> Frame:
    """Rank solvers by the number of cases that they bring to a tolerance, then by their mean time.

    A case without a solution is solved by a proof of this that the judge has checked (`select_answers`). The mean is
    over the solved cases, so that it is comparable only between solvers that solve as many cases. Solvers with a
    contradicted claim come last. The first rows are within noise of the best (`tie`), `auto` first.

    Parameters
    ----------
    report : Contents
    tolerance : float
    cases : names, optional
        Cases that are ranked; default: all that a ranking counts.

    Returns
    -------
    DataFrame
        By solver: `solved`, `proven` (solved cases that have no solution), `tried` (accepted cases), `cases`, `mean`
        [s] and `worst` [s] of the solved cases, `ratio` [-] of the mean to that of the first solver (not the engine's
        own) on the cases that both solve, `hardest` (case), `false` (number of false claims), `noise`, `tie` and
        `place`.
    """
    times = report.get_times(tolerance)
    names = list(times.columns) if cases is None else [case for case in cases if case in times]
    accepted = report.accepted[names]
    times = times.loc[accepted.any(axis=1), names]
    false = report.frame[
        report.frame["case"].isin(names) & (report.frame["claim_check"] == CONTRADICTED)
    ]
    ranking = pd.DataFrame(
        {
            "solved": times.notna().sum(axis=1),
            "proven": times[times.columns.intersection(report.list_proven(tolerance))]
            .notna()
            .sum(axis=1),
            "tried": accepted.loc[times.index].sum(axis=1),
            "cases": len(names),
            "mean": compute_mean(times, axis=1),
            "worst": times.max(axis=1),
            "hardest": times.fillna(-1.0).idxmax(axis=1) if len(names) else "",
            "false": false["solver"]
            .astype(str)
            .value_counts()
            .reindex(times.index)
            .fillna(0)
            .astype(int),
            "noise": report.noise.reindex(times.index),
        }
    )
    ranking = ranking.assign(liar=ranking["false"] > 0)
    ranking = ranking.sort_values(
        ["liar", "solved", "mean"], ascending=[True, False, True], kind="stable"
    )
    # Results tie with the first if they solve as many cases, in mean times that differ within noise.
    first = ranking.head(1).squeeze()
    noise = 1.0 + np.maximum(ranking["noise"], first["noise"])
    is_near = ranking["mean"].between(first["mean"] / noise, first["mean"] * noise)
    is_equal = (ranking["solved"] == first["solved"]) & (ranking["liar"] <= first["liar"])
    tie = (is_near & is_equal & (ranking["solved"] > 0)).to_numpy()
    ranking = ranking.assign(tie=tie, place=np.where(tie, 1, np.arange(1, len(tie) + 1))).drop(
        columns="liar"
    )
    is_first = ranking["tie"] & (ranking.index == PREFERRED_SOLVER)
    order = np.argsort(np.where(is_first, 0, np.where(tie, 1, 2)), kind="stable")
    ranking = ranking.iloc[order]
    best = ranking.index[(ranking["solved"] > 0) & (ranking.index != ENGINE_NAME)]
    return ranking.assign(ratio=compute_ratios(times.loc[ranking.index], *best[:1]))


def is_plug_in(solver: str) -> bool:
    """Return whether a solver is not part of lavender: a plug-in of the user, installed here or not."""
    spec = registry.specs().get(solver)
    return solver != ENGINE_NAME and (spec is None or not spec.builtin)


def format_size(case: Any) -> str:
    """Return the size of a case from its facts: "40 rows", of a program also the number of its variables."""
    rows = format_count(int(case["rows"]), "row")
    return (
        f"{format_count(int(case['variables']), 'variable')}, {rows}" if case["variables"] else rows
    )


# -- answers of engines ------------------------------------------------------------------------------------


def read_engine_answers(sources: Sequence[str], lines: Frame) -> Frame:
    """Read the engine's answers in the folders among `sources`, and in the folders of the cases of `lines`.

    The impulse in the file of a step is judged; without one, the residual in its line of `engine.jsonl` counts. A
    folder without such lines has the answers that are stored with the steps of sequences.

    Returns
    -------
    DataFrame
        A row for each answer, by the path of its file: folder, file, rows, seconds [s], relative, velocity [m/s],
        iterations, energy_gain [J], worst, verdict and solver; numbers that were not recorded are nan. Steps that could
        not be recorded have the verdict "left out".
    """
    cases = select_cases(lines)
    files = cases[cases["source"].astype(str).str.endswith(SUFFIXES)]
    stored = files[files["stored"].notna() & (files["sequence"] != "")]
    answers = []
    for folder in dict.fromkeys(
        [*map(Path, sources), *(Path(str(s)).parent for s in files["source"])]
    ):
        own = [Path(s).name for s in stored["source"].astype(str) if Path(s).parent == folder]
        entries = read_engine_lines(folder) or [{"file": name, "solver": "engine"} for name in own]
        answers += [
            row for entry in entries if (row := _complete_answer(folder, entry)) is not None
        ]
    return _make_answers(answers)


def _make_answers(rows: Sequence[Row] = ()) -> Frame:
    """Return the DataFrame of an engine's answers."""
    table = pd.DataFrame(rows, columns=["folder", *ANSWER_TEXTS, *ANSWER_NUMBERS])
    return table.set_index(table["folder"] + "/" + table["file"])


def _complete_answer(folder: Path, answer: Row) -> Row | None:
    """Return an answer with the judge's numbers on its impulse; None without a residual or a readable impulse."""
    from lavender.io.recorder import describe_answer

    path = folder / Path(str(answer.get("file"))).name
    is_left_out = "left_out" in answer
    if is_left_out:
        file = answer.get("file", answer["left_out"])
        answer = dict.fromkeys(ANSWER_NUMBERS) | {"file": file, "verdict": LEFT_OUT}
    with contextlib.suppress(ValueError, KeyError, TypeError, LavenderError, OSError):
        impulse = None if is_left_out or not path.is_file() else io.load_solution(path)
        # Files of earlier versions do not hold the acceleration of a step with forces without digits.
        if impulse is not None and not answer.get("lost_digits"):
            threshold = float(answer.get("threshold", DEFAULT_THRESHOLD))
            problem = io.load(path)
            gain = compute_energy_gain(problem, impulse, problem.slack(impulse))
            answer = answer | describe_answer(problem, impulse, threshold) | {"energy_gain": gain}
    try:
        numbers = {
            x: math.nan if answer.get(x) is None else float(answer[x]) for x in ANSWER_NUMBERS
        }
    except (ValueError, TypeError):
        return None
    texts = {"folder": str(folder), **{name: str(answer.get(name, "")) for name in ANSWER_TEXTS}}
    is_judged = {"relative", "rows"} <= answer.keys()
    return (
        {name: escape_unprintable(text) for name, text in texts.items()} | numbers
        if is_judged
        else None
    )


def read_own_answers(report: Contents) -> Frame:
    """Return the engine's answers to the cases of a report, with `case` and `step` of each."""
    sources = {str(Path(s)): case for case, s in report.cases["source"].astype(str).items()}
    answers = report.engines[
        report.engines.index.isin(list(sources)) & report.engines["velocity"].notna()
    ]
    cases = answers.index.map(sources)
    return answers.assign(case=cases, step=report.cases.loc[cases, "step"].to_numpy())


# -- contents ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Contents:
    """Lines of a records file, earlier lines, and requested budgets, with the frames of the runs that count."""

    # The result of `lavender.report.run` or `read`. Times are compared within the newest run alone.
    lines: Frame
    earlier: Frame | None = None  # Lines of an earlier run to compare with.
    # [s] Time budgets for which a solver is recommended; default: three decades about the fastest times.
    times: Sequence[float] = ()
    # Answers of the engines that recorded the steps (`read_engine_answers`).
    engines: Frame = field(default_factory=_make_answers)
    # [m/s, rad/s on angular rows] Velocity error with which sentences and figures compare.
    error_limit: float = DEFAULT_ERROR_LIMIT
    figure_kinds: Sequence[str] = FILE_KINDS  # Formats of the files of figures.
    # Columns of the table for a paper: solved, tolerances such as 1e-6, ratio, slowest, accepted, false; default:
    # solved and all tolerances.
    columns: Sequence[str] = ()
    _times: dict[float, Frame] = field(default_factory=dict, init=False)  # Results of `get_times`.

    def __post_init__(self) -> None:
        for kind in self.figure_kinds:
            check_choice("figure_kinds", kind, FILE_KINDS)
        check_columns(self.columns)

    @cached_property
    def runs(self) -> Frame:
        """All runs of all machines (`select_runs`)."""
        return select_runs(self.lines)

    @cached_property
    def cases(self) -> Frame:
        """The descriptions of the cases by name."""
        return select_cases(self.lines)

    @cached_property
    def skips(self) -> Frame:
        """Pairs that did not run, and cases that did not load."""
        return select_skips(self.lines)

    @cached_property
    def left_out(self) -> dict[str, Frame]:
        """Cases that did not load, by sequence ("" for single cases). No number of a report counts them."""
        skips = self.skips[self.skips["solver"] == ""]
        return {str(name): some for name, some in skips.groupby("sequence", sort=False)}

    @cached_property
    def machine(self) -> Row:
        """The machine, versions and plan of the newest run; empty without runs."""
        return ([{}, *select_machines(self.lines).values()])[-1]

    @cached_property
    def is_stopped(self) -> bool:
        """Whether the newest run ended before everything was measured."""
        return not self.machine.get("whole", True)

    @cached_property
    def is_campaign(self) -> bool:
        """Whether the newest run has no times."""
        return bool(self.machine.get("plan", {}).get("campaign"))

    @cached_property
    def newest(self) -> pd.DataFrame:
        """The newest run; if it was stopped, the cases on which every solver was measured."""
        # Times are compared only within one run, and a file that has changed is another problem.
        sha = self.runs["case"].astype(object).map(self.cases["sha"].astype(str).to_dict())
        is_newest = self.runs["run"] == self.machine.get("run", "")
        frame = self.runs[is_newest & (self.runs["sha"].astype(str) == sha)]
        if not (self.is_stopped and len(frame)):
            return frame
        last = frame.iloc[-1]
        solvers = set(self.machine["plan"].get("solvers", ()))
        is_running = (frame["sequence"] == (last["sequence"] or None)) & (
            frame["solver"] == last["solver"]
        )
        skips = self.skips[self.skips["run"] == self.machine["run"]]
        sequences = self.cases["sequence"]
        done = {
            case: set(some)
            for case, some in frame[~is_running].groupby("case", observed=True)["solver"]
        }
        for name, solver in zip(skips["case"], skips["solver"], strict=True):
            for case in [name] if name in self.cases.index else self.cases.index[sequences == name]:
                done.setdefault(str(case), set()).add(solver)
        complete = [case for case, some in done.items() if some >= solvers]
        return frame[~is_running & frame["case"].isin(complete)]

    @cached_property
    def frame(self) -> pd.DataFrame:
        """The newest run without cases that the zero impulse solves: no ranking counts them."""
        return self.newest[~self.newest["nothing_to_do"].astype(bool)]

    @cached_property
    def subject(self) -> list[str]:
        """The cases of the first sentence: single problems, or if there are none the steps of sequences."""
        cases = self.frame.drop_duplicates("case")
        single = cases[cases["step"] < 0]
        return list(map(str, (single if len(single) else cases)["case"]))

    @cached_property
    def ranked_runs(self) -> Frame:
        """The runs of `frame` that rankings count, and the engine's own answers if it gave all of them in a time."""
        mode = "tol" if (self.frame["mode"] == "tol").any() else "budget"
        runs = select_starts(self.frame[self.frame["mode"] == mode])
        cases = runs.drop_duplicates("case")
        answers = self.engines.reindex(
            [str(Path(s)) for s in self.cases.loc[cases["case"], "source"]]
        )
        if self.is_campaign or not len(cases) or not (answers["seconds"] >= 0.0).all():
            return runs
        own = cases.assign(
            solver=ENGINE_NAME,
            tol=0.0,
            claims=False,
            claim_check=CONFIRMED,
            status_conflict="",
            form="",
            status=answers["verdict"].to_numpy(),
            message="",
            start=np.where(cases["step"] < 0, "cold", "carried"),
            time=answers["seconds"].to_numpy(),
            time_median=answers["seconds"].to_numpy(),
            iterations=answers["iterations"].fillna(0).astype(int).to_numpy(),
            relative=answers["relative"].to_numpy(),
            velocity=answers["velocity"].to_numpy(),
            worst_name=answers["worst"].to_numpy(),
        )
        categories = [name for name in runs if runs[name].dtype == "category"]
        return pd.concat([runs.astype(dict.fromkeys(categories, object)), own])

    @cached_property
    def has_runs(self) -> Frame:
        """Whether each solver (row) has a run on each case (column), of the runs that rankings compare."""
        runs = self.ranked_runs[["solver", "case"]].astype(str)
        return pd.crosstab(runs["solver"], runs["case"]) > 0

    @cached_property
    def accepted(self) -> Frame:
        """Whether each solver (row) accepts each case (column): it has a run on it, or on a step of its sequence."""
        sequences = self.cases.loc[self.has_runs.columns, "sequence"].astype(str).to_numpy()
        accepted = self.has_runs.copy()
        for name in set(sequences) - {""}:
            some = sequences == name
            accepted.loc[:, some] = accepted.loc[:, some].any(axis=1).to_numpy()[:, None]
        return accepted

    @cached_property
    def time_limit(self) -> float:
        """Time limit of a solve [s], which a case that is not solved counts in means."""
        limit = self.frame["time_limit"].max()
        return float(limit) if 0.0 < limit < math.inf else 1.0

    @cached_property
    def noise(self) -> pd.Series[float]:
        """Noise of each solver's times, relative to its times: twice the spread of its repetitions, within bounds."""
        runs = self.ranked_runs
        ratio = (
            (runs["time_median"] / runs["time"] - 1.0).groupby(runs["solver"].astype(str)).median()
        )
        return (2.0 * ratio).clip(MIN_NOISE, MAX_NOISE).fillna(MIN_NOISE)

    @cached_property
    def _proven(self) -> dict[str, float]:
        """Smallest residual of all runs on each case of which a run has proven that it has no solution."""
        cases = self.frame["case"][is_proof(self.frame)].astype(str).unique()
        runs = self.frame[self.frame["case"].isin(cases)]
        smallest = runs.groupby(runs["case"].astype(str))["relative"].min()
        return {case: float(smallest[case]) for case in cases}

    def list_proven(self, tolerance: float) -> list[str]:
        """Return the cases that have a checked proof that no answer exists, and no answer to the tolerance.

        A proof for 1e-9 does not exclude an answer to 1e-3. A proof for a looser tolerance holds for a tighter one.
        """
        return [case for case, smallest in self._proven.items() if not smallest <= tolerance]

    def select_answers(self, runs: Frame, tolerance: float) -> Frame:
        """Return the runs that solve their case to a tolerance.

        They have this or a tighter tolerance and a judged residual within it, or a proof that the case has no solution
        (`list_proven`).
        """
        reached = (runs["tol"] <= tolerance) & (runs["relative"] <= tolerance)
        return runs[reached | (is_proof(runs) & runs["case"].isin(self.list_proven(tolerance)))]

    def get_times(self, tolerance: float) -> Frame:
        """Return the time [s] of each solver (row) on each case (column) to a tolerance: nan if it did not solve it."""
        if tolerance not in self._times:
            runs = self.ranked_runs
            reached = self.select_answers(runs, tolerance).fillna({"time": 0.0})
            times = reached.groupby(["solver", "case"], observed=True)["time"].min().unstack()
            solvers = sorted(map(str, runs["solver"].unique()))
            cases = list(runs["case"].unique())
            self._times[tolerance] = times.reindex(index=solvers, columns=cases)
        return self._times[tolerance]

    @cached_property
    def tolerances(self) -> tuple[float, ...]:
        """Residual tolerances, largest first."""
        for run in reversed(select_machines(self.lines).values()):
            if run["plan"].get("tolerances"):
                return tuple(sorted(map(float, run["plan"]["tolerances"]), reverse=True))
        to_tolerance = self.runs.loc[self.runs["mode"] == "tol", "tol"]
        return tuple(sorted(set(to_tolerance), reverse=True)) or (1e-3, 1e-6, 1e-9)

    @property
    def tolerance(self) -> float:
        """The middle tolerance, to which a solver is recommended."""
        return self.tolerances[len(self.tolerances) // 2]

    @cached_property
    def time_budgets(self) -> tuple[float, ...]:
        """Time budgets [s] for which a solver is recommended; default: three decades about the fastest times."""
        fastest = self.get_times(self.tolerance).min()
        fastest = fastest[fastest > 0.0]
        middle = math.ceil(math.log10(fastest.median())) if len(fastest) else -3
        return tuple(self.times) or tuple(10.0**k for k in (middle - 1, middle, middle + 1))

    @cached_property
    def structures(self) -> dict[str, list[str]]:
        """Cases by structure, and steps by sequence."""
        return group_cases_by_structure(self.frame)

    @cached_property
    def busy(self) -> str:
        """A sentence if other processes used the processors during the measurement; else empty."""
        loads = [None if x != x else float(x) for x in self.frame["load"]]
        return (
            machine.make_busy_warning(loads, int(self.frame["cores"].iloc[0])) if len(loads) else ""
        )


# -- tables ------------------------------------------------------------------------------------------------


def tabulate_solvers(report: Contents) -> Frame:
    """Tabulate the solvers in their ranking: solved and accepted cases, and the mean time of the solved ones."""
    ranking = rank_solvers(report, report.tolerance, report.subject)
    table = pd.DataFrame(
        {
            "solver": ranking.index.astype(str),
            "solved": ranking["solved"].array,
            "accepted": ranking["tried"].array,
            "cases": ranking["cases"].array,
        }
    )
    if not report.is_campaign:
        for tolerance in report.tolerances:
            other = rank_solvers(report, tolerance, report.subject).reindex(ranking.index)
            target = f"to {format_tolerance(tolerance)}"
            if tolerance != report.tolerance:
                table[f"solved {target}"] = other["solved"].fillna(0).astype(int).array
            table[f"{target} [s]"] = other["mean"].array
        table["× best"] = [float(f"{x:.3g}") for x in ranking["ratio"]]
        table["slowest [s]"] = ranking["worst"].array
        table["tie"] = ranking["tie"].array
    return table.assign(**{"false claims": ranking["false"].array})


def order_solvers(report: Contents) -> list[str]:
    """Return the solvers in their ranking on the subject of a report, then those with runs on other cases alone."""
    names = list(map(str, rank_solvers(report, report.tolerance, report.subject).index))
    return names + [name for name in report.get_times(report.tolerance).index if name not in names]


def tabulate_matrix(report: Contents) -> Frame:
    """Tabulate the time [s] of each solver (columns, in their ranking) on each case to the middle tolerance."""
    times = report.get_times(report.tolerance)
    facts = report.cases.loc[times.columns, ["case", "law", "rows", "variables", "structure"]]
    facts = facts.reset_index(drop=True)
    facts = facts if facts["variables"].any() else facts.drop(columns="variables")
    return facts.join(times.loc[order_solvers(report)].T.add_suffix(" [s]").reset_index(drop=True))


def tabulate_runs(report: Contents) -> Frame:
    """Tabulate each solver on each case: time to each tolerance, smallest errors, status, and reasons of failures."""
    frame = report.newest
    runs = frame[(frame["step"] < 0) | ~frame["solver"].isin([ENGINE_NAME])]
    keys = ["case", "solver", "start"]
    # pandas 3.1 cannot align two indices of categories with codes of different sizes (above 127 cases).
    runs = runs.astype(dict.fromkeys((*keys, "claim_check", "status_conflict", "message"), str))
    to_tolerance = runs[runs["mode"] == "tol"] if (runs["mode"] == "tol").any() else runs
    table = runs.groupby(keys, sort=False)[["relative", "velocity", "roundoff_floor"]].min()
    table.columns = ["smallest residual [-]", "velocity error [m/s]", "floor [-]"]
    for tolerance in () if report.is_campaign else report.tolerances:
        target = f"to {format_tolerance(tolerance)}"
        reached = report.select_answers(to_tolerance, tolerance).sort_values("time")
        first = reached.drop_duplicates(keys).set_index(keys).reindex(table.index)
        table.insert(table.shape[1] - 3, f"{target} [s]", first["time"])
        table.insert(table.shape[1] - 3, f"{target}, median [s]", first["time_median"])
    table = table.join(
        to_tolerance.groupby(keys)[["status", "form", "iterations", "worst_name"]].last()
    )
    missed = select_failures(report).astype(
        dict.fromkeys((*keys, "status_conflict", "message"), str)
    )
    conflict = missed["status_conflict"]
    missed = missed.assign(
        reason=np.where(conflict != "", "✗ " + conflict + ". ", "") + missed["message"]
    )
    reasons = missed[missed["reason"] != ""].groupby(keys)["reason"].last()
    table["reason of a failure"] = reasons.reindex(table.index).fillna("")
    table = table.reset_index().rename(columns={"worst_name": "worst row"})
    warm = table["start"] != "cold"
    table["solver"] += np.where(warm, " (" + table["start"] + ")", "")
    return table.drop(columns="start")


def select_failures(report: Contents) -> Frame:
    """Return runs that missed their tolerance above the round-off floor, that died, and false claims."""
    f = report.frame
    floor = [at_floor(x, y) for x, y in zip(f["relative"], f["roundoff_floor"], strict=True)]
    missed = (f["mode"] == "tol") & ~f["success"] & ~np.array(floor, bool) & ~is_proof(f)
    died = ~np.isfinite(f["relative"]) | f["status"].astype(str).str.startswith(DEATHS)
    return f[missed | died | (f["claim_check"] == CONTRADICTED)]


def tabulate_structures(report: Contents) -> Frame:
    """Tabulate by structure and sequence the fastest solver to each tolerance with its ties, and the best in a time.

    A solver is named for a time if it serves at least `SERVED_QUANTILE` of the cases, with the smallest residual at
    this quantile; solvers within `RESIDUAL_NOISE_FACTOR` of it tie.
    """
    rows = []
    runs = select_starts(report.frame)
    runs = runs.assign(relative=runs["relative"].where(~is_proof(runs), 0.0))
    for name, cases in report.structures.items():
        row: Row = {"structure": name, "cases": len(cases)}
        sizes = report.cases.loc[cases, "rows"]
        row["rows"] = f"{sizes.min()}" + (f" to {sizes.max()}" if sizes.max() > sizes.min() else "")
        for tolerance in report.tolerances:
            ranking = rank_solvers(report, tolerance, cases)
            target = f"to {format_tolerance(tolerance)}"
            ties = list(map(str, ranking.index[ranking["tie"]]))[:MAX_TIES]
            first = ranking.head(1)
            row[target] = " ≈ ".join(ties) or "none"
            if ties and (solved := first["solved"].iloc[0]) < len(cases):
                row[target] = row[target].replace(ties[0], f"{ties[0]} ({solved}/{len(cases)})", 1)
            row[f"time {target} [s]"] = first["mean"].iloc[0] if ties else math.nan
        for t in report.time_budgets:
            done = runs[(runs["time"] <= t) & runs["case"].isin(cases)]
            left = done.groupby(["solver", "case"], observed=True)["relative"].min().unstack()
            left = left.reindex(columns=cases).fillna(1.0)
            left = left[(left <= SERVED_RESIDUAL).mean(axis=1) >= SERVED_QUANTILE]
            # Between two infinite residuals, the interpolated quantile is nan.
            score = (
                left.quantile(SERVED_QUANTILE, axis=1).fillna(math.inf).sort_values(kind="stable")
            )
            near = map(str, score.index[score <= RESIDUAL_NOISE_FACTOR * score.min()])
            names = sorted(near, key=lambda name: name != PREFERRED_SOLVER)
            row[f"in {format_seconds(t)}"] = " ≈ ".join(names[:MAX_TIES]) or "none"
        rows.append(row)
    return pd.DataFrame(rows)


def tabulate_costs(report: Contents) -> Frame:
    """Tabulate how the time to the middle tolerance grows with the number of rows: time = a rows^exponent.

    The exponent is fitted to the logarithms of the cases that a solver solves; the scatter is the typical factor
    between a case and the fit.
    """
    times = report.get_times(report.tolerance)
    rows_of = report.cases["rows"].to_dict()
    rows = []
    for solver, own in times.iterrows():
        t = own[own > 0.0]
        n = np.array([rows_of[c] for c in t.index], float)
        if len(t) < MIN_FIT_CASES or n.min() <= 0.0 or n.max() < MIN_FIT_SIZE_RATIO * n.min():
            continue
        x = np.log(n)
        y = np.log(t.to_numpy(float))
        exponent, constant = np.polyfit(x, y, 1)
        rows.append(
            {
                "solver": solver,
                "cases": len(t),
                "rows": f"{n.min():.0f} to {n.max():.0f}",
                "exponent of rows": round(float(exponent), 2),
                "fit at 1000 rows [s]": math.exp(constant + exponent * math.log(1000.0)),
                "scatter [factor]": round(float(np.exp(np.std(y - exponent * x - constant))), 2),
            }
        )
    return pd.DataFrame(rows).sort_values("fit at 1000 rows [s]") if rows else pd.DataFrame()


def tabulate_sequences(report: Contents) -> Frame:
    """Tabulate the time and iterations of all steps of each sequence, cold and with carried (warm) impulses.

    The time to map impulses to the next step is a column of its own, as an engine stores impulses in its contacts.
    """
    frame = report.frame
    runs = frame[frame["step"] >= 0].astype({"start": str})
    keys = ["sequence", "solver", "mode", "tol", "max_iter"]
    groups = runs.groupby([*keys, "start"], observed=True)
    table = groups.agg(
        steps=("case", "size"),
        time=("time", "sum"),
        carry=("carry_time", "sum"),
        iterations=("iterations", "sum"),
        residual=("relative", "median"),
    ).unstack("start")
    out = table.index.to_frame(index=False)[["sequence", "solver"]].astype(str)
    out["target"] = [describe_target(*x[2:]) for x in table.index]
    for start in ("cold", "carried"):
        for name, unit in (
            ("steps", ""),
            ("time", " [s]"),
            ("iterations", ""),
            ("residual", " [-]"),
        ):
            if (name, start) in table:
                out[f"{name}, {start}{unit}"] = table[name, start].to_numpy()
    if "time, carried [s]" in out and "time, cold [s]" in out:
        out["carrying [s]"] = table["carry", "carried"].to_numpy()
        out["cold / carried"] = (out["time, cold [s]"] / out["time, carried [s]"]).round(2)
    return out


def list_plain_sweeps() -> list[str]:
    """Return the names of the solvers that sweep without acceleration, the methods of most engines first."""
    own = [name for name, spec in registry.specs().items() if spec.plain_sweeps]
    return [*ENGINE_SWEEPS, *(name for name in own if name not in ENGINE_SWEEPS)]


def tabulate_sweeps(report: Contents) -> Frame:
    """Tabulate the largest errors over the steps of each sequence after fixed numbers of sweeps, cold and carried.

    The solvers are those with a sweep order. The velocity error is the judge's, of the worst row. The motion error is
    the largest difference of a body's velocity from that of a solution, over about 20 steps of a sequence. The first
    step, which has no step before it, does not count. `steps` is the number of steps with all of these runs.
    """
    plain = list_plain_sweeps()
    order = [
        *plain,
        *sorted(name for name, x in registry.specs().items() if x.order and name not in plain),
    ]
    runs = report.frame[(report.frame["mode"] == "budget") & (report.frame["step"] > 0)]
    runs = runs[runs["solver"].isin(order)]
    if not len(runs):
        return pd.DataFrame()
    keys = ["sequence", "solver", "max_iter", "start"]
    groups = runs.astype(dict.fromkeys(("sequence", "solver", "start"), str)).groupby(
        keys, sort=False
    )
    heads = {
        "relative": "residual, {} [-]",
        "velocity": "velocity error, {} [m/s]",
        "motion_error": "motion error, {} [m/s]",
    }
    table = groups[list(heads)].max().unstack("start")
    steps = groups.size().unstack("start").min(axis=1)
    out = table.index.to_frame(index=False).rename(columns={"max_iter": "sweeps"})
    for name, head in heads.items():
        for start in ("cold", "carried"):
            if (name, start) in table:
                out[head.format(start)] = table[name, start].to_numpy()
    out["steps"] = steps.to_numpy()
    return out.sort_values("solver", key=lambda solvers: solvers.map(order.index), kind="stable")


def tabulate_changes(report: Contents) -> Frame:
    """Tabulate times to a tolerance that differ from an earlier run beyond noise, on cases with the same numbers.

    Earlier times are multiplied by the change of the time of the loop of fixed work on the same case. The number of
    compared times is `attrs["compared"]`.
    """
    rows = []
    keys = ["case", "sha", "solver", "start", "tol"]
    assert report.earlier is not None
    frames = Contents(report.earlier).newest, report.frame[report.frame["step"] < 0]
    some = [f[f["mode"] == "tol"].astype(dict.fromkeys(keys[:4], str)) for f in frames]
    some = [f.assign(solved=(f["relative"] <= f["tol"]) | is_proof(f)) for f in some]
    both = pd.merge(*some, on=keys)
    drift = both.groupby("case")[["calibration_time_x", "calibration_time_y"]].median()
    drift = (drift["calibration_time_y"] / drift["calibration_time_x"]).fillna(1.0)
    for r in both.itertuples():
        before = r.time_x * drift[r.case] if r.solved_x else math.inf
        after = r.time_y if r.solved_y else math.inf
        spread = 2.0 * (max(r.time_median_x / r.time_x, r.time_median_y / r.time_y) - 1.0)
        noise = 1.0 + max(MAX_NOISE, spread if math.isfinite(spread) else 0.0)
        if before != after and not before / noise <= after <= before * noise:
            kinds = ("lost", "reached") if math.inf in (before, after) else ("slower", "faster")
            rows.append(
                {
                    "case": r.case,
                    "solver": r.solver,
                    "target": f"to {format_tolerance(r.tol)}",
                    "before [s]": before,
                    "now [s]": after,
                    "change": kinds[int(after < before)],
                }
            )
    changes = pd.DataFrame(rows)
    if not rows:
        changes["change"] = ["nothing beyond noise" if len(both) else "nothing was compared"]
    changes.attrs["compared"] = len(both)
    return changes
