"""The linear system of a derivative: its factor by what suits it, and what solves it where rows repeat others."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import sparse_lu
from lavender.problem import Problem
from lavender.solvers.factors import WIDE
from lavender.solvers.newton_systems.systems import is_full
from lavender_ext.derivative.linear import Linear
from lavender_ext.factor.sparse import SparsePanels, free_part

SINGULAR = 1e-12  # least pivot over the largest, from which on rows count as repeating others
SHIFT = 1e-11  # eps of (6)
TURNS = 8  # of (6): what is 1e-11 of the diagonal is off by 2^-8 then, what is 1e-9 by 1e-16
ENOUGH = 1e-14  # of the largest entry, below which a turn changes nothing
PROBES = 2  # random vectors that show what is not determined
SMALL = 64  # rows up to which the system is dense, whatever A is
# rows up to which it is dense where A is no symmetric matrix with few entries, or a contact slides
DENSE = 400

Solve = Callable[[FloatArray, bool], FloatArray]


def prepared(problem: Problem, linear: Linear, shift: float = 0.0) -> bool:
    """Whether the kernel has a dense factor."""
    data = problem.csr_data if problem.generalized is None else problem.metric
    found: bool = linear.prepare(data, shift)
    return found


class System:
    """A factor of G on the rows that are not its identity; solves with it and with its transpose.

    `of_kernel`: the factor is the kernel's own, and G is regular.
    """

    def __init__(self, problem: Problem, linear: Linear) -> None:
        self.problem, self.linear, self.n = problem, linear, linear.rows
        few = self.n > SMALL and not linear.slides and problem.is_symmetric
        if few and not is_full(problem.csr.nnz, problem.m, True):
            factor = self._panels
        else:
            factor = self._dense if self.n <= DENSE else self._superlu
        # Of few rows `prepared` was tried.
        tried = self.n <= SMALL
        once = linear.solve if tried and linear.regular else None if tried else factor(0.0)
        self.singular = once is None
        self.of_kernel = once is not None and factor == self._dense
        if once is None:
            self.g: Any = linear.matrix() if factor == self._dense else self._matrix(0.0)
            once = factor(SHIFT)
        if once is None:
            raise CapabilityError(
                f"the equations of this solution's states have no factor, shifted by {SHIFT:g} of their diagonal "
                "either: an A that is indefinite, or states that are wrong"
            )
        self._once = once

    def _dense(self, shift: float) -> Solve | None:
        return self.linear.solve if prepared(self.problem, self.linear, shift) else None

    def _h(self) -> tuple[Any, Any, FloatArray]:
        # H on the rows of G in compressed rows
        a, n = self.problem.csr, self.linear
        indptr, indices, data = free_part(a.indptr, a.indices, a.data, n.place, self.n)
        root = n.root[n.place >= 0]
        return indptr, indices, data / (np.repeat(root, np.diff(indptr)) * root[indices])

    def _panels(self, shift: float) -> Solve | None:
        # G = H, symmetric
        indptr, indices, data = self._h()
        panels = SparsePanels(indptr, indices, False, WIDE)
        lost = panels.factor(data, np.ones(self.n), shift, SINGULAR)
        return None if lost else lambda r, back: panels.solve(r)

    def _matrix(self, shift: float) -> Any:
        indptr, indices, data = self._h()
        h = sp.csr_array((data, indices, indptr), shape=(self.n, self.n))
        c, one = self.problem.cones, sp.eye_array(self.n)
        block = np.repeat(np.arange(c.n_blocks), np.diff(c.ptr))
        alone = ~c.is_contact[block]
        ends = np.concatenate([[0], np.cumsum(np.where(alone, 1, np.diff(c.ptr)[block]))])
        first = np.where(alone, np.arange(c.n_rows), c.ptr[block])
        columns = np.arange(ends[-1]) + np.repeat(first - ends[:-1], np.diff(ends))
        at = np.flatnonzero(self.linear.place >= 0)
        p = sp.csr_array((self.linear.p, columns, ends), shape=(c.n_rows, c.n_rows))[at][:, at]
        return sp.csc_array(one - p + p @ (h + shift * one))

    def _superlu(self, shift: float) -> Solve | None:
        try:
            found = sparse_lu(self._matrix(shift))
        except RuntimeError:
            return None
        pivots = np.abs(found.U.diagonal())
        if not pivots.min() > SINGULAR * pivots.max():
            return None
        return lambda r, back: found.solve(r, trans="T" if back else "N")

    def solve(self, r: FloatArray, back: bool = False) -> FloatArray:
        """Solve G x = r, or G^T x = r."""
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
