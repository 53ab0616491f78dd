"""What no solver can talk the judge into: claims need finite numbers, and the problem is out of its reach."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from calls import says
from random_problems import CONTACTS, GIVEN, arrays_of, random_contact_problem, random_lcp

import lavender as lv
from lavender import registry

# Worked out anew at each call, and the caller's own.
ANEW = {
    "contact_rows",
    "friction_rows",
    "normal_rows",
    "n_tangents",
    "n_together",
    "separate_rows",
    "spin_rows",
    "rolling_rows",
    "friction_coefficient",
    "coefficients",
    "stretch",
    "parents",
    "block_bodies",
    "is_contact",
    "is_box",
    "is_ellipse",
}


def test_solver_without_progress_is_stopped_as_stalled(plug_in):
    name = plug_in(
        lambda problem, impulse: says(lv.Status.MAX_ITERATIONS).__class__(
            lv.Status.MAX_ITERATIONS, 0
        ),
        resumable=True,
    )
    solution = lv.solve(random_lcp(5), name, max_iter=10**9)
    assert solution.status is lv.Status.STALLED
    assert "none of the" in solution.message


def given_by(form):
    return GIVEN[form](random_contact_problem(7))


@pytest.mark.parametrize("form", GIVEN)
def test_every_array_of_a_problem_is_read_only(form):
    problem = given_by(form)
    lv.solve(problem, "pgs", max_iter=3)
    found = arrays_of(problem, "problem", set())
    kept = [(name, array) for name, array in found if name.rpartition(".")[2] not in ANEW]
    names = {name for name, _ in kept}
    assert {"problem.b", "problem.csr.data", "problem.csr_data.d", "problem.cones.lower"} <= names
    assert ("problem.jacobian.data" in names) == (form in ("rows", "J and M"))
    assert [name for name, array in kept if array.flags.writeable] == []
    for matrix in (problem.csr, problem.delassus()):
        data = matrix.data if sp.issparse(matrix) else matrix
        with pytest.raises(ValueError, match="read-only"):
            data[...] = 0.0


def test_claim_with_a_residual_of_another_problem_is_contradicted(plug_in):
    from lavender.judge.residuals import judge_impulse

    def run(problem, impulse):
        easy = lv.Problem.lcp(problem.delassus(), np.zeros(problem.m) - 1.0)
        impulse[:] = 0.0
        return replace(says(lv.Status.CONVERGED), judged=judge_impulse(easy, impulse.copy()))

    problem = random_lcp(9)
    solution = lv.solve(problem, plug_in(run))
    assert solution.claim_check == "contradicted"
    np.testing.assert_array_equal(solution.residual.slack, -problem.b)


def test_infeasible_rows_leave_impulses_of_other_rows(plug_in):
    """The largest velocity error is that of rows that cannot be met; it chose the zero impulse for all."""

    def run(problem, impulse):
        impulse[:] = [
            *np.full(10, 0.1),
            0.0,
            0.1,
        ]  # the last two rows are off by 1.1 and 0.9, 1 each at rest
        return lv.Claim(lv.Status.INFEASIBLE, 1, certificate=np.array([*np.zeros(10), 1.0, 1.0]))

    contradicting = np.array([[1.0, -1.0], [-1.0, 1.0]])
    a = np.block([[np.eye(10), np.zeros((10, 2))], [np.zeros((2, 10)), contradicting]])
    solution = lv.solve(lv.Problem.lcp(a, [*np.full(10, 0.1), 1.0, 1.0]), plug_in(run))
    assert solution.status is lv.Status.INFEASIBLE and solution.claim_check == "confirmed"
    np.testing.assert_array_equal(solution.impulse[:10], 0.1)


def test_lemke_ray_on_a_solvable_problem_is_stalled():
    """A solution of at most 0.2 N s exists: a small lower bound on all solutions does not mean contradicting rows."""
    m = [
        [0.0, 0.0, 30.0, 25.0],
        [0.0, 0.0, 10.0, 5.0],
        [25.0, 25.0, 0.0, 0.0],
        [15.0, 5.0, 0.0, 0.0],
    ]
    problem = lv.Problem.lcp(m, np.ones(4))
    lost = lv.solve(problem, "lemke")
    assert lost.status is lv.Status.STALLED and lv.solve(problem).success
    assert "secondary ray" in lost.message and "at least" not in lost.message
    nearly = lv.solve(
        lv.Problem.lcp([[1.0, -1.0], [-1.0, 1.0 + 1e-6]], [1.0, 1.0]), "pgs", max_iter=100
    )
    assert nearly.impulse_bound is None or "at least" in nearly.message


#: What a solver may return in place of the answer, of (problem, answer): each with a claim of success.
LIARS = {
    "constant": lambda p, x: np.full(p.m, 1000.0),
    "runs away": lambda p, x: np.full(p.m, 1e18),
    "clamp forgotten": lambda p, x: np.linalg.lstsq(p.dense(), p.b, rcond=None)[0],
    "sign flipped": lambda p, x: -x,
    "one row wrong": lambda p, x: x * np.where(np.arange(p.m) == np.abs(x).argmax(), 1.01, 1.0),
    "stops early": lambda p, x: (1.0 - 1e-4) * x,
}


def laws():
    """One problem of rows for every law."""
    free = random_contact_problem(31, contacts=0, joints=9)
    ends = np.full(free.m, np.inf)
    yield replace(free, cones=replace(free.cones, lower=-ends, upper=ends))
    yield random_contact_problem(32, tangents=0, spin=False)
    yield from (make(33, law) for make in CONTACTS.values() for law in ("coulomb", "cone"))


@pytest.mark.parametrize("form", GIVEN)
@pytest.mark.parametrize("status", [lv.Status.CONVERGED, lv.Status.ROUNDOFF_LIMIT])
def test_false_claim_in_every_form_and_law_is_contradicted(form, status, plug_in):
    """A matrix is what docs/plugin.md shows; that A was formed of bodies, or of J and M, excuses rounding alone."""
    seen = set()
    for rows in laws():
        problem = GIVEN[form](replace(rows, compliance=rows.compliance + 0.3))
        answer = lv.solve(problem, tol=1e-12)
        assert answer.residual.relative <= 1e-11
        seen.add(problem.law)
        for name, lie in LIARS.items():
            if problem.law == "linear" and name == "clamp forgotten":
                continue  # nothing is to be clamped: this is the answer
            told = lie(problem, answer.impulse)

            def run(_, impulse, told=told):
                impulse[:] = told
                return says(status)

            liar = plug_in(
                run,
                operators={"matrix"},
                supports_rolling=True,
                box_friction_laws={"coulomb", "cone"},
            )
            solution = lv.solve(problem, liar)
            assert solution.claim_check == "contradicted", (problem, name, str(solution))
    assert seen == {"linear", "lcp", "coulomb", "cone"}


HIDDEN = lv.Problem.lcp(
    [[1.0, -3.0], [-3.0, 9.0]], [1.0, 0.0], [-2.0, -np.inf]
)  # b is not in A's range


def along(ray, b, mu):
    """Two contacts along one ray, which no impulse meets both: larger ones only cost more digits."""
    return lv.Problem.contact(np.outer(ray, ray), b, mu)


RUNAWAYS = {
    "b is not in the range of A": HIDDEN,
    "sweeps run away until A lambda - b rounds to 0": along(
        [-0.1, 2.6, 0.7, 1.4], [1.5, 0.0, -1.6, -0.1], [0.8, 0.5]
    ),
    "every row pulls": along([-0.2, -0.7, 0.6, 2.0], [0.2, -1.1, 1.4, -1.9], [0.3, 0.6]),
}


@pytest.mark.parametrize("problem", RUNAWAYS.values(), ids=RUNAWAYS)
@pytest.mark.parametrize("name", lv.available(external=False))
def test_unsolvable_problem_with_growing_impulses_is_not_accepted(name, problem):
    if registry.get(name).refuses(problem) is not None:
        return
    for budget in (
        {},
        {"tol": 1e-9},
        {"max_iter": 20_000},
    ):  # one that was used up in vain asks for a proof, too
        solution = lv.solve(problem, name, **budget)
        assert (
            not solution.success
            and solution.claim_check == "confirmed"
            and not solution.residual.at_floor
        )
        assert solution.status not in (lv.Status.ROUNDOFF_LIMIT, lv.Status.CONVERGED)
        if solution.status is not lv.Status.INFEASIBLE:
            with pytest.raises(lv.errors.SolveFailed):
                solution.raise_for_status()
        if name == "auto":
            assert solution.status is lv.Status.INFEASIBLE
            assert solution.iterations <= budget.get("max_iter", np.inf)
