"""Records that nothing solved, and a report of them in which every part of a page has something to show."""

import dataclasses
import io
import json

from rich.console import Console

from lavender.report import CaseInfo, Record, Records, Report, Run, Skip
from lavender.report.findings import print_report
from lavender.report.tables import read_engine_answers

TOLERANCES = (1e-3, 1e-6)
FALSE_CLAIM = {"claim_check": "contradicted", "status_conflict": "says CONVERGED"}
BUDGET = {"mode": "budget", "tol": 0.0, "max_iter": 8, "status": "MAX_ITERATIONS", "claims": False,
          "work": {"sweeps": 8}, "iterations": 8}  # fmt: skip
EVIL = '</script><script>alert("x")</script>&|'


def info(case, law="lcp", structure=("stack",), **more):
    made = CaseInfo("run", case, case, "sha" + case, law, 8, 8, 0, 0, 22, 1.0, structure, True, "a reason")
    return dataclasses.replace(made, **more)


def record(case, solver, time, relative, **more):
    """A record of three repetitions, the smallest of which took `time`."""
    values = {
        "run": "run", "case": case, "sha": "sha" + case, "solver": solver, "start": "cold", "mode": "tol",
        "tol": 1e-6, "max_iter": 0, "time_limit": 2.0, "relative": relative, "energy": relative, "velocity": relative,
        "roundoff_floor": 1e-15, "status": "CONVERGED", "claims": True, "times": (1.02 * time, time, 1.04 * time),
        "success": relative <= more.get("tol", 1e-6), "calibration_time": 1e-4,
    }  # fmt: skip
    return Record(**(values | more))


def records_of(*made, structure=None, law=None, rows=None, whole=True):
    found = Records()
    plan = {"tolerances": list(TOLERANCES), "solvers": sorted({r.solver for r in made})}
    found.add(
        Run("run", "2026-01-01", "0.1", "3.11", "linux", "a cpu", 2, 1, {"numpy": "2"}, plan, whole=whole)
    )
    for case in dict.fromkeys(r.case for r in made):
        words = (structure or {}).get(case, ("stack",))
        more = {"rows": rows[case]} if rows else {}
        found.add(info(case, (law or {}).get(case, "lcp"), words, **more))
    for r in made:
        found.add(r)
    return found


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
        for solver, ratio, relative in (("auto", 1.0, 1e-9), ("direct", 2.0, 1e-13), ("osqp", 3.0, 1e-8)):
            made.append(record(case, solver, ratio * size, relative, load=6.0))
        made.append(record(case, "pgs", size, 9e-4, tol=1e-3, iterations=40))
        made += [record(case, "pgs", 1e-4, (1 + 3 * k) * 1e-2, order=order, **BUDGET) for k, order in
                 enumerate(("given", "reverse"))]  # fmt: skip
        made.append(
            record(case, "liar", 0.1 * size, 0.5, message="done", worst_name="<b>row 3", **FALSE_CLAIM)
        )
        if case == "pile":
            made.append(record(case, "dead", 1.0, float("inf"), **{**crashed, "times": ()}))
    made.append(record("idle", "pgs", 1e-5, 1.0, velocity=3e-12))
    for step in range(2):
        for start, left in (("cold", 1e-1), ("carried", 1e-2)):
            steps = {"start": start, "step": step}
            made.append(record(f"walk[{step}]", "pgs", 1e-3, left, **steps, **BUDGET))
            made.append(record(f"walk[{step}]", "auto", 2e-3 if start == "cold" else 1e-3, 1e-8, **steps))
    found = records_of(*made, structure={EVIL: ("stack", "friction")}, law={EVIL: "coulomb"})
    source = str(folder / "pile.npz")
    change = {
        "pile": {"source": source, "stored": 1e-4, "diagnostics": ("duplicate rows: two of <3>",)},
        EVIL: {"source": "chains/one.npz", "guess": "answer"},
        "idle": {"nothing_to_do": True},
        **{f"walk[{k}]": {"sequence": "walk", "step": k, "structure": ("chain",)} for k in range(2)},
    }
    for case, values in change.items():
        found.add(dataclasses.replace(found.cases[case], **values))
    found.add(Skip("run", "torn", "", "did not load: torn: it is <empty>"))
    found.add(Skip("run", "walk 3", "", "did not load: of another problem", sequence="walk"))
    found.add(Skip("run", "pile", "sor", "takes laws linear"))
    answer = {"file": "pile.npz", "rows": 8, "seconds": 5e-4, "relative": 1e-7, "solver": "NEWTON", "verdict": "wrong",
              "velocity": 0.1, "worst": "contact 2"}  # fmt: skip
    (folder / "engine.jsonl").write_text(json.dumps(answer) + "\n" + json.dumps({"left_out": 1}) + "\n")
    old = records_of(record("pile", "auto", 0.3e-3, 1e-9), record("pile", "pgs", 1.0, 1e-1))
    old.source = "earlier.jsonl"
    return Report(found, old, [2e-4, 4e-3], read_engine_answers([], found))
