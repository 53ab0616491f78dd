"""What every registered solver owes its user: each capability its spec declares is exercised here."""

import functools
import inspect
import itertools
from dataclasses import replace

import numpy as np
import pytest
from enumeration import enumerate_lcp, random_bounds
from hypothesis import given, settings
from hypothesis import strategies as st
from random_problems import (
    CONTACTS,
    FORMS,
    as_matrix,
    random_contact_problem,
    random_general,
    seeds,
    touching,
)

import lavender as lv
from lavender import registry
from lavender.base.errors import TooLarge
from lavender.judge.certificates import check_certificate
from lavender.problem import LAWS, operators
from lavender.solvers import steps

HERE = [
    pytest.param(name, marks=pytest.mark.slow) if registry.specs()[name].external else name
    for name in lv.available()
]  # no kernel of ours is behind a backend
RESUMABLE = lv.available(resumable=True)
OURS = lv.available(external=False)


@functools.cache
def example(law, rows):
    """A well-behaved problem of that law; the smallest eigenvalue of A is well away from zero."""
    if law == "linear":
        base = random_contact_problem(21, contacts=0, joints=12, bodies=6)
        c = base.cones
        free = lv.Cones(
            c.ptr, c.kind, np.full(c.n_rows, -np.inf), np.full(c.n_rows, np.inf), c.mu, c.patch_radius
        )
        soft = base.compliance + 0.5
        problem = lv.Problem(base.b, free, rows=base.rows, compliance=soft)
    elif law == "lcp":
        base = random_contact_problem(22, tangents=0, spin=False)
        problem = lv.Problem(base.b, base.cones, rows=base.rows, compliance=base.compliance + 0.3)
    else:
        base = random_contact_problem(23, friction=law, tangents=2, spin=False)
        problem = lv.Problem(
            base.b, base.cones, rows=base.rows, compliance=base.compliance + 0.3, friction=law
        )
    assert problem.law == law
    return problem if rows else as_matrix(problem)


def examples(spec):
    """Of each law, given by rows and by A: what it takes."""
    for law in LAWS:
        for rows in (True, False):
            problem = example(law, rows)
            if spec.refuses(problem) is None:
                yield problem


@functools.cache
def samples():
    """(law, kind of block) to a well-behaved problem in each form it can be given in, and the slack all must find."""
    made = {}
    for law in ("linear", "lcp"):
        made[law, "rows"] = [given_by(example(law, True)) for given_by in FORMS.values()]
    for law, (kind, make) in itertools.product(("coulomb", "cone"), CONTACTS.items()):
        base = make(23, law)
        made[law, kind] = [
            given_by(replace(base, compliance=base.compliance + 0.3)) for given_by in FORMS.values()
        ]
    for tangents in (3, 4, 5):
        base = random_general(tangents, "cone", n=12, contacts=4, tangents=tangents)
        made["cone", f"round, {tangents} tangents"] = [base, as_matrix(base)]
    found = {}
    for key, forms in made.items():
        best = min((lv.solve(p, tol=1e-12) for p in forms), key=lambda s: s.residual.relative)
        assert best.residual.relative <= 1e-11, best
        found[key] = forms, best.slack
    return found


# Backends that must solve the easy examples; the others are judged all the same.
TRUSTED = {"osqp", "clarabel", "piqp", "daqp", "clarabel_cone"}


def budget(spec):
    return max(spec.max_iter, 20_000) if spec.resumable else None


@pytest.mark.parametrize("name", HERE)
def test_solves_every_kind_of_block_in_every_form_it_takes(name):
    """A solution, which is the only one in w where the law is convex, and the work that was done."""
    spec, taken, ours = registry.get(name), set(), name in OURS
    for (law, kind), (forms, slack) in samples().items():
        for problem in forms:
            if spec.refuses(problem) is not None:
                with pytest.raises(lv.CapabilityError):
                    lv.solve(problem, name)
                continue
            taken.add(law)
            tol = 1e-8 if ours else 1e-6
            solution = lv.solve(problem, name, tol=tol, max_iter=budget(spec))
            said = f"{law}, {kind}, {problem.operator}: {solution}"
            if ours or (name in TRUSTED and not kind.startswith("round")):
                assert solution.success and solution.claim_check == "confirmed", said
            # Others may fail, and may even be wrong about it: then the result says so.
            assert (
                solution.success or solution.status_conflict or solution.status is not lv.Status.CONVERGED
            ), said
            assert solution.solver.name == name
            assert solution.setup_time >= 0.0 and solution.solve_time > 0.0
            assert sum(solution.work.values()) > 0, "work must show what ran"
            assert solution.iterations > 0 or not spec.resumable, "the start is not a solution"
            np.testing.assert_array_equal(solution.slack, lv.residual(problem, solution.impulse).slack)
            if law != "coulomb" and solution.success:
                # An error e moves w by at most A e: a condition number of some hundreds, and room for it.
                size = np.abs(problem.slack(problem.start())).max()
                np.testing.assert_allclose(solution.slack, slack, atol=1e3 * tol * size, err_msg=said)
    assert taken >= set(spec.laws), "a law that it declares and refuses"


@pytest.mark.parametrize(
    "name", [p for p in HERE if "form" in registry.specs()[getattr(p, "values", [p])[0]].options]
)
def test_every_form_of_a_solver_finds_the_same(name):
    for (law, kind), (forms, slack) in samples().items():
        if kind.startswith("round") or registry.get(name).refuses(forms[0]):
            continue  # round cones have one form
        if kind == "boxes" and law not in registry.get(name).laws:
            continue  # handed on as bounded rows of a matrix
        for form in (
            ("impulse",) if kind == "ellipses" else ("impulse", "velocity")
        ):  # which are solved as a matrix
            tol = 1e-8 if name in OURS else 1e-6
            solution = lv.solve(forms[0], name, tol=tol, form=form)
            assert solution.solver.form.startswith(form)
            assert solution.success or name not in TRUSTED | set(OURS), f"{law}, {kind}: {solution}"
            if solution.success and law != "coulomb":
                size = np.abs(forms[0].slack(forms[0].start())).max()
                np.testing.assert_allclose(solution.slack, slack, atol=1e3 * tol * size)
    with pytest.raises(lv.LavenderError, match="velocity"):
        lv.solve(example("lcp", True), name, form="velocities")


@pytest.mark.parametrize("name", HERE)
def test_an_option_that_is_not_honoured_is_refused(name):
    spec = registry.get(name)
    problem = next(examples(spec))
    with pytest.raises(lv.UnknownName, match="no_such_option"):
        lv.solve(problem, name, no_such_option=1)
    for flag, option in (("order", {"order": "reverse"}), ("seed", {"seed": 3})):
        if not getattr(spec, flag):
            with pytest.raises(lv.CapabilityError, match=flag):
                lv.solve(problem, name, **option)
    if not spec.callback:
        with pytest.raises(lv.CapabilityError, match="callback"):
            lv.solve(problem, name, callback=print)
    if not spec.history:
        with pytest.raises(lv.CapabilityError, match="history"):
            lv.solve(problem, name, history=True)


@pytest.mark.parametrize("name", HERE)
def test_declared_options_are_those_of_the_factory(name):
    spec = registry.get(name)
    parameters = set(inspect.signature(spec.load()).parameters)
    assert spec.accepts <= parameters, f"{sorted(spec.accepts - parameters)} are declared and not taken"
    assert parameters <= spec.accepts, f"{sorted(parameters - spec.accepts)} are taken and not declared"


@pytest.mark.parametrize("name", OURS)
def test_a_budget_is_kept_and_never_leaves_more_than_the_start(name):
    """Of none the start comes back; few iterations are no more than that; without a tolerance all are spent."""
    for problem in examples(registry.get(name)):
        none = lv.solve(problem, name, tol=1e-12, max_iter=0)
        assert (none.status, none.iterations) == (lv.Status.MAX_ITERATIONS, 0)
        assert none.impulse.tobytes() == problem.start().tobytes()
        for n in (1, 3, 8):
            few = lv.solve(problem, name, tol=1e-12, max_iter=n)
            assert few.iterations <= n and few.claim_check == "confirmed"
            # Jacobi, mixing and proximal steps may leave the best of their sweeps for a while.
            assert few.residual.relative <= 1.0 or registry.get(name).resumable
        if registry.get(name).resumable:
            exact = lv.solve(problem, name, tol=0.0, max_iter=5)
            assert (exact.status, exact.iterations) == (lv.Status.MAX_ITERATIONS, 5)
            assert sum(exact.work.values()) >= 5


@pytest.mark.parametrize("name", lv.available(impulse=True))
def test_a_solution_given_back_is_kept(name):
    spec = registry.get(name)
    for problem in examples(spec):
        first = lv.solve(problem, name, tol=1e-9, max_iter=budget(spec))
        if not first.success:
            continue
        again = lv.solve(problem, name, tol=1e-8, impulse=first.impulse)
        assert again.success, again
        if spec.resumable:
            assert again.iterations == 0


@pytest.mark.parametrize("form", ["A", "J and M"])
@pytest.mark.parametrize("name", lv.available(law="cone", impulse=True, external=False))
def test_a_normal_that_moves_nothing_bears_friction_of_the_relaxed_law(name, form):
    """Its row of A is zero, and it separates as it slides: w_n = mu |w_t| > 0 beside lambda_n > 0."""
    b, impulse = [-0.5, 2.0, 0.0], np.array([2.0, 1.0, 0.0])  # w = (0.5, -1, 0) m/s
    if form == "A":
        problem = lv.Problem.contact(np.diag([0.0, 1.0, 1.0]), b, [0.5], friction="cone")
    else:
        problem = lv.Problem.from_jacobian(
            np.eye(3)[:, 1:], np.eye(2), [0, 0], target=b, cones=lv.Cones.contacts([0.5]), friction="cone"
        )
        if registry.get(name).refuses(problem) is not None:
            pytest.skip("takes no J and M")
    kept = lv.solve(problem, name, tol=1e-9, impulse=impulse)
    assert (kept.status, kept.iterations) == (lv.Status.CONVERGED, 0)
    assert kept.impulse.tolist() == impulse.tolist()
    cold = lv.solve(problem, name, tol=1e-9)
    assert cold.success, cold


@pytest.mark.parametrize("name", lv.available(order=True))
def test_orders_change_the_sweep_and_not_the_answer(name):
    spec = registry.get(name)
    problem = next(p for p in examples(spec) if p.law != "coulomb")
    results = {
        o: lv.solve(problem, name, order=o, tol=1e-10, max_iter=20_000)
        for o in ("given", "reverse", "random", "colored")
    }
    assert all(s.success for s in results.values())
    early = {lv.solve(problem, name, order=o, tol=0.0, max_iter=2).impulse.tobytes() for o in results}
    assert len(early) == len(results), "each order sweeps differently"


@pytest.mark.parametrize("name", lv.available(seed=True))
def test_seeds_change_random_sweeps(name):
    problem = next(examples(registry.get(name)))
    x, y, z = (
        lv.solve(problem, name, order="random", seed=s, tol=0.0, max_iter=2).impulse for s in (1, 1, 2)
    )
    assert x.tobytes() == y.tobytes() != z.tobytes()


@pytest.mark.parametrize("name", lv.available(history=True))
def test_history_is_recorded_at_fixed_counts(name):
    problem = next(examples(registry.get(name)))
    solution = lv.solve(problem, name, history=True, tol=0.0, max_iter=40)
    h = solution.history
    assert h.iterations.tolist() == [*range(17), 18, 20, 22, 24, 27, 30, 33, 37, 40]
    assert h.relative[0] == pytest.approx(1.0)
    assert h.relative[-1] == solution.residual.relative
    assert np.all(np.diff(h.time) >= 0.0)
    plain = lv.solve(problem, name, tol=0.0, max_iter=40)
    assert plain.impulse.tobytes() == solution.impulse.tobytes(), "watching changes nothing"


@pytest.mark.parametrize("name", lv.available(callback=True))
def test_a_callback_sees_the_iterate_and_may_stop(name):
    problem = next(examples(registry.get(name)))
    seen = []

    def callback(n, impulse, residual):
        seen.append((n, residual.relative))
        impulse[:] = np.nan  # a copy: the solver does not see this
        return n >= 3

    solution = lv.solve(problem, name, callback=callback, tol=0.0, max_iter=50)
    assert solution.status is lv.Status.INTERRUPTED
    assert [n for n, _ in seen] == [0, 1, 2, 3]
    assert np.isfinite(solution.impulse).all()


@pytest.mark.parametrize("name", RESUMABLE)
def test_time_limit_returns_the_iterate(name):
    problem = next(examples(registry.get(name)))
    lv.solve(problem, name, max_iter=1)  # what it imports is not begun under a limit that is shorter
    solution = lv.solve(problem, name, tol=0.0, max_iter=2**31 - 1, time_limit=0.05)
    assert solution.status is lv.Status.TIME_LIMIT
    assert solution.iterations > 0


def soft_static_contacts():
    """Two contacts of a body that nothing moves: compliance alone makes A = diag(1, 2, 1, 2)."""
    rows = touching([[-1, 0], [-1, 0]], inv_mass=[0.0], inv_inertia=np.zeros((1, 3, 3)))
    return lv.Problem.from_rows(
        rows, [1.0, 2.0, 1.0, -2.0], mu=0.5, tangents=1, compliance=[1.0, 2.0, 1.0, 2.0]
    )


@pytest.mark.parametrize("name", HERE)
def test_legal_oddities_are_solved_or_refused_by_reason(name):
    """0 rows, 1 row, all-static rows, zero rows of A, singular and indefinite A: a result or a CapabilityError."""
    cases = [
        lv.Problem.linear(np.zeros((0, 0)), []),
        lv.Problem.lcp(np.zeros((0, 0)), []),
        lv.Problem.linear([[2.0]], [1.0]),
        lv.Problem.lcp([[2.0]], [1.0]),
        lv.Problem.lcp([[2.0]], [-1.0]),
        lv.Problem.lcp([[-2.0]], [1.0]),
        lv.Problem.lcp(np.diag([1.0, 0.0]), [1.0, -1.0]),
        lv.Problem.lcp(np.diag([1.0, 0.0]), [1.0, 1.0], upper=3.0),
        lv.Problem.lcp(np.ones((3, 3)), [1.0, 1.0, 1.0]),
        lv.Problem.linear(np.ones((3, 3)), [1.0, 1.0, 1.0]),
        lv.Problem.lcp([[0.0, 1.0], [1.0, 0.0]], [1.0, 1.0]),
        lv.Problem.lcp([[-1.0, 2.0], [2.0, -1.0]], [1.0, 1.0]),
        lv.Problem.lcp([[2.0, 1.0], [-1.0, 2.0]], [1.0, 1.0]),
        lv.Problem.contact(np.diag([1.0, 0.0, 0.0]), [1.0, 0.2, 0.1], [0.5]),
        soft_static_contacts(),
    ]
    for problem in cases:
        try:
            solution = lv.solve(problem, name)
        except lv.CapabilityError:
            continue
        assert np.isfinite(solution.impulse).all(), (problem, solution)
        if name in OURS:
            assert solution.claim_check == "confirmed", (problem, solution)
        if problem.m == 0:
            assert solution.success


@pytest.mark.parametrize("name", ["auto", "direct", "lemke", "newton"])
@pytest.mark.parametrize("kind", ["definite", "semidefinite", "asymmetric"])
@given(seed=seeds, m=st.integers(1, 7), whole=st.booleans())
@settings(max_examples=20)
def test_small_bounded_rows_have_the_solution_of_enumeration(name, kind, seed, m, whole):
    """`whole`: small whole numbers, so that w = 0 and lambda = 0 at once. A semidefinite A leaves w alone unique."""
    rng = np.random.default_rng(seed)
    g = rng.normal(size=(m, max(1, m // 2) if kind == "semidefinite" else m + 2))
    skew, b = rng.normal(size=(m, m)), 2.0 * rng.normal(size=m)
    low, high = random_bounds(rng, m)
    if whole:
        g, skew, b = np.rint(g), np.rint(skew), np.rint(b)
        if kind == "semidefinite":  # rows twice: ties at every pivot
            g[m // 2 :] = g[: m - m // 2]
    a = g @ g.T + (0.0 if kind == "semidefinite" else 0.5 * np.eye(m))
    a = a + (skew - skew.T if kind == "asymmetric" else 0.0)
    if kind == "semidefinite":  # what has a solution
        low, high = np.zeros(m), np.full(m, np.inf)
        b = a @ np.maximum(b, 0.0) - np.maximum(skew[0], 0.0)
    solution = lv.solve(lv.Problem.lcp(a, b, low, high), name, tol=1e-9)
    assert solution.success and solution.claim_check == "confirmed", solution
    truth = enumerate_lcp(a, b, low, high)
    assert truth or kind == "semidefinite"
    for x, w in truth:
        if kind == "semidefinite":
            np.testing.assert_allclose(solution.slack, w, atol=1e-6)
        else:
            np.testing.assert_allclose(solution.impulse, x, atol=1e-6)


@pytest.mark.parametrize("name", OURS)
@given(seed=seeds, m=st.integers(1, 6))
@settings(max_examples=30)
def test_any_matrix_a_claim_is_a_solution(name, seed, m):
    """No claim that the judge contradicts, and no proof that there is none where enumeration finds a solution."""
    rng = np.random.default_rng(seed)
    a = np.rint(2.0 * rng.normal(size=(m, m)))
    low, high = random_bounds(rng, m)
    problem = lv.Problem.lcp(a, np.rint(3.0 * rng.normal(size=m)), low, high)
    if registry.get(name).refuses(problem):
        return
    solution = lv.solve(problem, name, tol=1e-9)
    assert solution.claim_check == "confirmed", solution
    assert np.isfinite(solution.impulse).all()
    if solution.status is lv.Status.INFEASIBLE:
        assert not enumerate_lcp(a, problem.b, low, high)


@pytest.mark.parametrize("name", HERE)
@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        ([[0.0, 1.0], [1.0, 2.0]], "row 0 has a zero diagonal"),
        ([[2.0, 3.0], [3.0, -1.0]], "row 1 has a negative diagonal, -1"),
        ([[1.0, 3.0], [3.0, 1.0]], "the residual grew instead of falling"),  # without such an entry
    ],
)
def test_what_was_not_solved_says_why(name, matrix, words):
    """A zero, a negative number on the diagonal of A, and an A that is not definite: sweeps find nothing."""
    for make, second in itertools.product((lv.Problem.linear, lv.Problem.lcp), (1.0, -1.0)):
        problem = make(matrix, [1.0, second])
        if registry.get(name).refuses(problem) is not None:
            continue
        solution = lv.solve(problem, name, tol=1e-6)
        if solution.status in (lv.Status.DIVERGED, lv.Status.STALLED, lv.Status.NUMERICAL_ERROR):
            assert solution.message
        if solution.status is lv.Status.DIVERGED and words.startswith("row"):
            assert words in str(solution)
        if name in ("gauss_seidel", "sor", "jacobi", "pgs") and problem.law == "linear" and second < 0.0:
            assert solution.status is lv.Status.DIVERGED and solution.message.startswith(words)


@pytest.mark.parametrize("name", HERE)
def test_a_row_that_nothing_can_meet_is_infeasible(name):
    problem = lv.Problem.lcp(np.diag([1.0, 0.0]), [1.0, 1.0])
    if registry.get(name).refuses(problem):
        with pytest.raises(lv.CapabilityError):
            lv.solve(problem, name)
        return
    solution = lv.solve(problem, name)
    assert solution.status is lv.Status.INFEASIBLE
    assert "row 1" in solution.message
    assert check_certificate(problem, solution.certificate) is None
    assert solution.claim_check == "confirmed"


BROKEN = [MemoryError("8 GB"), TooLarge("A would have 1e10 entries"), FloatingPointError("1e400")]


@pytest.mark.parametrize("error", [*BROKEN, KeyboardInterrupt()], ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("name", [name for name in OURS if name != "auto"])
def test_what_breaks_down_or_is_stopped_after_the_start_is_a_result(name, error, monkeypatch):
    """With the best impulse so far, and never one that is worse than the start."""
    spec = registry.get(name)
    *_, problem = examples(spec)
    start = 0.9 * lv.solve(problem).impulse
    factory = spec.load()
    runs = factory.run
    for before in (0, 1) if spec.resumable else (0,):  # calls that end well
        left = [before]

        def run(self, state, impulse, n, tol, time_limit=None, left=left):
            if left[0]:
                left[0] -= 1
                return runs(self, state, impulse, 1, tol, time_limit)
            if not spec.resumable:
                impulse[:] = 1e3
            raise error

        monkeypatch.setattr(factory, "run", run)
        found = lv.solve(problem, name, impulse=start, tol=1e-12, max_iter=500)
        if not (before and found.success):  # the first of its iterations may do
            stopped = isinstance(error, KeyboardInterrupt)
            assert found.status is (lv.Status.INTERRUPTED if stopped else lv.Status.NUMERICAL_ERROR)
            assert stopped or found.message.endswith(str(error))
            with pytest.raises(lv.SolveFailed):
                found.raise_for_status()
        assert found.residual.relative <= lv.residual(problem, start).relative
        monkeypatch.undo()


@pytest.mark.parametrize("error", BROKEN, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("limit", [None, 10.0])
def test_auto_goes_on_with_the_others_where_one_breaks_down(limit, error, monkeypatch):
    def breaks(self, n):
        raise error

    problem = random_contact_problem(3, contacts=60, bodies=20, friction="coulomb")
    assert problem.m > registry.SMALL_ROWS
    kinds = {steps.Newton, steps.Step, steps.Iterations, steps.Sweeps}
    for broken in [{kind} for kind in kinds] + [kinds]:
        for kind in broken:
            monkeypatch.setattr(kind, "advance", breaks)
        found = lv.solve(problem, tol=1e-13, time_limit=limit)  # the compiled call leaves that to the others
        ran = {stage.solver for stage in found.stages if stage.work}
        if len(broken) == 1:
            assert found.residual.relative <= 1e-6
            assert ran
        else:
            assert found.status is lv.Status.NUMERICAL_ERROR
            assert str(error) in found.message
        monkeypatch.undo()


@pytest.mark.parametrize("name", OURS)
def test_an_a_that_is_too_large_is_told_before_the_start_or_not_needed(name, monkeypatch):
    monkeypatch.setattr(operators, "MAX_INDEXABLE_ENTRIES", 4000)  # J and M have 2,700
    spec = registry.get(name)
    rng = np.random.default_rng(4)
    jac, mass = rng.normal(size=(90, 15)), np.diag(rng.uniform(1.0, 2.0, 15))
    chain = 0.2 * (np.eye(15, k=1) + np.eye(15, k=-1))
    for friction in ("coulomb", "cone"):
        problem = lv.Problem.from_jacobian(
            jac, mass + chain, rng.normal(size=15), cones=lv.Cones.contacts(0.5, count=30), friction=friction
        )
        if spec.refuses(problem) is not None:
            continue
        for more in ({}, {"time_limit": 10.0}, {"tol": 1e-30}):
            if name in ("admm", "jacobi", "direct", "lemke"):  # which read A
                with pytest.raises(lv.InputError, match="use a solver that takes J and M"):
                    lv.prepare(problem, name)
            else:
                assert lv.solve(problem, name, **more).residual.relative < 1.0
        assert lv.explain(problem).stages
