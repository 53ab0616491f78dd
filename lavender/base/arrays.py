"""Validation of arguments: dtype, shape and range of arrays; numbers, flags and names. Kernels do not validate.

The ranges are defined in `lavender_ext/core/validate.pxd`: absolute values do not exceed 1e60, and masses, lengths and
other nonnegative quantities are 0 or at least 1e-60. A problem can be written in other units without changing its
solution, so the message about a number out of range suggests a unit to change.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from lavender.base.errors import InputError
from lavender.base.lazy_import import issparse
from lavender.base.lazy_import import sparse as sp
from lavender_ext.core import checks
from lavender_ext.core.checks import MAX_MAGNITUDE, MIN_MAGNITUDE
from lavender_ext.judge.measure import all_finite

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int32]
BoolArray = npt.NDArray[np.bool_]
#: Type of arguments: a number, nested sequences of numbers, or an array; docstrings give shape and unit.
ArrayLike = npt.ArrayLike

FLOAT64, FLOAT32, INT32 = np.dtype(np.float64), np.dtype(np.float32), np.dtype(np.int32)
FLOAT_DTYPES = {FLOAT32, FLOAT64}  # Batches read arrays of these dtypes in place.


def _matches_shape(actual: tuple[int, ...], required: tuple[int | None, ...]) -> bool:
    """Return whether a shape equals the required one, in which None allows any length."""
    if len(actual) != len(required):
        return False
    for n, s in zip(required, actual, strict=True):  # noqa: SIM110 - a generator would double the time of the check
        if n is not None and n != s:
            return False
    return True


def mark_read_only(array: np.ndarray) -> np.ndarray:
    """Mark an array read-only, and return it."""
    array.setflags(write=False)
    return array


def to_numpy(name: str, value: Any) -> np.ndarray:
    """Convert array-like data, or an array of another library, to a NumPy array.

    Arrays with `__dlpack__` (PyTorch, JAX, CuPy) or `__array__` (Warp) are views if they are in the memory of the
    processor, and are copied once if they are on another device.
    """
    if not hasattr(value, "__dlpack__") or isinstance(value, np.ndarray):
        if get_labels(value) is not None:
            raise InputError(
                f"{name} is a {type(value).__name__} whose index would be ignored: sort it, and give {name}.to_numpy()"
            )
        try:
            return np.asarray(value)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"{name} cannot be read as an array ({error}); numbers are needed"
            ) from None
    if getattr(value, "requires_grad", False):
        raise InputError(f"{name} requires a gradient, which would be lost: give {name}.detach()")
    if hasattr(
        value, "resolve_neg"
    ):  # By DLPack, PyTorch passes a view with the negative bit with the wrong sign.
        value = value.resolve_neg()
    reason: Exception | None = None
    for read in (
        np.from_dlpack,
        lambda x: np.from_dlpack(x, device="cpu", copy=True),
        lambda x: x.cpu().numpy(),
        lambda x: x.get(),
        np.asarray,
    ):
        try:
            array = read(value)
        except Exception as error:  # Every library raises other exceptions.
            reason = error
            continue
        if isinstance(array, np.ndarray) and array.dtype != object:
            return array
    kind = type(value).__name__
    device = getattr(value, "device", "unknown")
    raise InputError(
        f"{name} is a {kind} on device {device} that cannot be read ({reason}): copy it to the host"
    )


def get_labels(value: Any) -> list[Any] | None:
    """Return the labels of the rows of a pandas Series or DataFrame; None for other values, and for 0, 1, 2, ..."""
    if isinstance(value, np.ndarray) or type(value).__module__.partition(".")[0] != "pandas":
        return None
    index = getattr(value, "index", None)
    labels = [] if index is None or callable(index) else list(index)
    return None if labels == list(range(len(labels))) else labels


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
    """Convert `value` to a private read-only C-contiguous array.

    Parameters
    ----------
    name : str
        Name of the argument in messages.
    value : array_like
        A scalar is repeated if the shape is one-dimensional with a known length. An empty list is accepted for any
        shape with a first length of 0 or None.
    shape : tuple of int or None
        Required shape; None allows any length.
    dtype : {numpy.float64, numpy.int32}
    finite : bool, default True
        Whether to reject numbers that are not finite, or above MAX_MAGNITUDE in absolute value.
    copy : bool, default True
        If False, an array that already has the required dtype and layout is returned itself, marked read-only.
    unit : str, optional
        Unit in messages.

    Returns
    -------
    numpy.ndarray
    """
    # Fast path for values that need no conversion and no message.
    if dtype is np.float64:
        array = checks.as_plain_array(value, shape, finite, copy)
        if array is not None:
            return array
        is_valid = type(value) is float and (abs(value) <= MAX_MAGNITUDE or not finite)
        if is_valid and len(shape) == 1 and shape[0] is not None:
            array = np.empty(shape[0])
            array.fill(value)
            return mark_read_only(array)
    elif type(value) is np.ndarray and value.dtype is INT32 and _matches_shape(value.shape, shape):
        return mark_read_only(value.copy() if copy or not value.flags.c_contiguous else value)
    label = f"{name} [{unit}]" if unit and unit != "-" else name
    array = to_numpy(label, value)
    if array.dtype.kind not in "buif":
        raise InputError(f"{label} has dtype {array.dtype}; real numbers are needed")
    check_unmasked(label, value)
    if dtype is np.int32 and array.dtype.kind == "f" and not np.array_equal(array, np.rint(array)):
        raise InputError(
            f"{label} holds {array[array != np.rint(array)][0]:g}; whole numbers are needed"
        )
    if array.ndim == 0 and len(shape) == 1 and shape[0] is not None:
        array = np.full(shape[0], array)
        copy = False
    row_shape = shape[1:]
    if array.shape == (0,) and row_shape and not shape[0] and None not in row_shape:
        array = array.reshape(0, *row_shape)  # An empty list has shape (0,) if it lists rows, too.
    if not _matches_shape(array.shape, shape):
        sizes = ", ".join("any" if n is None else str(n) for n in shape)
        required = f"({sizes}{',' * (len(shape) == 1)})"
        raise InputError(f"{label} has shape {array.shape}; {required} is needed")
    if (
        dtype is np.int32
        and array.size
        and (float(array.min()) < -(2**31) or float(array.max()) >= 2**31)
    ):
        raise InputError(
            f"{label} holds {array.min():g} to {array.max():g}; -2^31 to 2^31 - 1 is needed"
        )
    if array.dtype.itemsize > 8:
        with np.errstate(over="ignore", under="ignore"):
            array = array.astype(
                np.float64
            )  # Long doubles out of range become infinite without a warning.
    array = np.array(array, dtype, order="C") if copy else np.require(array, dtype, ["C", "A", "E"])
    if finite and array.dtype.kind == "f":
        check_finite_and_in_range(label, array, unit)
    return mark_read_only(array)


def as_float_array(name: str, value: Any) -> np.ndarray:
    """Convert `value` to an array of float32 or float64 of any shape; such an array is returned without a copy.

    The numbers are not checked.
    """
    if type(value) is np.ndarray and (value.dtype is FLOAT64 or value.dtype is FLOAT32):
        return value
    get_shape(name, value)
    check_unmasked(name, value)
    array = to_numpy(name, value)
    native = array.dtype.newbyteorder("=")
    if native in FLOAT_DTYPES:
        return array.astype(native, copy=False)
    return as_array(name, array, (None,) * array.ndim, finite=False)


def check_unmasked(name: str, value: Any) -> None:
    """Raise InputError at the first masked entry of a masked array.

    A conversion to a plain array would use the number under the mask.
    """
    # Test the attribute first, because NumPy imports `np.ma` only at its first use.
    if hasattr(value, "mask") and np.ma.is_masked(value):
        masked = np.argwhere(np.ma.getmaskarray(value))
        index = ", ".join(map(str, masked[0]))
        raise InputError(
            f"{name} is masked at [{index}]; an array without masked entries is needed"
        )


def get_shape(name: str, value: Any) -> tuple[int, ...]:
    """Return the shape of array-like data; raise InputError for nested sequences of different lengths."""
    try:
        return np.shape(value)
    except ValueError as error:
        raise InputError(
            f"{name} cannot be read as an array ({error}); numbers are needed"
        ) from None


def resolve_index(i: Any, n: int, thing: str = "world") -> int | list[int]:
    """Resolve an index of a sequence of n items.

    Parameters
    ----------
    i : int, slice, mask (n,) or sequence of int
    n : int
        Number of items.
    thing : str
        Name of an item in messages.

    Returns
    -------
    int or list of int
        The nonnegative position for an integer, else the list of positions.
    """
    if isinstance(i, slice):
        return list(range(*i.indices(n)))
    name = f"an index of {thing}s"
    is_scalar = isinstance(i, np.ndarray) and i.ndim == 0 and i.dtype.kind in "iu"
    if is_scalar or (
        isinstance(i, (int, np.integer)) and not isinstance(i, (bool, np.timedelta64))
    ):
        if not -n <= i < n:
            raise IndexError(f"{thing} {i} does not exist; there are {n}, numbered from 0")
        return range(n)[i]
    check_unmasked(name, i)
    entries = check_sequence(name, i, "whole numbers, or a mask,")
    shape = get_shape(name, entries)
    index = np.array(entries)
    if len(shape) != 1 or (index.dtype.kind not in "biu" and index.size):
        raise InputError(f"{name} is {i!r:.60}; whole numbers, or a mask, are needed")
    return list(map(int, np.arange(n)[index if index.size else []]))


def check_float(
    name: str, value: Any, *, low: float = -np.inf, high: float = np.inf, above: float | None = None
) -> float:
    """Return `value` as a float; raise InputError unless it is finite, in [low, high], and larger than `above`."""
    is_number = isinstance(value, (int, float, np.integer, np.floating))
    if not is_number or isinstance(value, (bool, np.timedelta64)):
        raise InputError(f"{name} is {value!r}; a number is needed")
    try:
        x = float(value)
    except OverflowError:  # The int is above the largest float.
        x = np.inf if value > 0 else -np.inf
    if not np.isfinite(x):
        raise InputError(f"{name} is {x}; a finite number is needed")
    if abs(x) > MAX_MAGNITUDE:
        raise InputError(f"{name} is {x:g}; at most {MAX_MAGNITUDE:g} is needed: change a unit")
    if above is not None and not x > above:
        raise InputError(f"{name} is {x:g}; more than {above:g} is needed")
    if x < low or x > high:
        required = f"at least {low:g}" if high == np.inf else f"{low:g} to {high:g}"
        raise InputError(f"{name} is {x:g}; {required} is needed")
    return x


def check_int(name: str, value: Any, low: int = 0, high: int | None = 2**31 - 1) -> int:
    """Return `value` as an int; raise InputError unless it is an integer in [low, high] (high None: no limit)."""
    is_integer = isinstance(value, (int, np.integer)) and not isinstance(
        value, (bool, np.timedelta64)
    )
    if not is_integer or value < low or (high is not None and value > high):
        upto = "" if high is None else f" to {high}"
        raise InputError(f"{name} is {value!r}; a whole number from {low}{upto} is needed")
    return int(value)


def check_bool(name: str, value: object) -> bool:
    """Return `value` as a bool; raise InputError unless it is True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{name} is {value!r}; True or False is needed")
    return bool(value)


def as_csr(
    name: str, value: Any, *, copy: bool = True, unit: str = "", too_many: str = ""
) -> sp.csr_array:
    """Convert a sparse matrix to read-only compressed rows of float64 and int32 with sorted columns.

    Indices and numbers are checked.

    Parameters
    ----------
    name : str
        Name of the argument in messages.
    value : sparse array or matrix
    copy : bool, default True
        If False, arrays that already have the required type are used and marked read-only.
    unit : str, optional
        Unit of the entries, for messages.
    too_many : str, optional
        Advice at the end of the message about more than 2^31 - 1 nonzeros.
    """
    if value.nnz >= 2**31:
        raise InputError(
            f"{name} has {value.nnz} nonzeros; at most 2^31 - 1 can be indexed{too_many}"
        )
    if value.dtype.kind not in "buif":
        raise InputError(f"{name} has dtype {value.dtype}; real numbers are needed")
    try:
        a = sp.csr_array(value, copy=copy)
        a.check_format(full_check=True)  # Check all indices here, since the kernels do not.
    except ValueError as error:
        raise InputError(
            f"{name} is not a valid compressed matrix ({error}); check its indices"
        ) from None
    if not a.has_canonical_format:
        a = a if copy else a.copy()
        a.sum_duplicates()
    data = as_array(name, a.data, (None,), finite=False, copy=False)
    check_finite_and_in_range(name, data, unit, a)
    fields = ((a.data, np.float64), (a.indices, np.int32), (a.indptr, np.int32))
    arrays = tuple(mark_read_only(np.ascontiguousarray(x, dtype)) for x, dtype in fields)
    return sp.csr_array(arrays, shape=a.shape)


def get_common_precision(*values: Any) -> str:
    """Return "float32" if all values that are not None are dense or sparse arrays of float32, else "float64"."""
    for x in values:
        if getattr(x, "dtype", None) is FLOAT64:
            return "float64"
    types = {getattr(x, "dtype", None) for x in values if x is not None}
    # float32 in the other byte order is a different dtype of the same precision.
    is_single = bool(types) and all(
        isinstance(x, np.dtype) and x.newbyteorder("=") == FLOAT32 for x in types
    )
    return "float32" if is_single else "float64"


def as_array_view(name: str, value: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    """Convert `value` as `as_array` with copy=False, for immediate use: the caller's array stays writable."""
    return as_array(name, value.view() if type(value) is np.ndarray else value, shape, copy=False)


def _raise_at_first(
    name: str, requirement: str, array: np.ndarray, is_bad: Any, csr: Any = None, advice: str = ""
) -> NoReturn:
    """Raise InputError at the first entry of the mask `is_bad`; if `csr` is given, `array` is its data."""
    bad = np.argwhere(is_bad)
    index = bad[0]
    value = array[tuple(bad[0])]
    if csr is not None:
        row = np.searchsorted(csr.indptr, index[0], side="right") - 1
        index = np.array([row, csr.indices[index[0]]])
    place = ", ".join(map(str, index))
    raise InputError(
        f"{name} must {requirement}; entry [{place}] is {value:g} ({len(bad)} such entries){advice}"
    )


def check_finite(name: str, array: np.ndarray, csr: Any = None) -> None:
    """Raise InputError at the first NaN or infinity of an array; if `csr` is given, `array` is its data."""
    if not all_finite(array.reshape(-1)):
        _raise_at_first(name, "be finite", array, ~np.isfinite(array), csr)


def check_finite_and_in_range(
    name: str, array: np.ndarray, unit: str = "", csr: Any = None
) -> None:
    """Raise InputError at the first number that is not finite or is above MAX_MAGNITUDE in absolute value."""
    if not checks.all_in_valid_range(array.reshape(-1)):
        check_finite(name, array, csr)
        requirement = f"be at most {MAX_MAGNITUDE:g} in size"
        is_bad = np.abs(array) > MAX_MAGNITUDE
        _raise_at_first(name, requirement, array, is_bad, csr, _suggest_unit(unit))


def check_nonnegative_magnitudes(name: str, array: np.ndarray, unit: str = "") -> None:
    """Raise InputError at the first number that is negative, or neither 0 nor in [MIN_MAGNITUDE, MAX_MAGNITUDE]."""
    if checks.find_invalid_magnitude_in_array(array.reshape(-1)) >= 0:
        check_finite_and_in_range(name, array, unit)
        check_not_negative(name, array)
        requirement = f"be 0 or at least {MIN_MAGNITUDE:g}"
        is_bad = (array > 0.0) & (array < MIN_MAGNITUDE)
        _raise_at_first(name, requirement, array, is_bad, advice=_suggest_unit(unit))


def check_not_nan(name: str, array: np.ndarray) -> None:
    """Raise InputError at the first NaN of an array."""
    if np.isnan(array).any():
        _raise_at_first(name, "not be NaN", array, np.isnan(array))


def check_not_negative(name: str, array: np.ndarray) -> None:
    """Raise InputError at the first negative entry of an array."""
    if (array < 0).any():
        _raise_at_first(name, "not be negative", array, array < 0)


def _suggest_unit(unit: str) -> str:
    """Return advice which unit to change for a quantity with this unit."""
    if unit == "-":
        return ": this quantity has no unit that you could change"
    letters = set(unit.replace("rad", "").replace("N s", "kg m/s"))
    units = [
        name
        for letter, name in (("k", "mass"), ("m", "length"), ("s", "time"))
        if letter in letters
    ]
    return (
        f": another unit of {' or '.join(units or ['mass, length', 'time'])} brings it nearer to 1"
    )


def check_sequence(name: str, value: Any, things: str) -> list[Any]:
    """Return a sequence as a list; raise InputError for texts, sparse matrices and objects that are not sequences."""
    is_sequence = isinstance(value, Iterable) and getattr(value, "ndim", 1) != 0
    if isinstance(value, (str, bytes, type)) or not is_sequence or issparse(value):
        raise InputError(f"{name} is {value!r:.60}; a sequence of {things} is needed")
    return list(value)


def check_choice(name: str, value: Any, choices: Sequence[str]) -> str:
    """Return `value` as a str; raise InputError unless it is one of the choices."""
    if not isinstance(value, str) or value not in choices:
        raise InputError(f"{name} is {value!r}; {' or '.join(map(repr, choices))} is needed")
    return str(value)  # Convert NumPy's strings: their repr in messages would show the type.


def as_names(things: str, value: Any, count: int) -> tuple[str, ...]:
    """Return names of `count` things as a tuple; raise InputError for another number of names."""
    names = tuple(map(str, check_sequence(f"names of {things}", value, f"{count} words")))
    if len(names) != count:
        raise InputError(
            f"names has {len(names)} entries for {count} {things}; one name for each is needed"
        )
    return names


def are_equal(x: object, y: object) -> bool:
    """Return whether two fields are equal: arrays in shape and every value, None only with None."""
    if isinstance(x, np.ndarray) or isinstance(y, np.ndarray):
        return np.array_equal(x, y)  # type: ignore[arg-type]
    return bool(x == y)


def format_html_table(facts: Mapping[str, Any], title: str) -> str:
    """Format facts as a small HTML table for notebooks; every text is escaped."""
    from html import escape

    rows = "".join(
        f"<tr><th>{escape(str(k))}</th><td>{escape(str(v))}</td></tr>" for k, v in facts.items()
    )
    return f"<table><caption>{escape(title)}</caption>{rows}</table>"
