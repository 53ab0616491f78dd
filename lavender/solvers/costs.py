"""The candidates of `auto` and their expected costs: a table, counts of structure, and fitted rates.

    cost = start + formed * entries + count * (row * m + work * w)                                            (1)

m rows; w multiply-adds of one iteration, counted from the structure (`structure.py`); start, row, work [ns] and count,
iterations to the end, are rates of `rates.json`, which `python -m benchmarks auto --fit` writes from runs of single
solvers. No clock is read: the same problem has the same plan everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import inf
from typing import Any

from lavender.deadline import NEVER, Deadline
from lavender.errors import BREAKDOWN, InputError
from lavender.problem import Problem
from lavender.registry import get
from lavender.solvers.structure import Structure
from lavender.solvers.weights import READ, decades, law_of, of_law, rates

__all__ = ["METHODS", "READ", "TABLE", "Cost", "Costs", "Plan", "candidates", "made", "rates", "structure_of"]

#: Solver and options of each candidate.
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "anderson": ("anderson", {}),
    "nncg": ("nncg", {"order": "symmetric", "restart": "against"}),
    "direct": ("direct", {}),
    "newton": ("newton", {}),
    "newton over rows": ("newton", {"form": "impulse"}),
    "admm": ("admm", {}),
    # The convex relaxation of Coulomb's law; its solution is one of Coulomb's law wherever contacts stick.
    "relaxation": ("anderson", {}),
}
ROLLING = ("anderson", "nncg", "newton")  # for contacts that resist rolling, in every form
_GIVEN = {
    "linear": ("direct", "anderson", "newton"),
    "lcp": ("anderson", "direct", "newton", "nncg"),
    "cone": ("anderson", "newton"),
    "coulomb": ("anderson", "newton", "admm", "nncg"),
    "round": ("nncg", "admm"),
}
#: At most four for each law and operator; "round": cones of more than two tangents.
TABLE: dict[str, dict[str, tuple[str, ...]]] = {
    "rows": _GIVEN
    | {"lcp": ("anderson", "direct", "newton"), "coulomb": ("anderson", "newton", "relaxation")},
    "matrix": _GIVEN | {"cone": ("anderson", "newton", "admm")},
    "generalized": {
        "linear": ("newton", "direct", "anderson", "newton over rows"),
        "lcp": ("newton", "anderson", "direct"),
        "cone": ("newton", "anderson", "newton over rows"),
        "coulomb": ("newton", "anderson", "admm", "newton over rows"),
        "round": ("newton", "nncg", "admm"),
    },
}
BOTH_WAYS = 2.0  # sweeps of an iteration in the symmetric order


@dataclass(frozen=True)
class Cost:
    """The expected cost of one candidate: set-up, cost of an iteration, expected number of iterations."""

    setup: float  # ns
    each: float  # ns
    count: float

    @property
    def total(self) -> float:
        """All of them [ns]."""
        return self.setup + self.count * self.each


@dataclass(frozen=True)
class Plan:
    """What `auto` would do with a problem: its candidates, and the counted cost of each.

    `str()` is one screen; `data()` are plain numbers and words, which `Plan.of` and `lavender.solve(..., plan=)` take.
    """

    rows: int
    law: str
    operator: str  # rows, matrix or generalized
    structure: str  # hash of blocks, law and operator: a plan is for problems of the same structure
    tol: float  # - relative residual
    small: bool  # one compiled call is tried before all of them
    candidates: tuple[tuple[str, Cost], ...]  # by expected cost, the least first
    first: tuple[str, int]  # the candidate with the first turn, and the iterations of that turn

    def data(self) -> dict[str, Any]:
        """As JSON has it; costs in nanoseconds."""
        costs = [{"name": name} | asdict(cost) for name, cost in self.candidates]
        return asdict(self) | {"candidates": costs, "first": list(self.first)}

    @classmethod
    def of(cls, given: Any) -> Plan:
        """A plan, or the data of one.

        Raises
        ------
        InputError
            Neither.
        """
        if isinstance(given, Plan):
            return given
        try:
            values = dict(given)
            costs = [
                (c["name"], Cost(*(float(c[k]) for k in ("setup", "each", "count"))))
                for c in values["candidates"]
            ]
            name, n = values["first"]
            if name not in dict(costs):
                raise ValueError(f"{name!r}, who is first, is no candidate")
            found = cls(**(values | {"candidates": tuple(costs), "first": (name, int(n))}))
        except (TypeError, ValueError, KeyError) as error:
            raise InputError(
                f"plan is a {type(given).__name__} that is no plan ({error}); what lavender.explain(problem) "
                "returns, or its .data(), is needed"
            ) from None
        for name, cost in found.candidates:
            if name not in METHODS or not (cost.setup >= 0.0 and cost.each > 0.0 and cost.count > 0.0):
                raise InputError(
                    f"plan: candidate {name!r} with {cost}; one of {', '.join(METHODS)} with costs above 0 is needed"
                )
        return found

    def check(self, problem: Problem) -> None:
        """Refuse a problem of another structure.

        Raises
        ------
        InputError
            The plan is of another problem.
        """
        if self.structure != structure_of(problem):
            raise InputError(
                f"the plan is of a problem of {self.rows} rows under the law {self.law!r} given as {self.operator}, "
                f"structure {self.structure}; this one has {problem.m}, {problem.law!r}, {problem.operator}, "
                f"{structure_of(problem)}: make its own with lavender.explain(problem)"
            )

    def __str__(self) -> str:
        name, n = self.first
        lines = [
            f"{self.rows} rows, law {self.law!r}, given as {self.operator}; tol {self.tol:.0e}",
            f"{'candidate':<18}{'total cost':>12}{'set-up':>12}{'iterations':>12}{'each':>12}",
        ]
        for candidate, cost in self.candidates:
            parts = [_time(cost.total), _time(cost.setup), f"{cost.count:.3g}", _time(cost.each)]
            lines.append(f"{candidate:<18}" + "".join(f"{part:>12}" for part in parts))
        if self.small:
            lines.append("before these, one compiled call for small problems is tried")
        why = (
            "the least total cost"
            if name == self.candidates[0][0]
            else "these cost little compared with the others"
        )
        lines.append(f"first turn: {name}, {n} iterations ({why})")
        lines.append("then, repeatedly, a turn of the candidate with the least expected remaining cost")
        return "\n".join(lines)


def _time(ns: float) -> str:
    unit, word = (1e9, "s") if ns >= 1e9 else (1e6, "ms") if ns >= 1e6 else (1e3, "us")
    return f"{ns / unit:.3g} {word}"


def structure_of(problem: Problem) -> str:
    """A hash of blocks, law and operator."""
    from hashlib import sha256  # 4 ms to import, needed only here

    found = sha256(f"{problem.law} {problem.operator} {problem.m}".encode())
    found.update(problem.cones.ptr.tobytes() + problem.cones.kind.tobytes())
    return found.hexdigest()[:12]


class Costs:
    """Costs of the candidates on one problem to `tol`.

    `given`: rates to use instead of those of the file; `plan`: costs to use instead of counting.
    """

    def __init__(
        self,
        problem: Problem,
        tol: float = 1e-6,
        given: Mapping[str, Any] | None = None,
        structure: Structure | None = None,
        plan: Plan | None = None,
    ) -> None:
        self.problem = problem
        self.structure = Structure(problem) if structure is None else structure
        self.rates = rates() if given is None else given
        self.planned = {} if plan is None else dict(plan.candidates)
        self.law = law_of(problem)
        self.decades = decades(tol)

    @property
    def sure(self) -> float:
        """A factorisation begins only if this many times its counted cost is left; nine in ten end within it."""
        return float(self.rates["sure"])

    def floor(self, name: str) -> float:
        """ns that a method which factors takes at least, told by rows alone; inf for sweeps, which take any time."""
        r, law, m = self.rates, self.law, self.structure.m
        if name == "newton" and self.problem.generalized is not None:
            v = r["velocities"]
            n = of_law(v["count"], law)
            return float(n * v["step"] + (READ + n) * v["entry"] * self.structure.sweep)
        if name in ("direct", "newton", "newton over rows"):
            part = r["direct" if name == "direct" else "newton"]
            return float(part["start"] + of_law(part["count"], law) * part["row"] * m)
        return float(r["admm"]["start"]) if name == "admm" else inf

    def least(self, name: str) -> Cost:
        """At least, without the analysis of a factor's pattern."""
        s = self.structure
        if name in self.planned:
            return self.planned[name]
        if name == "direct":
            return self._finite("direct", s.direct_least)
        if name == "newton" and s.problem.generalized is None:
            return self._finite("newton", s.newton_least)
        if name == "newton over rows":
            return self._finite("newton", s.newton_least)
        if name == "relaxation":
            return self._relaxation()
        return self.of(name)

    def of(self, name: str) -> Cost:
        """As counted; inf where the counting breaks down."""
        try:
            return self._of(name)
        except BREAKDOWN:
            return Cost(inf, 1.0, 1.0)

    def _of(self, name: str) -> Cost:
        s, r, law = self.structure, self.rates, self.law
        if name in self.planned:
            return self.planned[name]
        if name in ("anderson", "nncg"):
            a = r["anderson"]
            each = a["row"] * s.m + of_law(a["work"], law) * s.sweep
            count = self.decades * of_law(r[name]["count"], law)
            return Cost(a["start"], each * (1.0 if name == "anderson" else BOTH_WAYS), count)
        if name == "direct":
            return self._finite("direct", s.direct)
        if name == "relaxation":
            return self._relaxation() if s.is_loose else Cost(inf, 1.0, 1.0)
        if name == "admm":
            a, (factored, fill) = r["admm"], s.admm(1.0)
            setup = a["start"] + r["formed"] * s.formed + a["factor"] * factored
            return Cost(setup, a["work"] * fill, self.decades * a["count"])
        if name == "newton" and s.problem.generalized is not None:
            v = r["velocities"]
            if s.kernel is None:
                return Cost(float("inf"), 1.0, 1.0)
            each = v["step"] + v["entry"] * s.read + v["work"] * s.velocities
            return Cost(v["entry"] * READ * s.sweep, each, of_law(v["count"], law) * s.steps)
        return self._finite("newton", s.newton)

    def _relaxation(self) -> Cost:
        a, s = self.rates["anderson"], self.structure
        return Cost(a["start"], a["row"] * s.m + a["work"]["cone"] * s.sweep, self.decades * a["count"])

    def _finite(self, name: str, factor: float) -> Cost:
        r, s = self.rates[name], self.structure
        setup = r["start"] + self.rates["formed"] * s.formed
        count = 1.0 if name == "direct" and self.law == "linear" else of_law(r["count"], self.law)
        return Cost(setup, r["row"] * s.m + r["work"] * factor, count)


def candidates(structure: Structure, deadline: Deadline = NEVER) -> tuple[str, ...]:
    """Names of the table that take a problem, in its order; `direct` only if there is time to look at all of A."""
    problem = structure.problem
    if problem.cones.has_round:
        return TABLE[problem.operator]["round"]
    if problem.cones.has_rolling:
        return ROLLING
    names = TABLE[problem.operator][problem.law]
    asks = not deadline.passed(setup_time("direct", problem)) if "direct" in names else False
    return names if asks and structure.is_definite else tuple(name for name in names if name != "direct")


def setup_time(name: str, problem: Problem) -> float:
    """What a candidate sets up, or what counts its cost, takes before its first iteration [s]; 0: next to nothing."""
    solver, options = METHODS[name]
    asked = getattr(get(solver).load()(**options), "setup_time", None)
    return 0.0 if asked is None else float(asked(problem))


def made(problem: Problem, tol: float) -> Plan:
    """The plan of a problem to `tol`, counted in full; nothing is run."""
    from lavender.solvers.methods import make
    from lavender.solvers.schedule import first
    from lavender.solvers.solve_log import SolveLog

    costs = Costs(problem, tol)
    methods = make(SolveLog(problem, tol, 2**31 - 1), costs, candidates(costs.structure))
    chosen = first(methods)
    counted = sorted(((m.name, costs.of(m.name)) for m in methods), key=lambda pair: pair[1].total)
    return Plan(
        rows=problem.m, law=problem.law, operator=problem.operator, structure=structure_of(problem), tol=tol,
        small=costs.structure.is_small(tol), first=(chosen.name, chosen.steps(chosen.rest) if chosen.rest < inf else 0),
        candidates=tuple((name, cost) for name, cost in counted if cost.total < inf),
    )  # fmt: skip
