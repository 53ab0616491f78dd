"""Experiment 1: solve A x = b by a factorisation or by sweeps: residual, solution row by row, and cost.

A is symmetric positive definite with 40 rows, unit diagonal and a given condition number; b is random. The direct
solver does the same work for each A and ends at the round-off limit of float64. Gauss-Seidel needs more sweeps for a
larger condition number, and Jacobi more again. In the solution, a few sweeps find the impulses roughly; the rest of
the error belongs to combinations of many rows.

Jacobi is damped: x <- x - omega D^-1 (A x - b) multiplies the error by I - omega D^-1 A, whose spectral radius must
be below 1. Without damping (omega = 1) it is above 1 for each of these matrices. `jacobi` uses an omega that is safe
for every positive semidefinite A; if the eigenvalues of D^-1 A are known, 2 / (smallest + largest) is the best omega.

The cost of a factorisation depends on the structure of A. On a square lattice of n = k^2 rows, in which row i is
coupled to its four neighbours, the multiplications are counted:

    dense    n^3/6               banded   n k (k + 3)/2, bandwidth k
    sparse   sum over the columns of c (c + 3)/2, c entries below the diagonal of the factor, minimum-degree order
    sweeps   nonzeros of A for each sweep, until the relative residual is 1e-6

    python examples/direct_or_iterate.py [FIGURE.png]

A file named after a panel shows it alone: sweeps.png, rows.png, cost.png.
"""

import sys

import numpy as np
from panels import Numbers, put_legend_right, show
from scipy import sparse

import lavender as lv

CONDITIONS = (1e1, 1e2, 1e3, 1e4)  # of A before it is scaled to unit diagonal
ROWS = 40
TOL = 1e-6  # relative residual
SOLVERS = {"gauss_seidel": "Gauss-Seidel", "jacobi": "Jacobi"}
BUDGETS = (4, 16, 64)  # sweeps after which the solution is shown row by row
SHOWN = 1e2  # condition number of the system that is shown row by row
SIDES = (4, 6, 8, 12, 16, 24, 32)  # k


def make_system(condition, seed=0):
    """Return A (40, 40) [1/kg] and b (40,) [m/s]: eigenvalues spaced evenly in the logarithm, in a random basis.

    Scaling A to unit diagonal keeps the order of magnitude of its condition number.
    """
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.standard_normal((ROWS, ROWS)))[0]
    a = basis @ np.diag(np.geomspace(1.0, condition, ROWS)) @ basis.T
    scale = 1.0 / np.sqrt(np.diag(a))
    a = scale[:, None] * (0.5 * (a + a.T)) * scale[None, :]
    return a, rng.standard_normal(ROWS)


def sweep_by_hand(a, b, sweeps):
    """Return the impulse [N s] after so many sweeps of the chapter's loop."""
    impulse = np.zeros(len(b))
    for _ in range(sweeps):
        for i in range(len(b)):
            correction = (b[i] - a[i] @ impulse) / a[i, i]
            impulse[i] += correction
    return impulse


def make_lattice(k):
    """Return the matrix (k^2, k^2) of a square lattice: 4 on the diagonal, -1 for each neighbour."""
    line = sparse.diags([2.0 * np.ones(k), -np.ones(k - 1), -np.ones(k - 1)], [0, 1, -1])
    return sparse.csr_matrix(sparse.kron(line, sparse.eye(k)) + sparse.kron(sparse.eye(k), line))


def count_multiplications(k):
    """Return the multiplications of every method on the lattice of side k."""
    a = make_lattice(k)
    n = k * k
    factor = sparse.linalg.splu(
        a.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    below = np.diff(factor.L.indptr) - 1
    sweeps = {}
    for solver in SOLVERS:
        solution = lv.solve(lv.Problem.linear(a, np.ones(n)), solver, tol=TOL, max_iter=1_000_000)
        sweeps[solver] = solution.work["sweeps"] * a.nnz
    return {
        "dense": n**3 / 6,
        "banded": n * k * (k + 3) / 2,
        "sparse": float((below * (below + 3) / 2).sum()),
        **sweeps,
    }


def solve_system(condition):
    """Return the solutions of one system by every method, with the spectral radius of undamped Jacobi."""
    a, b = make_system(condition)
    problem = lv.Problem.linear(a, b)
    row = {"condition": float(np.linalg.cond(a)), "direct": lv.solve(problem, "direct", tol=1e-12)}
    for solver in SOLVERS:
        row[solver] = lv.solve(problem, solver, tol=TOL, max_iter=1_000_000, history=True)
    ends = np.linalg.eigvalsh(a)[[0, -1]]  # of D^-1 A, since d = 1
    row["best"] = 2.0 / ends.sum()
    row["undamped"] = np.abs(1.0 - ends).max()  # spectral radius of a Jacobi sweep at omega = 1
    for name, omega in (("jacobi, best", row["best"]), ("jacobi, undamped", 1.0)):
        row[name] = lv.solve(problem, "jacobi", omega=omega, tol=TOL, max_iter=1_000_000)
    return row


def solve_by_budget():
    """Return the impulses (40,) [N s] of the shown system: exact, after each budget, and by the loop above."""
    a, b = make_system(SHOWN)
    problem = lv.Problem.linear(a, b)
    after = {n: lv.solve(problem, "gauss_seidel", tol=0.0, max_iter=n).impulse for n in BUDGETS}
    return {
        "exact": lv.solve(problem, "direct", tol=1e-12).impulse,
        "after": after,
        "by hand": {n: sweep_by_hand(a, b, n) for n in BUDGETS},
    }


def numbers():
    """Return the solved systems by condition number, one solution row by row, and the counted cost by rows."""
    return Numbers(
        systems=lambda: {condition: solve_system(condition) for condition in CONDITIONS},
        rows=solve_by_budget,
        cost=lambda: {k * k: count_multiplications(k) for k in SIDES},
    )


def draw_sweeps(axes, found):
    """Draw the residual against the sweeps for each condition number."""
    for i, row in enumerate(found["systems"].values()):
        for solver, style in zip(SOLVERS, ("-", "--"), strict=True):
            h = row[solver].history
            rounded = float(f"{row['condition']:.2g}")
            label = f"{SOLVERS[solver]},\ncondition {rounded:,g}"
            axes.loglog(h.iterations[1:], h.relative[1:], style, color=f"C{i}", label=label)
        axes.axhline(row["direct"].residual.relative, color=f"C{i}", linestyle=":", linewidth=0.8)
    axes.set(
        title="dotted: direct, one factorisation", xlabel="sweeps", ylabel="relative residual [-]"
    )
    put_legend_right(axes)


def draw_rows(axes, found):
    """Draw the impulse of every row, direct and after each budget."""
    row = np.arange(1, ROWS + 1)
    axes.bar(row, found["rows"]["exact"], color="0.8", label="direct")
    for (n, impulse), style in zip(
        found["rows"]["after"].items(), ("C3x", "C1.", "C0_"), strict=True
    ):
        axes.plot(row, impulse, style, label=f"{n} sweeps")
    axes.axhline(0.0, color="k", linewidth=0.8)
    title = f"Gauss-Seidel, condition {np.linalg.cond(make_system(SHOWN)[0]):,.0f}"
    axes.set(title=title, xlabel="row", ylabel="impulse [N s]")
    put_legend_right(axes)


def draw_cost(axes, found):
    """Draw the multiplications against the number of rows."""
    n = list(found["cost"])
    for (name, style), color in zip(
        (
            ("dense", "s-"),
            ("banded", "o-"),
            ("sparse", "^-"),
            ("gauss_seidel", "x--"),
            ("jacobi", "+--"),
        ),
        ("k", "C2", "C4", "C0", "C1"),
        strict=True,
    ):
        label = f"{SOLVERS[name]} sweeps" if name in SOLVERS else f"{name} factorisation"
        axes.loglog(
            n, [found["cost"][i][name] for i in n], style, color=color, markersize=5, label=label
        )
    axes.set(title="a square lattice", xlabel="rows n", ylabel="multiplications")
    put_legend_right(axes)


PANELS = {"sweeps": draw_sweeps, "rows": draw_rows, "cost": draw_cost}


def print_numbers(found):
    """Print the tables."""
    print(f"{'condition':>10} {'direct':>9} {'Gauss-Seidel':>14} {'Jacobi':>10} {'ratio':>7}")
    print(
        f"{'':>10} {'residual':>9} {'sweeps':>14} {'sweeps':>10}   (to a relative residual of {TOL:g})"
    )
    for row in found["systems"].values():
        sweeps = [row[s].work["sweeps"] for s in SOLVERS]
        print(
            f"{row['condition']:>10.1e} {row['direct'].residual.relative:>9.1e} {sweeps[0]:>14} {sweeps[1]:>10} "
            f"{sweeps[1] / sweeps[0]:>7.1f}"
        )
    print("Jacobi: undamped spectral radius and status; best omega and its sweeps")
    for row in found["systems"].values():
        print(
            f"{row['condition']:>10.1e} {row['undamped']:>9.2f} {row['jacobi, undamped'].status.name.lower():>14} "
            f"{row['best']:>10.2f} {row['jacobi, best'].work['sweeps']:>7}"
        )
    exact = found["rows"]["exact"]
    for n, x in found["rows"]["after"].items():
        by_hand = np.abs(found["rows"]["by hand"][n] - x).max()
        print(
            f"after {n:>2} sweeps rows differ by up to {np.abs(x - exact).max():.3f} N s from the solution, whose "
            f"largest is {np.abs(exact).max():.2f}; the loop above differs by {by_hand:.0e}"
        )
    print("\nmultiplications on a square lattice")
    names = ("dense", "banded", "sparse", *SOLVERS)
    print(f"{'rows':>6}" + "".join(f"{name:>14}" for name in names))
    for n, by in found["cost"].items():
        print(f"{n:>6}" + "".join(f"{by[name]:>14.2e}" for name in names))
    largest = found["cost"][max(found["cost"])]
    ratio = largest["gauss_seidel"] / largest["banded"]
    print(f"on the largest lattice sweeps cost {ratio:.1f} times the banded factorisation")


def main(path="direct_or_iterate.png"):
    """Print the tables and draw the figure."""
    show(PANELS, numbers(), print_numbers, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
