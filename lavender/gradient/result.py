"""Gradients by the data of a problem, each computed at its first use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError, InputError
from lavender.base.lazy_import import issparse
from lavender.base.lazy_import import sparse as sp
from lavender.problem import OPERATORS, Problem
from lavender.problem.derived import cached_property

MATRICES = ("A", "J", "M")
# Data by which solutions can be differentiated -> forms of problems that have these data (see `OPERATORS`). In `jvp`,
# mu may have the shape (k, 2) of `coefficients`.
INPUTS = {
    **dict.fromkeys(
        ("b", "lower", "upper", "mu", "coefficients", "patch_radius", "rolling"), OPERATORS
    ),
    "A": ("matrix",),
    **dict.fromkeys(("target", "v_free", "compliance", "J"), ("rows", "generalized")),
    "M": ("generalized",),
}


COEFFICIENT_INPUTS = ("mu", "patch_radius", "rolling")
# Data of single rows. If linearly dependent rows share a load, no derivative by the data of one of them exists,
# because a change would contradict the other rows.
ROW_INPUTS = ("b", "target", "compliance", "A", "J")


class CoefficientRows:
    """Rows to which the coefficients of contacts apply, for the chain rule; -1 if a contact has no such row.

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


class GradientArrays:
    """Types of the gradients that are arrays, which `__getattr__` of derived classes computes."""

    if TYPE_CHECKING:
        b: FloatArray
        target: FloatArray
        v_free: FloatArray
        lower: FloatArray
        upper: FloatArray
        mu: FloatArray
        coefficients: FloatArray
        patch_radius: FloatArray
        rolling: FloatArray
        compliance: FloatArray


class Gradient(GradientArrays):
    """Gradients of a scalar by the data of a problem, computed by `Derivative.vjp`.

    Each gradient is computed at its first use and has the shape of the data. Its unit is the unit of the scalar over
    the unit of the data.

        b, target            (m,): by b of a matrix problem; by the target of a problem with J and M (same values)
        v_free               (nv,) or (n, 6): by v*, with b = target - J v*
        lower, upper         (m,): by the active bounds; if lower = upper, half of the sum for each
        mu, patch_radius, rolling   (k,): by the fields of `Cones`
        coefficients         (k, 2): by mu_1 and mu_2 of ellipses and boxes; (mu, 0) for other contacts
        compliance           (m,)
        A                    (m, m): by each entry; dense, or on the pattern of a sparse A
        J, M                 (m, nv), (nv, nv): sparse, on their patterns; M symmetric; see `full`

    Gradients by J and M are for fixed target and v*. `lavender.torch` and `lavender.jax` continue them to masses,
    arms and normals from which a program computes J and M.

    Accessing a gradient raises CapabilityError if the problem has no such data. It also does so if linearly dependent
    rows share a load (`Derivative.unique.target`) and the data belong to single rows: targets, J, compliance.
    Under the cone law, where a sliding contact separates at mu times its speed, this includes coefficients of sliding
    contacts.
    """

    if TYPE_CHECKING:
        A: Any
        J: sp.csr_array
        M: sp.csr_array

    def __init__(self, derivative: Any, adjoint: FloatArray) -> None:
        m = derivative.m
        end = len(adjoint) - derivative.m
        # q, s (m), f = y - J^T s (nv) and c (m) of equation (4) in `lavender.gradient`.
        self._q = adjoint[:m]
        self._s = adjoint[m : 2 * m]
        self._f = adjoint[2 * m : end]
        self._c = adjoint[end:]
        self._derivative = derivative

    @cached_property
    def _p(self) -> FloatArray:
        return np.asarray(self._derivative._apply_inverse_mass(self._f))

    def __repr__(self) -> str:
        return f"<Gradient of {self._derivative.m} rows by {', '.join(self._derivative.inputs)}>"

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self._derivative.inputs]

    if (
        not TYPE_CHECKING
    ):  # Hide `__getattr__` from type checkers, so that they report unknown names.

        def __getattr__(self, name: str) -> Any:
            """Compute the gradient by one input, and store it as an attribute."""
            if name not in INPUTS:
                raise AttributeError(f"a gradient has no {name!r}; it has {', '.join(INPUTS)}")
            derivative = self._derivative
            operators = INPUTS[name]
            if derivative.problem.operator not in operators:
                raise CapabilityError(
                    f"{name} exists only for problems given as {' or '.join(operators)}, and this one was given as "
                    f"{derivative.problem.operator}"
                )
            if name in ROW_INPUTS and not derivative._uses_kernel:
                derivative._check_row_changes(f"no derivative by {name} exists here")
            if name in (*COEFFICIENT_INPUTS, "coefficients") and not derivative._uses_kernel:
                derivative._check_coefficient_changes("mu" if name == "coefficients" else name)
            value = self.__dict__[name] = self._compute(name)
            return value

    def _compute(self, name: str) -> Any:
        """Compute the gradient by one input: (5) of `lavender.gradient`."""
        derivative = self._derivative
        problem = self._derivative.problem
        if name in ("b", "target"):
            return self._s
        if name == "v_free":
            return self._f.reshape(derivative._velocity_shape())
        if name == "compliance":
            return -self._s * derivative._impulse
        if name in ("lower", "upper"):
            return derivative._bound_weights[int(name == "upper")] * self._by_fixed_impulse
        if name in MATRICES:
            pattern = (
                problem.generalized.mass
                if name == "M"
                else problem.jacobian
                if name == "J"
                else problem.matrix
            )
            pairs = self._list_outer_product_pairs(name)
            if not issparse(pattern):
                return np.outer(*pairs[0])
            row = np.repeat(np.arange(pattern.shape[0]), np.diff(pattern.indptr))
            data = sum(u[row] * v[pattern.indices] for u, v in pairs)
            return sp.csr_array((data, pattern.indices, pattern.indptr), shape=pattern.shape)
        rows, gradient = derivative._coefficient_rows, self._by_row_coefficient
        if name == "rolling":
            return rows.select_rows_or_zero(gradient, rows.rolling)
        second = rows.select_rows_or_zero(gradient, rows.second)
        if name == "patch_radius":
            return rows.mu * second
        first = rows.select_rows_or_zero(gradient, rows.first)
        if name == "mu":
            return first + rows.radius * second
        pair = np.where(rows.has_pair, first, self.mu), np.where(rows.has_pair, second, 0.0)
        return np.stack(pair, axis=1)

    @cached_property
    def _by_fixed_impulse(self) -> FloatArray:
        """Gradient (m,) by impulses that are at a bound, including their effect on w and v."""
        derivative = self._derivative
        matrix, compliance = derivative.problem.matrix, derivative.problem.compliance
        if matrix is not None:
            return np.asarray(self._c - matrix.T @ self._s)
        assert compliance is not None
        return np.asarray(self._c + derivative._apply_jacobian(self._p) - compliance * self._s)

    @cached_property
    def _by_row_coefficient(self) -> FloatArray:
        """Gradient (m,) by the friction coefficient e of each row."""
        derivative = self._derivative
        linear = derivative._linear
        e: FloatArray = linear.multiply_projection_derivative(self._q, True, True)
        if derivative.problem.cones.has_ellipse:
            rows, dz_de, dy_de = derivative._ellipse_terms
            e[rows] = (
                dz_de * self._q[rows]
                - dy_de * linear.multiply_projection_derivative(self._q, True)[rows]
            )
        return e

    def _list_outer_product_pairs(self, name: str) -> list[tuple[FloatArray, FloatArray]]:
        """Return the gradient (5) by A, J or M, a sum of outer products u v^T, as pairs (u, v)."""
        derivative = self._derivative
        if name == "A":
            return [(-self._s, derivative._impulse)]
        if name == "J":
            return [(derivative._impulse, self._p), (-self._s, derivative._velocity)]
        change = derivative._velocity_change
        half = -0.5 * self._p
        return [(half, change), (-0.5 * change, self._p)]

    def full(self, name: str) -> FloatArray:
        """Compute the gradient by A, J or M as a dense array, including entries outside of the sparsity pattern.

        Raises
        ------
        InputError
            `name` is not "A", "J" or "M".
        CapabilityError
            The problem has no such matrix, or the derivative does not exist.
        """
        if name not in MATRICES:
            raise InputError(f"full needs one of {', '.join(MATRICES)}; {name!r} has no pattern")
        getattr(self, name)  # Raises CapabilityError if the gradient does not exist.
        return np.asarray(sum(np.outer(u, v) for u, v in self._list_outer_product_pairs(name)))
