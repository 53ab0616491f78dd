"""A case: a problem, why it is there, and what its solution is known to be; cases by name and parameters."""

from __future__ import annotations

import ast
import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, ParamSpec

from lavender.base.arrays import FloatArray, check_float
from lavender.base.errors import InputError, UnknownName
from lavender.problem import Problem
from lavender.problem.derived import cached_property

P = ParamSpec("P")
MAX_SIZE = 10**7  # of a whole-number parameter: larger ones are typing errors that would fill the memory


@dataclass(frozen=True, eq=False)
class Reference:
    """A solution that no solver of this package is asked to confirm by itself."""

    impulse: FloatArray | None  # (m,) N s, rounded to float64; None: there is no solution
    source: str  # how it is known, e.g. "closed form"
    compare: str = "impulse"  # what is unique: "impulse" (and slack), "slack" (A singular), "error" (neither)
    certificate: FloatArray | None = None  # (m,), where there is no solution


@dataclass(frozen=True, eq=False)
class Case:
    """One problem of the suite. `reference` is computed when first asked for."""

    name: str  # "pyramid(k=10, mass_ratio=1e6)": `case(name)` makes it again
    problem: Problem
    reason: str  # one line: what it tests
    family: str
    parameters: Mapping[str, Any]
    expect: str = ""  # what is expected of whom
    solve_reference: Callable[[], Reference] | None = field(default=None, repr=False)

    @cached_property
    def reference(self) -> Reference | None:
        """What the solution is known to be, or None where only the judge can say."""
        return None if self.solve_reference is None else self.solve_reference()

    def __str__(self) -> str:
        return f"{self.name}: {self.reason}"

    def __reduce__(self) -> tuple[Any, ...]:
        """Copied or pickled it is made again."""
        from lavender.lab.suite import case

        return case, (self.name,)


@dataclass(frozen=True, eq=False)
class Draft:
    """What a family function gives; `family` adds name and parameters."""

    problem: Problem
    reason: str
    reference: Callable[[], Reference] | None = None
    expect: str = ""


@dataclass(frozen=True)
class Family:
    """A function of the suite by name."""

    name: str
    make: Callable[..., Case]
    signature: inspect.Signature
    preset: Mapping[str, Any]  # what the name itself says, e.g. friction="coulomb"
    summary: str

    def case(self, **given: Any) -> Case:
        """The case of these parameters; the others take their defaults."""
        known = [name for name in self.signature.parameters if name not in self.preset]
        for name in given:
            if name not in known:
                raise UnknownName(f"parameter of {self.name}", name, known)
        return self.make(**self.preset, **given)


FAMILIES: dict[str, Family] = {}


def family(**twins: Mapping[str, Any]) -> Callable[[Callable[P, Draft]], Callable[P, Case]]:
    """Register a function under its name, and under other names with some parameters fixed."""

    def decorate(function: Callable[P, Draft]) -> Callable[P, Case]:
        name = function.__name__
        signature = inspect.signature(function, eval_str=True)
        summary = (function.__doc__ or "").partition("\n")[0]

        @functools.wraps(function)
        def make(*args: P.args, **kwargs: P.kwargs) -> Case:
            bound = signature.bind(*args, **kwargs)
            given = frozenset(bound.arguments)
            bound.apply_defaults()
            values = {n: _check(name, signature.parameters[n], v) for n, v in bound.arguments.items()}
            text = _text(name, values, given)
            try:
                draft = function(**values)  # type: ignore[call-arg]
            except MemoryError as error:
                raise InputError(
                    f"{text}: there is not enough memory ({str(error) or 'none left'}); give smaller parameters"
                ) from None
            return Case(
                name=text,
                problem=replace(draft.problem, name=text, copy=False),
                reason=draft.reason,
                family=name,
                parameters=MappingProxyType(values),
                expect=draft.expect,
                solve_reference=draft.reference,
            )

        for alias, preset in {name: {}, **twins}.items():
            FAMILIES[alias] = Family(alias, make, signature, MappingProxyType(dict(preset)), summary)
        return make

    return decorate


def _check(name: str, parameter: inspect.Parameter, value: Any) -> Any:
    """The value in the type that the signature declares."""
    wanted = parameter.annotation
    what = f"{name}: {parameter.name} is {value!r}"
    if wanted is str:
        if not isinstance(value, str):
            raise InputError(f"{what}; a word is needed")
        return value
    found = check_float(f"{name}: {parameter.name}", value)
    if wanted is int:
        if found != int(found) or not 0 <= found <= MAX_SIZE:
            raise InputError(f"{what}; a whole number from 0 to {MAX_SIZE} is needed")
        return int(found)
    return found


def _text(name: str, values: Mapping[str, Any], given: frozenset[str]) -> str:
    """A name that gives these parameters: what was asked for, spelled in one way."""
    best = name
    preset: Mapping[str, Any] = {}
    for alias in FAMILIES.values():
        fixed = alias.preset
        if alias.make.__name__ == name and fixed and all(values.get(n) == v for n, v in fixed.items()):
            best, preset = alias.name, fixed
    parameters = FAMILIES[name].signature.parameters
    shown = [
        f"{n}={spell(v)}"
        for n, v in values.items()
        if n not in preset and (n in given or v != parameters[n].default)
    ]
    return f"{best}({', '.join(shown)})" if shown else best


def spell(value: Any) -> str:
    """A value as it stands in names: the shortest text that gives the same number."""
    if not isinstance(value, float):
        return str(value)
    mantissa, _, exponent = f"{value:.16e}".partition("e")
    spellings = [repr(value), f"{value:.17g}", f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}"]
    mantissa, _, exponent = repr(value).partition("e")
    if exponent:
        spellings.append(f"{mantissa}e{int(exponent)}")
    return min((s for s in spellings if float(s) == value), key=len)


def parse(text: str) -> tuple[str, dict[str, Any]]:
    """Name and parameters of "pyramid(k=10, mass_ratio=1e6)"; words need no quotes.

    Raises
    ------
    InputError
        Not a name with parameters in brackets.
    """
    problem = InputError(
        f"{text!r} is not a case; write a name with parameters, such as pyramid(k=10, mass_ratio=1e6)"
    )
    if not isinstance(text, str):
        raise problem
    try:
        node = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise problem from None
    if isinstance(node, ast.Name):
        return node.id, {}
    if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name) or node.args:
        raise problem
    values: dict[str, Any] = {}
    for keyword in node.keywords:
        if keyword.arg is None or keyword.arg in values:
            raise problem
        values[keyword.arg] = _value(keyword.value, problem)
    return node.func.id, values


def _value(node: ast.expr, problem: InputError) -> Any:
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        value = _value(node.operand, problem)
        if isinstance(value, (int, float)):
            return -value
    if (
        isinstance(node, ast.Constant)
        and isinstance(node.value, (int, float, str))
        and not isinstance(node.value, bool)
    ):
        return node.value
    raise problem
