"""Ball arithmetic and rational numbers of python-flint, in which proofs are computed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from threading import RLock
from typing import Any

import numpy as np

from lavender.base.errors import SolverUnavailable

UNIT = 2.0**-53  # Unit round-off of float64.

# Held while a proof sets python-flint's precision, which is one for the whole process.
_precision_lock = RLock()


def _replace_lock_after_fork() -> None:
    """Create a new lock in a forked child: no thread of the child could release the old one."""
    global _precision_lock
    _precision_lock = RLock()


if hasattr(os, "register_at_fork"):  # It does not exist on Windows.
    os.register_at_fork(after_in_child=_replace_lock_after_fork)


@contextmanager
def set_ball_precision(bits: int) -> Iterator[Any]:
    """Set the precision of python-flint to `bits` in a context, which only one thread at a time can enter.

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
    """Factories of balls and of matrices of balls."""

    def __init__(self, flint: Any) -> None:
        self.number, self.matrix = flint.arb, flint.arb_mat


class Rationals:
    """Factories of rational numbers and of matrices of them."""

    def __init__(self, flint: Any) -> None:
        self.matrix, self._flint = flint.fmpq_mat, flint

    def number(self, x: float) -> Any:
        """Return the rational number that equals a float."""
        return self._flint.fmpq(*x.as_integer_ratio())


def to_dense(kind: Any, a: Any) -> Any:
    """Convert a sparse matrix to a dense matrix of balls or rationals."""
    dense = a.toarray()
    return kind.matrix(*dense.shape, [kind.number(x) for x in dense.ravel().tolist()])


def multiply_sparse_by_vector(kind: Any, a: Any, x: list[Any], nonzeros_of_x: Any) -> list[Any]:
    """Multiply a sparse matrix by a vector; `nonzeros_of_x`: indices of nonzero entries, None means all."""
    out, zero = [], kind.number(0.0)
    used = None if nonzeros_of_x is None else np.isin(a.indices, nonzeros_of_x)
    data, indices, ptr = a.data.tolist(), a.indices.tolist(), a.indptr.tolist()
    for i in range(a.shape[0]):
        total = zero
        for k in range(ptr[i], ptr[i + 1]):
            if (used is None or used[k]) and data[k] != 0.0:
                total = total + kind.number(data[k]) * x[indices[k]]
        out.append(total)
    return out


def round_up_magnitude(x: Any) -> float:
    """Return a float that is at least |x| for every number x of a ball; the conversion to float is rounded up."""
    up = abs(x).upper()
    return 0.0 if up == 0 else float(up) * (1.0 + 2.0**-50) + 2.0**-1070


def max_abs(x: list[Any]) -> float:
    """Return the largest magnitude of some numbers, 0 for an empty sequence."""
    return max((abs(float(q)) for q in x), default=0.0)


def get_certain_sign(x: Any) -> int:
    """Return +1 if certainly x >= 0, -1 if certainly x < 0, else 0."""
    return 1 if x >= 0 else -1 if x < 0 else 0
