"""Scaled copies of programs with an exactly known solution (`benchmarks/programs.py` runs more seeds and backends)."""

import numpy as np
import pytest
from calls import installed

import lavender as lv
from benchmarks.programs import is_right, list_copies, list_programs, run_backend

BASES = list(list_programs(3))
BY_NAME = {base.name: base for base in BASES}


@pytest.mark.parametrize(
    "name", installed("osqp", "clarabel", "piqp", "proxqp", "daqp", "quadprog", "highs", "scs")
)
@pytest.mark.parametrize("half", [0, pytest.param(1, marks=pytest.mark.nightly)])
def test_backend_solves_scaled_copies_and_makes_no_false_claim(name, half):
    bases = BASES[half::2]
    counts, failures = run_backend(name, bases)
    assert counts["solves"] == 13 * sum(base.x is not None for base in bases) >= 13 * 6
    assert counts["right and found"] >= 0.99 * counts["solves"], failures
    for column in (
        "wrong and found",
        "false INFEASIBLE or UNBOUNDED",
        "found differs from CONVERGED",
        "contradicted",
    ):
        assert counts[column] == 0, failures
    assert counts["not proved"] == 0, failures


def test_auto_solves_scaled_copies():
    counts, failures = run_backend("auto", BASES)
    assert counts["right and found"] == counts["solves"] and counts["proved"] == 26, failures


@pytest.mark.parametrize(
    "base", [base for base in BASES if base.kind == "x"], ids=lambda base: base.name
)
def test_solve_qp_error_is_the_same_in_all_units(base):
    """Errors are equal up to the rounding that the judge subtracts, which depends on the scales of the variables."""
    wrong = base.x + 1e-3 * np.random.default_rng(0).normal(size=len(base.x))
    errors = []
    for _, arrays, convert in list_copies(base.arrays, 0):
        qp = lv.Problem.from_qp(**arrays).qp
        x = wrong / convert(np.ones(len(wrong)))
        errors.append(float(qp.judge(x, np.zeros(len(qp.target)))[0]))
    np.testing.assert_allclose(errors, errors[0], rtol=1e-10)
    assert errors[0] > 1e-6 and not is_right(base, wrong)


@pytest.mark.parametrize(
    ("arrays", "x"),
    [
        # A row that another variable of 1e9 could hide.
        ({"P": np.eye(2), "q": [0.0, -1e9], "G": [[-1.0, 0.0]], "h": [-1.0]}, [0.0, 1e9]),
        # A placeholder bound as the only row with a side.
        ({"P": np.zeros((1, 1)), "q": [1.0], "lb": [0.0], "ub": [1e9]}, [-0.5]),
        ({"P": np.eye(1), "q": [0.0], "lb": [-1e9], "ub": [1e9]}, [0.5]),
        # A small coefficient in a row gives a variable a large size, another row a small one.
        (
            {
                "P": np.zeros((3, 3)),
                "q": np.zeros(3),
                "A": [[1.0, 1e-12, 0.0], [0.0, 1.0, 1.0]],
                "b": [1.0, 5.0],
                "lb": [0.0, 0.0, 0.0],
            },
            [1.0, -1e3, 1005.0],
        ),
        # A block of the cost of 1e-9 beside one of 1e9.
        ({"P": np.diag([1e9, 1e-9]), "q": [-1e9, -1e-9]}, [1.0, 0.0]),
    ],
)
def test_judge_of_programs_accepts_no_wrong_point(arrays, x):
    problem = lv.Problem.from_qp(**arrays)
    multipliers = np.zeros(len(problem.qp.target))
    assert problem.qp.judge(np.array(x, float), multipliers)[0] > 1e-3
    assert lv.solve_qp(problem, tol=1e-6).found


def test_solve_qp_with_new_vectors_has_the_answer_of_a_new_program():
    base = BY_NAME["rank 3"].arrays
    problem = lv.Problem.from_qp(**base)
    for name in ("auto", *installed("osqp", "daqp")):
        q = 1.5 * base["q"]
        h = base["h"] + 0.25
        here = lv.solve_qp(problem, q=q, h=h, solver=name)
        there = lv.solve_qp(lv.Problem.from_qp(**(base | {"q": q, "h": h})), name)
        assert here.found and here.x.tobytes() == there.x.tobytes()
    definite = BY_NAME["definite"].arrays
    here = lv.solve_qp(lv.Problem.from_qp(**definite), q=2.0 * definite["q"], tol=1e-9)
    there = lv.solve_qp(**(definite | {"q": 2.0 * definite["q"]}))
    np.testing.assert_allclose(here.x, there.x, rtol=1e-9)


def test_solve_qp_of_an_exact_answer_at_tol_zero_is_found():
    answer = lv.solve_qp(lv.Problem.from_qp(2.0 * np.eye(2), [-2.0, -4.0], ub=[0.5, 9.0]), tol=0.0)
    assert answer.error == 0.0 and answer.found and answer.solution.status is lv.Status.CONVERGED
    assert "ill-conditioned" not in str(answer.solution)


EDGE_CASES = [
    ("CONVERGED", {"P": np.zeros((0, 0)), "q": []}),
    ("CONVERGED", {"P": np.zeros((2, 2)), "q": [0.0, 0.0]}),
    ("CONVERGED", {"P": None, "q": [-1.0, -2.0], "G": [[1.0, 1.0]], "h": [1.0], "lb": [0.0, 0.0]}),
    ("CONVERGED", {"P": np.eye(2), "q": [1.0, 1.0], "lb": [1.0, 2.0], "ub": [1.0, 2.0]}),
    ("CONVERGED", {"P": np.eye(3), "q": [1e12, -1e12, 1.0], "lb": [-1.0] * 3, "ub": [1.0] * 3}),
    ("UNBOUNDED", {"P": np.zeros((2, 2)), "q": [1.0, 0.0]}),
    ("UNBOUNDED", {"P": np.diag([1.0, 0.0]), "q": [1.0, 1.0]}),
    (
        "INFEASIBLE",
        {
            "P": np.diag([1.0, 0.0]),
            "q": [1.0, -1.0],
            "G": [[1.0, 0.0], [-1.0, 0.0]],
            "h": [-1.0, -1.0],
        },
    ),
    ("INFEASIBLE", {"P": np.eye(2), "q": [1.0, 1.0], "G": [[0.0, 0.0]], "h": [-1.0]}),
]


@pytest.mark.parametrize(("status", "arrays"), EDGE_CASES)
def test_programs_at_the_edges_have_one_verdict(status, arrays):
    names = (
        "osqp",
        "clarabel",
        "piqp",
        "daqp",
        "quadprog",
        "highs",
        "scs",
        "qpalm",
        "cvxopt",
        "ecos",
    )
    for name in ("auto", *(name for name in names if lv.registry.specs()[name].missing() is None)):
        answer = lv.solve_qp(**arrays, solver=name, tol=1e-6)
        assert answer.solution.status.name == status, (name, str(answer))
        assert (
            answer.found == (status == "CONVERGED") == (answer.error <= 1e-6 and answer.ray is None)
        ), name
