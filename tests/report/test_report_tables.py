"""Sentences and tables of reports of records that nothing solved: one approved text."""

import json
import math

import pandas as pd
import pytest
from approved_texts import check_text

import lavender as lv
from lavender.report import Report, tables
from lavender.report.render import format_cells, format_markdown, list_number_heads
from lavender.report.tables import read_engine_answers
from lavender.report.text import format_percent
from lavender.report.timing import add_times
from tests.report.synthetic import BUDGET, FALSE_CLAIM, lines_of, record, report_of

SIZES = {f"c{n}": n for n in (10, 30, 100, 300, 1000)}
DEAD = {"status": "ERROR", "claims": False}


def all_of(cases, *solvers, relative=1e-8, **more):
    """A run of each solver (name, time) on each case."""
    return [
        record(case, solver, time, relative, **more) for case in cases for solver, time in solvers
    ]


def repeated(made, *factors):
    """The runs with repetitions that take these multiples of their times."""
    return [add_times(r, [x * r["time"] for x in factors]) for r in made]


def step_of(step, solver, relative, **more):
    return record(
        f"walk[{step}]", solver, 1e-3, relative, **{"step": step, "start": "carried", **more}
    )


def sweeps(*given):
    """Three steps swept n times: the first has no step before it, the second is harder than the third."""
    return [
        step_of(
            i,
            solver,
            10.0 * v,
            **BUDGET | {"max_iter": n, "start": start, "velocity": v, "motion_error": 2.0 * v},
        )
        for start, n, solver, hardest in given
        for i, v in enumerate((1.0, hardest, 1e-5))
    ]


def carried():
    """Four steps, cold, and with the impulses of the step before as start."""
    made = [step_of(k, "auto", 1e-8, start="cold", iterations=3, times=(2e-3,)) for k in range(4)]
    return made + [add_times({**r, "start": "carried", "carry_time": 2e-5}, [1e-3]) for r in made]


SWEEPS = (
    ("cold", 8, "pgs", 3e-3),
    ("cold", 16, "pgs", 9e-4),
    ("carried", 8, "pgs", 9e-4),
    ("carried", 4, "pgs", 1.1e-3),
)
NOISY = all_of("ab", ("direct", 1.0), ("auto", 1.07))
CRASHED = [
    *all_of("ab", ("auto", 1e-3)),
    *all_of("ab", ("mine", 0.0), relative=math.inf, message="ValueError", **DEAD),
    record("b", "yours", 0.0, math.inf, message="TypeError: of yours", **DEAD),
]
STOPPED = [
    *(step_of(i, "auto", 1e-8) for i in range(4)),
    *(step_of(i, "pgs", 0.5, **BUDGET) for i in range(4)),
]
ENGINE = all_of("a", ("auto", 4e-5), ("pgs", 5e-4)) + all_of("b", ("auto", 8e-5), ("pgs", 1e-3))
#: Name, runs, arguments of the report, and tables that are shown below the recommendation.
SCENARIOS = [
    (
        "a run to 1e-3 that reached 1e-7 counts for 1e-3 alone, and a budget for none",
        [
            record("a", "pgs", 1e-5, 1e-7, tol=1e-3),
            record("a", "pgs", 3e-5, 1e-7),
            record("a", "pgs", 1e-6, 1e-9, **BUDGET),
        ],
        {},
        "solvers",
    ),
    (
        "solved cases come before time, and false claims last",
        [
            *all_of("ab", ("slow", 1e-2)),
            record("a", "fast", 1e-5, 1e-8),
            record("b", "fast", 1e-5, 1e-2),
            record("a", "liar", 1e-6, 1e-8),
            record("b", "liar", 1e-6, 1e-8, **FALSE_CLAIM),
        ],
        {},
        "rank solvers runs",
    ),
    (
        "7 % within the noise of 8 % is a tie with auto first",
        repeated(NOISY, 1.0, 1.04, 1.08),
        {},
        "rank",
    ),
    ("7 % above the noise of 4 % is no tie", NOISY, {}, "rank"),
    (
        "7 % within the noise of the slower solver alone is a tie",
        [*all_of("ab", ("pgs", 1.0)), *repeated(all_of("ab", ("auto", 1.07)), 1.0, 1.04, 1.08)],
        {},
        "rank",
    ),
    (
        "another solver of fewer cases changes no mean",
        [
            record("a", "pgs", 1e-3, 1e-8),
            record("b", "pgs", 1e-2, 1e-8),
            record("a", "slow", 1.9, 1e-8),
        ],
        {},
        "rank",
    ),
    (
        "words of structures, laws and sequences are groups",
        all_of(("a", "b", "c", "walk[0]"), ("pgs", 1.0)),
        {
            "walk": True,
            "cases": {
                "b": {"structure": "stack, redundant", "law": "coulomb"},
                "c": {"structure": "pile, friction", "law": "coulomb"},
            },
        },
        "structures",
    ),
    (
        "two of three cases are solved by three solvers, of which two are equally fast",
        [
            *all_of("ab", ("newton", 1.0), ("auto", 1.001), ("pgs", 3.0)),
            record("c", "pgs", 1.0, 0.5),
        ],
        {},
        "structures solvers",
    ),
    (
        "times are rows to the power 1.5; three cases are too few for a fit",
        [
            *(record(c, "pgs", 1e-6 * n**1.5, 1e-8) for c, n in SIZES.items()),
            *all_of(list(SIZES)[:3], ("few", 1e-6)),
        ],
        {"cases": {c: {"rows": n} for c, n in SIZES.items()}},
        "costs",
    ),
    (
        "of 2 claims one is false, a run died, and a budget claims nothing",
        [
            record("a", "pgs", 1.0, 1e-8),
            record("b", "pgs", 1.0, 0.5, **FALSE_CLAIM),
            record("c", "pgs", 1.0, math.inf, status="KILLED", claims=False),
            record("c", "pgs", 1.0, 0.1, **BUDGET),
        ],
        {},
        "solvers",
    ),
    (
        "a miss at the floor, a proof and a budget are no failures",
        [
            record("a", "good", 1.0, 1e-8),
            record("a", "floor", 1.0, 1e-5, roundoff_floor=1e-5),
            record("a", "missed", 1.0, 1e-2, message="slow"),
            record("a", "liar", 1.0, 0.5, **FALSE_CLAIM),
            record("a", "proved", 1.0, 1.0, status="INFEASIBLE"),
            record("a", "budget", 1.0, 0.5, **BUDGET),
            record("a", "lucky liar", 1.0, 1e-9, **FALSE_CLAIM),
        ],
        {},
        "runs",
    ),
    ("the carried start halves the time", carried(), {"walk": True}, "sequences"),
    (
        "8 carried or 16 cold sweeps keep 1 mm/s; acceleration is only in the table",
        [
            *sweeps(*SWEEPS, ("carried", 2, "anderson", 1e-6)),
            sweeps(("carried", 2, "sequential_impulses", 1e-6))[1],
        ],
        {"walk": True},
        "sweeps",
    ),
    (
        "the engine's own 8 iterations leave 2.5 mm/s",
        sweeps(*SWEEPS),
        {
            "walk": True,
            "answers": {
                "walk[1]": {"relative": 0.1, "velocity": 2.5e-3, "iterations": 8, "solver": "PGS"}
            },
        },
        "",
    ),
    ("no measured number of sweeps keeps 1 mm/s", sweeps(SWEEPS[0], SWEEPS[3]), {"walk": True}, ""),
    (
        "only accelerated sweeps keep 1 mm/s",
        sweeps(SWEEPS[0], SWEEPS[3], ("carried", 2, "anderson", 1e-6)),
        {"walk": True},
        "",
    ),
    (
        "a late run is a miss within 10 ms",
        [*all_of("ab", ("late", 1.0)), *all_of("ab", ("early", 1e-3), relative=1e-2)],
        {"times": [1e-2]},
        "structures",
    ),
    ("no run ends within 10 ms", all_of("ab", ("late", 1.0)), {"times": [1e-2]}, "structures"),
    (
        "two steps were not reached within the time of a pass, and one was missed",
        [
            *(step_of(i, "pgs", 1e-8 if i < 3 else 0.25) for i in range(4)),
            *(step_of(i, "pgs", 0.5, **BUDGET) for i in range(6)),
            *(step_of(i, "pgs", 5e-4, tol=1e-3) for i in range(6)),
        ],
        {"walk": True},
        "",
    ),
    (
        "stopped in the first sequence, with two of three solvers unfinished",
        STOPPED,
        {"walk": True, "whole": False, "solvers": ["auto", "pgs", "nncg"]},
        "structures",
    ),
    (
        "stopped in a later sequence, with a case of which all solvers are measured",
        [*all_of("a", ("auto", 1e-3), ("pgs", 1e-3), ("nncg", 1e-3)), *STOPPED],
        {"walk": True, "whole": False},
        "structures",
    ),
    (
        "stopped with two of three problems complete",
        [*all_of("ab", ("auto", 1e-3), ("pgs", 1e-3)), *all_of("c", ("auto", 1e-3))],
        {"whole": False},
        "",
    ),
    ("stopped with no solution", [record("a", "auto", 1.0, 1.0)], {"whole": False}, ""),
    (
        "stopped before any problem was complete",
        all_of("c", ("auto", 1e-3)),
        {"whole": False, "solvers": ["auto", "pgs"]},
        "",
    ),
    (
        "a miss, a tie and a call",
        [
            *all_of("abc", ("auto", 1e-3), ("direct", 1.0001e-3)),
            *all_of("d", ("auto", 1.0), ("direct", 1.0), relative=1e-2),
        ],
        {},
        "",
    ),
    (
        "one case takes a thousand times as long",
        [record(c, "pgs", t, 1e-8) for c, t in (("a", 1e-4), ("b", 1e-4), ("c", 1e-1))],
        {},
        "",
    ),
    (
        "plug-ins have their place",
        all_of("a", ("auto", 1e-3), ("mine", 2e-3), ("other", 3e-3)),
        {},
        "",
    ),
    (
        "three solvers within 3 % and one at 20 %",
        all_of("a", ("pgs", 1e-3), ("auto", 1.03e-3), ("direct", 1.2e-3)),
        {},
        "solvers rank matrix",
    ),
    ("two crashed plug-ins", CRASHED, {"cases": {"b": {"law": "coulomb"}}}, "solvers"),
    *(
        (
            f"the engine's own answers are {words}",
            ENGINE,
            {
                "answers": {
                    case: {"solver": "NEWTON", "verdict": "wrong", "seconds": t, "relative": x}
                    for case, (t, x) in zip("ab", answers, strict=True)
                }
            },
            "rank",
        )
        for words, answers in (
            ("faster", [(1e-5, 1e-9), (2e-5, 1e-9)]),
            ("slower", [(1e-4, 1e-9), (2e-4, 1e-9)]),
            ("as fast", [(3.9e-5, 1e-9), (8e-5, 1e-9)]),
            ("right on one of two cases", [(1e-6, 1e-9), (1e-6, 1e-2)]),
            ("wrong or without a residual", [(1e-6, 1e-2), (1e-6, math.nan)]),
        )
    ),
    (
        "an engine that answered one of two problems is not ranked",
        ENGINE,
        {
            "answers": {
                "a": {"solver": "NEWTON", "verdict": "wrong", "seconds": 1e-5, "relative": 1e-9}
            }
        },
        "rank",
    ),
    *(
        (
            f"compared with an earlier run, {words}",
            [record("a", "pgs", now, x, calibration_time=1e-4 * drift)],
            {"old": lines_of(record("a", "pgs", 1e-3, 1e-8))},
            "changes",
        )
        for words, now, x, drift in (
            ("20 % slower is noise", 1.2e-3, 1e-8, 1.0),
            ("twice as slow", 2e-3, 1e-8, 1.0),
            ("twice as fast", 5e-4, 1e-8, 1.0),
            ("twice as slow as the machine is", 2e-3, 1e-8, 2.0),
            ("a solution is lost", 1e-3, 1e-2, 1.0),
        )
    ),
]


def describe_report(report, tables_shown):
    """The sentences of a report, and its tables with numbers of six digits."""
    parts = [report.verdict, *report.alarms, *report.sentences, *report.warnings, *report.code]
    for name in tables_shown.split():
        frame = (
            tables.rank_solvers(report, 1e-6)
            if name == "rank"
            else getattr(tables, f"tabulate_{name}")(report)
        )
        parts += [
            f"{name}:",
            frame.to_csv(index=name == "rank", float_format="%.6g", lineterminator="\n").rstrip(),
        ]
    return "\n".join(parts)


@pytest.mark.parametrize(
    ("name", "made", "more", "tables_shown"), SCENARIOS, ids=[name for name, *_ in SCENARIOS]
)
def test_report_has_its_approved_recommendation_and_tables(
    tmp_path, name, made, more, tables_shown
):
    more = dict(more)
    old, times, answers = (
        more.pop(key, default) for key, default in (("old", None), ("times", []), ("answers", {}))
    )
    if answers:  # of an engine, to the case of the same name
        folder = tmp_path / "steps"
        folder.mkdir()
        answer_lines = [
            json.dumps({"file": f"{case}.npz", "rows": 3, **answer})
            for case, answer in answers.items()
        ]
        (folder / "engine.jsonl").write_text(
            "\n".join(2 * answer_lines)
        )  # of an engine that ran twice
        more["cases"] = {case: {"source": str(folder / f"{case}.npz")} for case in answers}
    lines = lines_of(*made, **more)
    report = Report(lines, old, times, read_engine_answers([], lines))
    check_text("report_scenarios.txt", name, describe_report(report, tables_shown))


def test_report_without_times_ranks_by_solved_cases_and_shows_no_time():
    made = [
        *all_of("abc", ("auto", 0.0)),
        *all_of("ab", ("pgs", 0.0)),
        record("c", "pgs", 0.0, 0.5),
    ]
    lines = lines_of(*made)
    lines.at[0, "plan"]["campaign"] = True
    report = Report(lines)
    assert report.verdict == "Use auto: it solves all 3 problems to 10⁻⁶ (no times were measured)."
    page = report.make_page().render()
    assert (
        "µs" not in page.replace("10\u00a0µs", "").replace("10 µs", "")
        and "<svg" not in page
        and "✓" in page
    )
    assert "[s]" not in ",".join(report.sections["solvers"].frame)


def test_mean_time_is_of_the_solved_cases_and_ratio_of_the_shared_ones():
    """The mean of one case is its time, however many others are not solved or not accepted."""
    made = [*all_of("a", ("all", 2e-3)), *all_of("b", ("all", 4e-2)), record("b", "some", 1.0, 0.5)]
    made += all_of("a", ("some", 1e-3), ("few", 1e-3))
    ranking = tables.rank_solvers(report_of(*made), 1e-6)
    assert ranking.loc[["some", "few"], "mean"].to_numpy() == pytest.approx(1e-3)
    assert ranking.loc[["some", "few"], "ratio"].to_numpy() == pytest.approx(
        1.01e-3 / 2.01e-3, rel=0.01
    )
    assert ranking[["solved", "tried"]].to_dict("index") == {
        "all": {"solved": 2, "tried": 2},
        "some": {"solved": 1, "tried": 2},
        "few": {"solved": 1, "tried": 1},
    }


@pytest.mark.parametrize("status", ["INFEASIBLE", "UNBOUNDED"])
def test_checked_proof_is_the_answer_of_a_case_without_a_solution(status):
    unproven = {"status": status, "claim_check": "not proven"}
    made = [
        *all_of("ab", ("auto", 2e-3), ("pgs", 1e-3), ("guess", 1e-3)),
        record("none", "auto", 6e-5, 1.0, tol=1e-3, status=status),
        record("none", "pgs", 5e-1, 1.0, status="DIVERGED"),
        record("none", "guess", 1e-5, 1.0, **unproven),
    ]
    report = report_of(*made)
    ranking = report.ranking
    assert ranking["solved"].to_dict() == {"auto": 3, "pgs": 2, "guess": 2}
    assert ranking["proven"].to_dict() == {"auto": 1, "pgs": 0, "guess": 0}
    assert ranking.at["auto", "mean"] <= ranking.at["auto", "worst"] == 2e-3
    assert "solves all 3 problems (1 by a proof that it has no solution)" in report.verdict
    misses = next(text for text in report.sentences if text.startswith("Not solved"))
    assert "by pgs" in misses and "by guess" in misses and "auto" not in misses
    assert not report.alarms and report.get_times(1e-6).at["auto", "none"] == 6e-5
    # An answer to 1e-3 exists: the proof for 1e-6 is none of it.
    near = report_of(*made[:-2], record("none", "pgs", 1.0, 5e-4, tol=1e-3))
    assert (
        math.isnan(near.get_times(1e-3).at["auto", "none"])
        and near.get_times(1e-6).at["auto", "none"] == 6e-5
    )


@pytest.mark.parametrize(
    ("part", "whole", "digits", "text"),
    [
        (130, 150, 1, "86.7 %"),
        (25, 150, 1, "16.7 %"),
        (546, 900, 1, "60.7 %"),
        (2, 3, 0, "67 %"),
        (0, 7, 1, "0.0 %"),
        (7, 7, 0, "100 %"),
        (1, 3000, 1, "0.03 %"),
        (2999, 3000, 1, "99.97 %"),
        (999, 1000, 0, "99.9 %"),
        (1, 1000, 0, "0.1 %"),
    ],
)
def test_format_percent_rounds_and_keeps_0_and_100_for_exact_shares(part, whole, digits, text):
    assert format_percent(part, whole, digits) == text


def test_format_cells_times_have_one_unit_and_sizes_one_format():
    frame = pd.DataFrame(
        {
            "solver": ["a", "b"],
            "time [s]": [1.5e-3, math.nan],
            "rows": [3, 4],
            "residual [-]": [1e-7, 0.5],
            "x": [2.5, 3.0],
            "share": ["12 %", "3.1 %"],
            "none [-]": [math.nan, math.nan],
            "text": ["", ""],
        }
    )
    texts = format_cells(frame)
    assert list(texts) == ["solver", "time [ms]", "rows", "residual [-]", "x", "share"]
    assert texts.to_numpy().tolist() == [
        ["a", "1.50", "3", "1.0e-7", "2.5", "12 %"],
        ["b", "–", "4", "5.0e-1", "3", "3.1 %"],
    ]
    assert list_number_heads(texts) == set(texts) - {"solver"}
    assert list(format_cells(pd.DataFrame({"n": ["x", "y"], "t [s]": [2e-6, 3e-6]}))) == [
        "n",
        "t [µs]",
    ]
    sizes = format_cells(pd.DataFrame({"a [-]": [0.35, 0.2], "b [m/s]": [2.9e-3, math.nan]}))
    assert sizes.to_numpy().tolist() == [["3.5e-1", "2.9e-3"], ["2.0e-1", "–"]]
    markdown = format_markdown(pd.DataFrame({"a": ["<b>|*x*"]}))
    assert markdown == ["| a |", "| --- |", r"| &lt;b&gt;\|\*x\* |"]


def test_tabulate_structures_counts_a_case_that_a_solver_did_not_end_in_time_as_unsolved():
    made = [record("a", "half", 1e-3, 1e-9), record("b", "half", 1.0, 1e-9)]
    made += [record(case, "both", 1e-3, 1e-2, tol=1e-3) for case in "ab"]
    report = Report(lines_of(*made), times=(1e-2, 10.0))
    [row] = tables.tabulate_structures(report).to_dict("records")
    assert [x for name, x in row.items() if name.startswith("in ")] == ["both", "half"]


def test_energy_that_the_users_engine_gains_is_named_first(tmp_path):
    """An impulse that shoots a resting box up adds energy; a solver that gains less comes after the engine."""
    problem = lv.suite.case("box_stack(n=2)").problem
    folder = tmp_path / "steps"
    folder.mkdir()
    rows = []
    for k in range(2):
        path = folder / f"walk[{k}].npz"
        lv.io.save(problem, path, impulse=30.0 * lv.solve(problem).impulse)
        rows.append(
            json.dumps({"file": path.name, "rows": problem.m, "relative": 1.0, "solver": "PGS"})
        )
    (folder / "engine.jsonl").write_text("\n".join(rows))
    made = [step_of(k, "pgs", 1e-8, energy_gain=1e-3) for k in range(2)]
    facts = {f"walk[{k}]": {"source": str(folder / f"walk[{k}].npz")} for k in range(2)}
    lines = lines_of(*made, walk=True, cases=facts)
    report = Report(lines, engines=read_engine_answers([], lines))
    (text,) = [w for w in report.warnings if w.startswith("gains energy")]
    assert "your engine in 2 steps, at most" in text and "the first of 2" in text
