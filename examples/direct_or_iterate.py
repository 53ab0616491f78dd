"""Experiment 1: solve A x = b directly, or iterate? What sweeps know on the way, and what either costs.

A is symmetric positive definite with 40 rows, unit diagonal and a given condition number. The direct
solver does the same work for each and ends at the floor of float64. Gauss-Seidel needs more sweeps the
larger the condition number is, Jacobi more still. Row by row, a few sweeps find the rough shape of x; what is left
is what neighbours must agree on.

Jacobi is damped here: x <- x - omega D^-1 (A x - b) multiplies the error by I - omega D^-1 A, whose spectral radius
must stay below 1. Undamped (omega = 1) it does not, on any of these systems. `jacobi` takes an omega that is safe for
every positive semidefinite A; with the eigenvalues known, 2 / (smallest + largest) of D^-1 A is the best.

What a factorisation costs is its structure. On a square lattice of n = k^2 rows, row i tied to its four
neighbours, multiplications are counted:

    dense    n^3/6               banded   n k (k + 3)/2, bandwidth k
    sparse   sum over the columns of c (c + 3)/2, c entries below the diagonal of the factor, by minimum degree
    sweeps   nonzeros of A for each, until the relative residual is 1e-6

    python examples/direct_or_iterate.py [FIGURE.png]

A file named after a panel holds it alone: sweeps.png, cost.png.
"""

import sys

import numpy as np
from panels import beside, save
from scipy import sparse

import lavender as lv

CONDITIONS = (1e1, 1e2, 1e3, 1e4)
ROWS = 40
TOL = 1e-6  # relative residual
SOLVERS = {"gauss_seidel": "Gauss-Seidel", "jacobi": "Jacobi"}
SWEEPS = (4, 16, 64)  # after which single rows are shown
SHOWN = 1e2  # condition number of the system whose rows are shown
SIDES = (4, 6, 8, 12, 16, 24, 32)  # k


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


def lattice(k):
    """The matrix (k^2, k^2) of a square lattice: 4 on the diagonal, -1 for each neighbour."""
    line = sparse.diags([2.0 * np.ones(k), -np.ones(k - 1), -np.ones(k - 1)], [0, 1, -1])
    return sparse.csr_matrix(sparse.kron(line, sparse.eye(k)) + sparse.kron(sparse.eye(k), line))


def cost(k):
    """Multiplications of each way on the lattice of side k."""
    a = lattice(k)
    n = k * k
    factor = sparse.linalg.splu(
        a.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
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


def numbers():
    """By condition number the sweeps to TOL, histories and what the direct solver reached; rows; counted cost."""
    out = {}
    for condition in CONDITIONS:
        a, b = spd(condition)
        problem = lv.Problem.linear(a, b)
        row = {"condition": float(np.linalg.cond(a)), "direct": lv.solve(problem, "direct", tol=1e-12)}
        for solver in SOLVERS:
            row[solver] = lv.solve(problem, solver, tol=TOL, max_iter=1_000_000, history=True)
        ends = np.linalg.eigvalsh(a)[[0, -1]]  # of D^-1 A, since d = 1
        row["best"] = 2.0 / ends.sum()
        row["undamped"] = np.abs(1.0 - ends).max()  # spectral radius of Jacobi's sweep at omega = 1
        for name, omega in (("jacobi, best", row["best"]), ("jacobi, undamped", 1.0)):
            row[name] = lv.solve(problem, "jacobi", omega=omega, tol=TOL, max_iter=1_000_000)
        out[condition] = row
    shown = lv.Problem.linear(*spd(SHOWN))
    after = {n: lv.solve(shown, "gauss_seidel", tol=0.0, max_iter=n).impulse for n in SWEEPS}
    return {"systems": out, "after": after, "cost": {k * k: cost(k) for k in SIDES}}


def draw_sweeps(axes, found):
    """Residual against sweeps at each condition number."""
    for i, row in enumerate(found["systems"].values()):
        for solver, style in zip(SOLVERS, ("-", "--"), strict=True):
            h = row[solver].history
            label = f"{SOLVERS[solver]},\ncondition {row['condition']:,.0f}"
            axes.loglog(h.iterations[1:], h.relative[1:], style, color=f"C{i}", label=label)
        axes.axhline(row["direct"].residual.relative, color=f"C{i}", linestyle=":", linewidth=0.8)
    axes.set(title="dotted: direct, one factorisation", xlabel="sweeps", ylabel="relative residual [-]")
    beside(axes)


def draw_cost(axes, found):
    """Multiplications against rows."""
    n = list(found["cost"])
    for (name, style), color in zip(
        (("dense", "s-"), ("banded", "o-"), ("sparse", "^-"), ("gauss_seidel", "x--"), ("jacobi", "+--")),
        ("k", "C2", "C4", "C0", "C1"),
        strict=True,
    ):
        label = f"{SOLVERS[name]} sweeps" if name in SOLVERS else f"{name} factorisation"
        axes.loglog(n, [found["cost"][i][name] for i in n], style, color=color, markersize=5, label=label)
    axes.set(title="a square lattice", xlabel="rows n", ylabel="multiplications")
    beside(axes)


PANELS = {"sweeps": draw_sweeps, "cost": draw_cost}


def main(path="direct_or_iterate.png"):
    """Print the tables, save the figure."""
    found = numbers()
    print(f"{'condition':>10} {'direct':>9} {'Gauss-Seidel':>14} {'Jacobi':>10} {'ratio':>7}")
    print(f"{'':>10} {'residual':>9} {'sweeps':>14} {'sweeps':>10}   (to a relative residual of {TOL:g})")
    for row in found["systems"].values():
        sweeps = [row[s].work["sweeps"] for s in SOLVERS]
        print(
            f"{row['condition']:>10.1e} {row['direct'].residual.relative:>9.1e} {sweeps[0]:>14} {sweeps[1]:>10} "
            f"{sweeps[1] / sweeps[0]:>7.1f}"
        )
    print("Jacobi: undamped spectral radius, how it ends; best omega and its sweeps")
    for row in found["systems"].values():
        print(
            f"{row['condition']:>10.1e} {row['undamped']:>9.2f} {row['jacobi, undamped'].status.name.lower():>14} "
            f"{row['best']:>10.2f} {row['jacobi, best'].work['sweeps']:>7}"
        )
    exact = found["systems"][SHOWN]["direct"].impulse
    for n, x in found["after"].items():
        print(
            f"after {n:>2} sweeps rows differ by {np.abs(x - exact).max():.3f} N s of {np.abs(exact).max():.2f}"
        )
    print("\nmultiplications on a square lattice")
    names = ("dense", "banded", "sparse", *SOLVERS)
    print(f"{'rows':>6}" + "".join(f"{name:>14}" for name in names))
    for n, by in found["cost"].items():
        print(f"{n:>6}" + "".join(f"{by[name]:>14.2e}" for name in names))
    most = found["cost"][max(found["cost"])]
    print(f"on the largest lattice sweeps cost {most['gauss_seidel'] / most['banded']:.1f} times the band")
    save(PANELS, found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
