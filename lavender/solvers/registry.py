"""Solvers by name. Each has a `SolverSpec`, which lists its capabilities as data; the tests check every one of them.

A solver is an object that holds only its options; `SolverSpec.factory(**options)` makes it. `Solver` has all that is
asked of one. Third parties register through the entry point group "lavender.solvers" (an object that is a `SolverSpec`,
or a function that returns one) or with `register`.
"""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Protocol

from lavender.base.arrays import FloatArray, flag, whole_number
from lavender.base.deadline import Deadline
from lavender.base.errors import InputError, SolverUnavailable, UnknownName, check_name, last_words
from lavender.base.later import imported, loading
from lavender.judge.solution import Claim, Status
from lavender.problem import LAWS, OPERATORS, Problem, check_problem
from lavender.problem.derived import cached_property

__all__ = ["Solver", "SolverSpec", "State", "available", "get", "known", "register"]


# Modules whose SPECS are registered first, by name: they import this one.
SMALL_ROWS = 64  # rows up to which Python's share decides what a solve costs: a spec's `small` is tried first
TABLES = ("lavender.solvers", "lavender.external")


class SmallCall(Protocol):
    """Solves a problem of few rows to tol with the bits of `run`, or leaves it to `run`."""

    def in_vain(
        self, problem: Problem, impulse: FloatArray | None, tol: float, counts: tuple[int, ...]
    ) -> None:
        """The call from there left it after these counts: it need not be made again before `run`."""

    @property
    def limits(self) -> Any:
        """What it may cost over generalised velocities."""

    @property
    def rules(self) -> Any:
        """What is asked for of few rows of A or of bodies."""

    def attempt(
        self, problem: Problem, impulse: FloatArray | None, tol: float, most: float = ...
    ) -> tuple[Any, Any]:
        """(what the judge finds, None where it is left, and counts) from an impulse (m,) or from doing nothing."""

    def claim(
        self, problem: Problem, counts: Any, start: FloatArray | None, after: float, status: Status
    ) -> Claim:
        """What counts come to, from a start (m,) or from none to the residual `after`, with its turns."""


class State(Protocol):
    """What `prepare` returns: any object. `lavender.solve` reads these attributes of a resumable solver, if present."""

    @property
    def best(self) -> tuple[float, FloatArray | None]:
        """(relative residual, impulse (m,)) of the best iterate that the solver has checked; (inf, None) before.

        Optional, for solvers whose residual may rise: this is the result if the last iterate is worse.
        """

    @property
    def sweeps_per_decade(self) -> float:
        """Iterations in which the relative residual falls tenfold, by the last checks; NaN if it does not fall.

        Optional, for solvers whose iterations cost the same.
        """


class Solver:
    """What a factory returns: `prepare` and `run`, and what it does otherwise than here.

    A plug-in may return any object with `prepare` and `run` (`external/foreign.py`).
    """

    def prepare(self, problem: Problem) -> Any:
        """The state: factor, colour, allocate."""
        raise NotImplementedError

    def update(self, state: Any, problem: Problem) -> Any:
        """The state of a problem of the same structure with new numbers, and a fresh start."""
        return self.prepare(problem)

    def run(
        self, state: Any, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None
    ) -> Claim:
        """`max_iter` more iterations on `impulse` (m,) in place, fewer only if its own convergence test is met.

        If `resumable`, n1 and then n2 iterations give the bits of n1 + n2, and time_limit is None.
        """
        raise NotImplementedError

    needs_scipy = False  # `setup_time` may count parts of SciPy that are not loaded yet

    def setup_time(self, problem: Problem) -> float:
        """What `prepare` takes [s], counted from the size of the problem: begun only if that fits in a time limit."""
        return 0.0

    def ready(self, state: Any, time_limit: float) -> None:
        """A limit [s] was given, and its clock stands still: start processes."""

    def until(self, state: Any, deadline: Deadline) -> None:
        """Before `run`, where it is resumable: begin no long step (a factorisation) that would end after that."""

    def turn(
        self, state: Any, impulse: FloatArray, n: int, tol: float, time_limit: float | None, left: int | None
    ) -> Claim:
        """For `auto`: n iterations or a few more, up to `left`, on from where the last turn ended."""
        return self.run(state, impulse, n, tol, time_limit)

    def otherwise(self) -> Solver | None:
        """Who follows where this one stalls on friction as bounded rows (`polyhedral.py`)."""
        return None


@dataclass(frozen=True)
class SolverSpec:
    """One solver: its name, where its code is, and what it can do.

    Raises
    ------
    InputError
        A law or operator that does not exist, none at all, an empty name, options that are no table, requires that
        is no tuple of names, a capability that is neither True nor False, or a max_iter that is no whole number.
    """

    name: str
    # Of a Solver, or of an object with its methods; "module:attribute" is imported at first use.
    factory: str | Callable[..., Any]
    laws: frozenset[str]  # of LAWS: "linear", "lcp", "coulomb", "cone"
    summary: str
    reference: str = ""  # paper or manual
    # Forms of A (of OPERATORS) that it reads as given; with "matrix", A is formed from any other form.
    operators: frozenset[str] = frozenset({"rows", "matrix"})
    exact: bool = False  # ends after finitely many steps or at rounding accuracy, not at tol
    resumable: bool = True
    impulse: bool = True  # uses a warm start
    order: bool = False  # takes order= and ground=
    seed: bool = False  # takes seed=
    callback: bool = True  # takes callback=; needs resumable
    history: bool = True  # records history; needs resumable
    delegates: bool = False  # calls other solvers: only "auto"
    round_cones: bool = False  # takes contacts of more than two tangents in one cone
    # Of "coulomb" and "cone", the laws under which it takes boxes: contacts whose tangents are bounded each by
    # itself. A law that is not in `laws` is taken only without disks (by our own solvers as bounded rows:
    # solvers/polyhedral.py).
    boxes: frozenset[str] = frozenset()
    parts: bool = False  # takes contacts of more parts than tangents and one row that spins
    external: bool = False  # another project's code solves; its claims are its own
    max_iter: int = 1000  # default budget
    options: Mapping[str, str] = field(default_factory=dict)  # own options: name -> one line
    requires: tuple[str, ...] = ()  # modules that must be importable
    install: str = ""  # what to install where they are not
    bounded: str = ""  # of a solver for free rows: what to use for bounded rows
    with_bounds: str = ""  # the solver that is this very method with bounds, for `standing_in`
    refusal: Callable[[Problem], str | None] | None = None  # more reasons against a problem
    small: SmallCall | None = (
        None  # problems of few rows with default options, in one compiled call; asked of our own alone
    )
    plugged = False  # found by its entry point, as another process finds it
    own = False  # of this package; other solvers get copies, and what they return is checked (`external/foreign.py`)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise InputError(f"a solver's name is {self.name!r}; a text that is not empty is needed")
        if not isinstance(self.summary, str):
            raise InputError(f"summary of solver {self.name!r} is {self.summary!r:.80}; a text is needed")
        for what, names in (("laws", LAWS), ("operators", OPERATORS), ("boxes", ("coulomb", "cone"))):
            given = getattr(self, what)
            is_some = isinstance(given, Collection) and not isinstance(given, (str, bytes))
            if not is_some or not all(isinstance(name, str) and name in names for name in given):
                raise InputError(
                    f"{what} of solver {self.name!r} are {given!r:.80}; a set of {', '.join(names)} is needed"
                )
            if not given and what != "boxes":
                raise InputError(f"solver {self.name!r} has no {what}; of {', '.join(names)} one is needed")
            object.__setattr__(self, what, frozenset(given))
        if not isinstance(self.requires, (tuple, list)) or not all(isinstance(n, str) for n in self.requires):
            raise InputError(
                f"requires of solver {self.name!r} is {self.requires!r:.80}; a tuple of names of modules is needed"
            )
        if not isinstance(self.options, Mapping):
            raise InputError(
                f"options of solver {self.name!r} are {self.options!r:.80}; a table of names, with a line on each, "
                "is needed"
            )
        for name, kind in self.__dataclass_fields__.items():
            value = getattr(self, name)
            if kind.type == "bool" and not isinstance(value, bool):  # as __future__ leaves annotations
                flag(f"{name} of solver {self.name!r}", value)
        object.__setattr__(self, "max_iter", whole_number(f"max_iter of solver {self.name!r}", self.max_iter))
        if not self.resumable:
            object.__setattr__(self, "callback", False)
            object.__setattr__(self, "history", False)

    @property
    def accepts(self) -> frozenset[str]:
        """Options beyond those of the front door."""
        shared = {"order": ("order", "ground"), "seed": ("seed",)}
        return frozenset(self.options) | {
            o for flag, names in shared.items() if getattr(self, flag) for o in names
        }

    def missing(self) -> str | None:
        """None when the solver can run here, else what to install."""
        if not self.requires:
            return None
        absent = [m for m in self.requires if not _importable(m)]
        if not absent:
            return None
        return f"needs {', '.join(absent)}: pip install {self.install or ' '.join(absent)}"

    @cached_property
    def takes_all(self) -> bool:
        """No problem is refused."""
        kinds = self.boxes == {"coulomb", "cone"} and self.round_cones and self.parts
        return kinds and self.laws == set(LAWS) and "matrix" in self.operators and self.refusal is None

    def refuses(self, problem: Problem, kind_alone: bool = False) -> str | None:
        """None when the solver takes this problem, else the reason.

        kind_alone: Compare the problem's kind with the spec alone, for which nothing of the problem is worked out, and
        do not call `refusal`.
        """
        if self.takes_all:
            return None
        check_problem(problem)
        law, operator = problem.law, problem.operator
        if operator == "rows" and problem.cones.has_ellipse:
            operator = "matrix"  # of `problem.disk`, which is what solvers get
        if law in self.laws and law not in ("linear", "lcp", *self.boxes) and problem.cones.has_box:
            return (
                "takes no boxes, contacts that bound each tangent by itself: use one of those that do, "
                "lavender.available(problem) lists them, or give the problem cones.shaped('disk')"
            )
        if law not in self.laws and not (law in self.boxes and problem.cones.is_polyhedral):
            takes = ", ".join(law for law in LAWS if law in self.laws)
            way = _way_round(law, self.laws)
            if law == "coulomb" and "cone" in self.boxes and problem.cones.is_polyhedral:
                way = ": pass problem.relaxed('cone'), or use a solver for Coulomb friction"
            return f"takes laws {takes}, not {law!r}{self.bounded or way}"
        if "matrix" not in self.operators and operator not in self.operators:
            makers = {"rows": "Problem.from_rows", "generalized": "Problem.from_jacobian"}
            needs = " or ".join(f"{o} ({makers[o]})" for o in OPERATORS if o in self.operators)
            given = "as a matrix" if operator == "matrix" else f"by its {operator} form"
            if problem.operator != operator:
                given = f"by its {problem.operator} form with ellipses, which becomes a matrix (problem.disk)"
            return f"needs a problem with {needs}; this one was given {given}"
        if problem.cones.has_round and not self.round_cones:
            return (
                "takes no round cones (more than two tangents in one): use one of those that do, "
                "lavender.available(problem) lists them, or give the edges of a pyramid as rows"
            )
        if problem.cones.has_more_parts and not self.parts:
            return (
                "takes no contacts that resist what rolls: use one of those that do, lavender.available(problem) lists "
                "them, or leave the rows that roll out"
            )
        if self.refusal is None or kind_alone:
            return None
        try:
            return self.refusal(problem.disk) or None
        except Exception as error:
            if self.own:
                raise
            return f"cannot say whether it takes the problem: {last_words(error)}"

    def standing_in(self, problem: Problem) -> SolverSpec | None:
        """The same method with bounds, where a problem's bounds are what this one refuses; else None."""
        check_problem(problem)
        other = specs().get(self.with_bounds)
        bounds = other is not None and problem.law not in self.laws and other.refuses(problem) is None
        return other if bounds else None

    def load(self) -> Callable[..., Solver]:
        """The factory, imported now if it was not before.

        Raises
        ------
        SolverUnavailable
            There is none where the spec says.
        """
        if not isinstance(self.factory, str):
            return self.factory
        module, _, attribute = self.factory.partition(":")
        try:
            return getattr(imported(module), attribute)
        except Exception as error:
            raise SolverUnavailable(
                f"solver {self.name!r} cannot be imported from {self.factory!r}: {last_words(error)}"
            ) from error


def _way_round(law: str, laws: frozenset[str]) -> str:
    if law == "coulomb" and "cone" in laws:
        return ": pass problem.relaxed('cone'), or use a solver for Coulomb friction"
    if law in ("coulomb", "cone") and "lcp" in laws:
        return ": pass problem.boxed(normal_impulse), or use a solver for friction"
    if law == "cone" and "coulomb" in laws:
        return ": pass problem.relaxed('coulomb')"
    return ""


@cache
def _importable(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        return False


registered: dict[str, SolverSpec] = {}


def load_table(table: str) -> None:
    """Fill `registered` with the SPECS of a module."""
    for spec in imported(table).SPECS:
        registered.pop(spec.name, None)  # those that were asked for by name go to their places, too
        _add_own(spec)


def _add_own(spec: SolverSpec) -> None:
    object.__setattr__(spec, "own", True)
    registered[spec.name] = spec


def load() -> None:
    """Have `registered` filled, by one thread while the others wait."""
    with loading():
        fill()


@cache
def fill() -> None:
    """Fill `registered` once, with the built-in solvers and those of plug-ins."""
    from importlib.metadata import entry_points  # a tenth of `import lavender`, needed only here

    for table in TABLES:
        load_table(table)
    for entry in entry_points(group="lavender.solvers"):
        try:
            spec = entry.load()
            spec = spec if isinstance(spec, SolverSpec) else spec()
            _add(spec, replace=False)
            object.__setattr__(spec, "plugged", True)
        except Exception as error:  # a plug-in may fail in any way; it must not take lavender with it
            warnings.warn(
                f"solver plug-in {entry.name!r} ({entry.value}) was left out: {error}", stacklevel=4
            )


def register(spec: SolverSpec, *, replace: bool = False) -> None:
    """Add a solver; `replace=True` to put it in the place of one of the same name.

    Raises
    ------
    InputError
        Not a SolverSpec, or the name is taken.
    """
    load()
    _add(spec, flag("replace", replace))


def _add(spec: SolverSpec, replace: bool) -> None:
    if not isinstance(spec, SolverSpec):
        raise InputError(f"register needs a SolverSpec, not a {type(spec).__name__}")
    if spec.name in registered and not replace:
        raise InputError(
            f"a solver named {spec.name!r} is registered already; pass replace=True to take its place"
        )
    registered[spec.name] = spec


def specs() -> dict[str, SolverSpec]:
    """Every registered solver by name, installed or not."""
    load()
    return dict(registered)


def get(name: str) -> SolverSpec:
    """The solver of that name, ready to run.

    Raises
    ------
    UnknownName
        No such solver; the nearest names are listed.
    SolverUnavailable
        Its package is not installed; the message says what to install.
    """
    spec = registered.get(name) if isinstance(name, str) else None
    if spec is None and isinstance(name, str):
        spec = _found(name)
    if spec is None:
        raise UnknownName("solver", name, specs())
    reason = spec.requires and spec.missing()
    if reason:
        raise SolverUnavailable(f"solver {name!r} {reason}")
    return spec


def _found(name: str) -> SolverSpec | None:
    """One that is not registered yet: of ours its file alone is imported, for which a time limit has room."""
    own: SolverSpec | None = imported(TABLES[0]).spec_of(name)
    if own is not None:
        _add_own(own)
        return own
    load()
    return registered.get(name)


def known(problem: Problem | None = None) -> dict[str, str | None]:
    """Each solver's name with None if it is installed (and accepts `problem`), otherwise with the reason why not."""
    if problem is not None:
        check_problem(problem)
    return {
        name: spec.missing() or (spec.refuses(problem) if problem is not None else None)
        for name, spec in sorted(specs().items())
    }


def available(problem: Problem | None = None, *, law: str | None = None, **capabilities: bool) -> list[str]:
    """Names of the installed solvers that accept `problem`, accept the law, and have the capabilities.

    >>> from lavender.solvers.registry import available
    >>> "pgs" in available(law="lcp", order=True)
    True

    Raises
    ------
    InputError
        A capability that no spec has.
    """
    flags = {n for n, f in SolverSpec.__dataclass_fields__.items() if f.type == "bool"}
    for name in capabilities:
        if name not in flags:
            raise InputError(f"unknown capability {name!r}; known: {', '.join(sorted(flags))}")
    if law is not None:
        check_name("law", law, LAWS)
    for name, value in capabilities.items():
        flag(name, value)
    table = specs()
    return [
        name
        for name, reason in known(problem).items()
        if reason is None
        and (law is None or law in table[name].laws)
        and all(getattr(table[name], c) == v for c, v in capabilities.items())
    ]


def in_one_call(problem: Problem) -> list[str]:
    """Names of this project's solvers that take `problem` and do not go on iteration by iteration to a budget."""
    kind = (s for s in specs().values() if not (s.resumable or s.external))
    return [s.name for s in kind if not s.missing() and not s.refuses(problem)]
