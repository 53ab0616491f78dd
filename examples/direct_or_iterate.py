"""Solve A x = b directly, or iterate? One factorisation against Gauss-Seidel and Jacobi as A gets worse.

A is symmetric positive definite with 40 rows, unit diagonal and a given condition number. The direct
solver does the same work for each and ends at the floor of float64. Gauss-Seidel needs more sweeps the
larger the condition number is, Jacobi (damped, so that it converges) more still.

    python examples/direct_or_iterate.py [FIGURE.png]
"""

import sys

import numpy as np

import lavender as lv

CONDITIONS = (1e1, 1e2, 1e3, 1e4)
ROWS = 40
TOL = 1e-6  # relative residual
SOLVERS = ("gauss_seidel", "jacobi")


def spd(condition, seed=0):
    """A system (A, b) whose eigenvalues are spread evenly in the logarithm, in a random basis, then scaled to d = 1.

    Scaling a positive definite matrix to unit diagonal keeps the order of magnitude of its condition number.
    """
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.standard_normal((ROWS, ROWS)))[0]
    a = basis @ np.diag(np.geomspace(1.0, condition, ROWS)) @ basis.T
    scale = 1.0 / np.sqrt(np.diag(a))
    a = scale[:, None] * (0.5 * (a + a.T)) * scale[None, :]
    return a, rng.standard_normal(ROWS)


def numbers():
    """Results by condition number: sweeps to TOL, residual histories, and what the direct solver reached."""
    out = {}
    for condition in CONDITIONS:
        a, b = spd(condition)
        problem = lv.Problem.linear(a, b)
        row = {"condition": float(np.linalg.cond(a)), "direct": lv.solve(problem, "direct", tol=1e-12)}
        for solver in SOLVERS:
            row[solver] = lv.solve(problem, solver, tol=TOL, max_iter=1_000_000, history=True)
        out[condition] = row
    return out


def figure(found, path):
    """Residual against sweeps, one panel for each condition number."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(9, 6), layout="constrained")
    for axes, row in zip(canvas.subplots(2, 2, sharey=True).flat, found.values(), strict=True):
        for solver, style in zip(SOLVERS, ("-", "--"), strict=True):
            h = row[solver].history
            axes.loglog(h.iterations[1:], h.relative[1:], style, label=solver)
        axes.axhline(
            row["direct"].residual.relative, color="k", linestyle=":", label="direct, one factorisation"
        )
        axes.set_title(f"condition {row['condition']:.1e}")
        axes.set_xlabel("sweeps")
    canvas.axes[0].set_ylabel("relative residual")
    canvas.axes[2].set_ylabel("relative residual")
    canvas.axes[0].legend()
    canvas.savefig(path)


def main(path="direct_or_iterate.png"):
    """Print the table, save the figure."""
    found = numbers()
    print(f"{'condition':>10} {'direct':>9} {'Gauss-Seidel':>14} {'Jacobi':>10}")
    print(f"{'':>10} {'residual':>9} {'sweeps':>14} {'sweeps':>10}   (to a relative residual of {TOL:g})")
    for row in found.values():
        sweeps = [row[s].work["sweeps"] for s in SOLVERS]
        print(
            f"{row['condition']:>10.1e} {row['direct'].residual.relative:>9.1e} {sweeps[0]:>14} {sweeps[1]:>10}"
        )
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
