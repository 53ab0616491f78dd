"""Malformed argument values, and the checks that every public call rejects them.

Each layer has a table of valid calls (`Call`) in its `test_*invalid*.py`; the functions here replace one argument at a
time.
"""

import inspect
import re
import types
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

import lavender as lv

# Package -> layer with a table of calls of its own; modules outside of these packages belong to the core.
LAYERS = {"io": "io", "sim": "sim"} | dict.fromkeys(("audit", "report", "suite", "diagnostics"), "measuring")


@dataclass(frozen=True)
class Call:
    """A valid call of a public function."""

    function: Callable[..., Any]
    arguments: dict[str, Any]
    names: dict[str, str] = field(default_factory=dict)  # argument -> pattern of its name in messages, if another
    accepts_nan: bool = False  # measures and batches report NaN in their results
    any_length: frozenset[str] = frozenset()  # arguments whose length (or number of dimensions) is not fixed
    accepts: dict[str, tuple[str, ...]] = field(default_factory=dict)  # argument -> values that are valid after all

    def __call__(self, **changed: Any) -> Any:
        return self.function(**self.arguments | changed)


def wrong_values(good):
    """Yield (description, value) that no call accepts in place of `good`."""
    if isinstance(good, np.ndarray):
        first = np.arange(good.size).reshape(good.shape) == 0
        flat = good.ravel().tolist()
        yield "NaN", np.where(first, np.nan, good)
        yield "ragged", [flat, flat[:-1]]
        yield "text", good.astype(str)
        yield "lists of text", good.astype(str).tolist()
        yield "complex", good + 0j
        yield "dates", np.zeros(good.shape, "m8[s]")
        yield "objects", np.full(good.shape, None)
        yield "masked", np.ma.array(good, mask=first)
    elif isinstance(good, bool):
        yield from {"text": "no", "a number": 1, "None": None, "a list": [], "an array": np.zeros(2)}.items()
    elif isinstance(good, int | float):
        yield from {
            "NaN": np.nan, "text": "1", "complex": 1j, "True": True, "a list": [1.0, 2.0], "masked": np.ma.masked,
            "a date": np.timedelta64(1, "s"), "infinite": -np.inf,
        }.items()  # fmt: skip
        if isinstance(good, int):
            yield from {"a half": 2.5, "negative": -3, "very large": 2**70}.items()
    else:
        yield from {"an object": object(), "an ellipsis": ..., "bytes": b"x"}.items()


def wrong_shapes(good):
    """Yield arrays of a shape that a call rejects, perhaps by the name of another argument."""
    yield "a column", good[..., None]
    yield "longer", np.concatenate([good, good[:1]])
    yield "shorter", good[:-1]


def odd_values(good):
    """Yield values that a call may accept, or else rejects with an error of the package."""
    yield from {
        "None": None, "text": "no such word", "-1": -1, "very large": 2**70, "a half": 0.5, "True": True,
        "an empty list": [], "a mapping": {1: 2}, "a set": {1.0}, "an iterator": iter([1.0, 2.0]), "a function": len,
        "a class": int, "no dimension": np.array(1.0), "an empty array": np.zeros(0),
        "three dimensions": np.zeros((2, 2, 2)), "ragged": [[1.0, 2.0], [3.0]], "complex": 1j, "masked": np.ma.masked,
        "a Problem": lv.Problem.lcp(np.eye(2), np.ones(2)), "objects": np.full((2, 2), None), "NaN": np.nan,
        "a sparse array": sp.eye_array(3), "a structured array": np.zeros(2, [("x", float)]), "a slice": slice(0, 1),
        "a list of None": [None, None], "a date": np.timedelta64(1, "s"),
    }.items()  # fmt: skip
    if sp.issparse(good):
        dense = good.toarray()
        yield from {
            "NaN in it": sp.csr_array(np.where(dense != 0.0, np.nan, 0.0)), "longer": sp.csr_array(np.eye(5)),
            "complex": good.astype(complex), "COO": good.tocoo(), "dense": dense, "integers": good.astype(int),
        }.items()  # fmt: skip
    if isinstance(good, np.ndarray):
        first = np.arange(good.size).reshape(good.shape) == 0
        yield from {
            "infinite": np.where(first, np.inf, good), "numbers as objects": good.astype(object),
            "negative": -1 - np.abs(good), "huge": np.full(good.shape, 1e300), "halves": good + 0.5,
            "transposed": good.T, "flat": good.ravel(), "booleans": good > 0, "float16": good.astype(np.float16),
            "long double": good.astype(np.longdouble), "a scalar": good.flat[0] if good.size else 0.0,
            "unsigned": np.nan_to_num(np.abs(good)).clip(0, 9).astype(np.uint8),
        }.items()  # fmt: skip


def data_of(values):
    """Return the bytes of every array in the arguments, to be compared."""
    return {name: x.tobytes() for name, x in values.items() if isinstance(x, np.ndarray)}


def check_malformed_arguments(name, call):
    """Replace each argument by each malformed value; require an error that names it, and unchanged arguments."""
    call()
    before, wrong = data_of(call.arguments), []
    index = (IndexError,) if "__getitem__" in name else ()  # as of any sequence
    named_elsewhere = [*call.arguments, *call.names.values(), "worlds", "rows"]
    for argument, good in call.arguments.items():
        own = [call.names.get(argument, argument)]
        values = [(what, x, own) for what, x in wrong_values(good)]
        if isinstance(good, np.ndarray) and argument not in call.any_length:
            values += [(what, x, named_elsewhere) for what, x in wrong_shapes(good)]
        values += [(what, x, None) for what, x in odd_values(good)]
        for what, x, names in values:
            accepted = names is None or (what == "NaN" and call.accepts_nan and isinstance(good, np.ndarray))
            accepted = accepted or what in call.accepts.get(argument, ())
            try:
                call(**{argument: x})
            except lv.LavenderError as error:
                message = str(error)
                if names is not None and not any(re.search(rf"\b(?:{word})\b", message) for word in names):
                    wrong.append(f"{argument}: {what}: not named in {message!r}")
                elif names is not None and not isinstance(error, lv.InputError | lv.UnknownName):
                    wrong.append(f"{argument}: {what}: {type(error).__name__}")
                elif not message.strip():
                    wrong.append(f"{argument}: {what}: an empty message")
            except index:
                pass
            except Exception as error:
                wrong.append(f"{argument}: {what}: {type(error).__name__}: {error}"[:200])
            else:
                if not accepted:
                    wrong.append(f"{argument}: {what}: accepted")
    assert not wrong, "\n".join(wrong)
    assert data_of(call.arguments) == before


def strided(x):
    """Copy an array into every other entry of a wider one."""
    wide = np.zeros((*x.shape[:-1], 2 * x.shape[-1]), x.dtype)
    wide[..., ::2] = x
    return wide[..., ::2]


def read_only(x):
    x = x.copy()
    x.setflags(write=False)
    return x


#: The same numbers in other memory.
LAYOUTS = {
    "other byte order": lambda x: x.astype(x.dtype.newbyteorder()),
    "every other entry": strided,
    "columns first": np.asfortranarray,
    "reversed": lambda x: x[::-1].copy()[::-1],
    "read-only": read_only,
    "at an odd byte": lambda x: np.frombuffer(b" " + x.tobytes(), np.uint8)[1:].view(x.dtype).reshape(x.shape),
    "lists": np.ndarray.tolist,
}


def comparable(result):
    """Return the numbers of a result; None if it has none that can be compared."""
    if isinstance(result, lv.Batch):
        return [*result]
    if isinstance(result, tuple) and hasattr(result, "batch"):
        # J v is summed in another order if J has another layout.
        rounded = [p.b.round(12).tolist() for p in result.batch]
        return rounded, [p.cones for p in result.batch], result.impulse.tolist()
    if isinstance(result, np.ndarray):
        return result.tolist()
    return result if isinstance(result, lv.Problem) else None


def check_memory_layouts(call):
    """Require the same result from the same numbers in any layout."""
    expected = comparable(call())
    for argument, value in call.arguments.items():
        if isinstance(value, np.ndarray):
            for layout, convert in LAYOUTS.items():
                assert comparable(call(**{argument: convert(value)})) == expected, (argument, layout)


def check_float32(call):
    """Require single precision of float32 arrays, of either byte order."""

    def to_float32(x, order):
        if isinstance(x, tuple) and isinstance(x[0], np.ndarray):
            return to_float32(x[0], order), *x[1:]
        is_real = isinstance(x, np.ndarray) and x.dtype.kind == "f"
        return x.astype(np.float32).astype(np.dtype(np.float32).newbyteorder(order)) if is_real else x

    for order in "<>":
        result = call(**{argument: to_float32(x, order) for argument, x in call.arguments.items()})
        assert getattr(result, "batch", result).precision == "float32"


def takes_arguments(function):
    try:
        return any(p.name not in ("self", "cls") for p in inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return False


def public_calls(layer, module=lv, prefix=""):
    """Return the names of all public functions, classes and methods of a layer that take arguments."""
    names = set()
    for name in module.__all__:
        try:
            x = getattr(module, name)
        except ImportError:
            continue  # It belongs to a layer above, which is not there.
        home = (getattr(x, "__module__", None) or "").split(".")
        if LAYERS.get(home[1] if len(home) > 1 else "", "core") != layer:
            continue
        if inspect.isclass(x) and issubclass(x, BaseException):
            continue
        if inspect.isclass(x):
            kinds = types.FunctionType, classmethod, staticmethod
            for k in dir(x):
                if (k == "__getitem__" or not k.startswith("_")) and takes_arguments(getattr(x, k)):
                    names |= {f"{prefix}{name}.{k}"} if isinstance(inspect.getattr_static(x, k), kinds) else set()
        if callable(x) and takes_arguments(x):
            names.add(f"{prefix}{name}")
    return names


def check_every_public_call(public, calls, not_called):
    """Require that each public call is in the table of calls or among the exceptions."""
    called = {name.partition(",")[0].partition(" by ")[0] for name in calls}
    assert public - called - set(not_called) == set()


def make_tests_of_calls(layer, calls, not_called, public=None):
    """Return the tests of a table of calls: it is complete, arguments are checked, memory layouts change nothing."""

    def test_table():
        check_every_public_call(public or public_calls(layer), calls, not_called)

    @pytest.mark.filterwarnings("error")
    @pytest.mark.parametrize("name", calls)
    def test_arguments(name):
        check_malformed_arguments(name, calls[name])

    @pytest.mark.filterwarnings("error")
    @pytest.mark.parametrize("name", calls)
    def test_layouts(name):
        check_memory_layouts(calls[name])

    return test_table, test_arguments, test_layouts
