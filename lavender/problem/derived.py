"""Values computed once, also by several threads: `Derived`, `cached_property`, `computed_once`, `late_field`."""

from __future__ import annotations

import os
from collections.abc import Callable
from threading import RLock
from typing import TYPE_CHECKING, Any, Generic, TypeVar, overload

if TYPE_CHECKING:
    from lavender_ext.core.problem import Data

T = TypeVar("T")


class Derived:
    """Values that are computed from a problem's data and cached; copies of a problem do not share them.

    Every entry is set by one assignment of a complete value, so another thread reads a complete value or None. Two
    threads that read None compute identical bits.

    Attributes
    ----------
    view : Data or None
        Arrays that kernels read in generalised coordinates; set when the problem is created.
    cache : dict
        Values of other modules; each key begins with the name of its module. The key of the lock, which is held while
        a `computed_once` property is computed, is `_process`.
    """

    __slots__ = ("cache", "view")

    def __init__(self, view: Data | None = None) -> None:
        self.view = view
        self.cache: dict[Any, Any] = {}


# Identity of this process. A forked process gets a new object and then new locks, because threads that hold the old
# locks do not exist in it. The number of the process would need a system call at each property.
_process = object()


def _replace_process_after_fork() -> None:
    global _process
    _process = object()


if hasattr(os, "register_at_fork"):  # Windows has no fork.
    os.register_at_fork(after_in_child=_replace_process_after_fork)


class cached_property(Generic[T]):
    """A property that is computed at its first use and then stored as an attribute of the object.

    With `is_locked`, one thread computes it while others wait for the lock in `derived` of the object; otherwise two
    threads may compute it at the same time, with identical bits. `functools.cached_property` is not used: before
    Python 3.12 it holds one lock for all objects, so that threads wait for properties of other problems, and a process
    that is forked at that moment waits forever.
    """

    def __init__(
        self, function: Callable[[Any], T], name: str = "", is_locked: bool = False
    ) -> None:
        self.function = function
        self.name = name or function.__name__
        self.is_locked = is_locked
        self.__doc__ = function.__doc__

    @overload
    def __get__(self, instance: None, owner: type) -> cached_property[T]: ...

    @overload
    def __get__(self, instance: object, owner: type) -> T: ...

    def __get__(self, instance: Any, owner: type) -> Any:
        """Compute the property, unless another thread has done so."""
        if instance is None:
            return self
        attributes = instance.__dict__
        if not self.is_locked:
            return attributes.setdefault(self.name, self.function(instance))
        cache = instance.derived.cache
        with cache.get(_process) or cache.setdefault(_process, RLock()):
            if self.name not in attributes:
                attributes[self.name] = self.function(instance)
            return attributes[self.name]


def computed_once(function: Callable[[Any], T]) -> cached_property[T]:
    """Decorate a property that one thread computes while others wait."""
    return cached_property(function, is_locked=True)


def late_field(name: str) -> cached_property[Any]:
    """Return a property for a field of a dataclass that is computed, if it was not set, when it is first read.

    The attribute `_rest` of the object is a function and its arguments; the function returns the late fields by name.
    `_late_<name>` is a function and its arguments that compute one field without the others.
    """
    own_name = f"_late_{name}"

    def compute(instance: Any) -> Any:
        attributes = instance.__dict__
        if (own := attributes.get(own_name)) is not None:
            return own[0](*own[1])
        rest = attributes.get("_rest")
        if rest is not None:
            function, arguments = rest
            for field, value in function(*arguments).items():
                attributes.setdefault(field, value)  # Another thread may have set an equal value.
            attributes.pop("_rest", None)
        if name not in attributes:
            raise AttributeError(f"{type(instance).__name__!r} object has no attribute {name!r}")
        return attributes[name]

    return cached_property(compute, name)
