"""Extreme but valid input of the core: dust, and problems whose numbers are near the limits.

The claims are compared with the judge in long double (`judge_twin`).
"""

import hashlib
import json
import math
import multiprocessing
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
from extreme_problems import SPECIAL, build_problem, plain_data, problem_data
from hostile_problems import draw_problem
from hypothesis import given, reject
from judge_twin import Problem
from random_problems import random_lcp, seeds

import lavender as lv


@pytest.mark.parametrize("form", ["A", "J and M"])
def test_row_below_the_smallest_entry_is_solved_as_an_empty_row(form):
    """Its d is that of the other rows, and nothing is divided by its entry."""
    dust = 1e-61
    if form == "A":
        problem = lv.Problem([1.0, 0.0], lv.Cones.free(2), np.diag([1.0, dust]))
    else:
        problem = lv.Problem.from_jacobian(
            np.diag([1.0, dust]), np.eye(2), [0.0, 0.0], target=[1.0, 0.0], cones=lv.Cones.free(2)
        )
    assert problem.metric.empty.tolist() == [1] and problem.d.tolist() == [1.0, 1.0]
    assert lv.solve(problem, "auto").success
    solution = lv.solve(problem.updated(b=[1.0, 1.0]), "auto")
    assert not solution.success or solution.residual.relative <= 1e-6
    assert solution.status is not lv.Status.INFEASIBLE or solution.claim_check == "confirmed"


# Numbers whose exponents are below this are far from the ends of float64, so that both judges give the same.
MODERATE = 90.0
# 10 n times the condition number of M, above which float64 cannot give all digits of the judge in long double.
ILL_CONDITIONED = 1e14
ORDERS = ("given", "reverse", "symmetric", "random", "bottom_up", "top_down", "colored", "local")
STARTS = ("finite", "special", "none", "none")


@st.composite
def solve_cases(draw):
    """A problem, a solver (one in ten of another package) and options."""
    data = draw(problem_data())
    try:
        problem = build_problem(data)
    except lv.InputError:
        reject()
    own, external = (lv.available(problem, external=other) for other in (False, True))
    name = draw(st.sampled_from(external if external and draw(st.integers(0, 9)) == 9 else own))
    if len(data["cones"]["kind"]) > 10 and draw(st.booleans()):
        name = "auto"  # it solves each island by itself
    spec = lv.get(name)
    rng = np.random.default_rng(draw(seeds))
    options = {"tol": draw(st.sampled_from((1e-6, 1e-6, 1e-9, 1e-12, 1e-3, 0.0, 1e-300, 2.0)))}
    options["max_iter"] = draw(st.sampled_from((1, 2, 20, 50, 200, spec.max_iter)))
    start = draw(st.sampled_from(STARTS))
    if start != "none":
        numbers = (
            rng.normal(size=problem.m) if start == "finite" else rng.choice(SPECIAL, problem.m)
        )
        options["impulse"] = numbers.tolist()
    if spec.order and draw(st.booleans()):
        options["order"] = draw(st.sampled_from(ORDERS))
    if spec.history and draw(st.integers(0, 19)) == 19:
        options["history"] = True
    if draw(st.integers(0, 49)) == 49:
        options["time_limit"] = draw(st.sampled_from((0.0, 1e-6, 1e-3, 1.0)))
    case = {"problem": data, "solver": name, "options": options}
    if (
        not spec.external and "time_limit" not in options
    ):  # Repeating others' solvers is their own affair.
        how = draw(st.sampled_from(("once", "once", "again", "prepared", "many")))
        case |= {"again": how == "again", "prepared": how == "prepared"}
        if how == "many":
            count = draw(st.integers(0, 3))
            case["others"] = rng.choice(SPECIAL, (count, problem.m)).tolist()
            case["threads"] = draw(st.integers(1, 2))
    return case


def bits(solution):
    """Return everything that must be the same in a second run."""
    r = solution.residual
    numbers = np.array([r.relative, r.energy, r.velocity, r.roundoff_floor])
    return (
        solution.impulse.tobytes(),
        solution.slack.tobytes(),
        numbers.tobytes(),
        solution.status.name,
        solution.iterations,
        tuple(sorted(solution.work.items())),
    )


def hash_of(problem):
    """Return a hash of everything that a solver could have changed."""
    digest = hashlib.sha256()
    c = problem.cones
    arrays = [
        problem.b,
        problem.d,
        problem.guess,
        c.ptr,
        c.kind,
        c.lower,
        c.upper,
        c.mu,
        c.patch_radius,
        c.rolling,
    ]
    matrices = (
        [problem.csr]
        if problem.generalized is None
        else [problem.jacobian, problem.generalized.mass]
    )
    for matrix in matrices:
        arrays += (
            [matrix.indptr, matrix.indices, matrix.data] if hasattr(matrix, "indptr") else [matrix]
        )
    for x in arrays:
        digest.update(b"" if x is None else np.ascontiguousarray(x).tobytes())
    return digest.digest()


def check_case(case):
    """Solve a case, compare its claims with the judge in long double, and repeat it in every other way it names."""
    problem = build_problem(case["problem"])
    name = case["solver"]
    options = case["options"]
    before = hash_of(problem) if case.get("again") else None
    try:
        if case.get("prepared"):
            mine = {k: v for k, v in options.items() if k == "order"}
            rest = {k: v for k, v in options.items() if k != "order"}
            prepared = lv.prepare(problem, name, **mine)
            first = prepared.solve(**rest)
            solution = prepared.solve(problem, **rest)
            assert bits(first) == bits(solution)
        else:
            solution = lv.solve(problem, name, **options)
    except lv.InputError:
        assert options.get("time_limit") == 0.0, "a valid problem was rejected later"
        return
    check_claims(case["problem"], problem, solution, options)
    if "others" in case:
        check_many(case, problem, solution)
    if case.get("again"):
        assert hash_of(problem) == before, "the solver changed its problem"
        assert bits(lv.solve(build_problem(case["problem"]), name, **options)) == bits(solution)


def check_many(case, problem, solution):
    """Solve the same structure with other b in one call, and one by one."""
    options = dict(case["options"])
    others = []
    start = options.pop("impulse", None)
    for b in case["others"]:
        try:
            others.append((b, problem.updated(b=np.array(b, float))))
        except lv.InputError:
            continue  # Its numbers are out of range.
    problems = [problem, *(other for _, other in others)]
    starts = None if start is None else [start] * len(problems)
    solutions = lv.solve_many(
        problems, case["solver"], impulses=starts, threads=case["threads"], **options
    )
    assert bits(solutions[0]) == bits(solution)
    for (b, other), one in zip(others, solutions[1:], strict=True):
        assert bits(lv.solve(other, case["solver"], **case["options"])) == bits(one)
        check_claims(case["problem"] | {"b": b}, other, one, case["options"])


def check_claims(data, problem, solution, options):
    """Compare status, success and numbers of a solution with the judge in long double."""
    spec = lv.get(solution.solver.name)
    status = solution.status.name
    r = solution.residual
    budget = options.get("max_iter", spec.max_iter)
    if not spec.external:  # Those count in their own way.
        assert solution.iterations <= budget
        assert solution.claim_check == "confirmed", solution.status_conflict
    if status == "MAX_ITERATIONS" and solution.tol == 0.0 and spec.resumable:
        assert solution.iterations == budget
    is_finite = bool(np.isfinite(solution.impulse).all())
    assert is_finite or status in ("DIVERGED", "NUMERICAL_ERROR")
    assert not any(
        math.isnan(getattr(r, name))
        for name in ("relative", "energy", "velocity", "roundoff_floor")
    )
    try:
        solution.raise_for_status()
        accepted = True
    except lv.SolveFailed:
        accepted = False
    twin = Problem(data)
    if status == "INFEASIBLE" and solution.claim_check == "confirmed":
        assert not solution.success and solution.certificate is not None
        assert twin.refutes(solution.certificate) is None
    j = twin.judge(solution.impulse)
    if j.nothing or twin.d_edge or twin.of_factor > ILL_CONDITIONED:
        return
    slop = 1.0 + 1e-6
    unrefined = min(
        j.unrefined, 0.1 * max(solution.tol, j.relative)
    )  # A pass of this accuracy is not refined.
    within = solution.tol * slop + j.allowed + unrefined
    floor = (
        2.0 * max(j.roundoff_floor, min(r.roundoff_floor, j.floor_most)) * slop
        + j.allowed
        + unrefined
    )
    confirmed = solution.claim_check == "confirmed"
    numbers = (
        f"relative {r.relative:.3e}, floor {r.roundoff_floor:.3e}, in long double {j.relative:.3e}"
    )
    if solution.success or (status == "CONVERGED" and confirmed):
        assert j.relative <= within, numbers
    if (status == "ROUNDOFF_LIMIT" and confirmed) or accepted:
        assert j.relative <= max(within, floor), numbers
    if status == "ROUNDOFF_LIMIT" or (accepted and not solution.success):
        # Of rows with b = 0 in an island that nothing else acts on, the floor has no scale.
        assert r.relative <= 1e-5 and (math.isfinite(r.roundoff_floor) or r.relative == 0.0), (
            numbers
        )
    # A judge that reports a floor above 1e-5 accepts nothing: it says that float64 cannot measure this impulse.
    if is_finite and j.range < MODERATE and not r.relative <= r.roundoff_floor > 1e-5:
        both_infinite = (
            r.relative == j.relative == math.inf
        )  # Zero impulses solve the problem, these do not.
        assert (
            both_infinite
            or abs(r.relative - j.relative) <= 1e-6 * j.relative + j.allowed + unrefined
        ), numbers
        d = np.array(twin.d, float)
        rounding = (
            1e-6 + float(twin.of_factor) * 2.0**-53
        )  # The second term is that of the factor of M.
        assert abs(problem.disk.d - d).max(initial=0.0) <= rounding * d.max(initial=0.0)


@pytest.mark.fuzz
@pytest.mark.filterwarnings("error")
@given(case=solve_cases())
def test_claims_about_extreme_problems_hold_in_long_double(case):
    try:
        check_case(case)
    except (lv.CapabilityError, lv.SolverUnavailable):
        reject()  # an order or an option that this solver does not have for this problem


MEASURES = ("kinetic", "energy", "speed", "spin", "rows")


@pytest.mark.fuzz
@pytest.mark.filterwarnings("error")
@given(data=problem_data(), exponent=st.integers(-1070, 1020))
def test_motion_errors_and_ranks_of_extreme_problems_are_numbers(data, exponent):
    """A motion error is finite, or its `note` has the reason."""
    try:
        problem = build_problem(data)
    except lv.InputError:
        reject()
    for impulse in (np.full(problem.m, 2.0**exponent), lv.solve(problem).impulse):
        if not np.isfinite(impulse).all():
            continue
        error = lv.motion_error(problem, impulse)
        values = {name: getattr(error, name) for name in MEASURES}
        assert [
            name for name, value in values.items() if value is not None and not np.isfinite(value)
        ] == []
        assert error.relative is None or np.isfinite(error.relative) or error.note
        assert str(error)
    if problem.m and problem.is_symmetric:
        result = lv.redundancy(problem)
        assert 0 <= result.rank == problem.m - len(result.rows)


FOUND = [
    json.loads(line)
    for line in Path(__file__).with_name("found_problems.jsonl").read_text().splitlines()
]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("case", FOUND, ids=[case["name"] for case in FOUND])
def test_problems_that_once_had_false_claims_stay_fixed(case):
    check_case(case["spec"])


def check_hostile_solves(first, last):
    """Solve the drawn problems `first` to `last` with a drawn solver and start, and compare the claims."""
    for seed in range(first, last):
        problem = draw_problem(seed)
        rng = np.random.default_rng(seed)
        name = str(
            rng.choice(
                [n for n in lv.available(problem) if lv.get(n).builtin and not lv.get(n).external]
            )
        )
        options = {"tol": float(rng.choice([1e-3, 1e-6, 1e-9, 1e-12]))}
        if rng.random() < 0.3:
            options["max_iter"] = int(rng.integers(1, 60))
        start = (
            None
            if rng.random() < 0.6
            else rng.choice([1e-3, 1.0, 1e3]) * rng.standard_normal(problem.m)
        )
        try:
            solution = lv.solve(problem, name, impulse=start, **options)
            check_claims(plain_data(problem), problem, solution, options)
        except Exception:
            print(f"seed {seed}, {name}, {options}")
            raise


@pytest.mark.nightly
@pytest.mark.parametrize("part", range(20))
def test_claims_about_hostile_problems_hold_in_long_double_and_every_solve_ends(part):
    """5,000 solves in processes of their own, because a solve that does not end cannot be interrupted."""
    child = multiprocessing.get_context("spawn").Process(
        target=check_hostile_solves, args=(250 * part, 250 * (part + 1))
    )
    child.start()
    child.join(900.0)  # s; a part takes some ten.
    is_over = not child.is_alive()
    child.kill()
    assert is_over and child.exitcode == 0


def test_the_comparison_in_long_double_detects_false_claims():
    problem = random_lcp(3)
    solution = lv.solve(problem, "direct", tol=1e-9)
    data = plain_data(problem)
    options = {"tol": 1e-9}
    check_claims(data, problem, solution, options)

    for changed in (
        {"impulse": solution.impulse * (1.0 + 1e-6)},
        {"impulse": np.full(problem.m, np.nan)},
        {"status": lv.Status.INFEASIBLE, "certificate": np.ones(problem.m)},
        {"iterations": 10**9},
    ):
        false = object.__new__(lv.Solution)
        object.__setattr__(false, "__dict__", solution.__dict__ | changed)
        with pytest.raises(AssertionError):
            check_claims(data, problem, false, options)
