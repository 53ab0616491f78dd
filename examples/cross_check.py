"""Do solvers of every kind agree? One LCP and one boxed LCP by all of them, compared with OSQP's optimum.

An LCP with symmetric positive semidefinite A is the optimality condition of a quadratic program, so a QP solver and
an LCP solver check each other. The problems are cases of the suite: eight contacts of which one opens, and two boxes
whose tangents have bounds of a fixed size. Each is solved directly, by Jacobi and projected Gauss-Seidel, and by
every QP backend that is installed. `gauss_seidel` has no bounds; the comparison runs `pgs` in its place and shows it
as "gauss_seidel → pgs". The distance of each answer from OSQP's is measured as the energy of the difference of
velocities,

    |l - l_osqp|_A = sqrt((l - l_osqp).A (l - l_osqp))   [sqrt J]

since velocities are unique even if impulses are not: a box on four corners can share its weight in many ways.
"allowed" is the largest distance that the judge's residual of the answer allows; a larger distance would show that
the residual is computed wrongly. `quadprog` factors A, which is singular for the boxes, and is listed as not solved.

    python examples/cross_check.py [FIGURE.png]

The chapter shows it as boxed.png.
"""

import sys

from panels import Numbers, show

import lavender as lv
from lavender import registry, suite

CASES = {"lcp": "toy_stack", "boxed": "boxed_friction(n=2)"}
OURS = ("direct", "gauss_seidel", "jacobi", "pgs")
TOL = 1e-8  # relative residual


def list_backends(problem):
    """Return the QP backends that are installed and accept the problem."""
    return [name for name in lv.available(problem) if registry.get(name).external]


def compare(case):
    """Return the table of `cross_check` for a case."""
    problem = suite.case(case).problem
    return lv.cross_check(
        problem, [*OURS, *list_backends(problem)], "osqp", tol=TOL, max_iter=100_000
    )


def numbers():
    """Return the table of each case."""
    return Numbers(**{name: (lambda case=case: compare(case)) for name, case in CASES.items()})


def draw_boxed(axes, found):
    """Draw the distance of each solver on the boxed LCP, and the distance that its residual allows."""
    table = found["boxed"]
    notes = {table.reference: " (the reference)"}
    names = [
        (f"{row.solver} → {row.ran}" if row.ran else row.solver)
        + notes.get(row.solver, "" if row.verdict == "agrees" else f" ({row.verdict})")
        for row in table
    ]
    place = range(len(names))
    axes.semilogx([max(row.distance, 1e-17) for row in table], place, "o", label="distance")
    axes.semilogx([row.allowed for row in table], place, "k|", markersize=10, label="allowed")
    axes.set_yticks(place, names, fontsize=8)
    axes.invert_yaxis()
    axes.set(
        title=f"{table.problem.name}, to {TOL:g}",
        xlabel=r"distance from OSQP's optimum [$\sqrt{J}$]",
    )
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)


PANELS = {"boxed": draw_boxed}


def print_numbers(found):
    """Print both tables."""
    for table in found.values():
        print(f"{table}\n{len(table.agreed)} of {len(table)} agree with {table.reference}\n")


def main(path="cross_check.png"):
    """Print the tables and draw the figure."""
    show(PANELS, numbers(), print_numbers, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
