"""What a solution says about the solvers that ran: work that was done is counted and named, and a start is called a
solution only if it is returned as it was given and meets the tolerance.
"""

import numpy as np
import pytest
from drawn_worlds import AXES, draw_worlds
from random_problems import as_matrix, general, make_well_posed_problem

import lavender as lv
from lavender.judge.residuals import combine_best_islands
from lavender.problem.cones import project_impulse
from lavender.solvers import registry

TOL = 1e-6
#: Messages of a solve in which no solver ran, and what they state about the impulse.
IS_START = "the start is a solution"
IS_MOVED = "the start is a solution after"
LAWS = ("linear", "lcp", "coulomb", "cone")
SOLVERS = [name for name, spec in registry.specs().items() if spec.builtin and not spec.external]


def axis_contact(law, form):
    """Return a block of 2 kg that approaches the ground along its axes: a few sweeps solve it exactly."""
    jac = np.eye(3)[[2, 0, 1]]
    mass = 2.0 * np.eye(3)
    free = np.array([2.0, 0.0, -1.0])
    if law in ("linear", "lcp"):
        bound = np.full(3, np.inf)
        cones = lv.Cones.bounded(-bound if law == "linear" else np.zeros(3), bound)
        problem = lv.Problem.from_jacobian(jac, mass, free, cones=cones)
    else:
        problem = lv.Problem.from_jacobian(
            jac, mass, free, cones=lv.Cones.contacts(0.4), friction=law
        )
    return as_matrix(problem) if form == "matrix" else problem


def iterate_problems(law):
    """Yield (name, problem) of a law in each form."""
    for form in ("generalized", "matrix"):
        yield f"axis contact, {form}", axis_contact(law, form)
    bodies = make_well_posed_problem(law, True)
    yield "bodies", bodies
    yield "bodies as a matrix", as_matrix(bodies)
    yield "bodies as J and M", general(bodies)


def iterate_starts(problem):
    """Yield (name, start (m,) [N s] or None): the solution, zeros, the start of the next step, one far away."""
    solution = lv.solve(problem, tol=1e-9).impulse
    rng = np.random.default_rng(1)
    yield "none", None
    yield "zeros", np.zeros(problem.m)
    yield "solution", solution.copy()
    yield "near", solution * (1.0 + 1e-3 * rng.standard_normal(problem.m))
    yield "far", 1e3 * (1.0 + np.abs(solution))


def iterate_calls(problem, solver, start):
    """Yield (name, solution) of each way to call a solver."""
    yield "solve", lv.solve(problem, solver, impulse=start, tol=TOL)
    yield "prepare", lv.prepare(problem, solver).solve(impulse=start, tol=TOL)
    yield "solve_many", lv.solve_many([problem], solver, impulses=[start], tol=TOL)[0]
    yield "limit", lv.solve(problem, solver, impulse=start, tol=TOL, time_limit=100.0)
    yield "max_iter", lv.solve(problem, solver, impulse=start, tol=TOL, max_iter=2000)
    yield "no iterations", lv.solve(problem, solver, impulse=start, tol=TOL, max_iter=0)
    if problem.generalized is not None:
        g = problem.generalized
        batch = lv.Batch(
            np.array([g.jac.toarray()] * 2),
            np.array([[g.momentum_of(column) for column in np.eye(g.nv)]] * 2),
            np.array([g.v_free] * 2),
            target=problem.b + g.velocity_of(g.v_free),
            cones=problem.cones,
            compliance=problem.compliance,
            friction=problem.friction,
        )
        starts = None if start is None else np.array([start] * 2)
        yield "batch", lv.solve_many(batch, solver, impulse=starts, tol=TOL)[1]


def find_fault(problem, start, solution):
    """Return what is wrong with the account of a solution; empty if nothing is."""
    given = problem.start() if start is None else start
    work, message = sum(dict(solution.work).values()), solution.message
    same = np.array_equal(solution.impulse, given)
    solved = solution.residual.relative <= TOL
    if work:
        if "start is a solution" in message:
            return "work, and the start is called a solution"
        if solution.solver.name != "auto":  # Others may have factored without an iteration.
            return ""
        if not all(stage.solver.split()[0] in message for stage in solution.stages):
            return "a solver that ran is not named"
        return "" if solution.iterations else "work without iterations"
    if solution.iterations:
        return "iterations without work"
    if message.startswith(IS_MOVED):
        cones, moved = problem.cones, solution.impulse != given
        allowed = [project_impulse(cones, given), problem.start()]
        known = np.logical_or.reduce(
            [np.isclose(solution.impulse, x, rtol=1e-12, atol=0.0) for x in allowed]
        )
        return "" if solved and moved.any() and known.all() else "the start is not the result"
    if message.startswith(IS_START):
        return "" if solved and same else "the start is not the result, or no solution"
    return "" if message and not solved else "no reason is given"


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("solver", SOLVERS)
def test_what_ran_is_what_is_said(solver, law):
    faults = []
    for name, problem in iterate_problems(law):
        if registry.get(solver).refuses(problem):
            continue
        for named, start in iterate_starts(problem):
            for call, solution in iterate_calls(problem, solver, start):
                fault = find_fault(problem, start, solution)
                if fault:
                    faults.append((name, named, call, fault, solution.message, dict(solution.work)))
    assert not faults, "\n".join(map(str, faults[:20])) + f"\n{len(faults)} in all"


def is_behind(problem, impulse, other, tol, by_energy):
    """Return whether an island of `impulse` ends behind `other` by the measure of the returned impulse."""
    inside = project_impulse(problem.cones, other)
    best = combine_best_islands(problem, impulse, (inside,), tol, by_energy=by_energy)
    return not np.array_equal(best, impulse)


@pytest.mark.parametrize(("seed", "law"), [(14, "lcp"), (46, "cone"), (1012, "cone")])
def test_a_start_costs_nothing(seed, law, monkeypatch):
    if seed == 1012:  # Contacts that no impulse moves, and that slide.
        monkeypatch.setitem(AXES, "coupling", ("an empty row",))
    rng = np.random.default_rng(seed)
    faults = []
    for i, world in enumerate(draw_worlds(seed, 14, law)):
        problem = world.make_problem()
        cold = lv.solve(problem, tol=1e-9)
        size = np.abs(cold.impulse).max() or 1.0
        noise = rng.standard_normal(problem.m)
        near = cold.impulse * (1.0 + 1e-3 * noise)
        for start in (size * noise, 1e6 * size * noise, 1e20 * noise, near, np.ones(problem.m)):
            s = lv.solve(problem, impulse=start, tol=1e-9)
            is_said = s.work or np.array_equal(s.impulse, start) or "were moved" in s.message
            if not is_said:
                faults.append((i, "the start was replaced silently", s.message))
            if s.residual.relative <= 1e-9 or s.status is lv.Status.ROUNDOFF_LIMIT:
                continue
            proved = s.status is lv.Status.INFEASIBLE
            if cold.residual.relative <= 1e-9:
                faults.append((i, "solved without the start", s.message))
            elif is_behind(problem, s.impulse, cold.impulse, 1e-9, proved):
                faults.append((i, "behind the solve without a start", s.message))
            if world.choice["coupling"] == "an empty row" and s.residual.relative > 1.0:
                faults.append((i, "a row that no impulse moves is off by more than 1", s.message))
    assert not faults, faults
