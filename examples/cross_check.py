"""Do solvers of every kind agree? One LCP and one boxed LCP by all of them, beside OSQP's optimum.

An LCP with symmetric positive semidefinite A is the optimality condition of a quadratic program, so that a QP solver
and a solver of the LCP check each other. The problems are the suite's: eight contacts of which one opens, and two
boxes whose tangents have bounds of a fixed size. Each is solved directly, by Gauss-Seidel, Jacobi and projected
Gauss-Seidel, and by every QP backend that is installed. The distance of each answer from OSQP's is measured as the
energy of the difference of velocities,

    |l - l_osqp|_A = sqrt((l - l_osqp).A (l - l_osqp))   [sqrt J]

since velocities are unique where impulses need not be: a box on four corners shares its weight in many ways. "allowed"
is the largest distance that the judge's residual of the answer leaves room for: a larger one would show that the
residual is computed wrongly. A solver that fails says so: `quadprog` factors A, which is singular for the boxes.

    python examples/cross_check.py [FIGURE.png]

The chapter shows it as boxed.png.
"""

import sys

from panels import save

import lavender as lv
from lavender import registry, suite

CASES = {"lcp": "toy_stack", "boxed": "boxed_friction(n=2)"}
OURS = ("direct", "gauss_seidel", "jacobi", "pgs")
TOL = 1e-8  # relative residual


def backends(problem):
    """QP backends that are installed and take the problem."""
    return [name for name in lv.available(problem) if registry.get(name).external]


def numbers():
    """A table of `cross_check` for each case."""
    out = {}
    for name, case in CASES.items():
        problem = suite.case(case).problem
        out[name] = lv.cross_check(problem, [*OURS, *backends(problem)], "osqp", tol=TOL, max_iter=100_000)
    return out


def draw_boxed(axes, found):
    """Of the boxed LCP the distance of each solver, and how far its residual lets it be."""
    table = found["boxed"]
    said = {table.reference: " (the reference)"}
    names = [
        (f"{row.solver} → {row.ran}" if row.ran else row.solver)
        + said.get(row.solver, "" if row.verdict == "agrees" else f" ({row.verdict})")
        for row in table
    ]
    place = range(len(names))
    axes.semilogx([max(row.distance, 1e-17) for row in table], place, "o", label="distance")
    axes.semilogx([row.allowed for row in table], place, "k|", markersize=10, label="allowed")
    axes.set_yticks(place, names, fontsize=8)
    axes.invert_yaxis()
    axes.set(title=f"{table.problem.name}, to {TOL:g}", xlabel=r"distance from OSQP's optimum [$\sqrt{J}$]")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)


PANELS = {"boxed": draw_boxed}


def main(path="cross_check.png"):
    """Print both tables, save the figure."""
    found = numbers()
    for table in found.values():
        print(f"{table}\n{len(table.agreed)} of {len(table)} agree with {table.reference}\n")
    save(PANELS, found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
