"""Select and rank runs of a frame: the runs that count, cases by structure, times to a tolerance, and their ties."""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from lavender.judge.solution import CONTRADICTED

Frame: TypeAlias = pd.DataFrame
# [s] Added to times in geometric means. In shorter calls, the overhead of Python dominates.
MEAN_TIME_SHIFT = 1e-5
# Times within noise count as equal. Noise is twice the difference of median and minimum of the repetitions, relative to
# the minimum, and within these bounds.
MIN_NOISE, MAX_NOISE = 0.05, 0.25
PREFERRED_SOLVER = "auto"  # Listed first among equally good solvers, as its users need not choose a method.
STRUCTURE_ORDER = (
    *("separate", "chain", "mesh", "stack", "pile", "dense"),
    *("redundant", "friction", "large mass ratio", "asymmetric"),
)


def select_ranked_runs(frame: Frame) -> Frame:
    """Return the runs that rankings count: to a tolerance, if there are any, in the order "given"."""
    mode = "tol" if (frame["mode"] == "tol").any() else "budget"
    return select_starts(frame[frame["mode"] == mode])


def select_starts(frame: Frame) -> Frame:
    """Return the runs from the start that counts: cold, or carried over the steps of a sequence."""
    runs = frame[frame["order"] == "given"]
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
    for word, some in sorted(words.groupby("word"), key=lambda x: (order.get(x[0], len(order)), x[0])):
        laws = some["law"].value_counts().index
        for law in laws:
            members = tuple(some.loc[some["law"] == law, "case"])
            names.setdefault(members, []).append(word if len(laws) == 1 else f"{word}, {law}")
    groups = {" / ".join(words): list(members) for members, words in names.items()}
    steps = cases[cases["sequence"] != ""].groupby("sequence")["case"].agg(list)
    return {**groups, **{f"sequence {name}": members for name, members in steps.items()}}


def compute_mean(times: Any, axis: int = 0) -> Any:
    """Compute the geometric mean of times [s], shifted by `MEAN_TIME_SHIFT`; of a frame or series without nan."""
    return np.exp(np.log(np.add(times, MEAN_TIME_SHIFT)).mean(axis=axis)) - MEAN_TIME_SHIFT


def get_times(frame: Frame, tolerance: float) -> Frame:
    """Return the time [s] of each solver (row) on each case (column) to a tolerance: nan if it did not reach it."""
    return _get_times_of_runs(select_ranked_runs(frame), tolerance)


def _get_times_of_runs(runs: Frame, tolerance: float) -> Frame:
    """Compute `get_times` from ranked runs."""
    reached = runs[(runs["tol"] <= tolerance) & (runs["relative"] <= tolerance)].assign(
        time=lambda x: x["time"].fillna(0.0)
    )
    times = reached.groupby(["solver", "case"], observed=True)["time"].min().unstack()
    return times.reindex(index=sorted(map(str, runs["solver"].unique())), columns=list(runs["case"].unique()))


def rank_solvers(frame: Frame, tolerance: float) -> Frame:
    """Rank solvers by the number of cases that they bring to a tolerance, then by their mean time.

    Solvers with a contradicted claim come last. The first rows are within noise of the best (`tie`), `auto` first.

    Returns
    -------
    DataFrame
        By solver: `solved`, `cases`, `mean` [s] and `worst` [s] of the solved cases, `hardest` (case), `tie`.
    """
    runs = select_ranked_runs(frame)
    times = _get_times_of_runs(runs, tolerance)
    ratio = (runs["time_median"] / runs["time"] - 1.0).groupby(runs["solver"], observed=True).median()
    false = frame.loc[frame["claim_check"] == CONTRADICTED, "solver"].unique()
    ranking = pd.DataFrame({
        "solved": times.notna().sum(axis=1), "cases": times.shape[1], "worst": times.max(axis=1),
        "mean": compute_mean(times, axis=1),
        "hardest": times.fillna(-1.0).idxmax(axis=1) if len(times.columns) else "",
        "false": times.index.isin(false), "noise": (2.0 * ratio).reindex(times.index).clip(MIN_NOISE, MAX_NOISE),
    }, index=times.index)  # fmt: skip
    ranking = ranking.sort_values(["false", "solved", "mean"], ascending=[True, False, True], kind="stable")
    first = ranking.iloc[:1]
    equal = [ranking[name] == value for name in ("false", "solved") for value in first[name]]
    noise = ranking["noise"].fillna(MIN_NOISE)
    near = ranking["mean"] <= first["mean"].max() * (1.0 + np.maximum(noise, noise.iloc[:1].max()))
    tie = np.logical_and.reduce([*equal, near, ranking["solved"] > 0]) if len(ranking) else []
    preferred = ranking.index == PREFERRED_SOLVER
    ranking = ranking.assign(tie=tie, later=~(preferred & tie))
    return ranking.sort_values(["tie", "later"], ascending=[False, True], kind="stable").drop(columns="later")


def choose_time_budgets(times: Frame) -> tuple[float, ...]:
    """Return three decades of time [s] about the median over the cases of the fastest time."""
    fastest = times.min().dropna()
    fastest = fastest[fastest > 0.0]
    middle = math.ceil(math.log10(fastest.median())) if len(fastest) else -3
    return tuple(10.0**k for k in (middle - 1, middle, middle + 1))
