"""Modules that are loaded when something of them is first used.

Parts of SciPy would be half of `import lavender`.

`from lavender.base.later import sparse as sp` stands where one would write `import scipy.sparse as sp`. What is likely
to be used while the clock of a solve runs is loaded before, by `load`.
"""

from __future__ import annotations

import os
from importlib import import_module
from threading import RLock
from typing import TYPE_CHECKING, Any

__all__ = ["above", "imported", "issparse", "lapack", "load", "loading", "sparse", "spatial"]

_lock = RLock()


def loading() -> RLock:
    """The lock under which one thread at a time imports modules and fills tables from them."""
    return _lock


def imported(name: str) -> Any:
    """A module, imported now if it was not before.

    Python locks each module by itself, a file before its package: of two threads that enter a package by different
    files, one would get half a module.
    """
    with loading():
        return import_module(name)


def _forked() -> None:
    global _lock
    _lock = RLock()  # no thread is left in a fork's child to give the other one back


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_forked)


class _Later:
    """A module, imported at its first attribute."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        if name == "_name" or name.startswith("__"):  # of a copy that is being made
            raise AttributeError(name)
        value = getattr(imported(self._name), name)
        setattr(self, name, value)
        return value

    def __reduce__(self) -> tuple[Any, ...]:
        return _Later, (self._name,)


if TYPE_CHECKING:
    from scipy import sparse, spatial
    from scipy.linalg import lapack
else:
    sparse, spatial, lapack = map(_Later, ("scipy.sparse", "scipy.spatial", "scipy.linalg.lapack"))


def above(name: str) -> Any:
    """A module of a floor above, by which a method of this one is a short way to a function there."""
    return _Later(name)


def load(*more: str) -> None:
    """Load sparse arrays and their graphs (orders of factors), LAPACK and further modules, if they are not."""
    for name in ("scipy.sparse", "scipy.sparse.csgraph", "scipy.linalg.lapack", *more):
        imported(name)


def issparse(value: object) -> bool:
    """Whether `value` is a sparse array or matrix of SciPy; what cannot be one loads nothing."""
    return hasattr(type(value), "tocsr") and bool(sparse.issparse(value))
