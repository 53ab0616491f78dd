"""What a certificate proves: no solution, or how large the impulses of every solution are."""

from fractions import Fraction

import numpy as np
import pytest
import scipy.sparse as sp
from random_problems import FORMS, as_matrix, general, random_contact_problem, touching
from scipy.optimize import linprog

import lavender as lv
from lavender import registry
from lavender.judge.certificates import (
    check_certificate,
    format_lower_bound,
    list_conflicting_blocks,
    prove_infeasibility,
)

OURS = lv.available(external=False)


def opposed(eps):
    """Two rows that push apart what they hold; eps of softness in the second."""
    return lv.Problem.lcp([[1.0, -1.0], [-1.0, 1.0 + eps]], [1.0, 1.0])


@pytest.mark.parametrize("name", lv.available(opposed(1.0)))
def test_certificate_of_a_definite_matrix_is_rejected(name):
    """Its solution is b.y over the slack: 2e12 N s in each row, which some find, and all others say they miss."""
    problem = opposed(1e-12)
    solution = lv.solve(problem, name)
    assert solution.status is not lv.Status.INFEASIBLE or solution.claim_check != "confirmed"
    if name in OURS:
        assert solution.claim_check == "confirmed"
    if solution.impulse_bound is not None:
        eps = Fraction(1.0 + 1e-12) - 1
        assert 1e12 <= solution.impulse_bound <= 4 / eps + 2  # the sum of (2 / eps + 1, 2 / eps)
        assert "at least" in solution.message
    if name == "newton":
        assert solution.status is lv.Status.STALLED and solution.impulse_bound >= 2e12


@pytest.mark.parametrize("name", ["auto", "direct", "newton", "lemke"])
def test_infeasible_message_names_the_proof(name):
    near = "for data within rounding of yours; for yours every solution has an impulse of at least "
    for eps, words in ((0.0, "no solution, proved"), (2.0**-52, f"no solution {near}")):
        solution = lv.solve(opposed(eps), name)
        assert solution.status is lv.Status.INFEASIBLE and solution.claim_check == "confirmed"
        assert (solution.impulse_bound == np.inf) is (eps == 0.0)
        assert (
            eps == 0.0 or 9e15 <= solution.impulse_bound <= 4.0 / eps + 2.0
        )  # the sum of (2 / eps + 1, 2 / eps)
        assert words in solution.message
    assert lv.solve(opposed(1.0), name).impulse_bound is None


def held(law, soft, form):
    """One body between floor and ceiling that come nearer, by rows of each law."""
    rows = touching([[-1, 0], [-1, 0]], normal=np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    friction = {"friction": law, "tangents": 2, "mu": 0.5} if law in ("coulomb", "cone") else {}
    target = [0.1, 0.0, 0.0] * 2 if friction else 0.1
    problem = lv.Problem.from_rows(rows, target=target, compliance=soft, **friction)
    if law == "linear":  # no contacts: J and M of free rows
        ends = np.full(2, np.inf)
        return lv.Problem.from_jacobian(
            [[1.0], [-1.0]],
            [[1.0]],
            [0.0],
            target=[0.1, 0.1],
            cones=lv.Cones.bounded(-ends, ends),
            compliance=np.full(2, soft),
        )
    return FORMS[form](problem)


@pytest.mark.parametrize("form", ["rows", "J and M"])
@pytest.mark.parametrize("law", ["linear", "lcp", "coulomb", "cone"])
def test_infeasible_is_claimed_of_rigid_and_not_of_soft_rows(law, form):
    """However small R is, it is data: strictly convex problems have a solution, rigid ones here have none."""
    for name in OURS:
        for soft in (2e-18, 6e-16, 1e-12):
            problem = held(law, soft, form)
            if registry.get(name).refuses(problem):
                continue
            solution = lv.solve(problem, name, max_iter=200)
            assert solution.status is not lv.Status.INFEASIBLE, (name, soft, str(solution))
            assert solution.claim_check == "confirmed"
            if solution.impulse_bound is not None:  # of the normals: 0.1 / soft each
                assert 0.0 < solution.impulse_bound <= 0.2 / soft * (1.0 + 1e-9)
        problem = held(law, 0.0, form)
        if registry.get(name).refuses(problem) is None:
            solution = lv.solve(problem, name, max_iter=200)
            assert solution.claim_check == "confirmed" and not solution.success
            if solution.status is lv.Status.INFEASIBLE:
                assert (
                    solution.impulse_bound == np.inf and "no solution, proved" in solution.message
                )
    assert lv.solve(held(law, 0.0, form)).status is lv.Status.INFEASIBLE


@pytest.mark.parametrize("form", ["rows", "J and M"])
@pytest.mark.parametrize("seed", [0, 1, 5, 6, 21, 30])
def test_infeasible_rigid_rows_among_soft_ones_are_found(seed, form):
    """Masses on a line, held two by two; a linear program of the velocities tells which rows can be met at once."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(60, 90)), int(rng.integers(69, 96))
    pair = np.array([rng.choice(n, 2, replace=False) for _ in range(m)], np.int32)
    target = rng.normal(0.0, 0.1, m)
    lower = np.where(rng.random(m) < 0.5, -np.inf, 0.0)
    soft = np.where(rng.random(m) < 0.3, 1e-6, 0.0)  # 1e-9 of d
    jac = np.zeros((m, 12))
    jac[:, 0], jac[:, 6] = 1.0, -1.0
    bodies = np.full(n, 1e3), np.tile(1e3 * np.eye(3), (n, 1, 1)), np.zeros((n, 6))
    rows = lv.Rows(*bodies, jac=jac, joint_ptr=np.arange(m + 1, dtype=np.int32), joint_body=pair)
    problem = lv.Problem.from_rows(
        rows, target=target, lower=lower, upper=np.inf, compliance=soft, mu=0.0
    )
    solution = lv.solve(FORMS[form](problem))

    j = np.zeros((m, n))
    j[np.arange(m), pair[:, 0]], j[np.arange(m), pair[:, 1]] = 1.0, -1.0
    free = lower < 0.0
    rigid = soft == 0.0
    one = rigid & free
    below = rigid & ~free
    met = linprog(
        np.zeros(n),
        A_ub=-j[below],
        b_ub=-target[below],
        A_eq=j[one],
        b_eq=target[one],
        bounds=(None, None),
    )
    assert solution.status is (lv.Status.CONVERGED if met.success else lv.Status.INFEASIBLE), str(
        solution
    )


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("law", ["lcp", "coulomb", "cone"])
def test_impulse_bound_holds_for_every_solution(law, form):
    """(2) for any direction, of problems that are solved."""
    told = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        friction = {"friction": law} if law != "lcp" else {"tangents": 0, "spin": False}
        problem = FORMS[form](random_contact_problem(seed, **friction))
        solution = lv.solve(problem, tol=1e-9)
        if not solution.success:
            continue
        for _ in range(10):
            y = np.zeros(problem.m)
            c = problem.cones
            y[c.normal_rows] = rng.uniform(0.0, 1.0, len(c.normal_rows)) * (
                rng.random(len(c.normal_rows)) < 0.5
            )
            free = np.isneginf(c.lower) & np.isposinf(c.upper) & ~c.contact_rows
            y[free] = rng.normal(size=free.sum())
            found = prove_infeasibility(problem, y)
            assert found.reason or not y.any()
            assert found.impulse_bound <= np.abs(solution.impulse).sum() * (1.0 + 1e-6), seed
            told += found.impulse_bound > 0.0
    assert told > 5


def walking(seed, dust=2.78e-17):
    """A condensed horizon of model-predictive control: M = P, J = -G, target = -h, some rows of G zero."""
    rng = np.random.default_rng(seed)
    n = 16
    state = np.tril(np.cumsum(np.cumsum(np.eye(n), axis=0), axis=0)) * 1e-2
    hessian = state.T @ state + 1e-3 * np.eye(n)
    limits = np.vstack([np.zeros((1, n)), state[:-1]])  # the first step cannot be moved any more
    jac = np.vstack([limits, -limits])
    bound = np.concatenate([0.065 + np.zeros(n), 100.0 + 0.3 * rng.random(n)])
    bound[0] = -dust  # a foot that stands on its border
    free = -np.linalg.solve(hessian, state.T @ rng.normal(size=n))
    cones = lv.Cones.bounded(np.zeros(2 * n), np.full(2 * n, np.inf))
    return lv.Problem.from_jacobian(-jac, hessian, free, target=-bound, cones=cones)


@pytest.mark.parametrize("noise", [0.0, 1e-9, -1e-7])
def test_certificate_with_noise_on_a_soft_row_proves_without_that_row(noise):
    """Two rigid rows of one velocity contradict each other; every certificate is 0 on a soft row."""
    problem = lv.Problem.from_jacobian(
        np.ones((3, 1)),
        [[2.0]],
        [0.0],
        target=[0.0, 1.0, 0.5],
        cones=lv.Cones.free(3),
        compliance=[0.0, 0.0, 0.1],
    )
    assert check_certificate(problem, [-1.0, 1.0, noise]) is None


def test_format_lower_bound_has_one_digit_and_is_never_above_the_bound():
    rng = np.random.default_rng(0)
    for bound in (*10.0 ** rng.uniform(-30.0, 30.0, 200), 9.999, 1.0, 0.95, 1e22):
        text = format_lower_bound(bound)
        assert 0.5 * bound < float(text) <= bound and float(text) == float(f"{float(text):.0e}"), (
            bound,
            text,
        )


def test_proof_names_the_rows_and_the_contacts_that_contradict():
    """A free row holds a velocity at 0, and the normal of a contact requires 1 m/s of it."""
    jac = np.zeros((8, 4))
    jac[[0, 1, 2, 3, 4, 5, 6, 7], [0, 1, 0, 2, 3, 2, 0, 1]] = 1.0
    problem = lv.Problem.from_jacobian(
        jac,
        np.eye(4),
        np.zeros(4),
        target=np.eye(8)[2],
        cones=lv.Cones.free(2) + lv.Cones.contacts(0.5, count=2),
    )
    proof = prove_infeasibility(problem, -np.eye(8)[0] + np.eye(8)[2])
    assert (proof.impulse_bound, proof.message) == (
        np.inf,
        "no solution, proved: row 0 against contact 0",
    )
    assert list_conflicting_blocks(problem, proof.y) == ((0,), (2,))


@pytest.mark.parametrize("law", ["coulomb", "cone"])
@pytest.mark.parametrize("mu", [0.0, 0.5])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_auto_proves_that_opposed_contacts_contradict_in_any_island(law, mu, place):
    """Two contacts push one velocity in opposite directions, and both require it to grow."""
    jac = np.zeros((6, 3))
    jac[[0, 1, 2, 3, 4, 5], [0, 1, 2, 0, 1, 2]] = [1.0, 1.0, 1.0, -1.0, 1.0, -1.0]
    b = np.tile([0.5, 0.1, 0.2, -0.6, 0.1, 0.0], 3)
    b[6 * place : 6 * place + 6] = [1.0, 0.1, 0.2, 0.5, 0.1, 0.0]
    whole = lv.Problem.from_jacobian(
        sp.block_diag([jac] * 3),
        np.eye(9),
        np.zeros(9),
        target=b,
        cones=lv.Cones.contacts(mu, count=6),
        friction=law,
    )
    for problem in (whole, as_matrix(whole)):
        solution = lv.solve(problem)
        assert solution.status is lv.Status.INFEASIBLE and solution.claim_check == "confirmed", str(
            solution
        )
        assert set(np.flatnonzero(solution.certificate)) <= set(range(6 * place, 6 * place + 6))


@pytest.mark.parametrize("name", lv.available(walking(0)))
@pytest.mark.parametrize("form", ["matrix", "J and M"])
def test_row_of_rounding_size_needs_no_impulse(form, name):
    for seed in range(3):
        dusty = walking(seed)
        problem = as_matrix(dusty) if form == "matrix" else dusty
        assert len(problem.metric.empty) and problem.b[0] > 0.0
        solution = lv.solve(problem, name, tol=1e-6)
        clean = lv.solve(
            problem.updated(b=np.where(np.arange(problem.m) == 0, 0.0, problem.b)), name, tol=1e-6
        )
        assert solution.success == clean.success, str(solution)
        assert solution.claim_check == "confirmed"
        if form == "J and M" and name in OURS:  # nor to any tolerance
            assert lv.solve(problem, name, tol=1e-20).status is not lv.Status.INFEASIBLE
    real = walking(0, dust=1e-3)
    assert (
        lv.solve(as_matrix(real) if form == "matrix" else real, name).status is lv.Status.INFEASIBLE
    )


def test_empty_row_of_bodies_of_rounding_size_needs_no_impulse():
    rows = random_contact_problem(3, tangents=0, spin=False).rows
    jac = rows.jac.copy()
    jac[0] = 0.0
    for form in (lambda p: p, as_matrix, general):
        for dust, status in ((1e-17, "CONVERGED"), (1e-2, "INFEASIBLE")):
            target = np.zeros(len(jac) + rows.n_contacts)
            given = lv.Rows(
                **{f: getattr(rows, f) for f in rows.__dataclass_fields__ if f != "jac"}, jac=jac
            )
            target[0] = dust
            problem = form(lv.Problem.from_rows(given, target=target, tangents=0))
            assert lv.solve(problem).status.name == status
