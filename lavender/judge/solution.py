"""The result of a solve: the impulse, the solver's claim, the judge's residual, and the cost."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from enum import Enum
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from lavender.base.arrays import FloatArray, check_choice, check_int, format_html_table
from lavender.base.errors import SolveFailed, require_packages
from lavender.base.lazy_import import import_module_lazily
from lavender.judge.residuals import Residual
from lavender.problem.derived import cached_property, late_field
from lavender_ext.core.checks import make_instance

if TYPE_CHECKING:
    from lavender.judge.states import State, States


class Status(str, Enum):
    """The solver's claim about how a solve ended; `description` explains it.

    A status is equal to its name: `solution.status == "STALLED"`.
    """

    description: str

    def __new__(cls, name: str, description: str) -> Status:
        """Create the member; its text is its name."""
        member = str.__new__(cls, name)
        member._value_, member.description = name, description
        return member

    CONVERGED = "CONVERGED", "the solver's own test at tol was met"
    ROUNDOFF_LIMIT = (
        "ROUNDOFF_LIMIT",
        "the residual or its floor is above tol, within twice the floor",
    )
    MAX_ITERATIONS = "MAX_ITERATIONS", "the iteration budget was used up"
    TIME_LIMIT = "TIME_LIMIT", "the time limit was reached"
    STALLED = "STALLED", "no further progress"
    DIVERGED = "DIVERGED", "the iterate grew, or is not finite"
    INFEASIBLE = (
        "INFEASIBLE",
        "no solution exists; `certificate` proves it, unless `claim_check` says otherwise",
    )
    UNBOUNDED = (
        "UNBOUNDED",
        "the objective of a quadratic program decreases without limit along `ray`",
    )
    NUMERICAL_ERROR = "NUMERICAL_ERROR", "a factorisation or the backend failed"
    INTERRUPTED = "INTERRUPTED", "stopped by Ctrl-C or by the callback"
    INVALID_PROBLEM = "INVALID_PROBLEM", "the data of one world of a batch are not a valid problem"

    def __str__(self) -> str:
        return self.name


# Members as module constants: access through the class costs 600 instructions and is needed a dozen times per solve.
CONVERGED = Status.CONVERGED
DIVERGED = Status.DIVERGED
ROUNDOFF_LIMIT = Status.ROUNDOFF_LIMIT
INFEASIBLE = Status.INFEASIBLE
INTERRUPTED = Status.INTERRUPTED
MAX_ITERATIONS = Status.MAX_ITERATIONS
NUMERICAL_ERROR = Status.NUMERICAL_ERROR
STALLED = Status.STALLED
TIME_LIMIT = Status.TIME_LIMIT

#: Values of `Solution.claim_check`, from best to worst.
CLAIM_CHECKS = CONFIRMED, NOT_PROVEN, CONTRADICTED = "confirmed", "not proven", "contradicted"


@dataclass(frozen=True)
class SolverStage:
    """One stage of `auto`: the solver that ran, its work and the residual before and after.

    Parameters
    ----------
    solver : str
    work : mapping of str to int
        Counts of sweeps, factorisations, pivots, ...
    before, after : float, -
        Smallest relative residual reached before and after the stage; NaN if it was not computed.
    """

    solver: str
    work: Mapping[str, int]
    before: float
    after: float


@dataclass(frozen=True, eq=False)
class Claim:
    """Result of one call of a solver's `run`, as the solver reports it.

    Parameters
    ----------
    status : Status
        MAX_ITERATIONS means that exactly the requested iterations were done.
    iterations : int
        Iterations of this call.
    work : mapping of str to int
        Counts of sweeps, factorisations, ... of this call.
    message : str
    form : str
        Formulation that ran, if the solver has several.
    dual : object
        A backend's multipliers as it returned them.
    certificate : (m,) array, optional
        With INFEASIBLE: proof that no solution exists. With STALLED: a direction that bounds the impulse of every
        solution.
    stages : tuple of SolverStage
        Stages of a solver that calls others.
    judged : lavender_ext.judge.measure.Judged, optional
        Result of the judge for the returned impulse, if the solver called it. It is used only if it belongs to the
        problem and the impulse, bit for bit.
    refutation : str
        What shows that the claim is false: the residual of the solver's own impulse, or a solution where the solver
        claims that there is none. A solver leaves it empty.
    """

    status: Status
    iterations: int
    work: Mapping[str, int] = field(default_factory=dict)
    message: str = ""
    form: str = ""
    dual: Any = None
    certificate: FloatArray | None = None
    stages: tuple[SolverStage, ...] = ()
    judged: Any = field(default=None, repr=False, compare=False)
    refutation: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class History:
    """Residuals at fixed iteration counts (`lavender.solve(..., history=True)`), in arrays of one length k.

    Parameters
    ----------
    iterations : (k,) int64
    time : (k,), s
        Time of the solver alone, without the judge.
    relative : (k,), -
    energy : (k,), sqrt J
    velocity : (k,), m/s
        Relative residual, energy error and largest velocity error, as in `Residual`.
    solvers : (k,) str
        Solver of each record if `auto` ran, else empty. `iterations` counts all stages, each in the unit of its
        solver: sweeps of `anderson`, steps of `newton`, `admm`, `nncg` and `direct`, pivots of `lemke`.
    """

    iterations: np.ndarray
    time: FloatArray
    relative: FloatArray
    energy: FloatArray
    velocity: FloatArray
    solvers: tuple[str, ...] = ()

    def plot(self, against: str = "iterations") -> Any:
        """Plot the relative residual and return the matplotlib figure.

        Parameters
        ----------
        against : {"iterations", "time"}
            Horizontal axis.
        """
        check_choice("against", against, ("iterations", "time"))
        figure, (axes,) = _make_figure("History.plot", 1)
        self._draw(axes, against)
        return figure

    def __repr__(self) -> str:
        if not len(self.iterations):
            return "<History without records>"
        ends = f"relative {self.relative[0]:.2e} to {self.relative[-1]:.2e}"
        return (
            f"<History of {len(self.iterations)} records, {self.iterations[-1]} iterations, {ends}>"
        )

    def _draw(self, axes: Any, against: str = "iterations") -> None:
        """Draw the relative residual into axes of matplotlib."""
        x = np.asarray(self.iterations if against == "iterations" else self.time)
        shown = self.relative > 0.0
        line = axes.semilogy(x[shown], self.relative[shown], marker="o", markersize=3)[0]
        if self.solvers:
            line.set(marker="", color="0.6")
            for name in dict.fromkeys(self.solvers):
                chosen = shown & (np.array(self.solvers) == name)
                axes.semilogy(x[chosen], self.relative[chosen], "o", markersize=3, label=name)
            axes.legend()
        axes.set_xlabel("iterations" if against == "iterations" else "time [s]")
        axes.set_ylabel("relative residual [-]")
        axes.grid(alpha=0.3)


def _make_figure(caller: str, n_axes: int) -> tuple[Any, Any]:
    """Return a figure of matplotlib, which needs no display, and its axes one below the other."""
    require_packages(caller, "matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 4.0 * n_axes), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(n_axes, squeeze=False).flat


@dataclass(frozen=True)
class SolverRun:
    """Name, options, formulation and sweep order of the solver that ran."""

    name: str
    options: Mapping[str, Any]  # mapping of str to object
    form: str = ""  # Formulation that was solved, if the solver has several.
    order: str = ""  # Name of the order in which a sweep visits the blocks; empty if the solver has no order.


@dataclass(frozen=True, eq=False, repr=False)
class Solution:
    """Result of `solve` for every status. `str()` is a summary in one line.

    Parameters
    ----------
    impulse : (m,), N s
        The answer, in the order of the problem's rows. It is the best iterate of each island; with tol=0 the last
        iterate.
    residual : Residual
        Error of the answer, measured by the judge: `relative` [-], `energy` [sqrt J], `velocity` [m/s], worst row.
    status : Status
        The solver's claim. `success` and `claim_check` are the judge's findings.
    tol : float, -
        Requested relative residual.
    iterations : int
        Iterations in the solver's own unit.
    work : mapping of str to int
        Counts of sweeps, products, factorisations, pivots, ... that were done.
    setup_time, solve_time : float, s
        Time to prepare (factor, colour, allocate) and to iterate.
    solver : SolverRun
        Name, options, formulation and sweep order.
    message : str
        Explanation of the status.
    history : History or None
        With `history=True`: arrays `iterations`, `time` [s], `relative` [-], `energy` [sqrt J] and `velocity` [m/s].
    dual : object
        A backend's multipliers as it returned them.
    certificate : (m,) or None
        With INFEASIBLE: the proof that no solution exists, if the claim is confirmed.
    impulse_bound : float or None, N s
        With a certificate: lower bound of sum |impulse| over all solutions of the given problem; inf if there are
        none. Also with STALLED, if the solver found a direction that shows such a bound.
    claim_check : {"confirmed", "not proven", "contradicted"}
        Result of comparing `status` with the judge's residual and certificate. "confirmed": they agree, or the status
        claims nothing that can be checked. "not proven": the status is INFEASIBLE, and no certificate proves it.
        "contradicted": the judge's figures exclude what the status claims.
    status_conflict : str
        Reason if the claim is contradicted, else empty.
    sweeps_per_decade : float
        Sweeps in which the residual fell tenfold at the last checks; NaN if it did not fall or was not checked.
    stages : tuple of SolverStage
        Stages of `auto` in the order in which they ran; empty for other solvers.
    velocity_tol : float or None, m/s
        Requested velocity error; None if the solve was to reach a relative residual.
    program_error : float or None, -
        Error of a quadratic program that `solve_qp` solved, to which `tol` and `success` then refer.
    start : str
        Start of the solve: "the given impulses", "problem.guess", or "" for zero impulses.

    Examples
    --------
    >>> import lavender as lv
    >>> problem = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0])  # 1/kg, m/s
    >>> solution = lv.solve(problem, "pgs", tol=1e-9)
    >>> solution.impulse.tolist(), solution.slack.tolist()  # N s, m/s
    ([0.5, 0.0], [0.0, 1.5])
    >>> solution.success, solution.status.name, solution.residual.relative <= 1e-9
    (True, 'CONVERGED', True)
    """

    impulse: FloatArray
    residual: Residual
    status: Status
    tol: float
    iterations: int
    work: Mapping[str, int]
    setup_time: float
    solve_time: float
    solver: SolverRun
    message: str
    history: History | None
    dual: Any
    certificate: FloatArray | None
    impulse_bound: float | None
    claim_check: str
    status_conflict: str
    sweeps_per_decade: float
    stages: tuple[SolverStage, ...]
    velocity_tol: float | None = None
    program_error: float | None = None
    start: str = ""

    @classmethod
    def from_fields(cls, values: dict[str, Any]) -> Solution:
        """Build a solution from its fields by name, without copying or checking them.

        `_rest`, a function that returns the other fields by name, and its arguments, replaces fields that are computed
        when one of them is first read.
        """
        solution: Solution = make_instance(cls, values)
        return solution

    def with_fields(self, **values: Any) -> Solution:
        """Return a copy with other values of these fields. Postponed fields of the copy stay postponed."""
        return Solution.from_fields(self.__dict__ | values)

    def __reduce__(self) -> tuple[Any, ...]:
        # `work` is a read-only view of a dict, which cannot be pickled: store a dict.
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return _rebuild_solution, (values | {"work": dict(self.work)},)

    @property
    def slack(self) -> FloatArray:
        """w = A lambda - b (m,) [m/s], recomputed by the judge."""
        return self.residual.slack

    @cached_property
    def states(self) -> States:
        """State of each block (open, sticks, slides, at a bound or free), and its distance to another state."""
        from lavender.judge.states import compute_states

        return compute_states(self.residual._problem, self.impulse)

    def state(self, i: int) -> State:
        """Return the state of block i (see `states`).

        Raises
        ------
        IndexError
            The problem has no block i.
        """
        state: State = self.states[i]
        return state

    @property
    def success(self) -> bool:
        """Whether relative residual and floor are at most `tol`, or the velocity error at most `velocity_tol`.

        Of a quadratic program: whether its status is CONVERGED, which is so if `program_error` is at most `tol`.
        """
        if self.program_error is not None:
            return self.status is CONVERGED
        if self.velocity_tol is not None:
            return self.residual.velocity <= self.velocity_tol
        judged = self.residual
        return judged.relative <= self.tol and (
            judged.roundoff_floor <= self.tol or self.tol == 0.0
        )

    @property
    def is_contradicted(self) -> bool:
        """Return whether the judge's figures contradict `status`."""
        # Postponed fields belong to claims that have been checked, so they are not computed here.
        return self.__dict__.get("claim_check") == CONTRADICTED

    def motion_error(self, reference: Any = None) -> Any:
        """Return the error of the motion in units: see `lavender.motion_error`."""
        return import_module_lazily("lavender.diagnostics.motion_error").motion_error(
            self.residual._problem, self.impulse, reference
        )

    def raise_for_status(self) -> Solution:
        """Return self if the judge accepts the result (within tol, or at the round-off limit of float64).

        Raises
        ------
        SolveFailed
            The judge does not accept the result; the message is the one-line summary.
        """
        if self.success or (self.program_error is None and self.residual.at_floor):
            return self
        raise SolveFailed(str(self))

    def plot(self, rows: int = 10) -> Any:
        """Plot the rows with the largest velocity errors, and the history if there is one; return the figure.

        Parameters
        ----------
        rows : int, default 10
            Number of rows that are shown.
        """
        figure, axes = _make_figure("Solution.plot", 1 if self.history is None else 2)
        error = self.residual.velocity_by_row
        worst = np.argsort(-error, kind="stable")[: check_int("rows", rows, 1)][::-1]
        problem = self.residual._problem
        names = [f"{problem.row_name(int(i))} [{problem.row_unit(int(i))}]" for i in worst]
        axes[0].barh(names, error[worst])
        axes[0].set(xlabel="velocity error", title=f"{self.solver.name}: {self.status.name}")
        if self.history is not None:
            self.history._draw(axes[1])
        return figure

    def _repr_html_(self) -> str:
        """Return a small HTML table of the result for notebooks."""
        facts = {
            "status": self.status.name,
            "tolerance": f"{self.tol:.0e}",
            **self.residual._facts,
            "work": self._work_text,
            "time": self._time_text,
        }
        if self.claim_check != CONFIRMED:
            facts[self.claim_check] = self.status_conflict or self.status.name
        return format_html_table(facts, self.solver.name)

    def __repr__(self) -> str:
        return f"<Solution {self}>"

    @property
    def _work_text(self) -> str:
        """Work that was done, in words."""
        work = self.work or {"iterations": self.iterations}
        done = ", ".join(format_work_count(n, k) for k, n in work.items())
        order = f", order {self.solver.order}" if self.solver.order else ""
        return f"{done}{order}, from {self.start}" if self.start else f"{done}{order}"

    @property
    def _time_text(self) -> str:
        """Time of set-up and iterations together, with a unit: "1.3 ms"."""
        t = self.setup_time + self.solve_time
        return f"{1e3 * t:.3g} ms" if t < 0.9995 else f"{t:.3g} s"

    def __str__(self) -> str:
        note = f"; {self.message}" if self.message else ""
        wrong = (
            f"; CONTRADICTED: {self.status_conflict}" if self.claim_check == CONTRADICTED else ""
        )
        judged = (
            self.residual
            if self.program_error is None
            else f"program error {self.program_error:.1e}"
        )
        return f"{self.solver.name}: {self.status.name}, {judged}, {self._work_text}, {self._time_text}{note}{wrong}"


def name_start(guess: FloatArray | None, impulse: Any) -> str:
    """Return the name of the start of a solve with `problem.guess` and the argument `impulse`: `Solution.start`."""
    if impulse is not None and impulse is not guess:
        return "the given impulses"
    return "" if guess is None else "problem.guess"


def get_order_name(order: Any) -> str:
    """Return the name of a sweep order; the name of an array of block indices is "permutation"."""
    return order if isinstance(order, str) else "permutation"


def format_work_count(n: int, kind: str) -> str:
    """Format a count of `work` with its name: 1 sweep, 2 sweeps."""
    kind = kind.replace("_", " ")
    return f"{n} {kind.removesuffix('s') if n == 1 else kind}"


def sum_work_counts(works: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Add the work of several claims or stages, kind by kind."""
    out: dict[str, int] = {}
    for work in works:
        for kind, count in work.items():
            out[kind] = out.get(kind, 0) + count
    return out


def raise_if_interrupted(solution: Solution) -> Solution:
    """Return the solution; raise KeyboardInterrupt if Ctrl-C ended its solve, so that the caller does not continue."""
    if solution.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return solution


for _field in fields(Solution):
    if _field.name not in ("velocity_tol", "program_error", "start"):
        setattr(Solution, _field.name, late_field(_field.name))


def _rebuild_solution(values: dict[str, Any]) -> Solution:
    """Rebuild a pickled solution."""
    return Solution.from_fields(values | {"work": MappingProxyType(values["work"])})
