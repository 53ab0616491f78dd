"""Statistics of records are what their definitions say."""

import dataclasses
import math
import sys

import pytest

from lavender import bench, report
from lavender.report import table_specs
from lavender.report.bench import statistics
from tests.report.synthetic import BUDGET, FALSE_CLAIM, TOLERANCES, info, record, records_of


def test_time_to_a_level_is_that_of_the_cheapest_run_to_a_level_that_reached_it():
    found = records_of(
        record("a", "x", 5.0, 1e-4, tol=1e-3),
        record("a", "x", 9.0, 1e-8),
        record("a", "x", 1.0, 9e-4, **BUDGET),  # nor does a budget that happened to reach it
        record("a", "x", 0.1, 1e-9, order="reverse", mode="budget"),  # another order does not count
        record("a", "y", 2.0, 2e-3, tol=1e-3, status="STALLED", claims=False),
        record("a", "y", 3.0, 0.5, tol=1e-3, **FALSE_CLAIM),
    )
    x, y = report.summarize_runs_by_case(found)
    assert dict(x.times) == {1e-3: 5.0, 1e-6: 9.0}
    assert (x.best, x.status) == (1e-8, "CONVERGED")
    assert dict(y.times) == {1e-3: math.inf, 1e-6: math.inf}
    assert (y.best, y.status_conflict) == (2e-3, "says CONVERGED")


def test_budgets_change_no_table_to_a_tolerance():
    """The runs with a budget are faster, make fewer passes and reach more than the runs to a tolerance."""
    made = []
    for case in "ab":
        made += [
            record(case, "x", 5.0, 1e-7, work={"sweeps": 50}),
            record(case, "y", 4.0, 1e-7, work={"sweeps": 40}),
        ]
        made.append(record(case, "z", 2.0, 1e-2, work={"sweeps": 30}, backend_time_min=1.0))
    steps = [record(f"s {i}", "y", 4.0, 1e-7, step=i) for i in range(2)]
    swept = BUDGET | {"max_iter": 20, "work": {"sweeps": 20}}
    budgets = [record(case, solver, 1.0, 1e-9, backend_time_min=0.1 if solver == "z" else None, **swept)
               for case in "ab" for solver in "xz"]  # fmt: skip
    budgets += [record(f"s {i}", "y", 1.0, 1e-9, step=i, **swept) for i in range(2)]

    def tables(*records):
        found = records_of(*records)
        for i in range(2):
            found.add(info(f"s {i}", sequence="s", step=i))
        return (
            [dict(r.times) for r in report.summarize_runs_by_case(found)],
            report.compute_mean_times_by_law(found),
            report.compute_profiles(found, "time"),
            report.compute_profiles(found, "work"),
            [line.by_tolerance for line in report.recommend_solvers(found, [9.0])],
            statistics.compare_backend_times(found),
            [r.reached for r in statistics.compute_robustness(found)],
        )

    assert tables(*made, *steps) == tables(*made, *steps, *budgets)
    # Without any run to a tolerance, budgets are all that there is.
    (z,) = report.summarize_runs_by_case(records_of(record("a", "z", 1.0, 1e-9, **BUDGET)))
    assert z.times[1e-6] == 1.0


@pytest.mark.parametrize(
    ("check", "conflict", "mark", "wrong"),
    [
        ("confirmed", "", "", 0),
        ("not proven", "", "not proven", 0),
        ("contradicted", "says INFEASIBLE, auto found a solution", "✗ contradicted", 1),
    ],
)
def test_a_claim_that_is_not_proven_is_neither_a_proof_nor_a_false_claim(check, conflict, mark, wrong):
    claim = {"status": "INFEASIBLE", "claim_check": check, "status_conflict": conflict}
    found = records_of(record("a", "x", 1.0, 0.5, **claim))
    assert len(report.list_failures(found)) == (0 if check == "confirmed" else 1)
    assert [c.wrong for c in report.count_claims(found)] == [wrong]
    table = table_specs.tabulate_times_to_tolerances(report.summarize_runs_by_case(found), TOLERANCES)
    assert str(table.rows[0][table.heads.index("claim")]) == mark
    assert table.marks == ["bad" if wrong else ""]


def test_profiles_count_misses_and_refusals_at_infinity():
    found = records_of(
        record("a", "fast", 1.0, 1e-7), record("a", "slow", 3.0, 1e-7),
        record("b", "fast", 2.0, 1e-1, success=False), record("b", "slow", 4.0, 1e-7),
        record("c", "slow", 1.0, 1e-7), record("d", "slow", 1.0, 1.0), record("d", "fast", 1.0, 1.0),
    )  # fmt: skip
    profile = next(p for p in report.compute_profiles(found) if p.tolerance == 1e-6)
    assert profile.cases == 4
    assert dict(profile.curves) == {"fast": ((1.0, 0.25),), "slow": ((1.0, 0.5), (3.0, 0.75))}


def test_shifted_geometric_means_charge_misses_the_limit():
    found = records_of(
        record("a", "x", 1.0, 1e-7), record("b", "x", 4.0, 1e-7),
        record("a", "y", 1.0, 1e-7), record("b", "y", 0.5, 1.0, success=False),
        record("a", "z", 1.0, 1e-7),  # does not take b: not compared
    )  # fmt: skip
    means = report.compute_mean_times_by_law(found)["lcp"][1e-6]
    shift = statistics.MEAN_TIME_SHIFT
    assert set(means) == {"x", "y"}
    assert means["x"] == (pytest.approx(math.sqrt((1 + shift) * (4 + shift)) - shift), 2, 2)
    assert means["y"] == (pytest.approx(math.sqrt((1 + shift) * (2 + shift)) - shift), 1, 2)  # limit 2 s


def test_families_are_structures_and_laws():
    words = {"a": ("stack",), "b": ("stack", "redundant")}
    made = [record(case, "x", 1.0, 1e-7) for case in "ab"]
    assert list(report.group_cases_by_family(records_of(*made, structure=words))) == ["stack", "redundant"]
    alone = records_of(made[0], structure={"a": ("stack", "redundant", "friction")})
    assert report.group_cases_by_family(alone) == {"stack / redundant / friction": ["a"]}
    two_laws = records_of(*made, law={"b": "coulomb"})
    assert report.group_cases_by_family(two_laws) == {"stack, coulomb": ["b"], "stack, lcp": ["a"]}


def test_claims_failures_and_spreads():
    found = records_of(
        record("a", "x", 1.0, 1e-7), record("a", "x", 1.0, 1e-2, **FALSE_CLAIM),
        record("a", "y", math.nan, math.inf, status="CRASHED (SIGSEGV)", claims=False, success=False, message="died"),
        record("a", "z", 1.0, 1e-5, status="ROUNDOFF_LIMIT", roundoff_floor=1e-5),  # excused
        record("a", "w", 1.0, math.inf, status="INFEASIBLE", roundoff_floor=math.nan, success=False,
               worst_name="row 3"),
        *(record("a", "x", 1.0, r, order=o, **BUDGET) for o, r in (("given", 1e-2), ("reverse", 4e-2))),
    )  # fmt: skip
    by = {c.solver: c for c in report.count_claims(found)}
    assert (by["x"].claims, by["x"].wrong) == (2, 1)
    assert (by["y"].crashed, by["y"].attempted, by["y"].reached) == (1, 1, 0)
    # If a run was repeated alternately, the first run counts; a run with a time limit is always interleaved.
    for mode, wrong in (("tol", 1), ("time", 2)):
        more = records_of(
            *found, record("a", "x", 1.0, 1e-2, mode=mode, interleave_group="one", **FALSE_CLAIM)
        )
        assert next(c.wrong for c in report.count_claims(more) if c.solver == "x") == wrong
        assert sum(bool(f.status_conflict) for f in report.list_failures(more)) == wrong
    failed = [(f.solver, f.status) for f in report.list_failures(found)]
    assert failed == [("x", "CONVERGED"), ("y", "CRASHED (SIGSEGV)"), ("w", "INFEASIBLE")]
    (spread,) = report.compute_order_spreads(found)
    assert (spread.budget, spread.worst_to_best_ratio) == (8, 4.0)
    assert (
        statistics.Spread(
            "a", "x", 8, {"given": 1e-16, "reverse": 4e-15}, roundoff_floor=2e-15
        ).worst_to_best_ratio
        == 2.0
    )


def test_the_table_of_claims_explains_different_numbers_of_runs():
    found = records_of(
        record("a", "direct", 1.0, 1e-7), record("a", "newton", 1.0, 1e-7), record("a", "newton", 1.0, 1e-4, tol=1e-3),
        record("a", "pgs", 1.0, 1e-7), record("a", "pgs", 1.0, 1e-4, tol=1e-3), record("a", "pgs", 1.0, 1e-2, **BUDGET),
        record("a", "auto", 1.0, 1e-7, mode="time", interleave_group="one"),
    )  # fmt: skip
    text = table_specs.explain_run_counts(found)
    assert "Exact solvers are run to 1e-6 alone: direct." in text
    assert "Solvers that cannot stop after any iteration have no budgets: auto, direct, newton." in text
    assert "runs with a time limit: auto." in text and "does not accept" not in text
    found.add(bench.Skip("run", "a", "sor", "takes laws linear"))
    assert "A solver has no runs on problems that it does not accept." in table_specs.explain_run_counts(
        found
    )


def test_changes_beyond_noise_are_named():
    old = records_of(
        record("a", "x", 1.0, 1e-7), record("a", "y", 1.0, 1e-7), record("a", "z", 1.0, 1e-2, success=False),
        record("a", "w", 1.0, 1e-7), record("a", "v", 1.0, 1e-7, time_median=1.5), record("b", "x", 1.0, 1e-7),
    )  # fmt: skip
    new = records_of(
        record("a", "x", 3.0, 1e-7), record("a", "y", 1.1, 1e-7), record("a", "z", 1.0, 1e-7),
        record("a", "w", 1.0, 1e-4, success=False), record("a", "v", 1.9, 1e-7),
    )  # fmt: skip
    found = {c.solver: c for c in statistics.compare_times(old, new) if c.tolerance == 1e-6}
    kinds = {"x": "slower", "y": "same", "z": "reached", "w": "lost", "v": "same"}
    assert {s: c.kind for s, c in found.items()} == kinds
    assert found["v"].noise == 2.0  # its repeats spread by half
    # A case whose numbers have changed is not compared.
    changed = records_of(record("a", "x", 3.0, 1e-7))
    changed.add(info("a", sha="another"))
    assert statistics.compare_times(old, changed) == []


def test_a_slower_machine_is_no_slower_code():
    old = records_of(*(record("a", solver, 1e-3, 1e-7, calibration_time=1e-4) for solver in ("pgs", "auto")))
    slower = [dataclasses.replace(r, time_min=1.6 * r.time_min) for r in old]
    by = [dataclasses.replace(r, calibration_time=1.6 * r.calibration_time) for r in slower]
    assert {c.kind for c in statistics.compare_times(old, records_of(*by))} == {"same"}
    assert {c.kind for c in statistics.compare_times(old, records_of(*slower))} == {"slower"}
    assert statistics.compute_machine_drift(old, records_of(*by)) == pytest.approx(1.6)


@pytest.fixture(scope="module")
def measured():
    return bench.run(["stack(n=6)"], ["auto", "osqp"], bench.Plan(tolerances=(1e-6,), budgets=(), repeats=2))


def test_backends_have_the_time_of_their_own_interface_too(measured):
    (osqp,) = statistics.compare_backend_times(measured)
    (r,) = (r for r in measured if r.solver == "osqp")
    assert 0.0 < r.backend_time_min < r.time_min
    assert (osqp.solver, osqp.solved) == ("osqp", 1)
    assert (osqp.backend_time, osqp.total_time) == (
        pytest.approx(r.backend_time_min),
        pytest.approx(r.time_min),
    )


def test_each_run_has_the_load_of_the_machine_and_a_row_of_the_frame(measured):
    assert all(r.load is None or r.load >= 1.0 for r in measured)  # this process at least
    assert sys.platform != "linux" or not any(r.load is None for r in measured)
    pytest.importorskip("pandas", reason="a frame needs pandas (extra: frame)")
    assert measured.frame()["relative"].tolist() == [r.relative for r in measured]
