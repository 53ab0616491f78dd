"""Second-order solver for every law: interior point, active-set polish, proximal Newton.

    z = D^1/2 lambda,   H = D^-1/2 A D^-1/2,   s = H z - g complementary to z on every block

0. A warm start over bodies is judged first; then at most 64 sweeps (counted in `work`) and, for contacts, at most
   six Newton steps over the bodies, or one banded factorisation of joints alone, where these will do
   (`warm_start.py`).
1. Newton's method on the natural map from the warm start, then from the solution of H z = g.
2. A cold Mehrotra interior point, polished on the identified rows as soon as it has found them, to the floor of
   float64.
3. Where that stops short on rows that nearly depend on each other: both again through the augmented
   system of the bodies.
4. Coulomb friction by a proximal Newton method on the Alart-Curnier map, and by interior points on
   De Saxce's form of the law, whose convex problem moves with every step.

The parts stand in `_newton/`. Form "velocity" factors I + K^T V K over the bodies and never squares J; "impulse"
factors over the rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np

from lavender._arrays import FloatArray
from lavender.errors import InputError
from lavender.problem import Problem
from lavender.registry import SolverSpec
from lavender.solution import Claim, Status
from lavender.solvers._newton.convex import solve_convex
from lavender.solvers._newton.coulomb import solve_coulomb
from lavender.solvers._newton.run import Run
from lavender.solvers._newton.systems import System, make_system
from lavender.solvers.warm_start import claim_of, warm_start

FORMS = ("auto", "velocity", "impulse")


@dataclass
class NewtonState:
    """The system of a problem, made once."""

    problem: Problem
    system: System | None  # None where nothing moves


@dataclass(frozen=True)
class Newton:
    """Interior point and semismooth Newton.

    Parameters
    ----------
    form : {"auto", "velocity", "impulse"}
        Unknowns of the factorisation: the bodies (needs rows) or the rows of A. "auto": the bodies where
        they are known.
    """

    form: str = "auto"

    @np.errstate(all="ignore")  # what overflows is judged
    def prepare(self, problem: Problem) -> NewtonState:
        if self.form not in FORMS:
            raise InputError(f"form is {self.form!r}; one of {', '.join(FORMS)} is needed")
        if self.form == "velocity" and problem.rows is None:
            raise InputError(
                "form='velocity' needs a problem with rows (Problem.from_rows); this one was given as a matrix"
            )
        if problem.m == 0:
            return NewtonState(problem, None)
        form = self.form
        if form == "auto":
            form = "impulse" if problem.rows is None or problem.rows.n_bodies == 0 else "velocity"
        system = make_system(problem, form)
        return NewtonState(problem, system if system.sc.m else None)

    def update(self, state: NewtonState, problem: Problem) -> NewtonState:
        return self.prepare(problem)

    @np.errstate(all="ignore")  # what overflows is judged
    def run(
        self, state: NewtonState, impulse: FloatArray, n: int, tol: float, time_limit: float | None = None
    ) -> Claim:
        problem, system = state.problem, state.system
        if problem.m == 0:
            return Claim(Status.CONVERGED, 0)
        if system is None:
            system = make_system(problem, "impulse")
            impulse[:] = system.sc.fixed
            return Claim(Status.STALLED, 0, {"factorisations": 0}, "no row can move")
        cold = bool(np.array_equal(impulse, problem.start()))
        sweeps = system.factorisations = 0
        if not cold and self.form == "auto":
            tried = warm_start(problem, impulse, tol, n, time_limit)
            claim, sweeps, system.factorisations = claim_of(tried), tried.sweeps, tried.factorisations
            if claim is not None:
                return claim
        deadline = np.inf if time_limit is None else perf_counter() + time_limit
        run = Run(system, tol, n, deadline)
        z = system.sc.unknown(impulse)
        run.score(z)
        interrupted = False
        try:
            if not run.done():
                if problem.law == "coulomb" and system.sc.has_friction:
                    solve_coulomb(run, z, cold)
                else:
                    solve_convex(run, z, cold)
        except KeyboardInterrupt:
            interrupted = True  # the best iterate goes back all the same
        impulse[:] = system.sc.impulse(run.best_z)
        if interrupted:
            status = Status.INTERRUPTED
        elif run.certificate is not None:
            status = Status.INFEASIBLE
        elif run.reached():
            status = Status.CONVERGED
        elif run.at_floor():
            status = Status.FLOOR
        elif system.factorisations >= n:
            status = Status.MAX_ITERATIONS
        elif run.spent():
            status = Status.TIME_LIMIT
        else:
            status = Status.STALLED
        work = {"factorisations": system.factorisations} | ({"sweeps": sweeps} if sweeps else {})
        return Claim(
            status,
            system.factorisations,
            work,
            run.message,
            form=system.form,
            certificate=run.certificate,
        )


SPEC = SolverSpec(
    name="newton",
    factory=Newton,
    laws=frozenset({"linear", "lcp", "coulomb", "cone"}),
    resumable=False,
    max_iter=1500,
    options={"form": "auto, velocity (bodies) or impulse (rows): unknowns of the factorisation"},
    summary="interior point, active-set polish and proximal semismooth Newton",
    reference="Mehrotra 1992; Nesterov, Todd 1997; Hintermueller, Ito, Kunisch 2002; Alart, Curnier 1991; "
    "De Saxce, Feng 1998",
)
