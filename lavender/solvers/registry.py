"""Registry of solvers by name. A `SolverSpec` lists the capabilities of a solver as data; tests check each of them.

A solver is an object that holds only its options; `SolverSpec.factory(**options)` creates it. `Solver` defines the
interface. Other packages register solvers through the entry point group "lavender.solvers" (a `SolverSpec`, or a
function that returns one) or with `register`.
"""

from __future__ import annotations

import importlib.util
import re
import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import cache
from math import nan
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, TypedDict

from lavender.base.arrays import FloatArray, check_bool, check_int
from lavender.base.deadline import Deadline
from lavender.base.errors import (
    InputError,
    SolverUnavailable,
    UnknownName,
    check_name,
    format_error,
)
from lavender.base.lazy_import import import_lock, import_module_under_lock
from lavender.judge.solution import Claim
from lavender.problem import LAWS, OPERATORS, Problem, check_problem
from lavender.problem.derived import cached_property

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    from lavender.solvers.small import SmallCall

__all__ = [
    "Solver",
    "SolverOptions",
    "SolverSpec",
    "State",
    "available",
    "get",
    "known",
    "program_backends",
    "register",
]


# Modules with the SPECS that are registered first. They are named by strings because they import this module.
TABLES = ("lavender.solvers", "lavender.programs")
ENTRY_POINT_GROUP = "lavender.solvers"
#: Backends that `auto` tries in this order for quadratic programs; osqp is always installed.
PROGRAM_BACKENDS = ("piqp", "clarabel", "osqp")


class SolverOptions(TypedDict, total=False):
    """Options of the built-in solvers, for type checkers; the spec of a solver lists the options that it accepts.

    `**{"name": value}` with a `dict[str, Any]` passes the options of a plug-in.
    """

    order: Any
    seed: int
    ground: Any
    form: str
    relaxation: float
    memory: int
    convex: int | None
    restart: str
    sweep: Literal["pgs", "blocks"]
    omega: float
    settings: Mapping[str, Any]
    isolate: bool


class State(Protocol):
    """State of one solve, as `Solver.prepare` returns it. All attributes are optional, for resumable solvers.

    A state with a `StoppingTest` as its attribute `watch` leaves the best iterate to it: `watch.keep_best(impulse,
    tol)`, or the state's own `keep_best` if its rows have another order, writes the best impulse of each island.
    """

    @property
    def best(self) -> tuple[float, FloatArray | None]:  # pyright: ignore[reportReturnType]
        """(relative residual, impulse (m,)) of the best iterate that the solver has checked; (inf, None) at first.

        Solvers with a residual that may rise provide this attribute. Its impulse becomes the result if the last
        iterate is worse.
        """

    @property
    def sweeps_per_decade(self) -> float:  # pyright: ignore[reportReturnType]
        """Number of iterations in which the relative residual fell tenfold, from the last checks; NaN if it did not.

        Solvers with iterations of equal cost provide this attribute.
        """


class Solver:
    """Interface of a solver: `prepare` and `run` are required, the other methods have defaults.

    A plug-in may return any object with `prepare` and `run` (`solvers/foreign.py` wraps it).
    """

    #: Whether the stopping test of a prepared state checks the start, so that no result is worse than the start.
    checks_start: ClassVar[bool] = True
    #: Whether a failed run returns its last iterate under Coulomb's law (`lavender_ext/judge/best.pxd`).
    keeps_last: ClassVar[bool] = False
    #: Modules that a solve may import; under a time limit before its clock starts.
    lazy_modules: ClassVar[tuple[str, ...]] = ()

    def prepare(self, problem: Problem) -> Any:
        """Build the state of a solve: factor, colour, allocate."""
        raise NotImplementedError

    def update(self, state: Any, problem: Problem) -> Any:
        """Return the state for a problem of the same structure with new numbers, without a warm start."""
        return self.prepare(problem)

    def complete(self, state: Any) -> None:
        """Form and factor now, for `lavender.prepare`, what does not depend on b; `update` may then keep it."""

    def run(
        self, state: Any, impulse: FloatArray, max_iter: int, tol: float, time_limit: float | None
    ) -> Claim:
        """Run `max_iter` more iterations on `impulse` (m,) in place; fewer only if the solver's own test is met.

        If the solver is `resumable`, runs of n1 and then n2 iterations give the same bits as a run of n1 + n2, and
        `time_limit` is None.
        """
        raise NotImplementedError

    def estimate_setup_cost(self, problem: Problem) -> float:
        """Estimate the cost of `prepare` [ns]; under a time limit, `auto` starts a solver only if this cost fits."""
        return 0.0

    def estimate_iteration_cost(self, problem: Problem) -> float:
        """Estimate the cost of one iteration [ns]; NaN if it is not known."""
        return nan

    def estimate_total_cost(self, problem: Problem) -> float:
        """Estimate the cost of all iterations to a solution [ns], without the set-up; NaN if it is not known."""
        return nan

    def start_workers(self, state: Any, time_limit: float) -> None:
        """Start worker processes for a solve with a limit [s], before its clock starts."""

    def set_deadline(self, state: Any, deadline: Deadline) -> None:
        """Set the deadline of the next `run` of a resumable solver, whose long steps read it."""

    def fallback(self) -> Solver | None:
        """Return the solver to use after this one stalls on friction written as bounded rows (`polyhedral.py`)."""
        return None


@dataclass(frozen=True)
class SolverSpec:
    """Name, code and capabilities of one solver.

    Parameters
    ----------
    name : str
        Name for `lavender.solve(problem, name)`.
    factory : str or callable
        Callable that returns a `Solver` (or any object with its methods) from keyword options; "module:attribute" is
        imported at first use.
    laws : set of str
        Laws that the solver accepts, of "linear", "lcp", "coulomb", "cone".
    summary : str
        One line for tables.
    reference : str
        Paper or manual.
    operators : set of str
        Forms of A that the solver reads as given, of "rows", "matrix", "generalized"; with "matrix", A is formed from
        any other form.
    exact : bool
        Whether the solver ends after finitely many steps or at rounding accuracy, independent of `tol`.
    resumable : bool
        Whether the solver can continue after `max_iter` iterations with the same bits as one longer run.
    impulse : bool
        Whether the solver uses a warm start.
    order : bool
        Whether the solver accepts the options `order` and `ground`.
    seed : bool
        Whether the solver accepts the option `seed`.
    callback : bool
        Whether the solver accepts a `callback`; requires `resumable`.
    history : bool
        Whether the solver records `history`; requires `resumable` or `delegates`.
    delegates : bool
        Whether the solver calls other solvers (only "auto" does).
    plain_sweeps : bool
        Whether an iteration is one sweep without acceleration, as engines run a fixed number of.
    round_cones : bool
        Whether the solver accepts contacts of more than two tangents in one cone.
    box_friction_laws : set of str
        Laws, of "coulomb" and "cone", under which the solver accepts boxes: contacts that bound each tangent
        separately. If such a law is not in `laws`, only problems without disks are accepted (built-in solvers solve
        boxes as bounded rows: solvers/polyhedral.py).
    supports_rolling : bool
        Whether the solver accepts contacts with rolling friction, or with torsional friction and several tangents.
    singular_programs : bool
        Whether the solver accepts quadratic programs with a singular P (`Problem.from_qp`).
    external : bool
        Whether the code of another project solves the problem, so that lavender does not guarantee its claims.
    max_iter : int
        Default iteration budget.
    options : mapping of str to str
        Options of this solver: name and one line of description.
    requires : tuple of str
        Modules that must be importable.
    install : str
        Arguments of `pip install` that install these modules.
    bounded_hint : str
        For a solver of free rows: recommendation of the error message about bounded rows.
    bounded_variant : str
        For a solver of free rows: name of the solver with the same method for bounded rows; see `standing_in`.
    refusal : callable, optional
        Returns a reason not to accept a problem, or None; called after all other checks.
    small : SmallCall, optional
        Compiled call for small problems with default options; only for built-in solvers.

    Attributes
    ----------
    distribution : str
        Name of the installed package in which lavender found the solver by an entry point; else empty. Solvers with an
        entry point are found by other processes, too.
    builtin : bool
        Whether the solver is part of this package. The claims of others are checked (`solvers/foreign.py`).

    Raises
    ------
    InputError
        An unknown law or operator, an empty set of them, an empty name, a `factory` that cannot be called or imported,
        `options` that are not a mapping, `requires` that is not a tuple of names, a capability that is not a bool, or a
        `max_iter` that is not an integer.
    """

    name: str
    factory: str | Callable[..., Any]
    laws: frozenset[str]
    summary: str
    reference: str = ""
    operators: frozenset[str] = frozenset({"rows", "matrix"})
    exact: bool = False
    resumable: bool = True
    impulse: bool = True
    order: bool = False
    seed: bool = False
    callback: bool = True
    history: bool = True
    delegates: bool = False
    plain_sweeps: bool = False
    round_cones: bool = False
    box_friction_laws: frozenset[str] = frozenset()
    supports_rolling: bool = False
    singular_programs: bool = False
    external: bool = False
    max_iter: int = 1000
    options: Mapping[str, str] = field(default_factory=dict)
    requires: tuple[str, ...] = ()
    install: str = ""
    bounded_hint: str = ""
    bounded_variant: str = ""
    refusal: Callable[[Problem], str | None] | None = None
    small: SmallCall | None = None
    distribution = ""
    builtin = False

    def __post_init__(self) -> None:
        is_path = (
            isinstance(self.factory, str) and re.fullmatch("[^:]+:[^:]+", self.factory) is not None
        )
        is_names = isinstance(self.requires, (tuple, list)) and all(
            isinstance(n, str) for n in self.requires
        )
        fields = [
            ("name", isinstance(self.name, str) and bool(self.name), "a text that is not empty"),
            ("summary", isinstance(self.summary, str), "a text"),
            (
                "factory",
                callable(self.factory) or is_path,
                "a callable, or the text 'module:attribute',",
            ),
            ("requires", is_names, "a tuple of names of modules"),
            ("options", isinstance(self.options, Mapping), "a mapping from names to descriptions"),
        ]
        for name, choices in (
            ("laws", LAWS),
            ("operators", OPERATORS),
            ("box_friction_laws", ("coulomb", "cone")),
        ):
            values = getattr(self, name)
            is_set = isinstance(values, Collection) and all(
                isinstance(x, str) and x in choices for x in values
            )
            is_filled = name == "box_friction_laws" or (is_set and len(values) > 0)
            fields.append((name, is_set and is_filled, f"a set of {', '.join(choices)}"))
        for name, is_valid, needed in fields:
            if not is_valid:
                given = getattr(self, name)
                raise InputError(
                    f"{name} of solver {self.name!r} is {given!r:.80}; {needed} is needed"
                )
        for name in ("laws", "operators", "box_friction_laws"):
            object.__setattr__(self, name, frozenset(getattr(self, name)))
        for name, kind in self.__dataclass_fields__.items():
            value = getattr(self, name)
            if kind.type == "bool" and not isinstance(
                value, bool
            ):  # `type` is the annotation as a string.
                check_bool(f"{name} of solver {self.name!r}", value)
        object.__setattr__(
            self, "max_iter", check_int(f"max_iter of solver {self.name!r}", self.max_iter)
        )
        if not self.resumable:
            object.__setattr__(self, "callback", False)
            object.__setattr__(self, "history", self.history and self.delegates)

    @property
    def accepts(self) -> frozenset[str]:
        """Names of the options that `lavender.solve` passes on to the factory."""
        shared = {"order": ("order", "ground"), "seed": ("seed",)}
        flags = [flag for flag in shared if getattr(self, flag)]
        return frozenset(self.options).union(*(shared[flag] for flag in flags))

    def missing(self) -> str | None:
        """Return None if the solver can run here, else the reason and what to install."""
        if not self.requires:
            return None
        absent = [m for m in self.requires if not _is_importable(m)]
        if not absent:
            return None
        return f"needs {', '.join(absent)}: pip install {self.install or ' '.join(absent)}"

    @cached_property
    def takes_all(self) -> bool:
        """Whether the solver accepts every problem."""
        kinds = (
            self.box_friction_laws == {"coulomb", "cone"}
            and self.round_cones
            and self.supports_rolling
        )
        return (
            kinds and self.laws == set(LAWS) and "matrix" in self.operators and self.refusal is None
        )

    def refuses(self, problem: Problem) -> str | None:
        """Return None if the solver accepts this problem, else the reason why not."""
        if type(problem) is not Problem:
            check_problem(problem)
        if not self.singular_programs and problem.qp is not None and problem.qp.is_singular:
            return f"needs a positive definite P, and P is singular: use auto, or {_list_program_solvers()}"
        if self.takes_all:
            return None
        law = problem.law
        blocks = problem.cones._blocks
        others = "use a solver of lavender.available(problem), or"
        accepts_boxes = law in ("linear", "lcp", *self.box_friction_laws)
        if law in self.laws and not accepts_boxes and problem.cones.has_box:
            return f"takes no boxes, which bound each tangent: {others} cones.shaped('disk')"
        if law not in self.laws and not (
            law in self.box_friction_laws and problem.cones.is_polyhedral
        ):
            takes = ", ".join(law for law in LAWS if law in self.laws)
            way = ""
            relaxed_laws = self.laws | (
                self.box_friction_laws if problem.cones.is_polyhedral else set()
            )
            if law == "coulomb" and "cone" in relaxed_laws:
                way = ": pass problem.relaxed('cone'), or use a solver for Coulomb friction"
            elif law in ("coulomb", "cone") and "lcp" in self.laws:
                way = ": pass problem.boxed(normal_impulse), or use a solver for friction"
            elif law == "cone" and "coulomb" in self.laws:
                way = ": pass problem.relaxed('coulomb')"
            return f"takes laws {takes}, not {law!r}{self.bounded_hint or way}"
        operator = "matrix" if problem.matrix is not None else problem.operator
        if operator == "rows" and blocks.has_ellipse:
            operator = "matrix"  # Solvers get `problem.disk`, which has the form of a matrix here.
        if "matrix" not in self.operators and operator not in self.operators:
            makers = {"rows": "Problem.from_rows", "generalized": "Problem.from_jacobian"}
            needs = " or ".join(f"{o} ({makers[o]})" for o in OPERATORS if o in self.operators)
            given = "as a matrix" if operator == "matrix" else f"by its {operator} form"
            if problem.operator != operator:
                given = f"by its {problem.operator} form with ellipses, which becomes a matrix (problem.disk)"
            return f"needs a problem with {needs}; this one was given {given}"
        if blocks.has_round and not self.round_cones:
            return f"takes no round cones (over two tangents in one): {others} give edges as rows"
        if blocks.has_rolling and not self.supports_rolling:
            return (
                f"takes no contacts that resist what rolls: {others} leave the rows that roll out"
            )
        if self.refusal is None:
            return None
        return self.refusal(problem.disk if blocks.has_ellipse else problem) or None

    def standing_in(self, problem: Problem) -> SolverSpec | None:
        """Return the `bounded_variant` if this solver refuses the problem only because of its bounds, else None."""
        check_problem(problem)
        other = specs().get(self.bounded_variant)
        bounds = (
            other is not None and problem.law not in self.laws and other.refuses(problem) is None
        )
        return other if bounds else None

    @property
    def lazy_modules(self) -> tuple[str, ...]:
        """Modules that a solve may import, as the factory names them."""
        return getattr(self.load(), "lazy_modules", ())

    def load(self) -> Callable[..., Solver]:
        """Return the factory; import it if necessary.

        Raises
        ------
        SolverUnavailable
            The module or attribute does not exist.
        """
        if not isinstance(self.factory, str):
            return self.factory
        module, _, attribute = self.factory.partition(":")
        try:
            return getattr(import_module_under_lock(module), attribute)
        except Exception as error:
            raise SolverUnavailable(
                f"solver {self.name!r} cannot be imported from {self.factory!r}: {format_error(error)}"
            ) from error


def _list_program_solvers() -> str:
    """Return the names of installed solvers that accept a singular P, as in "clarabel, osqp or piqp"."""
    names = sorted(
        name
        for name, s in specs().items()
        if s.singular_programs and not s.delegates and not s.missing()
    )
    return (
        " or ".join(filter(None, (", ".join(names[:-1]), names[-1]))) if names else "install osqp"
    )


@cache
def _is_importable(module: str) -> bool:
    """Return whether a module can be found, without importing it."""
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        return False


registered: dict[str, SolverSpec] = {}


def _add_own(spec: SolverSpec) -> None:
    object.__setattr__(spec, "builtin", True)
    registered[spec.name] = spec


def load_all() -> None:
    """Fill `registered` with all solvers, once; other threads wait until it is filled."""
    with import_lock():
        register_all_solvers()


@cache
def register_all_solvers() -> None:
    """Fill `registered` with the built-in solvers and the plug-ins."""
    for table in TABLES:
        for spec in import_module_under_lock(table).SPECS:
            # Restore the order of the table, from which `get` may have registered a solver before.
            registered.pop(spec.name, None)
            _add_own(spec)
    from importlib.metadata import (
        entry_points,
    )  # It takes a tenth of the time of `import lavender`.

    for entry in entry_points(group=ENTRY_POINT_GROUP):
        _register_plugin(entry)


def _register_plugin(entry: EntryPoint) -> None:
    """Register the solver of an entry point. A warning names one that fails, or has another name than its solver."""
    distribution = entry.dist.name if entry.dist else entry.name
    title = f"solver plug-in {entry.name!r} ({entry.value}) of {distribution}"
    try:
        spec = entry.load()
        spec = spec if isinstance(spec, SolverSpec) else spec()
        if isinstance(spec, SolverSpec) and spec.name in registered:
            raise InputError(
                f"another solver is named {spec.name!r}; give its SolverSpec a name of its own"
            )
        _add_spec(spec, replace=False)
    # A plug-in may raise any error, or exit; a warning suffices, so that other solvers can be used.
    except (Exception, SystemExit) as error:
        text = str(error) if isinstance(error, InputError) else format_error(error)
        warnings.warn(f"{title} was left out: {text}", stacklevel=2)
        return
    object.__setattr__(spec, "distribution", distribution)
    if spec.name != entry.name:
        warnings.warn(
            f"{title} has a solver named {spec.name!r}: use this name; its authors should give the entry point and "
            "the SolverSpec the same name",
            stacklevel=2,
        )


def register(spec: SolverSpec, *, replace: bool = False) -> None:
    """Add a solver; `replace=True` replaces a solver of the same name.

    Raises
    ------
    InputError
        `spec` is not a SolverSpec, or the name is in use.
    """
    load_all()
    _add_spec(spec, check_bool("replace", replace))


def _add_spec(spec: SolverSpec, replace: bool) -> None:
    if not isinstance(spec, SolverSpec):
        raise InputError(f"spec is a {type(spec).__name__}; a lavender.SolverSpec is needed")
    if not re.fullmatch(r"[A-Za-z0-9_.-]+", spec.name):
        raise InputError(
            f"name of solver {spec.name!r} is not of letters, digits and the characters _ . -"
        )
    if spec.name in registered and not replace:
        raise InputError(
            f"a solver named {spec.name!r} is registered already; replace=True replaces it"
        )
    registered[spec.name] = spec


def specs() -> dict[str, SolverSpec]:
    """Return all registered solvers by name, installed or not."""
    load_all()
    return dict(registered)


def get(name: str) -> SolverSpec:
    """Return the spec of an installed solver.

    Raises
    ------
    UnknownName
        The solver does not exist; the message lists the nearest names.
    SolverUnavailable
        Its package is not installed; the message names the package.
    """
    spec = registered.get(name) if isinstance(name, str) else None
    if spec is None and isinstance(name, str):
        # The file of a built-in solver is imported alone, which takes less time than the whole table.
        spec = import_module_under_lock(TABLES[0]).get_spec(name)
        if spec is not None:
            _add_own(spec)
        else:
            spec = specs().get(name)
    if spec is None:
        raise UnknownName("solver", name, specs())
    reason = spec.requires and spec.missing()
    if reason:
        raise SolverUnavailable(f"solver {name!r} {reason}")
    return spec


def known(problem: Problem | None = None) -> dict[str, str | None]:
    """Return {name: None if the solver is installed and accepts `problem`, else the reason}."""
    if problem is not None:
        check_problem(problem)
    return {
        name: spec.missing() or (spec.refuses(problem) if problem is not None else None)
        for name, spec in sorted(specs().items())
    }


def available(
    problem: Problem | None = None, *, law: str | None = None, **capabilities: bool
) -> list[str]:
    """Return the names of installed solvers that accept `problem` and the law, and have the capabilities.

    >>> from lavender.solvers.registry import available
    >>> "pgs" in available(law="lcp", order=True)
    True

    Raises
    ------
    InputError
        A capability is not a field of `SolverSpec`.
    """
    flags = {n for n, f in SolverSpec.__dataclass_fields__.items() if f.type == "bool"}
    for name in capabilities:
        if name not in flags:
            raise InputError(f"unknown capability {name!r}; known: {', '.join(sorted(flags))}")
    if law is not None:
        check_name("law", law, LAWS)
    for name, value in capabilities.items():
        check_bool(name, value)
    table = specs()
    return [
        name
        for name, reason in known(problem).items()
        if reason is None
        and (law is None or law in table[name].laws)
        and all(getattr(table[name], c) == v for c, v in capabilities.items())
    ]


def program_backends() -> list[SolverSpec]:
    """Return the specs of the installed `PROGRAM_BACKENDS`."""
    return [get(name) for name in PROGRAM_BACKENDS if not specs()[name].missing()]
