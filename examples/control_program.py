"""A program of predictive control with 10,000 variables: lavender beside the backends alone.

A random stable system x' = A x + B u of 12 states and 4 inputs, bounded, over a horizon of N steps: minimise the sum of
u'R u / 2 + x'Q x / 2 subject to the equations of motion. Each solver runs once on sparse matrices; times are CPU times
of this process.

    python examples/control_program.py
"""

import time

import numpy as np
import qpsolvers
import scipy.sparse as sp

import lavender as lv

N_STATES, N_INPUTS, N_STEPS = 12, 4, 625


def make_program(n_steps, seed=1):
    """Return P, q, A, b, lb, ub of the program, in the notation of qpsolvers; x is (u_0, x_1, u_1, x_2, ...)."""
    rng = np.random.default_rng(seed)
    motion = np.eye(N_STATES) + 0.05 * rng.normal(size=(N_STATES, N_STATES))
    motion /= max(1.0, np.abs(np.linalg.eigvals(motion)).max())
    inputs = 0.1 * rng.normal(size=(N_STATES, N_INPUTS))
    start = rng.normal(size=N_STATES)
    weights = rng.uniform(0.5, 2.0, N_STATES)
    P = sp.diags(np.tile(np.r_[0.1 * np.ones(N_INPUTS), weights], n_steps), format="csc")
    here = sp.hstack([-sp.csc_matrix(inputs), sp.eye(N_STATES)])
    before = sp.hstack([sp.csc_matrix((N_STATES, N_INPUTS)), -sp.csc_matrix(motion)])
    A = (sp.kron(sp.eye(n_steps), here) + sp.kron(sp.eye(n_steps, k=-1), before)).tocsc()
    b = np.zeros(n_steps * N_STATES)
    b[:N_STATES] = motion @ start
    ub = np.tile(np.r_[0.3 * np.ones(N_INPUTS), 5.0 * np.ones(N_STATES)], n_steps)
    return P, np.zeros(P.shape[0]), A, b, -ub, ub


def main():
    """Print the time of each solver and the largest difference of its x from that of `auto`."""
    P, q, A, b, lb, ub = make_program(N_STEPS)
    settings = {"osqp": {"eps_abs": 1e-8, "eps_rel": 1e-8}}
    alone = [name for name in ("piqp", "clarabel", "osqp") if name in qpsolvers.available_solvers]
    reference = None
    print(f"{len(q)} variables, {len(b)} equations")
    for name in ("auto", "newton", *alone):
        through = name not in alone
        begin = time.process_time()
        if through:
            x = lv.solve_qp(P, q, A=A, b=b, lb=lb, ub=ub, solver=name).x
        else:
            x = qpsolvers.solve_qp(
                P, q, A=A, b=b, lb=lb, ub=ub, solver=name, **settings.get(name, {})
            )
        seconds = time.process_time() - begin
        reference = x if reference is None else reference
        where = "lavender" if through else "alone"
        print(f"{where:8} {name:8} {1e3 * seconds:7.1f} ms  {np.abs(x - reference).max():.0e}")


if __name__ == "__main__":
    main()
