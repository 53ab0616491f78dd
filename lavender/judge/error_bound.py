"""Bound the distance between an answer and an exact solution.

In the metric of d, with z = D^1/2 lambda, s = D^-1/2 w, y = z - s, H = D^-1/2 A D^-1/2, Pi the projection of each
block's law and P = dPi/dy (lavender_ext/core/block_projection.pxd), a solution z* = z + dz is a root of
F(z) = z - Pi(y). Along the segment from z to z* the mean value of P is P0 + L E R^T, with P0 and unit columns L, R
chosen below for each block, and

    G dz = -F + L v,   v = E R^T dy,   dy = (I - H) dz,   G = I - P0 + P0 H                                       (1)
    R^T dy = -R^T T F + (R^T T L) v,   T = (I - H) G^-1,   |v_g| <= e_g |R_g^T dy| for each group g                 (2)

If this contracts, it bounds dy and dz block by block:

    |W R^T dy| <= |W R^T T F| / (1 - q)    if q = ||W R^T T L W||_2 < 1, W^2 = diag(e)                              (3)
    |R_g^T dy| <= ((I - Q)^-1 r)_g         if the norms Q of the blocks of R^T T L diag(e) have a spectral radius
                                           below 1; r_g = |R_g^T T F|                                               (4)

The margin of a row or friction component (derivative/natural.pxd) is the distance of y from another case of the
projection. If it is larger than the bound, the component is certain: P0 is P there. Any other component is uncertain:
P0 is the middle of all values that P may have, and the bound is computed again.

    uncertain row               P in [0, 1]                    P0 = 1/2, e = 1/2
    uncertain contact, cone     0 <= P <= I, symmetric         P0 = I / 2, e = 1/2
    uncertain contact, Coulomb  P lower triangular             P0 = I / 2, e = (a + sqrt(a^2 + 1)) / 2, a^2 = sum a_g^2
    sticks or slides, Coulomb   I + phi u (a e_n - u)^T        phi = 1/2, e = sqrt(1 + a^2) / 2, u = y_t / |y_t|
    sticks or slides, cone      I - phi q q^T, q ~ (a, -u)     phi = 1/2, e = 1/2
    slides, two or more rows    P turns with u                 P0 = P and, with x >= |dy|, t = |y_t|, kappa = a s_n /
    t,
                                e = (a x_n + kappa x_t) / (t - x_t) + (kappa + a) x_t / (t - x_t)                   (5)

Proof: all mean values in the box of (3) or (4) are regular, so F is one-to-one on the box and a local homeomorphism at
each of its points (Clarke 1976, Pacific J. Math. 64, 97-102). The root of F(.) = (1 - tau) F(z) is followed from tau =
0 to 1; its distance from z does not exceed tau times the bound, so it cannot leave the box. Therefore exactly one
solution lies within the bound. If A is symmetric positive definite and the law is convex, (3) contracts for every set
of uncertain blocks (if all are uncertain, R^T T L is twice Cayley's transform of H), and there is only one solution.
Under Coulomb's law, or with another A, further solutions may exist outside of the box.

Bounds are enlarged by the rounding errors of w (from the sums of its terms), of M^-1 (from the condition of M) and of
G^-1 (from I - G^-1 G as computed). The bound therefore also holds for data that differ from the given data by
rounding. There is no bound if G is singular to rounding (rows that share a load), if neither (3) nor (4) contracts, or
if an island has more than `MAX_ISLAND_ROWS` rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.problem import Problem
from lavender.problem.ordering import group_rows_by_island
from lavender_ext.derivative.linear import CASES, Linear

UNIT_ROUNDOFF = 2.0**-53
MAX_ISLAND_ROWS = 600  # Larger islands have no bound: dense products of 600 rows take about 0.1 s.
MAX_MATRIX_ENTRIES = 4e6  # No bound is computed if A has more entries than this, because A is formed.
# Every row counts as uncertain if rows became uncertain in this many consecutive computations of the bound.
MAX_UNCERTAINTY_STEPS = 8
# Largest number of steps of the iteration for (5); each doubles the assumed bound of |dy|.
MAX_RADIUS_STEPS = 8
MAX_INVERSE_ERROR = 0.1  # G counts as singular if ||I - G^-1 G|| may be larger than this.
# q of (3) and the spectral radius of (4) must be below 1 by this much, which covers the rounding of norms.
CONTRACTION_MARGIN = 1e-9
LARGE_NORM = 0.5  # If the estimate of a norm by sums exceeds this, the norm is computed by singular values.
SUM_ROUNDING_FACTOR = 1.0 + 1e-8  # Sums of bounds are multiplied by this, which covers their rounding.


@dataclass(frozen=True)
class _Component:
    """A friction component of a contact, with a coefficient above 0.

    Parameters
    ----------
    rows : (n,) int
        Rows of the component.
    block : (n,) int
        All rows of its contact, the normal first.
    coefficient : float
        a of |z_t| <= a z_n in scaled rows.
    """

    rows: Any
    block: Any
    coefficient: float


@dataclass
class _Group:
    """Columns of L and R in (1) of one friction component or row, and the bound e of the corresponding block of E.

    Parameters
    ----------
    left_rows, right_rows : (n,) int
        Rows of the entries of `left` and `right`.
    left, right : (n, k)
        Columns of L and R.
    radius : float or None
        Bound e; None if it is computed by (5).
    component : _Component, optional
        If given, the bound holds only if y_t keeps its direction: |dy_t| < |y_t| / 2.
    is_uncertain : bool
        Whether the component is uncertain; P0 then has kappa = 1 in (5).
    """

    left_rows: Any
    left: FloatArray
    right_rows: Any
    right: FloatArray
    radius: float | None
    component: _Component | None = None
    is_uncertain: bool = False


def bound_errors(problem: Problem, impulse: FloatArray, linear: Linear) -> tuple[FloatArray, FloatArray]:
    """Bound the errors of an answer row by row; rows for which no bound is known have inf.

    Parameters
    ----------
    problem : Problem
    impulse : (m,), N s
    linear : Linear
        Derivative of `problem.disk` at `problem.on_disk(impulse)`.

    Returns
    -------
    impulse_error, margin_error : (m,), N s (N m s on angular rows)
        Error bounds of the impulses and of `linear.margin`, both in the rows of `problem.disk`.
    """
    disk, m = problem.disk, problem.m
    impulse_error, margin_error = np.full(m, np.inf), np.full(m, np.inf)
    if m == 0 or disk.max_entries > MAX_MATRIX_ENTRIES or not np.isfinite(linear.residual).all():
        return impulse_error, margin_error
    with np.errstate(all="ignore"):  # An island with an overflow has no bound.
        scaled = _Scaled(problem, impulse, linear)
        for rows in group_rows_by_island(disk, disk.cones.ptr):
            if len(rows) > MAX_ISLAND_ROWS:
                continue
            errors = _Island(scaled, rows).bound()
            if errors is not None:
                impulse_error[rows], margin_error[rows] = errors
    for error in (impulse_error, margin_error):
        error[~np.isfinite(error)] = np.inf
    return impulse_error, margin_error


def bound_slack_rounding(problem: Problem, impulse: FloatArray) -> FloatArray:
    """Bound the rounding (m,) [m/s] of w = A lambda - b as the judge computes it, without errors of solving with M."""
    x, b = np.abs(impulse), np.abs(problem.b)
    if problem.matrix is not None:
        operations: Any = np.diff(problem.csr.indptr) + 8.0
        return np.asarray(UNIT_ROUNDOFF * operations * (abs(problem.csr) @ x + b))
    assert problem.compliance is not None
    jac = abs(problem.jacobian)
    operations = 2.0 * np.diff(jac.indptr) + np.bincount(jac.indices, minlength=1).max() + 16.0
    if problem.generalized is None:
        assert problem.rows is not None
        inverse, free = abs(problem.rows.inverse_mass_matrix()), np.abs(problem.rows.v_free.ravel())
        terms = jac @ (inverse @ (jac.T @ x) + free)
    else:
        y = abs(problem.whitened)
        operations = operations + 2.0 * np.diff(y.indptr)
        terms = y @ (y.T @ x) + jac @ np.abs(problem.generalized.v_free)
    return np.asarray(UNIT_ROUNDOFF * operations * (terms + problem.compliance * x + b))


def bound_mass_rounding(problem: Problem) -> FloatArray:
    """Bound the relative rounding (m,) of M^-1 in the norm of M, for each row, by the condition of M's trees."""
    general = problem.generalized
    if general is None:
        return np.zeros(problem.m)
    rounding_of_tree = np.zeros(int(general.trees.max(initial=-1)) + 1)
    mass = general.mass
    if mass.nnz > general.nv:
        order = np.argsort(general.trees, kind="stable")
        sizes = np.bincount(general.trees)
        for tree, velocities in enumerate(np.split(order, np.cumsum(sizes)[:-1])):
            n = len(velocities)
            if n == 1:
                continue
            rounding_of_tree[tree] = np.inf
            if n > MAX_ISLAND_ROWS:
                continue
            block = mass[velocities][:, velocities].toarray()
            root = np.sqrt(np.diagonal(block))
            block = block / (root[:, None] * root)
            inverse = _invert(block)
            if inverse is not None:
                rounding_of_tree[tree] = (n + 8) * UNIT_ROUNDOFF * _inf_norm(block) * _inf_norm(inverse)
    rounding_of_tree += 8 * UNIT_ROUNDOFF
    jac = general.jac
    out = np.zeros(problem.m)
    np.maximum.at(
        out,
        np.repeat(np.arange(problem.m), np.diff(jac.indptr)),
        rounding_of_tree[general.trees[jac.indices]],
    )
    return out


class _Scaled:
    """A problem's answer in the metric of d, with bounds of rounding, and the derivative of its projection."""

    def __init__(self, problem: Problem, impulse: FloatArray, linear: Linear) -> None:
        disk = problem.disk
        cones = disk.cones
        self.disk, self.is_cone, self.ptr = disk, disk.friction == "cone", cones.ptr
        self.block_of = np.repeat(np.arange(cones.n_blocks), np.diff(cones.ptr))
        self.is_contact = cones.is_contact[self.block_of]  # (m,)
        self.root, self.case = linear.root, linear.case
        z, w = self.root * linear.impulse, linear.slack
        s = w / self.root
        self.y, self.f, self.margin = z - s, linear.residual, self.root * linear.margin
        self.normal_impulse = z - self.f  # This is Pi(y); its entries at normal rows are used.
        self.power = linear.impulse * (w + disk.b)  # Products lambda_i (A lambda)_i.
        rounding = bound_slack_rounding(problem, impulse)
        if problem is not disk:
            rounding = problem.cones.stretch * rounding + 4 * UNIT_ROUNDOFF * np.abs(disk.b)
        self.mass_rounding = bound_mass_rounding(disk)
        self.y_rounding = rounding / self.root + 4 * UNIT_ROUNDOFF * (np.abs(z) + np.abs(s))
        # P is stored block by block: one diagonal entry for a bounded row, the rows of a square matrix for a contact.
        size = np.where(self.is_contact, np.diff(cones.ptr)[self.block_of], 1)
        first = np.where(self.is_contact, cones.ptr[self.block_of], np.arange(disk.m))
        self.p, self.p_ptr, self.p_columns = (
            linear.p,
            np.append(0, np.cumsum(size)),
            _list_ranges(first, first + size),
        )
        # Index of each row within its island, which `_Island` sets.
        self.local_row = np.zeros(disk.m, np.intp)
        self.components: dict[int, list[_Component]] = {}
        coefficient = cones.friction_coefficient
        for block, rows in cones.friction_components():
            if coefficient[rows[0]] > 0.0:
                block_rows = np.arange(cones.ptr[block], cones.ptr[block + 1])
                a = float(coefficient[rows[0]] * self.root[rows[0]] / self.root[block_rows[0]])
                self.components.setdefault(block, []).append(_Component(rows, block_rows, a))


class _Island:
    """One island of an answer, with dense matrices and its rows numbered from 0."""

    def __init__(self, scaled: _Scaled, rows: IntArray) -> None:
        n, local_row = len(rows), scaled.local_row
        local_row[rows] = np.arange(n)
        self.is_cone, self.root = scaled.is_cone, scaled.root[rows]
        a = scaled.disk.csr
        entries = _list_ranges(a.indptr[rows], a.indptr[rows + 1])
        row_of = np.repeat(np.arange(n), a.indptr[rows + 1] - a.indptr[rows])
        self.h = np.zeros((n, n))
        self.h[row_of, local_row[a.indices[entries]]] = a.data[entries]
        self.h /= self.root[:, None] * self.root
        self.f, self.y, self.case = scaled.f[rows], scaled.y[rows], scaled.case[rows]
        self.margin, self.normal_impulse = scaled.margin[rows], scaled.normal_impulse[rows]
        self.is_contact = scaled.is_contact[rows]
        mass_rounding = float(scaled.mass_rounding[rows].max(initial=0.0))
        energy = np.sqrt(max(float(scaled.power[rows].sum()), 0.0))
        self.y_rounding = scaled.y_rounding[rows] + mass_rounding * energy
        # Rounding of H: entries of a given matrix are rounded by the scaling only; H formed by products of J and M
        # has terms of size |H_ij| <= 1.
        self.h_rounding = (4 * UNIT_ROUNDOFF) * np.abs(self.h)
        if scaled.disk.matrix is None:
            self.h_rounding = self.h_rounding + (64 * UNIT_ROUNDOFF + mass_rounding)
        entries = _list_ranges(scaled.p_ptr[rows], scaled.p_ptr[rows + 1])
        row_of = np.repeat(np.arange(n), scaled.p_ptr[rows + 1] - scaled.p_ptr[rows])
        self.p = np.zeros((n, n))
        self.p[row_of, local_row[scaled.p_columns[entries]]] = scaled.p[entries]
        self.contacts, self.components = list[tuple[Any, list[_Component]]](), list[_Component]()
        self.f_rounding = self.y_rounding.copy()
        for block in np.unique(scaled.block_of[rows[self.is_contact]]).tolist():
            block_rows = local_row[scaled.ptr[block] : scaled.ptr[block + 1]]
            components = [
                _Component(local_row[c.rows], block_rows, c.coefficient)
                for c in scaled.components.get(block, [])
            ]
            self.contacts.append((block_rows, components))
            self.components += components
            # Pi of a contact has the Lipschitz constant 1 + a.
            lipschitz = 1.0 + _norm([c.coefficient for c in components])
            rounding = 32 * UNIT_ROUNDOFF * _norm(self.y[block_rows])
            self.f_rounding[block_rows] += lipschitz * _norm(self.y_rounding[block_rows]) + rounding

    def bound(self) -> tuple[FloatArray, FloatArray] | None:
        """Compute error bounds of impulses and of margins, (n,) [N s] each; return None if there is no bound."""
        possible = np.isfinite(self.margin)
        uncertain, x = np.zeros(len(self.f), bool), np.zeros(len(self.f))
        for step in range(2 * MAX_UNCERTAINTY_STEPS):
            outcome = self._bound_with_uncertain_rows(uncertain, x)
            if outcome is None:
                return None
            errors, x, more = outcome
            if errors is None and more is None:
                if uncertain[possible].all():
                    return None
                more = possible
            elif errors is not None:
                margin_error = self._bound_margins(x)
                more = possible & ~uncertain & (self.margin <= margin_error)
                if not more.any():
                    return errors / self.root, margin_error / self.root
            uncertain = uncertain | (possible if step >= MAX_UNCERTAINTY_STEPS else more)
        return None

    def _bound_margins(self, x: FloatArray) -> FloatArray:
        """Bound the change (n,) of scaled margins by their Lipschitz constants, for |dy| <= x (n,)."""
        out = x.copy()
        for block, components in self.contacts:
            block_norm, friction = _norm(x[block]), 0.0
            # Bound the change of the normal component of the projection.
            normal_change = block_norm if self.is_cone else x[block[0]]
            for c in components:
                size = _norm(x[c.rows])
                friction += c.coefficient * size
                out[c.rows] = size + c.coefficient * normal_change
            if self.is_cone:
                out[block[0]] = max(block_norm, x[block[0]] + friction)
        return out

    def _build_error_groups(self, uncertain: Any, x: FloatArray) -> tuple[FloatArray, list[_Group]]:
        """Choose P0 of (1), and the groups of L and R, for the set of uncertain rows and |dy| <= x (n,)."""
        p, groups = self.p.copy(), list[_Group]()
        half = np.eye(1)
        for i in np.flatnonzero(uncertain & ~self.is_contact):
            p[i, i] = 0.5
            groups.append(
                _Group(left_rows=np.array([i]), left=half, right_rows=np.array([i]), right=half, radius=0.5)
            )
        for block, components in self.contacts:
            unit = np.eye(len(block))
            has_uncertain = any(uncertain[c.rows[0]] for c in components)
            if uncertain[block[0]] or (self.is_cone and has_uncertain and len(components) > 1):
                a = _norm([c.coefficient for c in components])
                radius = 0.5 if self.is_cone else 0.5 * (a + np.sqrt(a * a + 1.0))
                p[np.ix_(block, block)] = 0.5 * unit
                groups.append(_Group(left_rows=block, left=unit, right_rows=block, right=unit, radius=radius))
                continue
            for c in components if self.case[block[0]] != CASES["open"] else ():
                if uncertain[c.rows[0]]:
                    groups += self._make_stick_or_slide_groups(c, x, p)
                elif self.case[c.rows[0]] == CASES["slides"] and len(c.rows) > 1:
                    groups.append(self._make_sliding_group(c, False))
        return p, groups

    def _make_sliding_group(self, c: _Component, is_uncertain: bool) -> _Group:
        """Build the group of (5) of a sliding component."""
        if self.is_cone:
            unit = np.eye(len(c.block))
            return _Group(
                left_rows=c.block,
                left=unit,
                right_rows=c.block,
                right=unit,
                radius=None,
                component=c,
                is_uncertain=is_uncertain,
            )
        right = np.concatenate([c.block[:1], c.rows])
        return _Group(
            left_rows=c.rows,
            left=np.eye(len(c.rows)),
            right_rows=right,
            right=np.eye(len(right)),
            radius=None,
            component=c,
            is_uncertain=is_uncertain,
        )

    def _make_stick_or_slide_groups(self, c: _Component, x: FloatArray, p: FloatArray) -> list[_Group]:
        """Return the groups of a component that may stick or slide in a closed contact, and write P0 of (1) to p.

        P0 is the middle of the values that the derivative of the projection may have; the groups bound the deviation
        from it. If the direction of sliding is known, only the change along it is uncertain.
        """
        t, a, unit = _norm(self.y[c.rows]), c.coefficient, np.eye(len(c.block))
        if not _norm(x[c.rows]) < 0.5 * t:  # The direction of sliding is not known.
            if self.is_cone:
                p[np.ix_(c.block, c.block)] = 0.5 * unit
                return [_Group(left_rows=c.block, left=unit, right_rows=c.block, right=unit, radius=0.5)]
            p[np.ix_(c.rows, c.block)] = 0.0
            p[c.rows, c.rows] = 0.5
            right = np.concatenate([c.block[:1], c.rows])
            return [
                _Group(
                    left_rows=c.rows,
                    left=np.eye(len(c.rows)),
                    right_rows=right,
                    right=np.eye(len(right)),
                    radius=float(np.sqrt(a * a + 0.25)),
                )
            ]
        u, length = self.y[c.rows] / t, float(np.sqrt(1.0 + a * a))
        across = np.concatenate([[a], -u])[:, None] / length
        rows = np.concatenate([c.block[:1], c.rows])
        turning = [self._make_sliding_group(c, True)] if len(c.rows) > 1 else []
        if self.is_cone:
            p[np.ix_(c.block, c.block)] = unit
            p[np.ix_(rows, rows)] -= 0.5 * across @ across.T
            return [
                _Group(left_rows=rows, left=across, right_rows=rows, right=across, radius=0.5, component=c),
                *turning,
            ]
        p[np.ix_(c.rows, c.block)] = 0.0
        p[c.rows, c.rows] = 1.0
        p[np.ix_(c.rows, rows)] += 0.5 * length * u[:, None] @ across.T
        return [
            _Group(
                left_rows=c.rows,
                left=u[:, None],
                right_rows=rows,
                right=across,
                radius=0.5 * length,
                component=c,
            ),
            *turning,
        ]

    def _compute_radius(self, group: _Group, x: FloatArray) -> float:
        """Return the bound e of a group for |dy| <= x (n,): its radius, or else (5); inf if y_t may reverse."""
        c = group.component
        if c is None:
            assert group.radius is not None
            return group.radius
        t, a, normal = _norm(self.y[c.rows]), c.coefficient, self.normal_impulse[c.block[0]]
        x_t, x_n = _norm(x[c.rows]), _norm(x[c.block]) if self.is_cone else x[c.block[0]]
        if not x_t < 0.5 * t:
            return np.inf
        if group.radius is not None:
            return group.radius
        kappa, turn = min(a * normal / t, 1.0), x_t / (t - x_t)
        if group.is_uncertain:  # P0 has kappa = 1.
            kappa, turn = 1.0, turn + (abs(t - a * normal) + x_t + a * x_n) / (t - x_t)
        return float((a * x_n + kappa * x_t) / (t - x_t) + (kappa + a) * turn)

    def _bound_with_uncertain_rows(
        self, uncertain: Any, guess: FloatArray
    ) -> tuple[FloatArray | None, FloatArray, Any] | None:
        """Bound |dz| and |dy| if the rows `uncertain` (n,) are uncertain, starting from |dy| <= `guess` (n,).

        Returns
        -------
        errors, x, more
            Bounds of |dz| (n,) and |dy| (n,), and None. If further rows became uncertain: None, the bound of |dy|, and
            a mask (n,) of these rows. If neither (3) nor (4) contracts: None, the bound of |dy|, None. If G is
            singular, None replaces the tuple.
        """
        n = len(self.f)
        p, groups = self._build_error_groups(uncertain, guess)
        g = np.eye(n) - p + p @ self.h
        inverse = _invert(g)
        if inverse is None:
            return None
        size = np.abs(inverse)
        error = _inf_norm(np.eye(n) - inverse @ g) + (n + 4) * UNIT_ROUNDOFF * _inf_norm(size @ np.abs(g))
        error += _inf_norm(size @ (np.abs(p) @ self.h_rounding))
        if not error < MAX_INVERSE_ERROR:
            return None
        error /= 1.0 - error
        change_of_y = np.eye(n) - self.h
        t = change_of_y @ inverse
        dz = np.abs(inverse @ self.f) + size @ self.f_rounding
        dy = np.abs(t @ self.f) + np.abs(t) @ self.f_rounding
        inverse_error = error * dz.max()  # Error of dz caused by the error of the computed G^-1.
        dz += inverse_error
        dy += np.abs(change_of_y).sum(axis=1) * inverse_error + self.h_rounding @ dz
        if not groups:
            return dz * SUM_ROUNDING_FACTOR, dy * SUM_ROUNDING_FACTOR + self.y_rounding, None
        left, left_ptr = _stack_columns(n, [(q.left_rows, q.left) for q in groups])
        right, right_ptr = _stack_columns(n, [(q.right_rows, q.right) for q in groups])
        on_y, on_z = t @ left, inverse @ left
        coupling, begin = right.T @ on_y, np.abs(right.T) @ dy
        coupling_error = float(np.sqrt(n)) * error * (1.0 + _inf_norm(self.h)) * _inf_norm(inverse)
        x = np.maximum(guess, 2.0 * (dy + self.y_rounding))
        for _ in range(MAX_RADIUS_STEPS):
            radius = np.array([self._compute_radius(group, x) for group in groups])
            if not np.isfinite(radius).all():
                # Rows of groups that need a known direction become uncertain, since x is too large for it.
                more = np.zeros(n, bool)
                for group, e in zip(groups, radius, strict=True):
                    if e == np.inf and group.component is not None:
                        more[group.component.rows[0]] = True
                return None, x, more
            v = _bound_group_terms(coupling, begin, radius, left_ptr, right_ptr, coupling_error)
            if v is None:
                return None, x, None
            step_z = _compute_group_norms(on_z, left_ptr) @ v
            step_y = _compute_group_norms(on_y, left_ptr) @ v
            y = (dy + step_y + coupling_error * v.sum()) * SUM_ROUNDING_FACTOR + self.y_rounding
            if (y <= x).all():
                return (dz + step_z + coupling_error * v.sum()) * SUM_ROUNDING_FACTOR, y, None
            x = np.maximum(x, 2.0 * y)
        return None, x, None


def _bound_group_terms(
    coupling: FloatArray,
    begin: FloatArray,
    radius: FloatArray,
    left_ptr: IntArray,
    right_ptr: IntArray,
    coupling_error: float,
) -> FloatArray | None:
    """Bound |v_g| of each group by (3) and (4), the smaller of both; None if neither contracts.

    `coupling` is R^T T L, with an error of at most `coupling_error` in its norm; `begin` is |R^T T F|; `radius` holds
    e of each group; `left_ptr` and `right_ptr` (groups + 1,) are the first columns of each group.
    """
    bounds = []
    norms = np.sqrt(
        np.add.reduceat(np.add.reduceat(coupling**2, right_ptr[:-1], axis=0), left_ptr[:-1], axis=1)
    )
    q, own = (norms + coupling_error) * radius, np.sqrt(np.add.reduceat(begin**2, right_ptr[:-1]))
    system = (1.0 - CONTRACTION_MARGIN) * np.eye(len(radius)) - q
    try:
        sizes = np.linalg.solve(system, own * SUM_ROUNDING_FACTOR + np.finfo(float).tiny)
    except np.linalg.LinAlgError:
        sizes = np.full(len(radius), np.nan)
    if (sizes > 0.0).all() and (system @ sizes >= own).all():
        bounds.append(radius * sizes)
    root = np.sqrt(radius)
    on_left, on_right = np.repeat(root, np.diff(left_ptr)), np.repeat(root, np.diff(right_ptr))
    scaled = on_right[:, None] * coupling * on_left
    if np.isfinite(scaled).all():
        norm = float(np.sqrt(_inf_norm(scaled) * _inf_norm(scaled.T)))
        if norm > LARGE_NORM:
            try:
                norm = float(np.linalg.norm(scaled, 2))
            except np.linalg.LinAlgError:
                norm = np.inf
        norm += coupling_error * float(radius.max()) + CONTRACTION_MARGIN
        if norm < 1.0:
            bounds.append(root * (_norm(on_right * begin) / (1.0 - norm)))
    return np.asarray(np.minimum.reduce(bounds)) if bounds else None


def _list_ranges(first: IntArray, end: IntArray) -> IntArray:
    """Return the concatenation of the ranges first[i], ..., end[i] - 1 over all i."""
    size = end - first
    return np.asarray(np.repeat(first - (np.cumsum(size) - size), size) + np.arange(size.sum()))


def _stack_columns(n: int, blocks: list[tuple[IntArray, FloatArray]]) -> tuple[FloatArray, IntArray]:
    """Return all columns of blocks (rows, values) as one matrix (n, all), and the offsets of the blocks in it."""
    ptr = np.cumsum([0, *(values.shape[1] for _, values in blocks)])
    out = np.zeros((n, int(ptr[-1])))
    for (rows, values), first, end in zip(blocks, ptr, ptr[1:], strict=False):
        out[rows, first:end] = values
    return out, ptr


def _compute_group_norms(matrix: FloatArray, ptr: IntArray) -> FloatArray:
    """Compute the norm of each row's entries in each group of columns, (n, groups)."""
    return np.asarray(np.sqrt(np.add.reduceat(matrix**2, ptr[:-1], axis=1)))


def _norm(x: Any) -> float:
    return float(np.linalg.norm(x))


def _inf_norm(a: FloatArray) -> float:
    return float(np.abs(a).sum(axis=1).max(initial=0.0))


def _invert(a: FloatArray) -> FloatArray | None:
    try:
        return np.asarray(np.linalg.inv(a), float)
    except np.linalg.LinAlgError:
        return None
