"""Make the tables of a report: group-bys of its frame of runs, with units in the names of columns.

The time of a solver to a tolerance on a case is the shortest time of its runs to this or a tighter tolerance with a
judged residual of at most the tolerance. Runs with a fixed budget do not count, since a reader cannot choose the budget
in advance. Single cases count from a cold start, steps of a sequence with carried impulses if the solver takes a start.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import pandas as pd

from lavender.base.deadline import format_seconds
from lavender.judge.residuals import at_floor
from lavender.judge.solution import CONFIRMED, CONTRADICTED, NOT_PROVEN
from lavender.report.ranking import MAX_NOISE, PREFERRED_SOLVER, get_times, rank_solvers, select_starts
from lavender.report.records import Skip, describe_target, format_tolerance
from lavender.report.text import format_count, format_residual

if TYPE_CHECKING:
    from lavender.report.contents import Contents

Frame: TypeAlias = pd.DataFrame
SERVED_RESIDUAL = 0.5  # A case is served if at most this fraction of the start's residual remains.
# A solver is recommended for a time or budget if it serves at least this share of the cases.
SERVED_QUANTILE = 0.9
RESIDUAL_NOISE_FACTOR = 2.0  # Residuals within this factor count as equal.
DEATHS = ("ERROR", "KILLED", "CRASHED")
# An exponent is fitted to at least so many cases and ratio of rows.
MIN_FIT_CASES, MIN_FIT_SIZE_RATIO = 4, 4.0


def count_solved(solved: int, cases: int) -> str:
    """Return the number of solved cases of all cases as " (7/8)"; empty if all are solved."""
    return "" if solved == cases else f" ({solved}/{cases})"


def compute_quantiles(groups: Any, q: float | list[float]) -> Any:
    """Compute quantiles of groups of residuals, interpolated linearly; inf if they lie between infinite residuals."""
    return groups.quantile(q).fillna(math.inf)


# -- tables ------------------------------------------------------------------------------------------------


def tabulate_fastest(report: Contents) -> Frame:
    """Tabulate the fastest solver to each tolerance by structure and sequence, with the solvers that tie with it."""
    rows = []
    for name, cases in report.structures.items():
        some = report.frame[report.frame["case"].isin(cases)]
        row: dict[str, Any] = {"structure": name, "cases": len(cases)}
        for tolerance in report.tolerances:
            ranking = rank_solvers(some, tolerance)
            best = ranking.iloc[0] if len(ranking) else None
            target = f"to {format_tolerance(tolerance)}"
            row[target], row[f"time {target} [s]"] = "none", math.nan
            if best is not None and best["solved"]:
                ties = [str(s) for s in ranking.index[ranking["tie"]]][1:3]
                solved = count_solved(int(best["solved"]), len(cases))
                row[target] = " ≈ ".join([f"{ranking.index[0]}{solved}", *ties])
                row[f"time {target} [s]"] = best["mean"]
        rows.append(row)
    return pd.DataFrame(rows)


def tabulate_times(report: Contents) -> Frame:
    """Tabulate the mean time of each solver to each tolerance by law, and the number of cases that reach it."""
    tables = []
    for law, some in report.frame.groupby("law", observed=True):
        table = pd.DataFrame()
        for tolerance in report.tolerances:
            ranking = rank_solvers(some, tolerance)
            target = f"to {format_tolerance(tolerance)}"
            part = ranking[["solved", "mean"]].set_axis([f"solved {target}", f"time {target} [s]"], axis=1)
            table = pd.concat([table, part], axis=1)
        table.insert(0, "cases", some["case"].nunique())
        table.insert(0, "law", law)
        middle = f"to {format_tolerance(report.tolerance)}"
        order = [f"solved {middle}", f"time {middle} [s]"]
        tables.append(table.sort_values(order, ascending=[False, True], kind="stable").rename_axis("solver"))
    table = pd.concat(tables).reset_index() if tables else pd.DataFrame()
    return table.drop(columns=[c for c in table if c.startswith("time")]) if report.is_campaign else table


def tabulate_cases(report: Contents) -> Frame:
    """Tabulate each case: size, fastest solver to the middle tolerance, and residual of its stored answer."""
    times = get_times(report.frame, report.tolerance)
    false = report.frame[report.frame["claim_check"] == CONTRADICTED]
    for case, solver in zip(false["case"], false["solver"], strict=True):
        times.loc[times.index == solver, times.columns == case] = math.nan
    target, rows = f"fastest to {format_tolerance(report.tolerance)}", []
    for name in times.columns:
        info, own = report.records.cases[name], times[name].dropna()
        stored = "" if math.isnan(info.stored) else f"{format_residual(info.stored)} {info.stored_verdict}"
        rows.append({
            "case": name, "law": info.law, "rows": info.rows, "contacts": info.contacts, "islands": info.islands,
            "structure": ", ".join(info.structure), target: own.idxmin() if len(own) else "none",
            "time [s]": own.min() if len(own) else math.nan, "stored answer [-]": stored,
        })  # fmt: skip
    table = pd.DataFrame(rows)
    return table if any(row["stored answer [-]"] for row in rows) else table.iloc[:, :-1]


def tabulate_runs(report: Contents) -> Frame:
    """Tabulate the time to each tolerance, smallest residual, status and claim of each solver on each case."""
    runs = report.frame[(report.frame["order"] == "given") & (report.frame["step"] < 0)]
    keys = ["case", "solver", "start"]
    # pandas 3.1 cannot align two indices of categories with codes of different sizes (above 127 cases).
    runs = runs.astype(dict.fromkeys(keys, str))
    to_tolerance = runs[runs["mode"] == "tol"] if (runs["mode"] == "tol").any() else runs
    table = runs.groupby(keys, sort=False)[["relative"]].min()
    for tolerance in report.tolerances:
        reached = to_tolerance[to_tolerance[["tol", "relative"]].max(axis=1) <= tolerance]
        reached = reached.groupby(keys)["time"]
        table[f"to {format_tolerance(tolerance)} [s]"] = reached.min().reindex(table.index)
    last = to_tolerance.groupby(keys)[["status", "form"]].last()
    checks = runs["claim_check"].map({CONFIRMED: 0, NOT_PROVEN: 1, CONTRADICTED: 2}).astype(int)
    worst = checks.groupby([runs[k] for k in keys]).max()
    table = table.join(last)
    table["claim"] = worst.map({0: "", 1: NOT_PROVEN, 2: f"✗ {CONTRADICTED}"})
    table = table.reset_index().rename(columns={"relative": "smallest residual [-]"})
    warm = table["start"].astype(str) != "cold"
    return table.assign(
        solver=table["solver"].astype(str) + np.where(warm, " (" + table["start"].astype(str) + ")", "")
    ).drop(columns="start")


def tabulate_claims(report: Contents) -> Frame:
    """Tabulate how many claims of each solver the judge confirms."""
    f = report.newest
    counts = pd.DataFrame({
        "solver": f["solver"].astype(str), "runs": 1, "claims": f["claims"].astype(int),
        "contradicted": (f["claims"] & (f["claim_check"] == CONTRADICTED)).astype(int),
        "to a tolerance": (f["mode"] == "tol").astype(int), "reached": f["success"].astype(int),
        "died": f["status"].astype(str).str.startswith(DEATHS).astype(int),
    })  # fmt: skip
    table = counts.groupby("solver").sum().reset_index()
    claims = table["claims"].where(table["claims"] > 0)
    rate = 100.0 * (claims - table["contradicted"]) / claims
    rounded = rate.round(1).clip(0.1, 99.9)  # Only exact rates are 0 % or 100 %.
    table.insert(2, "correct rate [%]", rounded.where((rate > 0.0) & (rate < 100.0), rate))
    return table


def select_failures(report: Contents) -> Frame:
    """Return runs that missed their tolerance above the round-off floor, that died, and false claims."""
    f = report.frame
    floor = [at_floor(x, y) for x, y in zip(f["relative"], f["roundoff_floor"], strict=True)]
    proven = (f["status"] == "INFEASIBLE") & (f["claim_check"] == CONFIRMED)
    missed = (f["mode"] == "tol") & ~f["success"] & ~np.array(floor, bool) & ~proven
    died = ~np.isfinite(f["relative"]) | f["status"].astype(str).str.startswith(DEATHS)
    return f[missed | died | (f["claim_check"] == CONTRADICTED)]


def tabulate_failures(report: Contents) -> Frame:
    """Tabulate failed runs with the row of the largest error and the reason."""
    f = select_failures(report)
    conflict = f["status_conflict"].astype(str)
    message = f["message"].astype(str)
    return pd.DataFrame({
        "case": f["case"].astype(str), "solver": f["solver"].astype(str), "start": f["start"].astype(str),
        "target": [describe_target(*x) for x in zip(f["mode"], f["tol"], f["max_iter"], strict=True)],
        "status": f["status"].astype(str), "residual [-]": f["relative"], "floor [-]": f["roundoff_floor"],
        "velocity error [m/s]": f["velocity"], "worst row": f["worst_name"].astype(str),
        "reason": np.where(conflict != "", "✗ " + conflict + ". " + message, message),
    })  # fmt: skip


def tabulate_costs(report: Contents) -> Frame:
    """Tabulate how the time to the middle tolerance grows with the number of rows: time = a rows^exponent.

    The exponent is fitted to the logarithms of the cases that a solver solves.
    """
    times, rows_of = get_times(report.frame, report.tolerance), report.records.cases
    rows = []
    for solver, own in times.iterrows():
        t = own.dropna()
        t, n = t[t > 0.0], np.array([rows_of[c].rows for c in t.index if t[c] > 0.0], float)
        if len(t) < MIN_FIT_CASES or n.min() <= 0.0 or n.max() < MIN_FIT_SIZE_RATIO * n.min():
            continue
        x, y = np.log(n), np.log(t.to_numpy(float))
        exponent, constant = np.polyfit(x, y, 1)
        scatter = float(np.exp(np.std(y - exponent * x - constant)))
        at = math.exp(constant + exponent * math.log(1000.0))
        rows.append({
            "solver": solver, "cases": len(t), "rows": f"{n.min():.0f} to {n.max():.0f}",
            "exponent of rows": round(float(exponent), 2), "fit at 1000 rows [s]": at,
            "scatter [factor]": round(scatter, 2),
        })  # fmt: skip
    return pd.DataFrame(rows).sort_values("fit at 1000 rows [s]") if rows else pd.DataFrame()


def tabulate_budgets(report: Contents) -> Frame:
    """Tabulate the residual of each solver after fixed numbers of iterations: median and 90th percentile."""
    runs = select_starts(report.frame[report.frame["mode"] == "budget"])
    groups = runs.groupby(["solver", "max_iter"], observed=True)["relative"]
    table = compute_quantiles(groups, [0.5, SERVED_QUANTILE]).unstack([1, 2]).sort_index(axis=1)
    names = {0.5: "median", SERVED_QUANTILE: "90 %"}
    table.columns = [f"{format_count(n, 'iteration')}, {names[q]} [-]" for n, q in table.columns]
    return table.rename_axis("solver").reset_index() if len(runs) else pd.DataFrame()


def tabulate_in_time(report: Contents) -> Frame:
    """Tabulate the solver with the smallest residual within each time by structure; none if it serves too few cases."""
    runs, rows = select_starts(report.frame), []
    for name, cases in report.structures.items():
        some, row = runs[runs["case"].isin(cases)], {"structure": name, "cases": len(cases)}
        for t in report.time_budgets:
            done = some[some["time"] <= t].groupby(["solver", "case"], observed=True)["relative"].min()
            left = done.unstack().reindex(columns=cases).fillna(1.0)
            groups = left.stack().groupby("solver", observed=True)
            score = compute_quantiles(groups, SERVED_QUANTILE).sort_values(kind="stable")
            score = score[(left <= SERVED_RESIDUAL).mean(axis=1).reindex(score.index) >= SERVED_QUANTILE]
            near = [str(s) for s in score.index[score <= RESIDUAL_NOISE_FACTOR * score.min()]]
            near.sort(key=lambda s: s != PREFERRED_SOLVER)
            row[f"in {format_seconds(t)}"] = " ≈ ".join(near[:3]) or "none"
            row[f"residual in {format_seconds(t)} [-]"] = score[near[0]] if near else math.nan
        rows.append(row)
    return pd.DataFrame(rows)


def tabulate_sequences(report: Contents) -> Frame:
    """Tabulate the time and iterations of all steps of each sequence, cold and with carried (warm) impulses."""
    runs = report.frame[(report.frame["step"] >= 0) & (report.frame["order"] == "given")].astype(
        {"start": str}
    )
    keys = ["sequence", "solver", "mode", "tol", "max_iter"]
    groups = runs.groupby([*keys, "start"], observed=True)
    table = groups.agg(steps=("case", "size"), time=("time", "sum"), iterations=("iterations", "sum"),
                       residual=("relative", "median")).unstack("start")  # fmt: skip
    out = table.index.to_frame(index=False)[["sequence", "solver"]].astype(str)
    out["target"] = [describe_target(*x[2:]) for x in table.index]
    for start in ("cold", "carried"):
        for name, unit in (("steps", ""), ("time", " [s]"), ("iterations", ""), ("residual", " [-]")):
            if (name, start) in table:
                out[f"{name}, {start}{unit}"] = table[name, start].to_numpy()
    if "time, carried [s]" in out and "time, cold [s]" in out:
        out["cold / carried"] = (out["time, cold [s]"] / out["time, carried [s]"]).round(2)
    return out


def tabulate_engines(report: Contents) -> Frame:
    """Tabulate engines' own answers, and the fastest solver here on the same cases, to the middle tolerance."""
    target, rows = f"to {format_tolerance(report.tolerance)}", []
    for e in report.engines:
        cases = [n for n, i in report.records.cases.items() if e.contains(i.source)]
        ranking = rank_solvers(report.frame[report.frame["case"].isin(cases)], report.tolerance)
        engine = e.rank(report.records, cases, report.tolerance)
        first = ranking.iloc[0] if len(ranking) and ranking["solved"].iloc[0] else None
        relative = e.lines["relative"]
        worst = e.lines.sort_values("velocity", na_position="first").iloc[-1]
        rows.append({
            "recorded": Path(e.folder).name, "steps": len(e.lines), "not recorded": e.left_out,
            "rows": e.lines["rows"].median(),
            "engine's own": f"{e.solver}{'' if engine is None else count_solved(engine['solved'], len(cases))}",
            f"own {target} [s]": math.nan if engine is None else engine["mean"],
            "residual, median [-]": relative.median(), "worst [-]": relative.max(),
            "above floor": e.above_floor, "stopped early": e.unconverged,
            "velocity error [m/s]": worst["velocity"], "worst row": worst["worst"],
            "first here": "none" if first is None else f"{ranking.index[0]}{count_solved(first['solved'], len(cases))}",
            f"first {target} [s]": math.nan if first is None else first["mean"],
        })  # fmt: skip
    return pd.DataFrame(rows)


def tabulate_changes(report: Contents) -> Frame:
    """Tabulate times to a tolerance that differ from an earlier run beyond noise, on cases with the same numbers.

    Earlier times are multiplied by the change of the time of the loop of fixed work on the same case.
    """
    rows, keys = [], ["case", "sha", "solver", "start", "tol"]
    frames = (report.earlier_frame, report.frame[report.frame["step"] < 0])
    some = [
        f[(f["mode"] == "tol") & (f["order"] == "given")].astype(dict.fromkeys(keys[:4], str)) for f in frames
    ]
    both = pd.merge(*some, on=keys)
    drift = both.groupby("case")[["calibration_time_x", "calibration_time_y"]].median()
    drift = (drift["calibration_time_y"] / drift["calibration_time_x"]).fillna(1.0)
    for r in both.itertuples():
        before, after = (
            t if x <= r.tol else math.inf
            for t, x in ((r.time_x * drift[r.case], r.relative_x), (r.time_y, r.relative_y))
        )
        spread = 2.0 * (max(r.time_median_x / r.time_x, r.time_median_y / r.time_y) - 1.0)
        noise = 1.0 + max(MAX_NOISE, spread if math.isfinite(spread) else 0.0)
        if before != after and not before / noise <= after <= before * noise:
            kinds = ("lost", "reached") if math.inf in (before, after) else ("slower", "faster")
            rows.append({"case": r.case, "solver": r.solver, "target": f"to {format_tolerance(r.tol)}",
                         "before [s]": before, "now [s]": after, "change": kinds[int(after < before)]})  # fmt: skip
    return pd.DataFrame(rows).assign(compared=len(both)) if rows else pd.DataFrame({"compared": [len(both)]})


def tabulate_idle(report: Contents) -> Frame:
    """Tabulate cases that the zero impulse solves, with the largest error of any solver, in units."""
    idle = report.newest[report.newest["nothing_to_do"].astype(bool)].sort_values("velocity")
    idle = idle.drop_duplicates("case", keep="last")
    columns = {"velocity": "velocity error [m/s]", "energy": "energy [√J]"}
    return idle[["case", "rows", "solver", "velocity", "energy"]].rename(columns=columns)


def tabulate_skips(skips: Iterable[Skip]) -> Frame:
    """Tabulate pairs of case and solver that did not run, or not to the end, with the reason."""
    return pd.DataFrame([{"case": s.case, "solver": s.solver, "reason": s.reason} for s in skips])
