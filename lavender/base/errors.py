"""Exceptions of lavender. Each message contains the invalid value, the requirement and a remedy."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from importlib.util import find_spec
from typing import Any

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
    "format_error",
    "require_packages",
]


class LavenderError(Exception):
    """Base class of all exceptions of lavender."""


class InputError(LavenderError, ValueError):
    """An argument, array or file is invalid."""


class TooLarge(InputError):
    """A matrix has more entries than 32-bit indices allow; raised when the matrix is first needed."""


class UnknownName(LavenderError, KeyError):
    """A solver, option, order, scene or case does not exist; the message suggests similar names.

    Parameters
    ----------
    kind : str
        Kind of the name, such as "solver" or "option of admm".
    name : object
        The unknown name.
    known : iterable of str
        Valid names.
    """

    def __init__(self, kind: str, name: object, known: Iterable[str]) -> None:
        import difflib  # Imported here, as it is needed only for error messages.

        known = sorted(set(known))
        by_lower_case = {word.lower(): word for word in reversed(known)}
        lower_case = str(name).lower()
        matches = difflib.get_close_matches(lower_case, by_lower_case, n=3, cutoff=0.6)
        # Initials come first: "si" is sequential_impulses, although "sip" is closer by letters.
        initials = [
            word
            for word in by_lower_case
            if "_" in word and "".join(part[:1] for part in word.split("_")) == lower_case
        ]
        matches = [lower_case] if lower_case in by_lower_case else [*initials, *matches]
        similar = [by_lower_case[match] for match in matches]
        hint = f"known: {', '.join(known) or 'none'}"
        if similar and isinstance(name, str):
            hint = f"did you mean {' or '.join(map(repr, similar))}?"
        noun, of, owner = kind.partition(" of ")
        self.message = f"unknown {noun} {name!r}{of}{owner}; {hint}"
        super().__init__(self.message)

    def __str__(self) -> str:
        # Without this method, KeyError would show the repr of the message.
        return self.message

    def __reduce__(self) -> tuple[Any, ...]:
        # The default unpickles an exception by calling its class with `args`, but `__init__` has other parameters.
        return UnknownName.__new__, (UnknownName, self.message), vars(self)


#: Packages of the extra `report`.
REPORT_PACKAGES = ("jinja2", "joblib", "markupsafe", "pandas")


def check_name(kind: str, name: object, known: Collection[str]) -> str:
    """Return `name`; raise UnknownName unless it is one of the known names."""
    if not isinstance(name, str) or name not in known:
        raise UnknownName(kind, name, known)
    return name


class SolverUnavailable(LavenderError):
    """The package of a known solver is not installed."""


class CapabilityError(LavenderError):
    """A solver or format does not support this problem or option; the message names alternatives."""


class InUse(LavenderError, RuntimeError):
    """An object that serves one thread at a time is used by another thread, or by the caller of this callback."""


# Exceptions that a solve of a valid problem can raise: arithmetic breaks down, memory is missing, or A, which is
# formed at its first use, is too large. The solve then returns a result with the exception as its message.
BREAKDOWN = (ArithmeticError, np.linalg.LinAlgError, MemoryError, TooLarge)


def format_error(error: BaseException) -> str:
    """Return the class and message of an exception on one line."""
    return " ".join(f"{type(error).__name__}: {error}".removesuffix(": ").split())


class SolveFailed(LavenderError):
    """The judge does not accept a result; raised only by `Solution.raise_for_status`."""


def require_packages(user: str, *names: str) -> None:
    """Raise InputError if a package that `user` needs is not installed; `user` is the subject of the message.

    Packages of REPORT_PACKAGES belong to the extra `report`. The others are dependencies of lavender, which are missing
    only after an installation without dependencies.
    """
    missing = [name for name in names if find_spec(name) is None]
    if missing:
        if set(missing) <= set(REPORT_PACKAGES):
            remedy = (
                "pip install 'lavender-contact[report]', or in a clone pip install -e '.[report]'"
            )
        else:
            remedy = (
                f"pip install {' '.join(missing)}; an installation of lavender without --no-deps "
                "brings the packages of its core, the extra `report` the others"
            )
        raise InputError(f"{user} needs {', '.join(missing)}: {remedy}")
