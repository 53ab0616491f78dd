"""Second-order solver for every law: interior point, active-set polish, proximal Newton.

    z = D^1/2 lambda,   H = D^-1/2 A D^-1/2,   s = H z - g complementary to z on every block

0. A warm start over bodies is judged first. If at most 64 sweeps (counted in `work`), or one banded factorisation of
   joints without other rows, can bring it to tol, these run (`warm_start.py`).
1. Bounded rows: active-set exchanges (Newton's method on the natural map) from the warm start and from the solution of
   H z = g.
2. A cold-started Mehrotra interior point. As soon as the active rows are identified, the solution on them is computed
   to the floor of float64.
3. If rows are nearly dependent and 1 and 2 fail: both again, with the augmented system of the bodies.
4. Coulomb friction: a proximal Newton method on the Alart-Curnier map, and interior points on De Saxce's form of the
   law, whose convex problem changes with every step. Where these stall, a path of smoothed problems (Chen, Mangasarian
   1996) is followed, each step by the coordinate that changes fastest (Rheinboldt 1986), through folds where contacts
   pass from stick to slip.

Problems in generalised coordinates are first solved over their velocities (`newton_systems/general.py`), without
forming A, unless a full A is counted to cost less than a tenth of that (few rows of a soft body). If that fails, 1 to 4
follow over the rows of A, unless form="velocity". Where velocities stand for bodies, of which two at most meet in every
block (free bodies of an engine), 1 to 4 are over these bodies, at once under Coulomb's law and where many contacts are
rigid (`SmallCall.may_cost`).

1 to 4 are compiled (`lavender_ext/newton/plan.pxd`) and run one factorisation at a time; in between, Python checks the
clock, Ctrl-C and certificates. `newton_systems/` makes their linear systems. Form "velocity" factors I + K^T V K over
the bodies and does not square J; "impulse" factors over the rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_choice
from lavender.base.deadline import Deadline, Stopwatch, TooLate
from lavender.base.errors import CapabilityError, InputError
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import compute_relative
from lavender.judge.solution import Claim, Status, counted, summed
from lavender.problem import OPERATORS, Problem
from lavender.solvers.costs import SOFT, STEPS, Count, factorisations, newton_cost
from lavender.solvers.newton_systems import general
from lavender.solvers.newton_systems.systems import System, bodies_of, is_dense, make_system
from lavender.solvers.registry import Solver, SolverSpec
from lavender.solvers.setup_times import (
    analysed,
    dense_work,
    formed_once,
    over_bodies,
    over_rows,
    over_velocities,
)
from lavender.solvers.small import NEWTON
from lavender.solvers.warm_start import claim_of, warm_start
from lavender_ext.core.method import OUTCOMES
from lavender_ext.newton.solve import COUNTED

FORMS = ("auto", "velocity", "impulse")
CHEAPER = 10.0  # times what rows of A cost, from which on velocities are left for them
ONE = Count("velocities", 1.0, 0.0, 0.0, steps=SOFT)  # a multiply-add of theirs, at least
ROWS = 3000  # up to which A is formed where velocities did not end it
WATCHED = 0.05  # s between two looks at Ctrl-C, as factors are counted
TIME_SHARE = 0.5  # of the time left that one turn may take
_ENDS = {
    OUTCOMES["reached"]: Status.CONVERGED,
    OUTCOMES["floor"]: Status.ROUNDOFF_LIMIT,
    OUTCOMES["stuck"]: Status.STALLED,
}
WARM = 1e-3  # relative residual from which rows of A go on from what velocities left


@dataclass
class NewtonState:
    """The linear system of a problem, made once."""

    problem: Problem
    system: System | None  # None where nothing moves
    general: Any = None  # lavender_ext.driver.driver.Driver, in generalised coordinates
    begun: bool = False  # by `turn`

    @property
    def count(self) -> Count:
        """One step: what is factored, by the analysis, and what is read beside it."""
        problem, system = self.problem, self.system
        read = float(problem.metric.work)
        if self.general is not None:
            soft, law = self.general.soft, problem.law
            steps = SOFT if soft and law != "linear" else 1.0 if soft or law == "lcp" else STEPS
            return Count("velocities", self.general.work, read, 0.0, steps=steps)
        if system is None:
            return Count("dense", 0.0, 0.0, float(problem.m))
        if system.form == "velocity":
            return Count("bodies", system.work, read, float(problem.m))
        made = 0.0 if problem.generalized is None else 1e9 * formed_once(problem)
        return Count(
            "dense" if system.dense else "panels",
            system.work,
            system.entries,
            float(problem.m),
            made,
        )

    @property
    def steps(self) -> float:
        """Iterations that it is counted to take: over velocities each is one of an island."""
        islands = 1 if self.general is None else max(1, self.general.islands)
        return factorisations(self.problem.law, self.count.form) * self.count.steps * islands

    @property
    def cost(self) -> float:
        """What it is counted to take to the end [ns]."""
        return newton_cost(self.count, self.problem.law)


@dataclass(frozen=True)
class Newton(Solver):
    """Interior point and semismooth Newton.

    Parameters
    ----------
    form : {"auto", "velocity", "impulse"}
        Unknowns of the factorisation: velocities (needs J and M) or the rows of A. "auto": velocities where
        they are known, but for J and M whose rows of A are counted to cost less than a tenth of them.
    """

    form: str = "auto"

    needs_scipy = True

    def setup_time(self, problem: Problem) -> float:
        """What `prepare` takes [s], as counted."""
        if problem.generalized is not None and self.form != "impulse":
            return over_velocities(problem)
        bodies = problem.rows is not None and problem.rows.n_bodies > 0 and self.form != "impulse"
        if bodies:
            return over_bodies(problem)
        few = not is_dense(problem.max_entries, problem.m, problem.law == "cone")
        return over_rows(problem) + (analysed(problem) if few else 0.0)

    def prepare(self, problem: Problem) -> NewtonState:
        """The system of a problem."""
        return self._prepare(problem, None)

    @np.errstate(all="ignore")  # what overflows is judged
    def _prepare(self, problem: Problem, like: System | None) -> NewtonState:
        check_choice("form", self.form, FORMS)
        if self.form == "velocity" and problem.matrix is not None:
            raise InputError(
                "form='velocity' needs a problem with J and M (Problem.from_rows, Problem.from_jacobian); this one "
                "was given as a matrix"
            )
        if problem.m == 0:
            return NewtonState(problem, None)
        bodies = kernel = None
        over_velocities = problem.generalized is not None and self.form != "impulse"
        if over_velocities:
            most = CHEAPER * _rows_of_j(problem) if self.form == "auto" else inf
            kernel = general.prepare(problem, most / newton_cost(ONE, problem.law))
            if kernel is not None and NewtonState(problem, None, kernel).cost > most:
                kernel = None
        if self.form != "impulse" and (kernel is None or NEWTON.may_cost(problem, kernel) == 0.0):
            bodies = bodies_of(problem)  # interior points are the shorter way
        if bodies is None and kernel is not None:
            return NewtonState(problem, None, kernel)
        if bodies is None and over_velocities and self.form == "velocity":
            raise CapabilityError(
                f"form='velocity' accepts a matrix of {general.MAX_MATRIX_ENTRIES:.1e} values over the velocities of "
                "island (dense or with the factor's own fill); this problem has a larger one: use form='impulse' "
                "or sweeps"
            )
        if problem.cones.has_round:
            raise CapabilityError(
                "round cones of more than two tangents are solved over velocities alone: form='impulse' does not take "
                f"them, and form='velocity' accepts {general.MAX_MATRIX_ENTRIES:.1e} values of an island's matrix"
            )
        form = "impulse" if bodies is None else "velocity"
        system = make_system(problem, form, like, bodies)
        return NewtonState(problem, system if system.solve.m else None)

    def update(self, state: NewtonState, problem: Problem) -> NewtonState:
        """The same of new numbers: between the same bodies the order of elimination stays."""
        return self._prepare(problem, state.system)

    @np.errstate(all="ignore")  # what overflows is judged
    def run(
        self,
        state: NewtonState,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None = None,
    ) -> Claim:
        problem, system = state.problem, state.system
        if problem.m == 0:
            return Claim(Status.CONVERGED, 0)
        if state.general is not None:
            return self._run_general(state, impulse, max_iter, tol, time_limit)
        return self._run_system(problem, system, impulse, max_iter, tol, time_limit)

    @np.errstate(all="ignore")  # what overflows is judged
    def advance(
        self,
        state: NewtonState,
        impulse: FloatArray,
        n: int,
        tol: float,
        time_limit: float | None = None,
        left: int | None = None,
    ) -> Claim:
        """n steps, or a few more up to `left`, on from where the last turn ended; the first from `impulse` (m,).

        Over generalised velocities nothing follows over rows.
        """
        again, state.begun = state.begun, True
        if state.general is None:
            return self._run_system(
                state.problem, state.system, impulse, n, tol, time_limit, again, left or SPEC.max_iter
            )
        claim = general.run(state.problem, state.general, impulse, n, tol, time_limit, again)
        if claim.status is Status.MAX_ITERATIONS and state.general.how != OUTCOMES["more"]:
            return Claim(Status.STALLED, claim.iterations, claim.work)
        return claim

    def _run_general(
        self, state: NewtonState, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None
    ) -> Claim:
        problem, deadline = state.problem, Deadline(time_limit)
        claim = general.run(problem, state.general, impulse, max_iter, tol, time_limit)
        left = max_iter - claim.iterations
        if claim.status not in (Status.STALLED, Status.NUMERICAL_ERROR, Status.DIVERGED) or left <= 0:
            return claim
        bodies = bodies_of(problem)
        if bodies is None and (self.form == "velocity" or problem.m > ROWS or problem.cones.has_round):
            return claim
        w, e = np.empty(problem.m), np.empty(problem.m)
        best, above = compute_relative(problem, impulse, w, e, True)
        if above <= tol:
            return claim
        before = impulse.copy()
        if not best <= WARM:
            impulse[:] = problem.start()
        system = make_system(problem, "impulse" if bodies is None else "velocity", bodies=bodies)
        more = self._run_system(
            problem, system if system.solve.m else None, impulse, left, tol, deadline.remaining(1e-3)
        )
        if not compute_relative(problem, impulse, w, e)[0] <= best:
            impulse[:] = before
        work = summed((claim.work, more.work))
        form = f"{claim.form}, then {more.form or 'impulse'}"
        total = claim.iterations + more.iterations
        return Claim(more.status, total, work, more.message, form=form, certificate=more.certificate)

    def _run_system(
        self,
        problem: Problem,
        system: System | None,
        impulse: FloatArray,
        max_iter: int,
        tol: float,
        time_limit: float | None,
        again: bool = False,
        more: int | None = None,
    ) -> Claim:
        if system is None:
            system = make_system(problem, "impulse")
            impulse[:] = system.solve.fixed
            return Claim(Status.STALLED, 0, {"factorisations": 0}, "no row can move")
        sweeps = worked = 0
        before = system.solve.done if again else 0
        if self.form == "auto" and problem.rows is not None and not again:
            how, sweeps, worked = warm_start(problem, impulse, tol, max_iter, time_limit)
            claim = claim_of(how, sweeps, worked)
            if claim is not None and general.confirmed(problem, impulse, tol):
                return claim
        max_iter -= worked
        status, certificate = _stages(problem, system, impulse, max_iter, tol, time_limit, again, more)
        solve = system.solve
        factorisations = worked + solve.done - before
        message = ", ".join(
            counted(count, what) for count, what in zip(solve.ran, COUNTED, strict=True) if count
        )
        work = {"factorisations": factorisations} | ({"sweeps": sweeps} if sweeps else {})
        return Claim(status, factorisations, work, message, form=system.form, certificate=certificate)


def _rows_of_j(problem: Problem) -> float:
    """What Newton's method over a full A of J and M is counted to take [ns]; inf where it does not take that."""
    m = float(problem.m)
    if m > ROWS or problem.cones.has_round:
        return inf
    rows = Count("dense", dense_work(problem.m), m * m, m, 1e9 * formed_once(problem))
    return newton_cost(rows, problem.law)


def _stages(
    problem: Problem,
    system: System,
    impulse: FloatArray,
    max_iter: int,
    tol: float,
    time_limit: float | None,
    again: bool = False,
    more: int | None = None,
) -> tuple[Status, FloatArray | None]:
    """Turns of at most n factorisations on `impulse`, in place, with a look at the clock and at Ctrl-C in between.

    `again`: on from where an earlier call has stopped; `more`: a later one may go on from where this one stops.
    """
    deadline = Deadline(time_limit)
    solve, certificate, proven = system.solve, None, False
    late = interrupted = False
    system.set_deadline(deadline)
    last = max_iter + (solve.done if again else 0)
    if not again:
        solve.start(impulse, tol, SPEC.max_iter if more else max_iter)
    if more:
        solve.allow(more)
    try:
        while True:
            before = solve.done
            most = WATCHED / max(system.seconds, 1e-6)
            left, watch = deadline.remaining(), Stopwatch()
            if left is not None:
                # Of the first the pace is only counted.
                most = min(most, TIME_SHARE * left / max(system.seconds, 1e-9)) if solve.done else 1.0
                if left <= system.seconds:
                    late = True
                    solve.stop()
            try:
                end = solve.step(max(1, int(min(most, last - before) if more else most)), impulse)
            except TooLate:  # the best iterate is there
                late, end = True, OUTCOMES["spent"]
                solve.stop()
            if solve.done > before:
                system.took(watch.seconds / (solve.done - before))
            if end == OUTCOMES["certificate"]:
                certificate = solve.direction
                proven = check_certificate(problem, certificate, tol, deadline) is None
                if proven:
                    solve.prove()
            elif end != OUTCOMES["more"] or (more and solve.done >= last):
                break
    except KeyboardInterrupt:
        interrupted = True  # the best iterate goes back all the same
        solve.stop()
        solve.step(1, impulse)
    if interrupted:
        return Status.INTERRUPTED, None
    if proven:
        return Status.INFEASIBLE, certificate
    if end == OUTCOMES["more"]:
        return Status.MAX_ITERATIONS, None
    if end == OUTCOMES["spent"]:
        if more and not late:
            return Status.STALLED, certificate  # none may follow
        return (Status.TIME_LIMIT if late and solve.done < last else Status.MAX_ITERATIONS), None
    return _ENDS[end], certificate


def _refusal(problem: Problem) -> str | None:
    if problem.cones.has_round and problem.generalized is None:
        return "takes round cones of more than two tangents with J and M alone (Problem.from_jacobian)"
    return None


SPEC = SolverSpec(
    name="newton",
    factory=Newton,
    laws=frozenset({"linear", "lcp", "coulomb", "cone"}),
    box_friction_laws=frozenset({"coulomb", "cone"}),
    operators=frozenset(OPERATORS),
    round_cones=True,
    supports_rolling=True,
    refusal=_refusal,
    small=NEWTON,
    resumable=False,
    max_iter=2500,
    options={"form": "auto, velocity (bodies, joints) or impulse (rows): unknowns of the factorisation"},
    summary="interior point, active-set polish and proximal semismooth Newton",
    reference="Mehrotra 1992; Nesterov, Todd 1997; Hintermueller, Ito, Kunisch 2002; Alart, Curnier 1991; "
    "De Saxce, Feng 1998",
)
