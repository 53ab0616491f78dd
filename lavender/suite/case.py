"""A test case: a problem, the property that it tests, its known solution; and case names with parameters."""

from __future__ import annotations

import functools
import inspect
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, ParamSpec

import numpy as np

from lavender.base.arrays import FloatArray, check_float
from lavender.base.errors import InputError
from lavender.problem import Problem
from lavender.problem.derived import cached_property

P = ParamSpec("P")
CASE_NAME = re.compile(r"\s*(\w+)\s*(?:\(([^()]*)\))?\s*")
MAX_SIZE = (
    10**7
)  # Larger integer parameters are rejected: they are typing errors and would fill the memory.


@dataclass(frozen=True, eq=False)
class Reference:
    """A solution that is known independently of this package's solvers.

    Parameters
    ----------
    impulse : (m,) N s, or None
        The solution, rounded to float64; None if the problem has no solution.
    source : str
        Method by which the solution was obtained, e.g. "closed form".
    compare : {"impulse", "slack", "error", "nothing"}
        Quantity that tests compare because it is unique: "impulse" (and the slack), "slack" (if A is singular),
        "error" (if neither is unique, only the judge's residual), "nothing" (if there is no solution).
    certificate : (m,) or None
        Proof that there is no solution.
    """

    impulse: FloatArray | None
    source: str
    compare: str = "impulse"
    certificate: FloatArray | None = None


@functools.cache
def load_references() -> dict[str, dict[str, str]]:
    """Load the solutions of `references.json`, which have no closed form, by case name.

    Each has "impulse", the m decimal numbers [N s] with up to 31 digits, "sha", the hash of the problem's data, and
    "source" and "compare" as in `Reference`.
    """
    text = Path(__file__).with_name("references.json").read_text(encoding="ascii")
    return {entry["name"]: entry for entry in json.loads(text)}


@dataclass(frozen=True, eq=False)
class Case:
    """One problem of the suite.

    Parameters
    ----------
    name : str
        A name such as "pyramid(k=10, mass_ratio=1e6)"; `case(name)` builds the case again.
    problem : Problem
    reason : str
        The property that the case tests, in one line.
    family : str
        Name of the function that builds the case.
    parameters : mapping
        Parameters of that function.
    solve_reference : callable, optional
        Computes the reference if it has a closed form.
    """

    name: str
    problem: Problem
    reason: str
    family: str
    parameters: Mapping[str, Any]
    solve_reference: Callable[[], Reference] | None = field(default=None, repr=False)

    @cached_property
    def reference(self) -> Reference | None:
        """Known solution, or None if only the judge can assess an answer."""
        if self.solve_reference is not None:
            return self.solve_reference()
        stored = load_references().get(self.name)
        if stored is None:
            return None
        impulse = np.array([float(digits) for digits in stored["impulse"].split()])
        return Reference(impulse, stored["source"], stored["compare"])

    def __str__(self) -> str:
        return f"{self.name}: {self.reason}"

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and unpickle a case by building it again."""
        from lavender.suite import case

        return case, (self.name,)


@dataclass(frozen=True, eq=False)
class Draft:
    """Return value of a family function; the decorator `register_family` adds name and parameters."""

    problem: Problem
    reason: str
    reference: Callable[[], Reference] | None = None


@dataclass(frozen=True)
class Family:
    """A family function under one of its names."""

    name: str
    make: Callable[..., Case]  # Builds the case of all parameters.
    signature: inspect.Signature  # Signature of the family function.
    preset: Mapping[str, Any]  # Parameters that the name fixes, e.g. friction="coulomb".
    summary: str  # First line of the function's docstring.


FAMILIES: dict[str, Family] = {}


def register_family(
    **aliases: Mapping[str, Any],
) -> Callable[[Callable[P, Draft]], Callable[P, Case]]:
    """Register a function under its name, and under aliases with some parameters fixed."""

    def decorate(function: Callable[P, Draft]) -> Callable[P, Case]:
        """Wrap the function so that it returns a `Case`, and register it."""
        name = function.__name__
        signature = inspect.signature(function, eval_str=True)
        summary = (function.__doc__ or "").partition("\n")[0]

        @functools.wraps(function)
        def make(*args: P.args, **kwargs: P.kwargs) -> Case:
            bound = signature.bind(*args, **kwargs)
            explicit = frozenset(bound.arguments)
            bound.apply_defaults()
            known = signature.parameters
            given_values = bound.arguments.items()
            values = {n: _convert_parameter(name, known[n], v) for n, v in given_values}
            text = _format_case_name(name, values, explicit)
            try:
                draft = function(**values)  # type: ignore[call-arg]
            except MemoryError:
                raise InputError(
                    f"{text}: there is not enough memory; give smaller parameters"
                ) from None
            return Case(
                name=text,
                problem=replace(draft.problem, name=text, copy=False),
                reason=draft.reason,
                family=name,
                parameters=MappingProxyType(values),
                solve_reference=draft.reference,
            )

        for alias, preset in {name: {}, **aliases}.items():
            FAMILIES[alias] = Family(
                alias, make, signature, MappingProxyType(dict(preset)), summary
            )
        return make

    return decorate


def _convert_parameter(name: str, parameter: inspect.Parameter, value: Any) -> Any:
    """Convert a value to the type that the signature declares, or raise InputError."""
    expected_type = parameter.annotation
    prefix = f"{name}: {parameter.name} is {value!r}"
    if expected_type is str:
        if not isinstance(value, str):
            raise InputError(f"{prefix}; a word is needed, such as kind=zero")
        return value
    converted = check_float(f"{name}: {parameter.name}", value)
    if expected_type is int:
        if converted != int(converted) or not 0 <= converted <= MAX_SIZE:
            raise InputError(f"{prefix}; a whole number from 0 to {MAX_SIZE} is needed")
        return int(converted)
    return converted


def _format_case_name(name: str, values: Mapping[str, Any], explicit: frozenset[str]) -> str:
    """Return the canonical name of a case; it has the parameters that are `explicit` or differ from their defaults."""
    best = name
    preset = FAMILIES[name].preset
    for alias in FAMILIES.values():
        fixed = alias.preset
        if (
            alias.make.__name__ == name
            and fixed
            and all(values.get(n) == v for n, v in fixed.items())
        ):
            best = alias.name
            preset = fixed
    parameters = FAMILIES[name].signature.parameters
    own = {n: v for n, v in values.items() if n in explicit or v != parameters[n].default}
    shown = [f"{n}={format_parameter_value(v)}" for n, v in own.items() if n not in preset]
    return f"{best}({', '.join(shown)})" if shown else best


def format_parameter_value(value: Any) -> str:
    """Return the shortest text of a value that is read back as the same number, for a case name."""
    if not isinstance(value, float):
        return str(value)
    mantissa, _, exponent = f"{value:.16e}".partition("e")
    spellings = [
        repr(value),
        f"{value:.17g}",
        f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}",
    ]
    mantissa, _, exponent = repr(value).partition("e")
    if exponent:
        spellings.append(f"{mantissa}e{int(exponent)}")
    return min((s for s in spellings if float(s) == value), key=len)


def parse_case_name(text: str) -> tuple[str, dict[str, Any]]:
    """Split "pyramid(k=10, mass_ratio=1e6)" into name and parameters; strings need no quotes.

    Raises
    ------
    InputError
        The text is not a name with parameters in brackets.
    """
    match = CASE_NAME.fullmatch(text) if isinstance(text, str) else None
    body = (match[2] or "").strip().removesuffix(",") if match else ""
    parameters = [part.partition("=") for part in body.split(",")] if body else []
    values = {name.strip(): _parse_value(value.strip()) for name, _, value in parameters}
    if match is None or len(values) < len(parameters) or "" in values or None in values.values():
        raise InputError(
            f"{text!r} is not a case, such as toy_stack or pyramid(k=10, mass_ratio=1e6)"
        )
    return match[1], values


def _parse_value(text: str) -> int | float | str | None:
    """Return the number or the word of a parameter; None for another text."""
    for convert in (int, float):
        try:
            return convert(text)
        except ValueError:
            pass
    word = text.strip("'\"")
    return word if word.isidentifier() else None
