"""Rows that nothing solved, and a report of them in which every part of a page has something to show."""

import io
import json

from rich.console import Console

from lavender.report import Report
from lavender.report.findings import print_report
from lavender.report.store import CASE_COLUMNS, CASE_DETAILS, RUN_COLUMNS, make_lines
from lavender.report.tables import read_engine_answers
from lavender.report.timing import add_times

TOLERANCES = (1e-3, 1e-6)
FALSE_CLAIM = {"claim_check": "contradicted", "status_conflict": "says CONVERGED"}
BUDGET = {
    "mode": "budget",
    "tol": 0.0,
    "max_iter": 8,
    "status": "MAX_ITERATIONS",
    "claims": False,
    "work": '{"sweeps": 8}',
    "iterations": 8,
}
EVIL = '</script><script>alert("x")</script>&|'


def record(case, solver, time, relative, **more):
    """The row of a run of three repetitions, the smallest of which took `time`."""
    values = {
        "kind": "run",
        "run": "run",
        "case": case,
        "sha": "sha" + case,
        "solver": solver,
        "tol": 1e-6,
        "time_limit": 2.0,
        "relative": relative,
        "error_energy": relative,
        "velocity": relative,
        "roundoff_floor": 1e-15,
        "status": "CONVERGED",
        "claims": True,
        "success": relative <= more.get("tol", 1e-6),
        "calibration_time": 1e-4,
    }
    times = more.pop("times", (1.02 * time, time, 1.04 * time))
    return add_times(RUN_COLUMNS | values | more, times)


def skip(case, solver, reason, sequence=""):
    pair = {"case": case, "solver": solver, "sequence": sequence}
    return {"kind": "skip", "run": "run", "reason": reason, **pair}


def lines_of(*made, cases=None, whole=True, solvers=None, walk=False, more=()):
    """Lines with a machine, the cases of the runs `made` with the facts `cases`, and `more` rows.

    With `walk`, all cases called walk[STEP] are steps of one sequence.
    """
    plan = {
        "tolerances": list(TOLERANCES),
        "solvers": solvers or sorted({r["solver"] for r in made}),
    }
    machine = {
        "kind": "machine",
        "run": "run",
        "started": "2026-01-01",
        "lavender": "0.1",
        "python": "3.11",
        "platform": "linux",
        "cpu": "a cpu",
        "cores": 2,
        "threads": 1,
        "versions": {"numpy": "2"},
        "plan": plan,
        "build": {},
        "load": None,
        "whole": whole,
    }
    rows = [machine]
    for case in dict.fromkeys(r["case"] for r in made):
        facts = {
            "kind": "case",
            "run": "run",
            "case": case,
            "source": case,
            "sha": "sha" + case,
            "law": "lcp",
            "rows": 8,
            "blocks": 8,
            "structure": "stack",
            "mass_ratio": 1.0,
            "reason": "a reason",
        }
        if walk and case.startswith("walk"):
            facts |= {"sequence": "walk", "step": int(case[5:-1])}
        rows.append(CASE_DETAILS | CASE_COLUMNS | facts | (cases or {}).get(case, {}))
    return make_lines([*rows, *made, *more])


def report_of(*made, **more):
    return Report(lines_of(*made, **more))


def shown(report, width=200, **more):
    """The text of a report in the terminal."""
    out = io.StringIO()
    print_report(report, Console(file=out, width=width), **more)
    return out.getvalue()


def example(folder):
    """A report with every table, sentence and warning; an engine's answers are read from `folder`."""
    made = []
    crashed = {"status": "CRASHED (SIGSEGV)", "claims": False}
    for i, case in enumerate(("pile", EVIL)):
        size = 1e-3 * (1 + i)
        for solver, ratio, relative in (
            ("auto", 1.0, 1e-9),
            ("direct", 2.0, 1e-13),
            ("osqp", 3.0, 1e-8),
        ):
            made.append(record(case, solver, ratio * size, relative, load=6.0))
        made.append(record(case, "pgs", size, 9e-4, tol=1e-3, iterations=40))
        made.append(record(case, "pgs", 1e-4, 1e-2, **BUDGET))
        made.append(
            record(
                case, "liar", 0.1 * size, 0.5, message="done", worst_name="<b>row 3", **FALSE_CLAIM
            )
        )
        if case == "pile":
            made.append(record(case, "dead", 1.0, float("inf"), **{**crashed, "times": ()}))
    made.append(record("idle", "pgs", 1e-5, 1.0, velocity=3e-12))
    for step in range(2):
        for start, left in (("cold", 1e-1), ("carried", 1e-2)):
            steps = {"start": start, "step": step}
            made.append(record(f"walk[{step}]", "pgs", 1e-3, left, **steps, **BUDGET))
            made.append(
                record(f"walk[{step}]", "auto", 2e-3 if start == "cold" else 1e-3, 1e-8, **steps)
            )
    facts = {
        "pile": {
            "source": str(folder / "pile.npz"),
            "stored": 1e-4,
            "diagnostics": ["duplicate rows: two of <3>"],
        },
        EVIL: {
            "source": "chains/one.npz",
            "guess": "answer",
            "structure": "stack, friction",
            "law": "coulomb",
        },
        "idle": {"nothing_to_do": True},
        **{f"walk[{k}]": {"structure": "chain"} for k in range(2)},
    }
    skips = [
        skip("torn", "", "did not load: torn: it is <empty>"),
        skip("pile", "sor", "takes laws linear"),
        skip("walk 3", "", "did not load: of another problem", "walk"),
    ]
    lines = lines_of(*made, cases=facts, walk=True, more=skips)
    answer = {
        "file": "pile.npz",
        "rows": 8,
        "seconds": 5e-4,
        "relative": 1e-7,
        "solver": "NEWTON",
        "verdict": "wrong",
        "velocity": 0.1,
        "worst": "contact 2",
    }
    (folder / "engine.jsonl").write_text(
        json.dumps(answer) + "\n" + json.dumps({"left_out": 1}) + "\n"
    )
    old = lines_of(record("pile", "auto", 0.3e-3, 1e-9), record("pile", "pgs", 1.0, 1e-1))
    return Report(lines, old, [2e-4, 4e-3], read_engine_answers([], lines))
