"""One check for arrays: dtype, shape, size of numbers, privacy. Kernels behind it check nothing.

What numbers may be is said in `lavender_ext/core/door.pxd`: at most 1e60 in size, and masses and their like 0 or at
least 1e-60. The same problem in other units has the same answer, so the message names a unit to change.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from lavender.base.errors import InputError
from lavender.base.lazy_import import issparse
from lavender.base.lazy_import import sparse as sp
from lavender_ext.core import checks
from lavender_ext.core.checks import LEAST, MOST
from lavender_ext.judge.measure import all_finite

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int32]
ArrayLike = npt.ArrayLike  #: numbers, nested sequences of them, or an array; the docstring has shape and unit


FLOAT64, FLOAT32, INT32 = np.dtype(np.float64), np.dtype(np.float32), np.dtype(np.int32)
FLOATS = {FLOAT32, FLOAT64}  # dtypes that batches read in place


def _fits(given: tuple[int, ...], wanted: tuple[int | None, ...]) -> bool:
    if len(given) != len(wanted):
        return False
    for n, s in zip(wanted, given, strict=True):  # noqa: SIM110 - a generator takes as long as the rest of the check
        if n is not None and n != s:
            return False
    return True


def read_only(array: np.ndarray) -> np.ndarray:
    """The array itself, which nobody may write to from here on."""
    array.setflags(write=False)
    return array


def as_array(
    name: str,
    value: Any,
    shape: tuple[int | None, ...],
    *,
    dtype: type = np.float64,
    finite: bool = True,
    copy: bool = True,
    unit: str = "",
) -> np.ndarray:
    """`value` as a private read-only C-contiguous array of the given shape (None: any length).

    A scalar fills a one-dimensional shape of known length; an empty list is no rows of any length. With `copy=False`
    an array that already fits is adopted and marked read-only.

    Raises
    ------
    InputError
        Not numeric, complex, of another shape, with masked entries, or with `finite` a number that is NaN, infinite or
        beyond MOST.
    """
    # What most callers give: nothing to convert, and no word to be made.
    if dtype is np.float64:
        made = checks.plain(value, shape, finite, copy)
        if made is not None:
            return made
        fits = type(value) is float and (abs(value) <= MOST or not finite)
        if fits and len(shape) == 1 and shape[0] is not None:
            plain = np.empty(shape[0])
            plain.fill(value)
            return read_only(plain)
    elif type(value) is np.ndarray and value.dtype is INT32 and _fits(value.shape, shape):
        return read_only(value.copy() if copy or not value.flags.c_contiguous else value)
    what = f"{name} [{unit}]" if unit and unit != "-" else name
    try:
        given = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} is not an array of numbers ({error})") from None
    if given.dtype.kind not in "buif":
        raise InputError(f"{what} has dtype {given.dtype}; real numbers are needed")
    check_unmasked(what, value)
    if (
        dtype is np.int32
        and given.dtype.kind == "f"
        and given.size
        and not np.array_equal(given, np.rint(given))
    ):
        raise InputError(f"{what} must hold whole numbers")
    if given.ndim == 0 and len(shape) == 1 and shape[0] is not None:
        given = np.full(shape[0], given)
        copy = False
    rest = shape[1:]
    if given.shape == (0,) and rest and not shape[0] and None not in rest:
        given = given.reshape(0, *rest)  # an empty list, of rows as of numbers
    if not _fits(given.shape, shape):
        sizes = ", ".join("any" if n is None else str(n) for n in shape)
        wanted = f"({sizes}{',' * (len(shape) == 1)})"
        raise InputError(f"{what} has shape {given.shape}; {wanted} is needed")
    if dtype is np.int32 and given.size and (float(given.min()) < -(2**31) or float(given.max()) >= 2**31):
        raise InputError(f"{what} holds numbers beyond 32 bits")
    if given.dtype.itemsize > 8:
        given = _narrowed(given)
    array: np.ndarray = (
        np.array(given, dtype, order="C") if copy else np.require(given, dtype, ["C", "A", "E"])
    )
    if finite and array.dtype.kind == "f":
        check_inside(what, array, unit)
    return read_only(array)


def as_floats(name: str, value: Any) -> np.ndarray:
    """`value` as an array of float32 or float64 of any shape, in place if it is one of them; numbers are not checked.

    Raises
    ------
    InputError
        As `as_array`: not numeric, complex, masked entries, or nested sequences of several lengths.
    """
    shape_of(name, value)
    check_unmasked(name, value)
    given = np.asarray(value)
    if given.dtype in FLOATS:
        return given
    native = given.dtype.newbyteorder("=")
    return (
        given.astype(native)
        if native in FLOATS
        else as_array(name, given, (None,) * given.ndim, finite=False)
    )


def check_unmasked(what: str, value: Any) -> None:
    """Raise InputError at the first masked entry of `what`: as a plain array it has the number under the mask."""
    if hasattr(value, "mask") and np.ma.is_masked(value):  # NumPy loads its module when it is first named
        masked = np.argwhere(np.ma.getmaskarray(value))
        where = ", ".join(map(str, masked[0]))
        raise InputError(f"{what} has no value at [{where}], {len(masked)} masked in all: fill them")


def shape_of(what: str, value: Any) -> tuple[int, ...]:
    """The shape of what may be an array of numbers, or InputError for nested sequences of several lengths."""
    try:
        return np.shape(value)
    except ValueError as error:
        raise InputError(f"{what} is not an array of numbers ({error})") from None


def places(i: Any, n: int, thing: str = "world") -> int | list[int]:
    """What an index names of n worlds: a whole number one of them; a slice, a mask (n,) or whole numbers a list."""
    if isinstance(i, slice):
        return list(range(*i.indices(n)))
    what = f"an index of {thing}s"
    is_array = isinstance(i, np.ndarray) and i.ndim == 0 and i.dtype.kind in "iu"
    if is_array or (isinstance(i, (int, np.integer)) and not isinstance(i, (bool, np.timedelta64))):
        if not -n <= i < n:
            raise IndexError(f"{thing} {i}; there are {n}")
        return range(n)[i]
    check_unmasked(what, i)
    given = several(what, i, "whole numbers, or a mask,")
    shape = shape_of(what, given)
    at = np.array(given)
    if len(shape) != 1 or (at.dtype.kind not in "biu" and at.size):
        raise InputError(f"{what} is {i!r:.60}; whole numbers, or a mask, are needed")
    chosen: list[int] = np.arange(n)[at if at.size else []].tolist()
    return chosen


def number(
    what: str, value: object, *, low: float = -np.inf, high: float = np.inf, above: float | None = None
) -> float:
    """`value` as a finite float in [low, high], or above `above`."""
    if isinstance(value, (bool, np.timedelta64)) or not isinstance(
        value, (int, float, np.integer, np.floating)
    ):
        raise InputError(f"{what} is {value!r}; a number is needed")
    try:
        x = float(value)
    except OverflowError:  # a whole number of more digits than a float has
        x = np.inf if value > 0 else -np.inf
    if not np.isfinite(x):
        raise InputError(f"{what} is {x}; a finite number is needed")
    if abs(x) > MOST:
        raise InputError(f"{what} is {x:g}; at most {MOST:g} is needed: change a unit")
    if above is not None and not x > above:
        raise InputError(f"{what} is {x:g}; more than {above:g} is needed")
    if x < low or x > high:
        wanted = f"at least {low:g}" if high == np.inf else f"{low:g} to {high:g}"
        raise InputError(f"{what} is {x:g}; {wanted} is needed")
    return x


def whole_number(what: str, value: object, low: int = 0, high: int | None = 2**31 - 1) -> int:
    """`value` as an int in [low, high], of any size with None."""
    if (
        isinstance(value, (bool, np.timedelta64))
        or not isinstance(value, (int, np.integer))
        or value < low
        or (high is not None and value > high)
    ):
        upto = "" if high is None else f" to {high}"
        raise InputError(f"{what} is {value!r}; a whole number from {low}{upto} is needed")
    return int(value)


def flag(what: str, value: object) -> bool:
    """`value` as True or False, and nothing else."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{what} is {value!r}; True or False is needed")
    return bool(value)


def as_csr(name: str, given: Any, *, copy: bool = True, unit: str = "", too_many: str = "") -> sp.csr_array:
    """A sparse matrix as compressed rows of float64 and int32, columns in order, finite, read-only: checked whole."""
    if given.nnz >= 2**31:
        raise InputError(f"{name} has {given.nnz} nonzeros, more than 32-bit indices reach{too_many}")
    if given.dtype.kind not in "buif":
        raise InputError(f"{name} has dtype {given.dtype}; real numbers are needed")
    try:
        a = sp.csr_array(given, copy=copy)
        a.check_format(full_check=True)  # kernels trust every index
    except ValueError as error:
        raise InputError(
            f"{name} is not a valid compressed matrix ({error}); check its indices and pointers"
        ) from None
    if not a.has_canonical_format:
        a = a if copy else a.copy()
        a.sum_duplicates()
    data = as_array(name, a.data, (None,), finite=False, copy=False)
    check_inside(name, data, unit, a)
    parts = ((a.data, np.float64), (a.indices, np.int32), (a.indptr, np.int32))
    return sp.csr_array(tuple(read_only(np.ascontiguousarray(x, kind)) for x, kind in parts), shape=a.shape)


def precision_of(*given: Any) -> str:
    """The word float32 where all of these are arrays of it, dense or sparse, or None, not all None; else float64."""
    types = {getattr(x, "dtype", None) for x in given if x is not None}
    if types == {FLOAT32} or FLOAT64 in types:
        return "float64" if FLOAT64 in types else "float32"
    # Float32 in the byte order of another machine is another dtype, and no other precision.
    is_single = bool(types) and all(isinstance(x, np.dtype) and x.newbyteorder("=") == FLOAT32 for x in types)
    return "float32" if is_single else "float64"


def borrowed(name: str, value: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    """`value` as `as_array` would adopt it, to be read at once and not kept: the array given stays writable."""
    return as_array(name, value.view() if type(value) is np.ndarray else value, shape, copy=False)


def _narrowed(wide: np.ndarray) -> np.ndarray:
    # Long double as float64, rounded; what does not fit becomes infinite without a warning, and is told by its place.
    with np.errstate(over="ignore", under="ignore"):
        return wide.astype(np.float64)


def check_finite(what: str, array: np.ndarray, csr: Any = None) -> None:
    """Raise InputError at the first NaN or infinity of `what`, the data of `csr` where that is given."""
    if not all_finite(array.reshape(-1)):
        bad = np.argwhere(~np.isfinite(array))
        raise InputError(
            f"{what} must be finite; entry [{_place(bad[0], csr)}] is {array[tuple(bad[0])]}, {len(bad)} in all"
        )


def _place(index: np.ndarray, csr: Any) -> str:
    """An index, or the row and column of what has it in the data of compressed rows."""
    if csr is not None:
        row = np.searchsorted(csr.indptr, index[0], side="right") - 1
        index = np.array([row, csr.indices[index[0]]])
    return ", ".join(map(str, index))


def check_inside(what: str, array: np.ndarray, unit: str = "", csr: Any = None) -> None:
    """Raise InputError at the first number of `what` that is not finite, or beyond MOST in size."""
    if checks.inside(array.reshape(-1)):
        return
    check_finite(what, array, csr)
    bad = np.argwhere(np.abs(array) > MOST)
    raise InputError(
        f"{what} must be at most {MOST:g} in size; entry [{_place(bad[0], csr)}] is {array[tuple(bad[0])]:g}, "
        f"{len(bad)} in all: {_advice(unit)}"
    )


def check_sizes(what: str, array: np.ndarray, unit: str = "") -> None:
    """Raise InputError at the first number of `what` that is negative, or neither 0 nor from LEAST to MOST."""
    flat = array.reshape(-1)
    at = checks.unsized(flat)
    if at < 0:
        return
    check_inside(what, array, unit)
    check_not_negative(what, flat)
    where = ", ".join(map(str, np.unravel_index(at, array.shape)))
    raise InputError(
        f"{what} must be 0 or at least {LEAST:g}; entry [{where}] is {flat[at]:g}: {_advice(unit)}"
    )


def _advice(unit: str) -> str:
    """Which units to change, of a quantity that has this one."""
    if unit == "-":
        return "it has no unit that could be another"
    letters = set(unit.replace("rad", "").replace("N s", "kg m/s"))
    units = [name for letter, name in (("k", "mass"), ("m", "length"), ("s", "time")) if letter in letters]
    return f"another unit of {' or '.join(units or ['mass, length', 'time'])} brings it nearer to 1"


def check_not_nan(what: str, array: np.ndarray) -> None:
    """Raise InputError at the first NaN of `what`."""
    bad = np.flatnonzero(np.isnan(array))
    if len(bad):
        raise InputError(f"{what} must not be NaN; entry [{bad[0]}] is, {len(bad)} in all")


def check_not_negative(what: str, array: np.ndarray) -> None:
    """Raise InputError at the first negative entry of `what`."""
    plain = array.ndim == 1 and array.dtype is FLOAT64 and array.flags.c_contiguous
    if checks.has_negative(array) if plain else array.size and array.min() < 0:
        i = int(np.argmin(array))
        raise InputError(f"{what} must not be negative; entry [{i}] is {array[i]}")


def several(what: str, given: Any, things: str) -> list[Any]:
    """A list of what is given, or InputError for a text and what is none."""
    is_sequence = (
        isinstance(given, Iterable) and getattr(given, "ndim", 1) != 0 and not isinstance(given, type)
    )
    if isinstance(given, (str, bytes)) or not is_sequence or issparse(given):
        raise InputError(f"{what}: {given!r:.60}; a sequence of {things} is needed")
    return list(given)


def one_of(name: str, given: Any, known: Sequence[str]) -> str:
    """A word of those that are known.

    Raises
    ------
    InputError
        Another word, or no word.
    """
    if not isinstance(given, str) or given not in known:
        raise InputError(f"{name} is {given!r}; {' or '.join(map(repr, known))} is needed")
    return str(given)  # NumPy's strings say in messages that they are NumPy's


def words_for(what: str, given: Any, count: int) -> tuple[str, ...]:
    """A word for each of `count` things that `what` names."""
    words = tuple(map(str, several(f"names of {what}", given, f"{count} words")))
    if len(words) != count:
        raise InputError(f"{len(words)} names for {count} {what}; one for each is needed")
    return words


def equal(x: object, y: object) -> bool:
    """Equality of fields: arrays bit for bit in value and shape, None with None."""
    if x is None or y is None:
        return x is y
    if isinstance(x, np.ndarray) or isinstance(y, np.ndarray):
        return np.array_equal(x, y)  # type: ignore[arg-type]
    return bool(x == y)


def table_of(facts: Mapping[str, Any], title: str) -> str:
    """Facts as a small HTML table, for notebooks; every text escaped."""
    from html import escape

    rows = "".join(f"<tr><th>{escape(str(k))}</th><td>{escape(str(v))}</td></tr>" for k, v in facts.items())
    return f"<table><caption>{escape(title)}</caption>{rows}</table>"
