"""Contact problems in three units, solved by QP packages that have no row in `backends.json`, each alone.

    python findings/probes/contact_probes.py [NAME ...]

prints for each installed package and unit how many problems are solved, reported as solved although wrong, and not
solved. The problems are those of the sets "default", "hard" and "engine" with at most 120 rows, symmetric semidefinite
A and fixed bounds (friction bounded by the exact normal impulses). The units multiply A by 1, 1e6 and 1e-6, which
divides impulses and bounds by the same number.
"""

import contextlib
import io
import sys
import warnings

import numpy as np

import lavender as lv

MAX_ROWS = 120
UNITS = (1.0, 1e6, 1e-6)
TOLERANCE = 1e-3  # energy residual, relative to the zero impulse
TIME_LIMIT = 2.0  # s for a problem, for packages with a limit


def make_problems():
    """Return (A, b, lower, upper) of each problem."""
    problems = []
    for name in dict.fromkeys(
        n for key in ("default", "hard", "engine") for n in lv.suite.SETS[key]
    ):
        problem = lv.suite.case(name).problem
        if problem.m > MAX_ROWS or not problem.is_symmetric:
            continue
        if problem.friction != "linear":
            cone = problem if problem.friction == "cone" else problem.relaxed("cone")
            impulse = lv.solve(cone, "newton", tol=1e-10, max_iter=500).impulse
            normals = impulse[problem.cones.normal_rows]
            problem = problem.boxed(np.maximum(normals, 1e-3 * np.abs(impulse).max()))
        if (
            problem.is_semidefinite
            and lv.solve(problem, tol=1e-9).status is not lv.Status.INFEASIBLE
        ):
            A = problem.dense()
            problems.append(((A + A.T) / 2, problem.b, problem.cones.lower, problem.cones.upper))
    return problems


def call_pounce(method, A, b, low, high):
    import pounce

    found = pounce.solve_qp(P=A, c=-b, lb=low, ub=high, method=method, time_limit=TIME_LIMIT)
    return np.array(found.x), found.status == "optimal"


def call_superadmm(A, b, low, high):
    from superADMM import getOptimOpts, superADMM

    options = getOptimOpts() | {"verbose": 0}
    x, _, flag, _ = superADMM(A, -b, np.eye(len(b)), low, high, options=options)
    return np.ravel(x), flag == 1


def call_elastiqp(method, A, b, low, high):
    """Call ElastiQP, whose bounds are soft with a linear penalty: 1e6 is above each multiplier here."""
    import elastiqp

    rows = np.vstack([np.eye(len(b))[np.isfinite(high)], -np.eye(len(b))[np.isfinite(low)]])
    sides = np.concatenate([high[np.isfinite(high)], -low[np.isfinite(low)]])
    found = elastiqp.solve(
        np.asfortranarray(A), -b, np.asfortranarray(rows), sides, 1e6, method=method
    )
    return np.array(found.x), found.status == elastiqp.Status.Solved


def call_ipax(A, b, low, high):
    import ipax

    class Program(ipax.QuadraticProblem):
        def bounds(self):
            return low, high

    found = ipax.solve(
        Program(A, -b),
        np.clip(np.zeros(len(b)), low, high),
        options=ipax.Options(max_time=TIME_LIMIT),
    )
    return np.array(found.x), found.status is ipax.Status.OPTIMAL


CALLS = {
    "pounce": lambda *problem: call_pounce("active-set", *problem),
    "pounce ipm": lambda *problem: call_pounce("ipm", *problem),
    "superADMM": call_superadmm,
    "elastiqp": lambda *problem: call_elastiqp("das", *problem),
    "elastiqp ipm": lambda *problem: call_elastiqp("ipm", *problem),
    "ipax": call_ipax,
}


def find_energy(A, b, low, high, x):
    """Return the energy residual of x: sqrt(sum d e^2) of the projected Gauss-Seidel steps e."""
    d = np.where(np.diag(A) > 0, np.diag(A), np.abs(A).max())
    step = x - np.clip(x - (A @ x - b) / d, low, high)
    return np.sqrt(np.sum(d * step**2))


def count_answers(call, problems, unit):
    """Return the numbers of right, wrong and missing answers."""
    counts = [0, 0, 0]
    for A, b, low, high in problems:
        arrays = A * unit, b.copy(), low / unit, high / unit
        try:
            with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
                warnings.simplefilter("ignore")
                x, claimed = call(*(a.copy() for a in arrays))
        except ModuleNotFoundError:
            raise
        except Exception:  # Packages raise their own exceptions.
            claimed = False
        zero = find_energy(*arrays, np.clip(np.zeros(len(b)), arrays[2], arrays[3]))
        counts[2 if not claimed else 0 if find_energy(*arrays, x) <= TOLERANCE * zero else 1] += 1
    return tuple(counts)


if __name__ == "__main__":
    problems = make_problems()
    print(f"{len(problems)} problems: solved, wrong, not solved with A times", *UNITS)
    for name in sys.argv[1:] or CALLS:
        with contextlib.suppress(ModuleNotFoundError):
            print(
                f"{name:12}",
                *(count_answers(CALLS[name], problems, unit) for unit in UNITS),
                flush=True,
            )
