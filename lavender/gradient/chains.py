"""Chain rules: from coefficients of rows to coefficients of contacts, and from J and M^-1 to the arrays of bodies."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.base.lazy_import import sparse as sp
from lavender.gradient.result import BODIES, Gradient
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


class BodyChain:
    """Chain rule from J and M^-1 to the arrays of `Rows`.

    A row of a contact along an axis a is (-a, -arm_a x a, a, arm_b x a), a spin or rolling row (0, -a, 0, a), on the
    columns of both bodies; t2 = n x t1.

    Parameters
    ----------
    derivative : Derivative

    Attributes
    ----------
    row, axis, contact, is_angular : (n,)
        For each row of contacts: its index, its axis (0, 1, 2 for n, t1, t2), its contact, and whether it is a spin or
        rolling row.
    axes : (c, 3, 3)
        n, t1 and t2 of each contact.
    columns : (m, 12) int
        Columns of J for each row.
    is_moving : (m, 12) bool
        Whether the column belongs to a moving body.
    """

    def __init__(self, derivative: Any) -> None:
        rows, cones = derivative.problem.rows, derivative.problem.cones
        if rows is None:
            raise CapabilityError(
                f"{', '.join(BODIES)} exist only for problems with bodies (Problem.from_rows)"
            )
        self.derivative, self.rows = derivative, rows
        kj, mj = rows.n_joints, len(rows.jac)
        first, tangents = cones.ptr[kj:-1], cones.n_tangents[kj:]
        spin, rolling = cones.spin_rows[kj:], cones.rolling_rows[kj:]
        groups = [(first, 0, False)]
        groups += [(np.where(tangents >= axis, first + axis, -1), axis, False) for axis in (1, 2)]
        groups += [(spin, 0, True), (rolling, 1, True), (np.where(rolling >= 0, rolling + 1, -1), 2, True)]
        row, axes_of_rows, contact, angular = [], [], [], []
        for row_of_contact, axis, is_angular in groups:
            contacts = np.flatnonzero(row_of_contact >= 0)
            row.append(row_of_contact[contacts])
            axes_of_rows.append(np.full(len(contacts), axis))
            contact.append(contacts)
            angular.append(np.full(len(contacts), is_angular))
        self.row, self.axis, self.contact, self.is_angular = map(
            np.concatenate, (row, axes_of_rows, contact, angular)
        )
        self.axes = np.stack([rows.normal, rows.tangent, np.cross(rows.normal, rows.tangent)], axis=1)
        body = np.empty((cones.n_rows, 2), np.int64)
        body[:mj] = np.repeat(rows.joint_body, np.diff(rows.joint_ptr), axis=0)
        body[mj:] = np.repeat(rows.contact_body, np.diff(cones.ptr[kj:]), axis=0)
        self.mj, self.body = mj, body
        self.columns = (6 * np.maximum(body, 0)[:, :, None] + np.arange(6)).reshape(-1, 12)
        self.is_moving = np.repeat(body >= 0, 6, axis=1)

    def convert_to_body_gradients(self, g: Gradient) -> dict[str, FloatArray]:
        """Compute the gradients by every array from those by J and M^-1."""
        derivative, r, columns = self.derivative, self.rows, self.columns
        entries = np.zeros(columns.shape)
        if r.n_bodies:
            for u, v in g._list_outer_product_pairs("J"):
                entries += u[:, None] * v[columns]
        entries[~self.is_moving] = 0.0
        lin_a, ang_a, lin_b, ang_b = np.split(entries[self.row], 4, axis=1)
        a, arm_a, arm_b = self.axes[self.contact, self.axis], r.arm_a[self.contact], r.arm_b[self.contact]
        is_angular = self.is_angular[:, None]
        by_axis = np.where(
            is_angular, ang_b - ang_a, lin_b - lin_a - np.cross(ang_a, arm_a) + np.cross(ang_b, arm_b)
        )
        axes, out = np.zeros((r.n_contacts, 3, 3)), {"jac": entries[: self.mj]}
        np.add.at(axes, (self.contact, self.axis), by_axis)
        out["normal"] = axes[:, 0] + np.cross(r.tangent, axes[:, 2])
        out["tangent"] = axes[:, 1] + np.cross(axes[:, 2], r.normal)  # pyright: ignore[reportArgumentType]
        for name, x in (("arm_a", -np.cross(a, ang_a)), ("arm_b", np.cross(a, ang_b))):
            out[name] = np.zeros((r.n_contacts, 3))
            np.add.at(out[name], self.contact, np.where(is_angular, 0.0, x))
        # v+ = v* + M^-1 J^T lambda, so the gradient by M^-1 is (y - J^T s) (J^T lambda)^T.
        left = g.v_free.reshape(-1, 6)
        right = derivative._apply_jacobian_transposed(derivative._impulse).reshape(-1, 6)
        out["inv_mass"] = np.einsum("ij,ij->i", left[:, :3], right[:, :3])
        tensor = np.einsum("ij,ik->ijk", left[:, 3:], right[:, 3:])
        out["inv_inertia"] = 0.5 * (tensor + tensor.transpose(0, 2, 1))
        return out

    def compute_jacobian_change(self, changes: dict[str, Any]) -> sp.csr_array | None:
        """Compute the change of J (m, 6 n) caused by changes of the arrays; None if J does not change."""
        r = self.rows
        if not any(name in changes for name in BODIES[:5]):
            return None
        entries = np.zeros(self.columns.shape)
        entries[: self.mj] = changes.get("jac", 0.0)
        dn, dt = (changes.get(name, np.zeros((r.n_contacts, 3))) for name in ("normal", "tangent"))
        axes = np.stack([dn, dt, np.cross(dn, r.tangent) + np.cross(r.normal, dt)], axis=1)
        a, da = self.axes[self.contact, self.axis], axes[self.contact, self.axis]
        angular = []
        for name in ("arm_a", "arm_b"):
            arm = getattr(r, name)[self.contact]
            d_arm = changes.get(name, np.zeros((r.n_contacts, 3)))[self.contact]
            angular.append(np.where(self.is_angular[:, None], da, np.cross(arm, da) + np.cross(d_arm, a)))
        linear = np.where(self.is_angular[:, None], 0.0, da)
        entries[self.row] = np.hstack([-linear, -angular[0], linear, angular[1]])
        stored = self.is_moving
        indptr = np.concatenate([[0], np.cumsum(stored.sum(axis=1))])
        return sp.csr_array(
            (entries[stored], self.columns[stored], indptr), shape=self.derivative.problem.jacobian.shape
        )

    def apply_inverse_mass_change(self, changes: dict[str, Any], force: FloatArray) -> FloatArray:
        """Compute dM^-1 f (6 n,) for forces and torques f (6 n,)."""
        f = force.reshape(-1, 6)
        out = np.zeros(f.shape)
        if "inv_mass" in changes:
            out[:, :3] = changes["inv_mass"][:, None] * f[:, :3]
        if "inv_inertia" in changes:
            out[:, 3:] = np.einsum("ijk,ik->ij", changes["inv_inertia"], f[:, 3:])
        return out.ravel()
