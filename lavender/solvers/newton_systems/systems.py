"""The matrix H = D^-1/2 A D^-1/2 of the scaled problem and its Newton systems, in two forms.

`VelocitySystem` keeps H = K K^T + theta as K, without forming H, and factors over the bodies. `MatrixSystem` stores H,
dense or in compressed rows. The equations and the methods that use them are in `lavender_ext/newton/`.

`run_newton_method` is the loop of the compiled method over every form, with checks of Ctrl-C and of certificates
between its steps. Kernels read the deadline, between steps and inside of a factorisation.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.base.deadline import Deadline
from lavender.base.lu import splu
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import get_zero_impulse_reference, judge_impulse
from lavender.judge.solution import Status
from lavender.problem import Problem
from lavender.solvers.factors import USE_WIDE_LANES
from lavender.solvers.newton_systems.augmented import AugmentedSystem
from lavender_ext.core.method import OUTCOMES
from lavender_ext.driver.driver import Driver
from lavender_ext.factor import graph
from lavender_ext.newton.solve import Layout, Solve, compute_body_jacobian, list_element_blocks

# If the judge does not confirm the result over velocities, the kernel runs again with a smaller tolerance, down to this
# fraction of tol.
MIN_TOLERANCE_RATIO = 1e-2
MORE, REACHED, STUCK, CERTIFICATE, SPENT = (
    OUTCOMES[name] for name in ("more", "reached", "stuck", "certificate", "spent")
)
_STATUS = {
    OUTCOMES["reached"]: Status.CONVERGED,
    OUTCOMES["floor"]: Status.ROUNDOFF_LIMIT,
    OUTCOMES["more"]: Status.MAX_ITERATIONS,
    OUTCOMES["stuck"]: Status.STALLED,
    # Over velocities, certificates are not computed; the method over rows of A or bodies continues.
    OUTCOMES["certificate"]: Status.STALLED,
    OUTCOMES["broken"]: Status.NUMERICAL_ERROR,
    OUTCOMES["lost"]: Status.DIVERGED,
    OUTCOMES["spent"]: Status.MAX_ITERATIONS,
}
UNLIMITED_STEPS = 2**31 - 1  # Budget of a kernel whose steps are limited by its calls.


class Bodies(NamedTuple):
    """The bodies of a problem."""

    pair: IntArray  # (n_blocks, 2) int32: bodies of each block; -1 for a static or missing body.
    n: int  # Number of bodies.
    # (nv,) int32: for J and M: 6 times the body of each velocity, plus its index in the body.
    column: IntArray | None = None


def find_bodies(problem: Problem) -> Bodies | None:
    """Return the bodies of a problem, or None if it has no bodies.

    For J and M these are free rigid bodies, of which every block must couple at most two.
    """
    if problem.rows is not None:
        return (
            Bodies(problem.rows.moving_block_bodies, problem.rows.n_bodies)
            if problem.rows.n_bodies
            else None
        )
    if problem.generalized is None or problem.cones._blocks.has_round:
        return None
    parts = graph.find_bodies_of_velocities(problem.metric, problem.generalized.order)
    return None if parts is None else Bodies(*parts)


class System:
    """H of a scaled problem, and the compiled Newton method on it."""

    form = ""
    work = 0.0  # Multiply-adds of one factorisation.
    factor_seconds = (
        0.0  # Upper bound of the time of a factorisation [s], on machines of the last ten years.
    )
    dense = False  # Whether A is stored as a full matrix.
    entries = 0.0  # Number of entries of A.
    solve: Solve


class VelocitySystem(System):
    """H = K K^T + theta over the bodies, with one block column of s unknowns for each body."""

    form = "velocity"

    def __init__(self, problem: Problem, bodies: Bodies, like: System | None = None) -> None:
        """Build the system; the layout of an earlier system `like` between the same bodies is reused."""
        data = problem.metric
        panel, columns = compute_body_jacobian(data, bodies.pair, bodies.column)
        structure = bodies.pair[list_element_blocks(data)], bodies.n, len(columns)
        reused = (
            like.layout
            if isinstance(like, VelocitySystem) and like.layout.serves(*structure)
            else None
        )
        self.layout: Layout = reused or Layout(*structure)
        self.work = self.layout.work
        self.factor_seconds = 0.5e-9 * self.work
        augmented = partial(AugmentedSystem, problem, self.layout, bodies)
        self.solve = Solve.over_bodies(
            data, panel, columns, self.layout, problem.law == "coulomb", USE_WIDE_LANES, augmented
        )


class MatrixSystem(System):
    """H stored as a matrix, dense or in compressed rows."""

    form = "impulse"

    def __init__(self, problem: Problem, may_be_dense: bool = True) -> None:
        matrix, symmetric = problem.csr_data, problem.is_symmetric
        solve = self.solve = Solve.over_rows(
            problem.metric, matrix, symmetric, USE_WIDE_LANES, splu, may_be_dense
        )
        self.dense = solve.is_dense
        if self.dense:
            self.work = solve.m**3 / 3.0  # As `costs.count_dense_work`.
        else:
            self.work = (1.0 if symmetric else 2.0) * solve.work
            self.entries = float(solve.entries)
        self.factor_seconds = (0.3e-9 if self.dense else 1e-9) * self.work


def make_system(
    problem: Problem, form: str, like: System | None = None, bodies: Bodies | None = None
) -> System:
    """Build the Newton system of a problem over its bodies (`form` "velocity") or the rows of A ("impulse").

    The layout of `like`, a system of a problem of the same structure, may be reused.
    """
    if problem.metric.reference_energy < 0.0:
        get_zero_impulse_reference(problem)
    if form == "impulse":
        return MatrixSystem(problem)
    bodies = bodies or find_bodies(problem)
    assert bodies is not None
    return VelocitySystem(problem, bodies, like)


class NewtonRun(NamedTuple):
    """Result of `run_newton_method`."""

    status: Status
    counts: Sequence[
        int
    ]  # Steps; over velocities also factorisations, friction updates and line search evaluations.
    # Proof that no solution exists if the status is INFEASIBLE, else a direction that gives a lower bound of every
    # solution's impulse, or None.
    certificate: FloatArray | None = None
    judged: Any = None  # The judge's pass over a result over velocities.


def run_newton_method(
    problem: Problem,
    method: Any,
    impulse: FloatArray,
    max_iter: int,
    tol: float,
    deadline: Deadline,
    steps_per_check: int,
    max_total: int | None = None,
    is_continued: bool = False,
) -> NewtonRun:
    """Run up to `max_iter` steps of a compiled method on `impulse` (m,) in place, until the judge's test at tol is met.

    Parameters
    ----------
    method : lavender_ext.core.method.Method
    steps_per_check : int
        Number of steps between two checks for Ctrl-C.
    max_total : int, optional
        If given, later calls may continue where this one stops, with at most this many steps in all calls.
    is_continued : bool
        Whether to continue a run to the same tol that used up its steps.
    """
    is_over_velocities = isinstance(method, Driver)
    tolerance_ratio = 1.0
    certificate: FloatArray | None = None
    judged: Any = None
    proven = False
    method.set_deadline(deadline)
    if not is_continued:
        method.start(impulse, tol, max_iter if max_total is None else UNLIMITED_STEPS)
        if method.how == SPENT:  # The deadline passed before H was formed.
            return NewtonRun(Status.TIME_LIMIT, [0, 0, 0, 0] if is_over_velocities else [0])
    if max_total is not None and max_total < UNLIMITED_STEPS:
        method.limit_work(max_total)
    begin = list(method.counts) if is_over_velocities else [method.done]
    last = begin[0] + max_iter

    def count_work() -> list[int]:
        """Return the counts of this call."""
        if not is_over_velocities:
            return [method.done - begin[0]]
        return [x - y for x, y in zip(method.counts, begin, strict=True)]

    try:
        while True:
            before = method.done
            deadline.has_passed()  # Kernels read the clock after some work only.
            steps = steps_per_check if max_total is None else min(steps_per_check, last - before)
            end = method.step(max(steps, 1), impulse)
            if end == CERTIFICATE and not is_over_velocities:
                certificate = method.direction
                with np.errstate(all="ignore"):
                    proven = check_certificate(problem, certificate, tol, deadline) is None
                if proven:
                    method.confirm_certificate()
                continue
            if end == REACHED and is_over_velocities:
                judged = judge_impulse(problem, impulse.copy())
                if not judged.relative <= tol:
                    # The judge does not confirm the kernel's test, which adds in another order and whose squares may
                    # underflow.
                    end = MORE if tolerance_ratio > MIN_TOLERANCE_RATIO else STUCK
                    tolerance_ratio *= 0.25
                    begin = [-x for x in count_work()]
                    last = max_iter + begin[0]
                    before = -1
                    method.start(impulse, tolerance_ratio * tol, UNLIMITED_STEPS)
            if end != MORE or (
                max_total is not None and (method.done >= last or method.done == before)
            ):
                break
    except KeyboardInterrupt:  # Return the best iterate.
        method.request_stop()
        method.step(1, impulse)
        return NewtonRun(Status.INTERRUPTED, count_work())
    status = _STATUS[end]
    if proven:
        status = Status.INFEASIBLE
    elif end in (MORE, SPENT) and method.done < last and deadline.has_passed():
        status = Status.TIME_LIMIT
    elif (end == SPENT and max_total is not None) or (end == MORE and method.done == before):
        status = Status.STALLED  # All `max_total` steps have been used, or a call did none.
    return NewtonRun(status, count_work(), None if end == MORE else certificate, judged)
