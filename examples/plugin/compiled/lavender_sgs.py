"""Symmetric Gauss-Seidel: projected sweeps over A, forwards and backwards in turn; the kernel is in Cython."""

from dataclasses import dataclass

from lavender_sgs_kernel import sweep

import lavender as lv
from lavender.solvers.sweeping import create_stopping_test, make_claim


@dataclass
class State:
    """The data of the kernel and the stopping test, which counts sweeps so that n1 and then n2 are n1 + n2."""

    data: tuple  # (m + 1,), (nnz,), (nnz,) 1/kg, (m,) m/s, (m,) 1/kg, and the cones
    watch: object


@dataclass(frozen=True)
class SymmetricGaussSeidel:
    """It has no options."""

    def prepare(self, problem):
        """Collect the arrays of the kernel."""
        A = problem.csr
        data = A.indptr, A.indices, A.data, problem.b, problem.d, problem.cones
        return State(data, create_stopping_test(problem, problem.csr_data))

    def update(self, state, problem):
        """Return the state for new numbers of the same structure."""
        return self.prepare(problem)

    def run(self, state, impulse, n, tol, time_limit=None):
        """Run n more sweeps on `impulse` in place, fewer only if the stopping test ends them."""
        done = state.watch.total

        def iterate(count, first):
            nonlocal done
            sweep(*state.data, impulse, done, count)
            done += count

        return make_claim(*state.watch.run_python(iterate, impulse, n, tol))


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
