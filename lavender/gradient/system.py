"""The linear system of a derivative where the kernel has no factor of it: many rows, or rows that repeat others."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.base.later import lapack
from lavender.base.lu import sparse_lu

__all__ = ["System"]

SINGULAR = 1e-12  # least pivot over the largest, from which on rows count as repeating others
SHIFT = 1e-11  # eps of (6)
TURNS = 8  # of (6): what is 1e-11 of the diagonal is off by 2^-8 then, what is 1e-9 by 1e-16
ENOUGH = 1e-14  # of the largest entry, below which a turn changes nothing
PROBES = 2  # random vectors that show what is not determined


class System:
    """A factor of G on the rows that are not its identity; solves with it and with its transpose."""

    def __init__(self, shifted: Callable[[float], Any], n: int) -> None:
        self.g, self.n = shifted(0.0), n
        self.is_dense = isinstance(self.g, np.ndarray)
        self.singular = n > 0 and not self._factor(self.g)
        if self.singular and not self._factor(shifted(SHIFT)):
            raise CapabilityError(
                f"the equations of this solution's states have no factor, shifted by {SHIFT:g} of their diagonal "
                "either: an A that is indefinite, or states that are wrong"
            )

    def _factor(self, g: Any) -> bool:
        if self.is_dense:
            # of the transpose, as LAPACK sees rows
            self._lu, self._swap, _ = lapack.dgetrf(g.T, overwrite_a=False)
            pivots = np.abs(self._lu.ravel(order="K")[:: self.n + 1])
        else:
            try:
                self._sparse = sparse_lu(g)
            except RuntimeError:
                return False
            pivots = np.abs(self._sparse.U.diagonal())
        return bool(pivots.min() > SINGULAR * pivots.max())  # NaN: no

    def _once(self, r: FloatArray, back: bool) -> FloatArray:
        if self.is_dense:
            x: FloatArray = lapack.dgetrs(self._lu, self._swap, r, trans=0 if back else 1)[0]
            return x
        return self._sparse.solve(r, trans="T" if back else "N")

    def solve(self, r: FloatArray, back: bool = False) -> FloatArray:
        """Solve G x = r, or G^T x = r."""
        if self.n == 0:
            return r.copy()
        x = self._once(r, back)
        if self.singular:
            g = self.g.T if back else self.g
            for _ in range(TURNS):
                more = self._once(r - g @ x, back)
                x = x + more
                if not np.abs(more).max() > ENOUGH * np.abs(x).max():
                    break
        return x

    def probes(self, back: bool) -> FloatArray:
        """(PROBES, n) vectors that G, or G^T, maps to rounding, of a random share; of a regular one none."""
        if not self.singular:
            return np.zeros((0, self.n))
        g, out = (self.g.T if back else self.g), []
        for x in np.random.default_rng(0).standard_normal((PROBES, self.n)):
            for _ in range(TURNS):
                x = x - self._once(g @ x, back)
            out.append(x / np.linalg.norm(x))
        return np.stack(out)
