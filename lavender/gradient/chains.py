"""Chain rule from coefficients of rows to coefficients of contacts."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.problem import Problem


class CoefficientRows:
    """Rows to which the coefficients of contacts apply; -1 if a contact has no such row.

    Attributes
    ----------
    first : (k,)
        First tangent.
    second : (k,)
        Spin row, or second tangent of a box or ellipse.
    rolling : (k,)
        First rolling row.
    has_pair : (k,) bool
        Whether the two tangents have separate coefficients.
    """

    def __init__(self, problem: Problem) -> None:
        c = problem.cones
        self.mu, self.radius = c.mu, c.patch_radius
        self.first = np.where(c.n_tangents > 0, c.ptr[:-1] + 1, -1)
        self.ellipse = c.is_ellipse
        self.second = np.where(self.ellipse, c.ptr[:-1] + 2, c.separate_rows)
        self.has_pair = self.ellipse | c.is_box
        self.rolling = c.rolling_rows
        self.m = c.n_rows

    def select_rows_or_zero(self, x: FloatArray, rows: Any) -> FloatArray:
        """Return x (m,) at the rows (k,), 0 for row -1."""
        return np.where(rows >= 0, x[np.maximum(rows, 0)], 0.0) if len(x) else np.zeros(len(rows))

    def compute_row_coefficient_changes(
        self, mu: FloatArray | None, radius: FloatArray | None, rolling: FloatArray | None
    ) -> FloatArray:
        """Compute the change de (m,) of the rows' coefficients caused by changes of the contacts' coefficients."""
        de = np.zeros(self.m)
        for rows, change in (
            (self.first, None if mu is None else mu if mu.ndim == 1 else mu[:, 0]),
            (self.second, None if mu is None else self.radius * mu if mu.ndim == 1 else mu[:, 1]),
            (self.second, None if radius is None else self.mu * radius),
            (self.rolling, rolling),
        ):
            if change is not None:
                de[rows[rows >= 0]] += change[rows >= 0]
        return de
