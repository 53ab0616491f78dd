"""Balls and rational numbers of python-flint: what is proved is proved in these."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from threading import RLock
from typing import Any

import numpy as np

from lavender.base.errors import SolverUnavailable

UNIT = 2.0**-53

_precision_lock = (
    RLock()
)  # Held while python-flint's precision, one for the whole process, is that of a proof.


def _forked() -> None:
    global _precision_lock
    _precision_lock = RLock()  # A fork's child has no thread that could release the other one.


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_forked)


@contextmanager
def balls(bits: int) -> Iterator[Any]:
    """Set the precision of python-flint to `bits` and restore it at the end; one thread at a time.

    Raises
    ------
    SolverUnavailable
        python-flint is not installed.
    """
    try:
        import flint
    except ImportError:
        raise SolverUnavailable(
            "prove needs python-flint (interval arithmetic): pip install 'lavender-contact[proof]'"
        ) from None
    with _precision_lock:
        before, flint.ctx.prec = flint.ctx.prec, bits
        try:
            yield flint
        finally:
            flint.ctx.prec = before


class Balls:
    """Numbers and matrices of balls."""

    def __init__(self, flint: Any) -> None:
        self.number, self.matrix = flint.arb, flint.arb_mat


class Rationals:
    """Numbers and matrices of rational numbers."""

    def __init__(self, flint: Any) -> None:
        self.matrix, self._flint = flint.fmpq_mat, flint

    def number(self, x: float) -> Any:
        """The rational number that a float is."""
        return self._flint.fmpq(*x.as_integer_ratio())


def matrix(kind: Any, a: Any) -> Any:
    """A sparse matrix in numbers of a kind, dense."""
    dense = a.toarray()
    return kind.matrix(*dense.shape, [kind.number(x) for x in dense.ravel().tolist()])


def times(kind: Any, a: Any, x: list[Any], at: Any) -> list[Any]:
    """Sparse times vector; `at`: the entries of x that are not zero, None: all."""
    out, zero = [], kind.number(0.0)
    live = None if at is None else np.isin(a.indices, at)
    data, indices, ptr = a.data.tolist(), a.indices.tolist(), a.indptr.tolist()
    for i in range(a.shape[0]):
        total = zero
        for k in range(ptr[i], ptr[i + 1]):
            if (live is None or live[k]) and data[k] != 0.0:
                total = total + kind.number(data[k]) * x[indices[k]]
        out.append(total)
    return out


def upper_end(x: Any) -> float:
    """No less than |x| for any number of a ball; the float of an upper end may be rounded down."""
    up = abs(x).upper()
    return 0.0 if up == 0 else float(up) * (1.0 + 2.0**-50) + 2.0**-1070


def largest(x: list[Any]) -> float:
    """The size of the largest of some numbers."""
    return max((abs(float(q)) for q in x), default=0.0)


def sign_of(x: Any) -> int:
    """+1 where certainly x >= 0, -1 where certainly x < 0, else 0."""
    return 1 if x >= 0 else -1 if x < 0 else 0
