"""Import modules at their first use, in any thread.

`from lavender.base.lazy_import import sparse as sp` replaces `import scipy.sparse as sp`: these parts of SciPy would
double the time of `import lavender`. `import_numerical_modules` imports them before the clock of a solve starts.

The package `lazy_loader` (SPEC 1) is not used because it is not thread-safe. When four threads used three lazy modules
of SciPy at once, 8 of 12 processes on Python 3.11 raised AttributeError, and its function `attach` deadlocked in 1 of
12.
"""

from __future__ import annotations

import os
from importlib import import_module
from threading import RLock
from typing import TYPE_CHECKING, Any

from lavender.base.errors import REPORT_PACKAGES, require_packages

_locks: dict[int, RLock] = {}  # By process.
_imported = set[str]()  # Names that `import_numerical_modules` has imported completely.


def import_lock() -> RLock:
    """Return the lock under which one thread at a time imports modules and fills tables from them.

    A forked process has a lock of its own, because the thread that may hold the old one does not exist there.
    """
    return _locks.get(os.getpid()) or _locks.setdefault(os.getpid(), RLock())


def import_module_under_lock(name: str) -> Any:
    """Import a module, under the lock, and return it.

    Python's own import system locks each module separately. If two threads import different modules of one package at
    once, one thread may therefore get an incomplete module.
    """
    with import_lock():
        return import_module(name)


class _LazyModule:
    """A module that is imported when its first attribute is read."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        if name == "_name" or name.startswith(
            "__"
        ):  # `copy` reads these names of an uninitialised object.
            raise AttributeError(name)
        if self._name in REPORT_PACKAGES:
            require_packages("a table or page", self._name)
        value = getattr(import_module_under_lock(self._name), name)
        setattr(self, name, value)
        return value

    def __reduce__(self) -> tuple[Any, ...]:
        return _LazyModule, (self._name,)


if TYPE_CHECKING:
    import markupsafe as markupsafe
    import pandas as pandas
    from scipy import sparse as sparse
    from scipy.linalg import lapack as lapack
else:
    sparse, lapack = map(_LazyModule, ("scipy.sparse", "scipy.linalg.lapack"))
    pandas, markupsafe = map(_LazyModule, ("pandas", "markupsafe"))  # For pages and tables.


def import_module_lazily(name: str) -> Any:
    """Import and return a module of a higher layer, for a method that is a shortcut to a function there."""
    return _LazyModule(name)


def import_numerical_modules(*names: str) -> None:
    """Import SciPy's sparse arrays, their graphs and LAPACK, and the modules `names`."""
    for name in ("scipy.sparse", "scipy.sparse.csgraph", "scipy.linalg.lapack", *names):
        if name not in _imported:  # This saves 10 us of every solve that factors.
            import_module_under_lock(name)
            _imported.add(name)


def issparse(value: object) -> bool:
    """Return whether `value` is a sparse array or matrix of SciPy, without importing SciPy if it cannot be one."""
    return hasattr(type(value), "tocsr") and bool(sparse.issparse(value))
