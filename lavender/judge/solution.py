"""The result of a solve: the impulse, the solver's claim, the judge's residual, and the cost."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from lavender.base.arrays import FloatArray, one_of, read_only, table_of
from lavender.base.errors import SolveFailed
from lavender.base.later import above
from lavender.judge.residuals import Residual, residual
from lavender.problem import Problem

if TYPE_CHECKING:
    from lavender.judge.states import State, States


class Status(str, Enum):
    """The solver's claim about how a solve ended; the value is its meaning in words."""

    CONVERGED = "its own test at tol was met"
    FLOOR = "above tol, within twice what rounding to float64 allows"
    MAX_ITERATIONS = "the iteration budget was used up"
    TIME_LIMIT = "the time limit was reached"
    STALLED = "no progress any more"
    DIVERGED = "the iterate grew, or is not finite"
    INFEASIBLE = "no solution exists; `certificate` proves it, unless `claim_check` says otherwise"
    NUMERICAL_ERROR = "a factorisation or the backend failed"
    INTERRUPTED = "stopped by Ctrl-C or by the callback"
    REFUSED = "of one world of many: its data are no problem's"

    def __str__(self) -> str:
        return self.name


# Looked up once: a member reached through its class costs 600 instructions, a dozen times a solve.
CONVERGED = Status.CONVERGED
DIVERGED = Status.DIVERGED
FLOOR = Status.FLOOR
INFEASIBLE = Status.INFEASIBLE
INTERRUPTED = Status.INTERRUPTED
MAX_ITERATIONS = Status.MAX_ITERATIONS
NUMERICAL_ERROR = Status.NUMERICAL_ERROR
STALLED = Status.STALLED
TIME_LIMIT = Status.TIME_LIMIT

#: Values of `Solution.claim_check`, from best to worst.
CLAIM_CHECKS = CONFIRMED, NOT_PROVEN, CONTRADICTED = "confirmed", "not proven", "contradicted"


@dataclass(frozen=True)
class Turn:
    """What one solver did in one turn of `auto`."""

    solver: str
    work: Mapping[str, int]  # sweeps, factorisations, pivots, ...
    before: float  # - least relative residual so far, nan if it was not computed
    after: float


@dataclass(frozen=True, eq=False)
class Claim:
    """What one call of a solver's `run` says of itself."""

    status: Status  # MAX_ITERATIONS: exactly the n iterations asked for
    iterations: int  # done in this call
    work: Mapping[str, int] = field(default_factory=dict)  # of this call: sweeps, factorisations, ...
    message: str = ""
    form: str = ""  # which formulation ran, where there is a choice
    dual: Any = None  # the backend's own multipliers, as it returned them
    certificate: FloatArray | None = None  # (m,), with INFEASIBLE; with STALLED a direction that is none
    turns: tuple[Turn, ...] = ()  # of a solver that hands over to others


@dataclass(frozen=True, eq=False)
class History:
    """Recorded at fixed iteration counts, never at times; arrays of one length."""

    iterations: np.ndarray  # int64
    time: FloatArray  # s, solver time alone
    relative: FloatArray  # -
    energy: FloatArray  # sqrt J
    velocity: FloatArray  # m/s

    def plot(self, against: str = "iterations") -> Any:
        """The relative residual on the way, as a figure of matplotlib.

        Parameters
        ----------
        against : {"iterations", "time"}
        """
        one_of("against", against, ("iterations", "time"))
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(6.0, 4.0), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        x = self.iterations if against == "iterations" else self.time
        shown = self.relative > 0.0
        axes.semilogy(np.asarray(x)[shown], self.relative[shown], marker="o", markersize=3)
        axes.set_xlabel("iterations" if against == "iterations" else "time [s]")
        axes.set_ylabel("relative residual [-]")
        axes.grid(alpha=0.3)
        return figure


@dataclass(frozen=True)
class SolverRun:
    """Which solver ran, how."""

    name: str
    options: Mapping[str, Any]
    form: str = ""
    order: str = ""  # in which a sweep visits the blocks, by name; empty if the solver takes no order


@dataclass(frozen=True, eq=False, repr=False)
class Solution:
    """Result of `solve`, for every status; it always holds the last iterate. `str()` is a summary on one line.

    Parameters
    ----------
    impulse : (m,) N s
        The answer, in the order of the problem's rows.
    residual : Residual
        Its error, measured by the judge: `relative` [-], `energy` [sqrt J], `velocity` [m/s], the worst row.
    status : Status
        The solver's claim. `success` and `claim_check` are the judge's findings.
    tol : float, -
        The relative residual that was asked for.
    iterations : int
        In the solver's own unit.
    work : mapping
        Counts of sweeps, products, factorisations, pivots, ... that were done.
    setup_time, solve_time : float, s
    solver : SolverRun
        Name, options, the form of the problem that was solved, and the sweep order of a solver that takes one.
    message : str
    history : History or None
        With `history=True`.
    dual : object
        A backend's own multipliers.
    certificate : (m,), or None
        With INFEASIBLE: the proof that there is no solution, if the claim is confirmed.
    impulse_bound : float or None, N s
        With a certificate: the least sum of |impulse| of every solution of the problem as it was given; inf where it
        has none. Also of STALLED, where a solver met a direction that shows such a bound.
    claim_check : {"confirmed", "not proven", "contradicted"}
        Result of comparing `status` with the judge's residual and certificate. "confirmed": they agree, or the status
        claims nothing that can be checked. "not proven": the status is INFEASIBLE, and no certificate proves it.
        "contradicted": the judge's figures exclude what the status claims.
    status_conflict : str
        Reason if the claim is contradicted, else empty.

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

    impulse: FloatArray  # (m,) N s
    residual: Residual
    status: Status  # the solver's claim
    tol: float  # - relative residual asked for
    iterations: int
    work: Mapping[str, int]  # sweeps, matvecs, factorisations, pivots, ...: what ran
    setup_time: float  # s, preparing (factor, colour, allocate)
    solve_time: float  # s, iterating
    solver: SolverRun
    message: str
    history: History | None
    dual: Any
    certificate: FloatArray | None  # (m,), with INFEASIBLE
    impulse_bound: float | None  # N s, with a certificate: the least sum |impulse| of every solution
    claim_check: str  # CONFIRMED, NOT_PROVEN or CONTRADICTED
    status_conflict: str  # why the judge's figures exclude what `status` claims; empty if they do not
    # of the last checks, in which the residual falls tenfold; NaN where it did not fall, or no sweeps were checked
    sweeps_per_decade: float
    turns: tuple[Turn, ...]  # of `auto`: who ran, in order, and what came of it; () of other solvers

    @classmethod
    def of(cls, values: dict[str, Any]) -> Solution:
        """The solution of all its fields by name, kept as they are."""
        made: Solution = object.__new__(cls)
        made.__dict__.update(values)
        return made

    @classmethod
    def late(
        cls,
        impulse: FloatArray,
        status: Status,
        tol: float,
        solve_time: float,
        rest: tuple[Callable[..., dict[str, Any]], tuple[Any, ...]],
        setup_time: float = 0.0,
    ) -> Solution:
        """Fields that are known; `rest`, a function and its arguments, are the others for the first who asks."""
        made: Solution = object.__new__(cls)
        kept = made.__dict__
        kept["impulse"], kept["status"], kept["tol"] = impulse, status, tol
        kept["setup_time"], kept["solve_time"], kept["_rest"] = setup_time, solve_time, rest
        return made

    def __getattr__(self, name: str) -> Any:
        # Only what is not there comes here: the first of the fields that `late` left for later, or no field at all.
        kept = self.__dict__
        rest = kept.get("_rest")
        if rest is not None:
            function, arguments = rest
            kept.update(function(*arguments))  # two threads write the same
            kept.pop("_rest", None)
        if name in kept:
            return kept[name]
        raise AttributeError(f"{type(self).__name__!r} has no attribute {name!r}")

    def __reduce__(self) -> tuple[Any, ...]:
        # A read-only view of a dict has no pickle.
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return _restored, (values | {"work": dict(self.work)},)

    @property
    def slack(self) -> FloatArray:
        """w = A lambda - b (m,) [m/s], recomputed by the judge."""
        return self.residual.slack

    @property
    def states(self) -> States:
        """What each block does (open, sticks, slides, at a bound or free), and which states are not certain."""
        kept = self.__dict__
        if "_states" not in kept:
            from lavender.judge.states import states_of

            kept["_states"] = states_of(self.residual._problem, self.impulse)
        found: States = kept["_states"]
        return found

    def state(self, i: int) -> State:
        """What block i does (see `states`).

        Raises
        ------
        IndexError
            No such block.
        """
        found: State = self.states[i]
        return found

    @property
    def is_contradicted(self) -> bool:
        """The judge's figures exclude what `status` claims."""
        # Fields that `late` left for later belong to claims that were checked: they are not made for this.
        return self.__dict__.get("claim_check") == CONTRADICTED

    @property
    def success(self) -> bool:
        """The judge's relative residual is at most `tol`."""
        return self.residual.relative <= self.tol

    def unstretched(self, problem: Problem) -> Solution:
        """The same of a problem with ellipses, from that of its disks."""
        s = problem.cones.stretch
        impulse, proof = read_only(s * self.impulse), self.certificate
        # Of the numbers that are handed out: s (lambda / s) rounds.
        found = residual(problem, impulse, "float64", tol=self.tol)
        return replace(
            self, impulse=impulse, residual=found, certificate=None if proof is None else read_only(s * proof)
        )

    def motion_error(self, reference: Any = None) -> Any:
        """How wrong the motion is, in units, with a bound: see `lavender.motion_error`."""
        return above("lavender.lab.motion").motion_error(self.residual._problem, self.impulse, reference)

    def raise_for_status(self) -> Solution:
        """Return self when the judge accepts the result (within tol, or at the floor of float64).

        Raises
        ------
        SolveFailed
            Otherwise, with the one-line summary.
        """
        if self.success or self.residual.at_floor:
            return self
        raise SolveFailed(str(self))

    def _repr_html_(self) -> str:
        """For notebooks: what came of it, as a small table."""
        facts = {
            "status": self.status.name,
            "relative residual": f"{self.residual.relative:.2e} (asked for {self.tol:.0e})",
            "worst row": f"{self.residual.worst_name}, {self.residual.velocity:.2g} m/s",
            "floor of float64": f"{self.residual.floor:.1e}",
            "work": self._done,
            "time": self._took,
        }
        if self.claim_check != CONFIRMED:
            facts[self.claim_check] = self.status_conflict or self.status.name
        return table_of(facts, self.solver.name)

    def __repr__(self) -> str:
        return f"<Solution {self}>"

    @property
    def _done(self) -> str:
        done = ", ".join(counted(n, k) for k, n in (self.work or {"iterations": self.iterations}).items())
        return f"{done}, order {self.solver.order}" if self.solver.order else done

    @property
    def _took(self) -> str:
        t = self.setup_time + self.solve_time
        return f"{1e3 * t:.3g} ms" if t < 0.9995 else f"{t:.3g} s"

    def __str__(self) -> str:
        note = f"; {self.message}" if self.message else ""
        wrong = f"; CONTRADICTED: {self.status_conflict}" if self.claim_check == CONTRADICTED else ""
        return (
            f"{self.solver.name}: {self.status.name}, {self.residual}, {self._done}, "
            f"{self._took}{note}{wrong}"
        )


def order_name(order: Any) -> str:
    """Return the name of a sweep order; an array of blocks is a permutation."""
    return order if isinstance(order, str) else "permutation"


def counted(n: int, what: str) -> str:
    """1 sweep, 2 sweeps: a count of `work` with its name in words."""
    what = what.replace("_", " ")
    return f"{n} {what.removesuffix('s') if n == 1 else what}"


def summed(works: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """The work of several claims or turns, kind by kind."""
    out: dict[str, int] = {}
    for work in works:
        for kind, count in work.items():
            out[kind] = out.get(kind, 0) + count
    return out


def uninterrupted(solution: Solution) -> Solution:
    """The solution, for callers that go on with it or to the next: KeyboardInterrupt where Ctrl-C ended its solve."""
    if solution.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return solution


def _restored(values: dict[str, Any]) -> Solution:
    return Solution.of(values | {"work": MappingProxyType(values["work"])})
