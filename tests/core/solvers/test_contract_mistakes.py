"""The contract finds deliberate mistakes: one solver in NumPy, and each of its variants with one mistake."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

import lavender as lv
from lavender import contract
from lavender.contract.run import find_failure
from lavender.problem.cones import CONTACT_BOX, ROW


@dataclass
class State:
    problem: lv.Problem
    A: np.ndarray
    b: np.ndarray
    cones: lv.Cones
    done: int = 0


class Sweeps:
    """Projected Gauss-Seidel in NumPy on A, under Coulomb's law and for every kind of block; `mistake` names one."""

    mistake = ""
    count = 0  # Sweeps of all solves.

    def prepare(self, problem):
        return State(problem, problem.dense(), problem.b, problem.cones)

    def update(self, state, problem):
        new = self.prepare(problem)
        kept = {"update keeps A": ("A",), "update keeps b": ("b",), "update keeps the blocks": ("cones",)}
        if self.mistake == "update keeps the coefficients":
            new.cones = replace(new.cones, mu=state.cones.mu)
        if self.mistake == "update keeps the bounds":
            new.cones = replace(new.cones, lower=state.cones.lower, upper=state.cones.upper)
        for name in kept.get(self.mistake, ()):
            setattr(new, name, getattr(state, name))
        return new

    def measure(self, state, x):
        """Return the number that the solver compares with tol."""
        judged = lv.residual(state.problem, x)
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
        if self.mistake == "ignores the start" and not state.done:
            x[:] = state.problem.start()
        before = x.copy()
        for k in range(n + (self.mistake == "one iteration more" and n > 1)):
            relative = self.measure(state, x) if tol > 0.0 or self.mistake == "stops at zero error" else 1.0
            if relative <= (tol or 1e-15):
                if self.mistake == "returns the iterate before the judged one":
                    x[:] = before
                return self.claim(lv.Status.CONVERGED, k)
            before = state.before = x.copy()
            if self.mistake == "every fourth sweep of a run is skipped" and k % 4 == 3:
                continue
            Sweeps.count += 1
            if self.mistake != "a counter shared by all solves" or Sweeps.count % 5:
                self.sweep(state, x)
            state.done += 1
        return self.claim(lv.Status.MAX_ITERATIONS, n)

    def claim(self, status, n):
        work = {"sweeps": 1 if self.mistake == "counts one sweep" else n}
        if self.mistake == "counts no work":
            work = {}
        return lv.Claim(status, n, work)

    def sweep(self, state, x):
        A, b, c, m = state.A, state.b, state.cones, self.mistake
        for i in range(c.n_blocks):
            first, end = c.ptr[i], c.ptr[i + 1]
            if c.kind[i] == ROW:
                for q in range(first, end):
                    low, high = c.lower[q], c.upper[q]
                    low = 0.0 if m == "a lower bound above zero is zero" and low > 0.0 else low
                    high = 0.0 if m == "an upper bound below zero is zero" and high < 0.0 else high
                    high = np.inf if m == "upper bounds are ignored" else high
                    low = -high if m == "bounds are symmetric" and 0.0 < high < np.inf else low
                    x[q] = min(max(low, x[q] - (A[q] @ x - b[q]) / state.problem.d[q]), high)
                continue
            x[first] = max(0.0, x[first] - (A[first] @ x - b[first]) / A[first, first])
            for rows, bound in self.components(c, i):
                step = 1.0 / np.linalg.eigvalsh(A[np.ix_(rows, rows)]).max()
                y = x[rows] - step * (A[rows] @ x - b[rows])
                norm = np.linalg.norm(y)
                if m == "discs are squares":
                    x[rows] = np.clip(y, -bound * x[first], bound * x[first])
                else:
                    x[rows] = y * min(1.0, bound * x[first] / max(norm, 1e-300))

    def components(self, c, i):
        """Yield rows and bound per unit of the normal impulse of each friction component of contact i."""
        m, first = self.mistake, c.ptr[i]
        mu, radius, nt, spin, roll = c.mu[i], c.patch_radius[i], c.n_tangents[i], c.spin_rows[i], c.rolling_rows[i]
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
            yield np.array([spin]), mu * (1.0 if m == "spin is bounded without its radius" else radius)
        if roll >= 0 and m != "rolling is ignored":
            yield np.arange(roll, roll + 2), mu if m == "rolling is bounded by mu" else c.rolling[i]


SPEC = lv.SolverSpec(
    "numpy_sweeps", Sweeps, laws=frozenset({"linear", "lcp", "coulomb"}), box_friction_laws=frozenset({"coulomb"}),
    operators=frozenset({"matrix"}), supports_rolling=True, max_iter=5000,
    refusal=lambda p: None if p.is_symmetric else "needs a symmetric A", summary="projected Gauss-Seidel in NumPy",
)  # fmt: skip
MISTAKES = (
    "a lower bound above zero is zero", "an upper bound below zero is zero", "upper bounds are ignored",
    "bounds are symmetric", "discs are squares", "boxes are squares", "planar friction is doubled",
    "coefficients are at most one", "tangents are ignored for coefficients above one", "spin is a tangent",
    "spin is ignored", "spin is bounded without its radius", "rolling is ignored", "rolling is bounded by mu",
    "update keeps A", "update keeps b", "update keeps the bounds", "update keeps the coefficients",
    "update keeps the blocks", "counts one sweep", "counts no work", "one iteration more", "stops at zero error",
    "stops at five times tol", "stops by the energy alone", "stops by the velocity alone",
    "stops by the change of the impulse", "returns the iterate before the judged one", "ignores the start",
    "every fourth sweep of a run is skipped", "a counter shared by all solves",
)  # fmt: skip


def find_unmet(mistake, monkeypatch):
    """Return the first check that the solver with a mistake does not meet, and the sentence of its failure."""
    monkeypatch.setattr(Sweeps, "mistake", mistake)
    lv.register(SPEC, replace=True)
    for check in contract.list_checks(SPEC):
        if failure := find_failure(SPEC, check).text:
            return f"{check.name}: {failure}"
    return ""


@pytest.mark.parametrize("mistake", MISTAKES)
def test_contract_finds_a_solver_with_one_mistake(mistake, monkeypatch):
    failure = find_unmet(mistake, monkeypatch)
    assert failure and "raised in" not in failure, failure


def test_contract_is_met_by_the_solver_without_a_mistake(monkeypatch):
    assert find_unmet("", monkeypatch) == ""
