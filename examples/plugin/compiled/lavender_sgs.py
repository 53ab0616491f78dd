"""Symmetric Gauss-Seidel: projected sweeps over A, forwards and backwards in turn; the kernel is in Cython."""

from dataclasses import dataclass

from lavender_sgs_kernel import sweep

import lavender as lv

CHECK_EVERY = 10  # sweeps between two residuals, counted from the first sweep of the state


@dataclass
class State:
    """The data of the kernel and the number of sweeps so far, so that n1 and then n2 sweeps are n1 + n2."""

    problem: lv.Problem
    data: tuple  # (m + 1,), (nnz,), (nnz,) 1/kg, (m,) m/s, (m,) 1/kg, and the cones
    done: int = 0


@dataclass(frozen=True)
class SymmetricGaussSeidel:
    """It has no options."""

    def prepare(self, problem):
        """Collect the arrays of the kernel."""
        A = problem.csr
        return State(problem, (A.indptr, A.indices, A.data, problem.b, problem.d, problem.cones))

    def update(self, state, problem):
        """Return the state for new numbers of the same structure."""
        return self.prepare(problem)

    def run(self, state, impulse, n, tol, time_limit=None):
        """Run n more sweeps on `impulse` in place, fewer only if the residual meets tol."""
        done = 0
        while done < n:
            checks = tol > 0.0 and state.done % CHECK_EVERY == 0
            if checks and lv.residual(state.problem, impulse).relative <= tol:
                return lv.Claim(lv.Status.CONVERGED, done, {"sweeps": done})
            count = min(n - done, CHECK_EVERY - state.done % CHECK_EVERY) if tol > 0.0 else n
            sweep(*state.data, impulse, state.done, count)
            state.done += count
            done += count
        return lv.Claim(lv.Status.MAX_ITERATIONS, n, {"sweeps": n})


SPEC = lv.SolverSpec(
    name="sgs",
    factory=SymmetricGaussSeidel,
    laws=frozenset({"linear", "lcp", "coulomb"}),
    operators=frozenset({"matrix"}),
    max_iter=1000,
    options={},
    summary="symmetric Gauss-Seidel",
    reference="Young 1971, Iterative Solution of Large Linear Systems",
)
