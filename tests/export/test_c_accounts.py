"""A run of the C library that counts no work returns its start, and the judge calls it a solution."""

import ctypes as ct

import numpy as np
import pytest
from clib import METHODS
from random_problems import as_matrix, general, make_well_posed_problem

import lavender as lv
from lavender.problem.cones import project_impulse
from lavender.solvers import registry

TOL = 1e-6


def iterate_problems():
    """Yield (name, problem) of each law by bodies, by A, by J and M, and of one contact along its axes."""
    for law in ("linear", "lcp", "coulomb", "cone"):
        bodies = make_well_posed_problem(law, True)
        forms = {"bodies": bodies, "matrix": as_matrix(bodies), "J and M": general(bodies)}
        yield from ((f"{law}, {form}", problem) for form, problem in forms.items())
    contact = lv.Problem.from_jacobian(
        np.eye(3)[[2, 0, 1]], 2.0 * np.eye(3), np.array([2.0, 0.0, -1.0]), cones=lv.Cones.contacts(0.4)
    )  # fmt: skip
    yield "axis contact, J and M", contact
    yield "axis contact, matrix", as_matrix(contact)


def iterate_starts(problem):
    """Yield (name, start (m,) [N s] or None): none, zeros, the solution, the next step's, one far away."""
    solution = lv.solve(problem, tol=1e-10).impulse
    rng = np.random.default_rng(1)
    yield "none", None
    yield "zeros", np.zeros(problem.m)
    yield "solution", solution.copy()
    yield "near", solution * (1.0 + 1e-3 * rng.standard_normal(problem.m))
    yield "far", 1e3 * (1.0 + np.abs(solution))


@pytest.mark.parametrize("method", METHODS)
def test_a_run_without_work_returns_its_start(library, method):
    faults = []
    runs = 0
    for name, problem in iterate_problems():
        if registry.get(method).refuses(problem):
            continue
        for named, start in iterate_starts(problem):
            given = problem if start is None else problem.updated(guess=start)
            options = library.options(method)
            view = library.problem(given)
            if library.c.lav_takes(ct.byref(view), ct.byref(options)):
                continue
            for budget in (2000, 0):
                solver = library.open(view, options)
                found = solver.run(budget, TOL)
                runs += 1
                work = found.iterations or found.sweeps or found.restarts
                impulse = solver.impulse()
                begin = problem.start() if start is None else start
                solved = lv.residual(problem, impulse).relative <= TOL
                case = name, named, budget, found.iterations, found.sweeps, found.verdict.relative
                if solved != (found.verdict.relative <= TOL):
                    faults.append((*case, "the verdict is not the judge's"))
                if not work:
                    if budget and not solved:
                        faults.append((*case, "no work and no solution"))
                    # Sweeps begin within the bounds, or at zero if that is better.
                    inside = project_impulse(problem.cones, begin)
                    if not any(
                        np.array_equal(impulse, x) for x in (begin, inside, problem.start())
                    ):
                        faults.append((*case, "no work and another impulse"))
    assert runs
    assert not faults, "\n".join(map(str, faults[:20])) + f"\n{len(faults)} in all"
