"""Accelerated projected gradient descent with restart, in the metric of d = diag(A).

    y <- l + beta (l - l_before),    l <- clip(y - s (A y - b) / d, lower, upper)

s = 1 / max_i sum_j |A_ij| / d_i bounds 1 over the largest eigenvalue of D^-1 A. A step uphill restarts beta.
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np

import lavender as lv
from lavender.base.arrays import check_bool
from lavender.solvers.sweeping import create_stopping_test, make_claim


@dataclass
class State:
    """What one run carries from call to call, so that n1 and then n2 iterations are n1 + n2."""

    problem: lv.Problem
    A: object  # (m, m) CSR, 1/kg
    step: np.ndarray  # (m,) kg, s / d
    watch: object  # the stopping test: it checks the residual, and keeps the impulse that the solve returns
    before: np.ndarray | None = None  # (m,) N s, the iterate before the last
    theta: float = 1.0


@dataclass(frozen=True)
class APGD:
    """Options live here; everything that changes lives in the state."""

    restart: bool = True

    def __post_init__(self):
        check_bool("restart", self.restart)

    def prepare(self, problem):
        """Everything that does not depend on the iterate."""
        A, d = problem.csr, problem.d
        largest = float((abs(A).sum(axis=1) / d).max(initial=0.0))
        watch = create_stopping_test(problem, problem.csr_data)
        return State(problem, A, 1.0 / (max(largest, 1.0) * d), watch)

    def update(self, state, problem):
        """Return the state for new numbers of the same structure; nothing can be reused."""
        return self.prepare(problem)

    def run(self, state, impulse, n, tol, time_limit=None):
        """n more iterations on `impulse` in place, fewer only if the stopping test ends them."""
        problem, cones = state.problem, state.problem.cones

        def iterate(count, first):
            if first:  # The test may have replaced the start by the zero impulse.
                state.before = impulse.copy()
            for _ in range(count):
                theta, now = state.theta, impulse.copy()
                after = 0.5 * theta * (sqrt(theta * theta + 4.0) - theta)
                y = now + theta * (1.0 - theta) / (theta * theta + after) * (now - state.before)
                impulse[:] = np.clip(
                    y - state.step * (state.A @ y - problem.b), cones.lower, cones.upper
                )
                uphill = (y - impulse) @ ((impulse - now) / state.step) > 0.0
                state.theta = 1.0 if self.restart and uphill else after
                state.before = now

        status, done = state.watch.run_python(iterate, impulse, n, tol)
        return make_claim(status, done, "products")


def refusal(problem):
    """Refuse asymmetric A, for which the step size is not safe."""
    return None if problem.is_symmetric else "needs a symmetric A; use pgs"


SPEC = lv.SolverSpec(
    name="apgd",
    factory=APGD,
    laws=frozenset({"linear", "lcp"}),
    operators=frozenset({"matrix"}),
    max_iter=2000,
    options={"restart": "start beta anew after a step uphill; default True"},
    refusal=refusal,
    summary="accelerated projected gradient descent with restart",
    reference="Nesterov 1983; O'Donoghue, Candes 2015; Mazhar, Heyn, Negrut, Tasora 2015 for contacts",
)
