"""Do the solvers agree? Each one beside an optimum that OSQP found and the judge has accepted.

On the optimum of a symmetric positive semidefinite problem the slack w = A l - b is unique, the impulses
need not be: four corners of a box share its weight in many ways. So solvers are compared in the energy norm

    |Delta|_A = sqrt((l1 - l2).A (l1 - l2))   [sqrt J]

which no residual can hide: |Delta|_A^2 <= |Delta|_A |eps|_A + |eps|_D |Delta|_D, eps = e1 - e2.
At mass ratio 1e6 sweeps have not moved the heavy box when they stop, say so, and are not believed.

    python examples/cross_validate.py [FIGURE.png]
"""

import sys

import lavender as lv
from lavender import suite

CASES = (
    "stack(n=16)",
    "box_stack(n=4)",
    "box_stack(n=4, mass_ratio=1e6)",
    "random_spd(n=50)",
    "boxed_friction(n=3)",
)
TOL = 1e-6
SWEEPS = 20_000


def numbers():
    """A CrossCheck for each case, over solvers of every kind that are installed."""
    wanted = ("direct", "pgs", "sequential_impulses", "jacobi", "osqp", "clarabel", "piqp", "quadprog")
    found = {}
    for name in CASES:
        problem = suite.case(name).problem
        solvers = [s for s in lv.available(problem) if s in wanted]
        found[name] = lv.cross_check(problem, solvers, reference="osqp", tol=TOL, max_iter=SWEEPS)
    return found


def figure(found, path):
    """Distance to the reference against the distance that the residuals allow."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(8, 4.5), layout="constrained")
    axes = canvas.subplots()
    for i, (name, table) in enumerate(found.items()):
        compared = [row for row in table if row.distance is not None]
        axes.loglog(
            [max(row.allowed, 1e-18) for row in compared],
            [max(row.distance, 1e-18) for row in compared],
            "o",
            color=f"C{i}",
            label=name,
        )
    ends = [1e-18, 1e3]
    axes.loglog(ends, ends, "k--", linewidth=0.8)
    axes.set(
        xlabel="allowed by the residuals [sqrt J]",
        ylabel="distance to the reference $|\\Delta|_A$ [sqrt J]",
        title="no point may lie above the line",
    )
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
    canvas.savefig(path)


def main(path="cross_validate.png"):
    """Print the tables, save the figure."""
    found = numbers()
    for table in found.values():
        print(table, end="\n\n")
    wrong = [row.solver for table in found.values() for row in table.contradicted]
    print(f"claims contradicted: {', '.join(wrong) or 'none'}")
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
