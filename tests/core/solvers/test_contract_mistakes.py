"""The contract finds deliberate mistakes: one solver in NumPy, and each of its variants with one mistake."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from types import SimpleNamespace

import numpy as np
import pytest

import lavender as lv
from lavender import contract
from lavender.base.arrays import check_float
from lavender.contract.checks import find_failure
from lavender.problem.cones import CONTACT_BOX, ROW
from lavender.solvers.sweeping import create_stopping_test, make_claim


@dataclass
class State:
    problem: lv.Problem
    A: np.ndarray
    b: np.ndarray
    cones: lv.Cones
    done: int = 0
    watch: object = None
    step: dict[int, float] = field(
        default_factory=dict
    )  # [kg] Steps of friction components by their first row.

    @cached_property
    def units(self):
        """First rows of contacts, and all other rows, with the block of each."""
        c = self.cones
        rows = np.union1d(c.ptr[:-1], np.flatnonzero(~c.contact_rows)).tolist()
        block = np.repeat(np.arange(c.n_blocks), np.diff(c.ptr)).tolist()
        return [(row, block[row]) for row in rows]


class Sweeps:
    """Projected Gauss-Seidel in NumPy on A, under Coulomb's law and for every kind of block; `mistake` names one."""

    mistake = ""
    count = 0  # Sweeps of all solves.
    cache = {}  # noqa: RUF012 - matrices by the number of rows, which all objects share

    def __init__(self, order="given", ground=None, seed=0):
        self.order, self.seed = order, seed

    def prepare(self, problem):
        A = problem.dense()
        if self.mistake == "needs a row":
            A.max()
        if self.mistake == "rejects rows of zeros" and not A.any(axis=1).all():
            raise ValueError("a row of A is zero")
        if self.mistake == "solves with (A + A^T)/2":
            A = 0.5 * (A + A.T)
        if self.mistake == "shares the matrices of problems of one size":
            A = self.cache.setdefault(problem.m, A)
        return State(problem, A, problem.b, problem.cones)

    def update(self, state, problem):
        new = self.prepare(problem)
        kept = {
            "update keeps A": ("A",),
            "update keeps b": ("b",),
            "update keeps the blocks": ("cones",),
        }
        if self.mistake == "update keeps the coefficients":
            new.cones = replace(new.cones, mu=state.cones.mu)
        if self.mistake == "update keeps the bounds":
            new.cones = replace(new.cones, lower=state.cones.lower, upper=state.cones.upper)
        for name in kept.get(self.mistake, ()):
            setattr(new, name, getattr(state, name))
        return new

    def list_units(self, state):
        """Return the units in the order of a sweep."""
        units = state.units
        b = np.abs(state.problem.b)
        if self.mistake == "leaves out rows whose b is below a thousandth of the largest":
            units = [unit for unit in units if b[unit[0]] >= 1e-3 * b.max()]
        if self.mistake == "ignores the order":
            return units
        if self.order == "random":
            seed = 0 if self.mistake == "ignores the seed" else self.seed
            order = np.random.default_rng([seed, state.done]).permutation(len(units))
            return [units[i] for i in order]
        orders = {"reverse": units[::-1], "colored": units[::2] + units[1::2]}
        return orders.get(self.order, units)

    def find_end(self, state, x, tol):
        """Return the status of a solve that ends before this sweep, or None."""
        if self.mistake == "stops at two":
            return lv.Status.CONVERGED if state.done >= 2 else None
        if tol == 0.0 and self.mistake != "stops at zero error":
            return None
        relative = self.measure(state, x)
        if relative <= (tol or 1e-15):
            return lv.Status.CONVERGED
        return None if relative < 1e12 else lv.Status.DIVERGED

    def measure(self, state, x):
        """Return the number that the solver compares with tol."""
        judged = lv.residual(state.problem, x)
        p = state.problem
        if self.mistake == "stops by one norm over all rows":
            step = np.clip(x - (state.A @ x - p.b) / p.d, p.cones.lower, p.cones.upper) - x
            return 100.0 * np.linalg.norm(p.d * step) / max(np.linalg.norm(p.b), 1e-300)
        if self.mistake == "stops by the energy alone":
            return judged.energy / max(judged.energy_at_zero, 1e-300)
        if self.mistake == "stops by the velocity alone":
            return judged.velocity / max(judged.velocity_at_zero, 1e-300)
        if self.mistake == "stops by the change of the impulse":
            return np.linalg.norm(x - getattr(state, "before", np.full_like(x, np.inf))) / max(
                np.linalg.norm(x), 1e-300
            )
        return judged.relative / (5.0 if self.mistake == "stops at five times tol" else 1.0)

    def run(self, state, x, n, tol, time_limit=None):
        if not self.mistake:  # Without a mistake, the package's stopping test ends a run.
            state.watch = state.watch or create_stopping_test(state.problem, state.problem.csr_data)

            def iterate(count, first):
                for _ in range(count):
                    self.sweep(state, x)
                    state.done += 1

            return make_claim(*state.watch.run_python(iterate, x, n, tol))
        if self.mistake == "ignores the start" and not state.done:
            x[:] = state.problem.start()
        if self.mistake == "fails without a message":
            return lv.Claim(lv.Status.NUMERICAL_ERROR, 0, {"sweeps": 1})
        n = max(n, 2) if self.mistake == "spends two iterations" else n
        before = x.copy()
        for k in range(n + (self.mistake == "one iteration more" and n > 1)):
            if status := self.find_end(state, x, tol):
                if self.mistake == "returns the iterate before the judged one":
                    x[:] = before
                return self.claim(status, k)
            before = state.before = x.copy()
            if self.mistake == "every fourth sweep of a run is skipped" and k % 4 == 3:
                continue
            Sweeps.count += 1
            if self.mistake != "a counter shared by all solves" or Sweeps.count % 5:
                self.sweep(state, x)
            if self.mistake == "rounds to single precision":
                x[:] = x.astype(np.float32)
            state.done += 1
        return self.claim(lv.Status.MAX_ITERATIONS, n)

    def claim(self, status, n):
        work = {
            "sweeps": 1
            if self.mistake == "counts one sweep"
            else n + (self.mistake == "stops at two")
        }
        if self.mistake in ("counts no work", "counts passes"):
            work = {"passes": n} if self.mistake == "counts passes" else {}
        return lv.Claim(status, n, work, "the error grew" if status is lv.Status.DIVERGED else "")

    def sweep(self, state, x):
        A, b, c, m = state.A, state.b, state.cones, self.mistake
        for first, i in self.list_units(state):
            if c.kind[i] == ROW:
                low, high = c.lower[first], c.upper[first]
                low = 0.0 if m == "a lower bound above zero is zero" and low > 0.0 else low
                high = 0.0 if m == "an upper bound below zero is zero" and high < 0.0 else high
                high = np.inf if m == "upper bounds are ignored" else high
                low = -high if m == "bounds are symmetric" and 0.0 < high < np.inf else low
                x[first] = min(
                    max(low, x[first] - (A[first] @ x - b[first]) / state.problem.d[first]), high
                )
                continue
            x[first] = max(0.0, x[first] - (A[first] @ x - b[first]) / A[first, first])
            for rows, bound in self.components(c, i):
                if rows[0] not in state.step:
                    state.step[rows[0]] = 1.0 / np.linalg.eigvalsh(A[np.ix_(rows, rows)]).max()
                y = x[rows] - state.step[rows[0]] * (A[rows] @ x - b[rows])
                norm = np.sqrt(y @ y)
                if m == "discs are squares":
                    x[rows] = np.clip(y, -bound * x[first], bound * x[first])
                else:
                    x[rows] = y * min(1.0, bound * x[first] / max(norm, 1e-300))

    def components(self, c, i):
        """Yield rows and bound per unit of the normal impulse of each friction component of contact i."""
        m = self.mistake
        first = c.ptr[i]
        mu, radius, nt, spin, roll = (
            c.mu[i],
            c.patch_radius[i],
            c.n_tangents[i],
            c.spin_rows[i],
            c.rolling_rows[i],
        )
        if m == "coefficients are at most one":
            mu = min(mu, 1.0)
        if m == "tangents are ignored for coefficients above one" and mu > 1.0:
            nt = 0
        if m == "planar friction is doubled" and nt == 1:
            mu *= 2.0
        if c.kind[i] == CONTACT_BOX:
            ratio = 1.0 if m == "boxes are squares" else radius
            yield np.array([first + 1]), mu
            yield np.array([first + 2]), mu * ratio
            return
        if m == "spin is a tangent" and spin >= 0:
            yield np.arange(first + 1, spin + 1), mu
            spin = -1
        elif nt:
            yield np.arange(first + 1, first + 1 + nt), mu
        if spin >= 0 and m != "spin is ignored":
            yield (
                np.array([spin]),
                mu * (1.0 if m == "spin is bounded without its radius" else radius),
            )
        if roll >= 0 and m != "rolling is ignored":
            yield np.arange(roll, roll + 2), mu if m == "rolling is bounded by mu" else c.rolling[i]


ROWS = frozenset({"linear", "lcp"})
SPEC = lv.SolverSpec(
    "numpy_sweeps",
    Sweeps,
    laws=frozenset({"linear", "lcp", "coulomb"}),
    box_friction_laws=frozenset({"coulomb"}),
    operators=frozenset({"matrix"}),
    supports_rolling=True,
    max_iter=5000,
    order=True,
    seed=True,
    refusal=lambda p: None if p.is_symmetric or p.law in ROWS else "needs a symmetric A",
    summary="projected Gauss-Seidel in NumPy",
)
OF_ROWS = replace(SPEC, laws=ROWS, box_friction_laws=frozenset(), supports_rolling=False)
MISTAKES = (
    "a lower bound above zero is zero",
    "an upper bound below zero is zero",
    "upper bounds are ignored",
    "bounds are symmetric",
    "discs are squares",
    "boxes are squares",
    "planar friction is doubled",
    "coefficients are at most one",
    "tangents are ignored for coefficients above one",
    "spin is a tangent",
    "spin is ignored",
    "spin is bounded without its radius",
    "rolling is ignored",
    "rolling is bounded by mu",
    "update keeps A",
    "update keeps b",
    "update keeps the bounds",
    "update keeps the coefficients",
    "update keeps the blocks",
    "counts one sweep",
    "counts no work",
    "one iteration more",
    "stops at zero error",
    "stops at five times tol",
    "stops by the energy alone",
    "stops by the velocity alone",
    "stops by the change of the impulse",
    "returns the iterate before the judged one",
    "ignores the start",
    "every fourth sweep of a run is skipped",
    "a counter shared by all solves",
)


@pytest.fixture
def find_unmet(register, monkeypatch):
    """Return the first check that the solver with a mistake does not meet, and the sentence of its failure."""

    def find(mistake):
        monkeypatch.setattr(Sweeps, "mistake", mistake)
        register(SPEC)
        for check in contract.list_checks(SPEC):
            if failure := find_failure(SPEC, check).text:
                return f"{check.name}: {failure}"
        return ""

    return find


@pytest.mark.parametrize("mistake", MISTAKES)
def test_contract_finds_a_solver_with_one_mistake(mistake, find_unmet):
    failure = find_unmet(mistake)
    assert failure and "raised in" not in failure, failure
    assert not failure.startswith(
        "rounding"
    )  # Only the solver without a mistake has the stopping test.


def test_contract_is_met_by_the_solver_without_a_mistake(find_unmet):
    assert find_unmet("") == ""


class WithOption(Sweeps):
    def __init__(self, order="given", ground=None, seed=0, extra=1):
        super().__init__(order, ground, seed)


#: Mistake of a solver of bounded rows, the check that must fail, and words of its sentence.
FAULTS = [
    (
        "stops by one norm over all rows",
        "problems_are_solved",
        "for two islands whose b differ by 1e6 (law lcp) the",
    ),
    (
        "solves with (A + A^T)/2",
        "problems_are_solved",
        "for an asymmetric A (law lcp) the result is",
    ),
    ("rounds to single precision", "problems_are_solved", "CONVERGED and lv.residual"),
    ("shares the matrices of problems of one size", "problems_are_solved", "the result is"),
    (
        "leaves out rows whose b is below a thousandth of the largest",
        "problems_are_solved",
        "islands whose b differ",
    ),
    ("fails without a message", "problems_are_solved", "A failure has no message"),
    ("rejects rows of zeros", "problems_are_solved", "a row of A is zero"),
    ("needs a row", "problems_are_solved", "was raised in"),
    ("counts passes", "problems_are_solved", "Its work must count one of backend_calls"),
    ("spends two iterations", "budgets_are_kept", "max_iter=1"),
    ("stops at two", "budgets_are_kept", "or the claim"),
    (
        "stops at two",
        "interruptions_return_the_iterate",
        "TIME_LIMIT after at least 1 iteration is required",
    ),
    ("ignores the order", "orders_change_the_sweep", "give the same bits after 2 sweeps"),
    ("ignores the seed", "orders_change_the_sweep", "give the same bits after 2 sweeps"),
]


def failure(spec, name):
    return find_failure(spec, contract.CHECKS[name]).text


@pytest.mark.parametrize(
    "mistake, check, words", FAULTS, ids=[f"{mistake}-{check}" for mistake, check, _ in FAULTS]
)
def test_contract_of_a_faulty_solver_names_the_unmet_check(
    register, monkeypatch, mistake, check, words
):
    monkeypatch.setattr(Sweeps, "mistake", mistake)
    register(OF_ROWS)
    sentence = failure(OF_ROWS, check)
    assert words in sentence
    assert "np." not in sentence and "assert" not in sentence


@pytest.mark.parametrize(
    "check, more, words",
    [
        (
            "options_match_the_spec",
            {"options": {"omega": "a factor"}},
            "the options omega are in the spec or",
        ),
        (
            "options_match_the_spec",
            {"factory": WithOption},
            "the options extra are in the spec or in",
        ),
        (
            "problems_are_solved",
            {"laws": {"lcp", "cone"}, "refusal": lambda p: "no" * (p.law == "cone")},
            "the spec lists the law cone, but refuses every problem with it",
        ),
        (
            "budgets_are_kept",
            {"refusal": lambda p: "never"},
            "the law linear, but refuses every problem with it",
        ),
    ],
)
def test_contract_of_a_wrong_spec_names_the_unmet_check(register, check, more, words):
    spec = replace(OF_ROWS, **more)
    register(spec)
    assert words in failure(spec, check)


def test_checks_apply_to_listed_capabilities_only():
    spec = replace(SPEC, order=False, seed=False, resumable=False, callback=False, history=False)
    names = {check.name for check in contract.list_checks(spec)}
    assert not names & {"orders_change_the_sweep", "interruptions_return_the_iterate"}
    assert "problems_are_solved" in names


# -- what the tests of all registered solvers require ------------------------------------------------------


class Barzilai:
    """Projected gradient with Barzilai-Borwein steps, whose own test reads the residual every ten iterations.

    It solves every solvable problem, and runs away on others: its objective falls without end.
    """

    def __init__(self, growth=1e6):
        self.growth = growth if self.is_silent else check_float("growth", growth, above=0.0)

    is_silent = False

    def prepare(self, problem):
        A = problem.csr
        step = 1.0 / float((abs(A).sum(axis=1) / problem.d).max(initial=1.0))
        return SimpleNamespace(p=problem, A=A, done=0, best=(np.inf, None), step=step)

    def run(self, s, x, n, tol, time_limit=None):
        p = s.p
        for i in range(n):
            if tol > 0.0 and s.done % 10 == 0:
                relative = lv.residual(p, x).relative
                if relative < s.best[0]:
                    s.best = relative, x.copy()
                if not tol < relative < 1e12:
                    status = lv.Status.CONVERGED if relative <= tol else lv.Status.DIVERGED
                    return lv.Claim(status, i, {"products": 2 * i}, "it grew" * (relative > tol))
            new = np.clip(x - s.step * (s.A @ x - p.b) / p.d, p.cones.lower, p.cones.upper)
            change = new - x
            curvature = float(change @ (s.A @ change))
            if curvature > 0.0:
                s.step = min(float(change @ (p.d * change)) / curvature, 1e6)
            x[:] = new
            s.done += 1
        return lv.Claim(lv.Status.MAX_ITERATIONS, n, {"products": 2 * n})


BARZILAI = lv.SolverSpec(
    "barzilai",
    Barzilai,
    laws=ROWS,
    operators=frozenset({"matrix"}),
    options={"growth": "largest step"},
    refusal=lambda p: None if p.is_symmetric else "needs a symmetric A",
    summary="Barzilai-Borwein",
)


def find_failures(register, spec):
    register(spec)
    failures = {check.name: find_failure(spec, check).text for check in contract.list_checks(spec)}
    return {name: text for name, text in failures.items() if text}


def test_contract_finds_a_solver_that_passes_every_solvable_problem(register):
    failures = find_failures(register, BARZILAI)
    assert "growth=1000000.0 and growth=500000.0 give" in failures["options_change_the_iterates"]
    assert "islands" in failures["islands_are_solved_next_to_an_island_without_a_solution"]
    assert "ROUNDOFF_LIMIT" in failures["rounding_ends_a_solve"]
    assert "problems_are_solved" not in failures and "budgets_are_kept" not in failures


def test_results_of_a_registered_solver_without_a_solution_are_not_worse_than_zero(register):
    """The iterate with the smallest E counts after a long or failed run, as from the package's own solvers."""
    register(BARZILAI)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(2, 5))
        limit = rng.normal(size=(1, n))
        J = np.vstack([rng.normal(size=(2, n)), limit, -limit])
        problem = lv.Problem.lcp(J @ J.T, np.array([0.0, 0.0, 5.0, 5.0]) - J @ rng.normal(size=n))
        found = lv.solve(problem, "barzilai")
        assert found.residual.energy <= found.residual.energy_at_zero * (1.0 + 1e-12)


def test_contract_finds_options_with_any_value(register, monkeypatch):
    monkeypatch.setattr(Barzilai, "is_silent", True)
    text = find_failures(register, BARZILAI)["wrong_values_of_options_raise"]
    assert text.startswith("for ") and "growth='no such word' was accepted" in text


def test_contract_finds_packages_that_a_file_imports_at_its_top(register, tmp_path, monkeypatch):
    (tmp_path / "heavy_solver.py").write_text(
        "import numpy\nfrom scipy import sparse\nclass Heavy:\n    def __init__(self):\n        pass\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    spec = replace(BARZILAI, factory=__import__("heavy_solver").Heavy, options={})
    register(spec)
    check = contract.CHECKS["the_file_imports_numpy_alone"]
    assert not check.applies(spec)  # Only a plug-in with an entry point is read by every command.
    object.__setattr__(spec, "distribution", "heavy")
    assert check.applies(spec)
    text = find_failure(spec, check).text
    assert "heavy_solver.py, line 2 imports scipy" in text


class Keeping(Barzilai):
    """It keeps a view of the iterate, and writes into it in the next solve."""

    kept = ()

    def prepare(self, problem):
        for view in self.kept:
            view[:] = np.nan
        return super().prepare(problem)

    def run(self, s, x, n, tol, time_limit=None):
        Keeping.kept = (*self.kept, x[:])
        return super().run(s, x, n, tol, time_limit)


def test_solver_that_keeps_a_view_of_the_iterate_changes_no_solution(register):
    register(replace(BARZILAI, factory=Keeping))
    problem = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0])
    prepared = lv.prepare(problem, "barzilai")
    first = prepared.solve()
    before = first.impulse.copy()
    prepared.solve()
    np.testing.assert_array_equal(first.impulse, before)
    assert first.success


@pytest.mark.parametrize("best", [[np.nan, 0.0], [1.0], [[0.5, 0.0]], "none", None])
def test_best_iterate_that_is_no_impulse_does_not_count(register, best):
    class Wrong(Barzilai):
        def run(self, s, x, n, tol, time_limit=None):
            x[:] = [0.4, 0.0]
            s.best = 0.0, best
            return lv.Claim(lv.Status.MAX_ITERATIONS, n, {"products": n})

    register(replace(BARZILAI, factory=Wrong))
    found = lv.solve(lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0]), "barzilai")
    np.testing.assert_array_equal(found.impulse, [0.4, 0.0])
