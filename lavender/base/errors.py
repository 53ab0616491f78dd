"""What lavender raises. Every message says what came, what was needed, and what to do."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from functools import wraps
from typing import Any, TypeVar

import numpy as np

__all__ = [
    "BREAKDOWN",
    "CapabilityError",
    "InUse",
    "InputError",
    "LavenderError",
    "SolveFailed",
    "SolverUnavailable",
    "TooLarge",
    "UnknownName",
    "check_name",
    "last_words",
    "reject_former_names",
]


class LavenderError(Exception):
    """Base of everything lavender raises on purpose."""


class InputError(LavenderError, ValueError):
    """An argument, array or file that lavender cannot take."""


class TooLarge(InputError):
    """A matrix of more entries than indices reach; whoever needs it finds out when it is formed."""


class UnknownName(LavenderError, KeyError):
    """A solver, option, order, scene or case that does not exist; the message names the nearest.

    Parameters
    ----------
    kind : word for the thing, such as "option of solver 'pgs'"
    name : the unknown name
    known : names that exist
    successor : the present name, if `name` is a former one; the message suggests it
    """

    def __init__(self, kind: str, name: object, known: Iterable[str], successor: str = "") -> None:
        import difflib  # needed only where something went wrong

        known = sorted(set(known))
        plain = {word.lower(): word for word in reversed(known)}
        near = [plain[w] for w in difflib.get_close_matches(str(name).lower(), plain, n=3, cutoff=0.5)]
        near = [successor] if successor else near
        hint = (
            f"did you mean {' or '.join(map(repr, near))}?"
            if near
            else f"known: {', '.join(known) or 'none'}"
        )
        what, of, owner = kind.partition(" of ")
        self.message = f"unknown {what} {name!r}{of}{owner}; {hint}"
        super().__init__(self.message)

    def __str__(self) -> str:
        # KeyError would show the repr of the message.
        return self.message

    def __reduce__(self) -> tuple[Any, ...]:
        # Between processes exceptions travel by their arguments; those of __init__ are others.
        return _restored, (self.message,)


def check_name(kind: str, name: object, known: Collection[str]) -> str:
    """Return a name of those that are known; raise UnknownName for every other value."""
    if not isinstance(name, str) or name not in known:
        raise UnknownName(kind, name, known)
    return name


_Callable = TypeVar("_Callable", bound=Callable[..., Any])


def reject_former_names(**successors: str) -> Callable[[_Callable], _Callable]:
    """Decorate a function or class with renamed keyword arguments: a former name raises `UnknownName`.

    Parameters
    ----------
    **successors : present name by former name
    """

    def decorate(function: Any) -> Any:
        is_class = isinstance(function, type)
        inner = function.__init__ if is_class else function

        @wraps(inner)
        def call(*args: Any, **arguments: Any) -> Any:
            for name in successors.keys() & arguments.keys():
                kind = f"argument of {function.__name__}"
                raise UnknownName(kind, name, (), successor=successors[name])
            return inner(*args, **arguments)

        if not is_class:
            return call
        function.__init__ = call
        return function

    return decorate


def _restored(message: str) -> UnknownName:
    error = UnknownName.__new__(UnknownName, message)
    error.message = message
    return error


class SolverUnavailable(LavenderError):
    """A known solver whose package is not installed here."""


class CapabilityError(LavenderError):
    """A solver or format that cannot take this problem or option; the message says which can."""


class InUse(LavenderError, RuntimeError):
    """An object that serves one thread at a time is at work for another one, or for the caller of this callback."""


# What may end a run of numbers that are valid, and makes a result with the error as its message: arithmetic that breaks
# down, memory that is not there, an A that is too large and was not needed before.
BREAKDOWN = (ArithmeticError, np.linalg.LinAlgError, MemoryError, TooLarge)


def last_words(error: BaseException) -> str:
    """Its class and what it says, on one line."""
    return " ".join(f"{type(error).__name__}: {error}".removesuffix(": ").split())


class SolveFailed(LavenderError):
    """Raised only by `Solution.raise_for_status`."""
