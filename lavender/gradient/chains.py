"""From reaches to the coefficients of contacts, and from J and M^-1 to the arrays of bodies."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.base.lazy_import import sparse as sp
from lavender.gradient.result import BODIES, Gradient
from lavender.problem import Problem


class Parts:
    """Where the coefficients of contacts stand: first row of what slides, spin or second side, and what rolls."""

    def __init__(self, problem: Problem) -> None:
        c = problem.cones
        self.mu, self.radius = c.mu, c.patch_radius
        self.first = np.where(c.n_tangents > 0, c.ptr[:-1] + 1, -1)
        self.ellipse = c.is_ellipse
        self.second = np.where(self.ellipse, c.ptr[:-1] + 2, c.apart_rows)
        self.two = self.ellipse | c.is_box
        self.rolls = c.rolling_rows
        self.m = c.n_rows

    def gather(self, x: FloatArray, at: Any) -> FloatArray:
        """x at these rows (k,), 0 where -1 stands."""
        return np.where(at >= 0, x[np.maximum(at, 0)], 0.0) if len(x) else np.zeros(len(at))

    def reaches(
        self, mu: FloatArray | None, radius: FloatArray | None, rolling: FloatArray | None
    ) -> FloatArray:
        """The change de (m,) of the reaches by changes of the coefficients."""
        de = np.zeros(self.m)
        for at, change in (
            (self.first, None if mu is None else mu if mu.ndim == 1 else mu[:, 0]),
            (self.second, None if mu is None else self.radius * mu if mu.ndim == 1 else mu[:, 1]),
            (self.second, None if radius is None else self.mu * radius),
            (self.rolls, rolling),
        ):
            if change is not None:
                de[at[at >= 0]] += change[at >= 0]
        return de


class Bodies:
    """The chain from J and M^-1 to the arrays of `Rows`.

    A row of a contact along an axis a is (-a, -arm_a x a, a, arm_b x a), one that turns (0, -a, 0, a), on the columns
    of both bodies; t2 = n x t1.
    """

    def __init__(self, of: Any) -> None:
        rows, cones = of.problem.rows, of.problem.cones
        if rows is None:
            raise CapabilityError(f"{', '.join(BODIES)} are data of problems with bodies (Problem.from_rows)")
        self.of, self.rows = of, rows
        kj, mj = rows.n_joints, len(rows.jac)
        first, tangents = cones.ptr[kj:-1], cones.n_tangents[kj:]
        spin, roll = cones.spin_rows[kj:], cones.rolling_rows[kj:]
        pieces = [(first, 0, False)]
        pieces += [(np.where(tangents >= axis, first + axis, -1), axis, False) for axis in (1, 2)]
        pieces += [(spin, 0, True), (roll, 1, True), (np.where(roll >= 0, roll + 1, -1), 2, True)]
        self.row, self.axis, self.contact, self.turns = [], [], [], []
        for at, axis, turns in pieces:
            has = np.flatnonzero(at >= 0)
            self.row.append(at[has])
            self.axis.append(np.full(len(has), axis))
            self.contact.append(has)
            self.turns.append(np.full(len(has), turns))
        self.at, self.k, self.i, self.turn = map(
            np.concatenate, (self.row, self.axis, self.contact, self.turns)
        )
        self.axes = np.stack([rows.normal, rows.tangent, np.cross(rows.normal, rows.tangent)], axis=1)
        body = np.empty((cones.n_rows, 2), np.int64)
        body[:mj] = np.repeat(rows.joint_body, np.diff(rows.joint_ptr), axis=0)
        body[mj:] = np.repeat(rows.contact_body, np.diff(cones.ptr[kj:]), axis=0)
        self.mj, self.body = mj, body
        self.columns = (6 * np.maximum(body, 0)[:, :, None] + np.arange(6)).reshape(-1, 12)
        self.moves = np.repeat(body >= 0, 6, axis=1)

    def back(self, g: Gradient) -> dict[str, FloatArray]:
        """Gradients by every array, of those by J and M^-1."""
        o, r, columns = self.of, self.rows, self.columns
        entries = np.zeros(columns.shape)
        if r.n_bodies:
            for u, v in g._pairs("J"):
                entries += u[:, None] * v[columns]
        entries[~self.moves] = 0.0
        lin_a, ang_a, lin_b, ang_b = np.split(entries[self.at], 4, axis=1)
        a, arm_a, arm_b = self.axes[self.i, self.k], r.arm_a[self.i], r.arm_b[self.i]
        still = self.turn[:, None]
        by_axis = np.where(
            still, ang_b - ang_a, lin_b - lin_a - np.cross(ang_a, arm_a) + np.cross(ang_b, arm_b)
        )
        axes, out = np.zeros((r.n_contacts, 3, 3)), {"jac": entries[: self.mj]}
        np.add.at(axes, (self.i, self.k), by_axis)
        out["normal"] = axes[:, 0] + np.cross(r.tangent, axes[:, 2])
        out["tangent"] = axes[:, 1] + np.cross(axes[:, 2], r.normal)
        for name, x in (("arm_a", -np.cross(a, ang_a)), ("arm_b", np.cross(a, ang_b))):
            out[name] = np.zeros((r.n_contacts, 3))
            np.add.at(out[name], self.i, np.where(still, 0.0, x))
        # dM^-1: v+ has M^-1 J^T lambda, so (y - J^T s) dM^-1 (J^T lambda).
        left, right = g.v_free.reshape(-1, 6), o._wrench(o._impulse).reshape(-1, 6)
        out["inv_mass"] = np.einsum("ij,ij->i", left[:, :3], right[:, :3])
        turn = np.einsum("ij,ik->ijk", left[:, 3:], right[:, 3:])
        out["inv_inertia"] = 0.5 * (turn + turn.transpose(0, 2, 1))
        return out

    def jacobian(self, given: dict[str, Any]) -> sp.csr_array | None:
        """The change of J (m, 6 n) along changes of the arrays; None of none."""
        r = self.rows
        if not any(name in given for name in BODIES[:5]):
            return None
        entries = np.zeros(self.columns.shape)
        entries[: self.mj] = given.get("jac", 0.0)
        dn, dt = (given.get(name, np.zeros((r.n_contacts, 3))) for name in ("normal", "tangent"))
        axes = np.stack([dn, dt, np.cross(dn, r.tangent) + np.cross(r.normal, dt)], axis=1)
        a, da = self.axes[self.i, self.k], axes[self.i, self.k]
        turns = []
        for name in ("arm_a", "arm_b"):
            arm, change = getattr(r, name)[self.i], given.get(name, np.zeros((r.n_contacts, 3)))[self.i]
            turns.append(np.where(self.turn[:, None], da, np.cross(arm, da) + np.cross(change, a)))
        lin = np.where(self.turn[:, None], 0.0, da)
        entries[self.at] = np.hstack([-lin, -turns[0], lin, turns[1]])
        keep = self.moves
        indptr = np.concatenate([[0], np.cumsum(keep.sum(axis=1))])
        return sp.csr_array((entries[keep], self.columns[keep], indptr), shape=self.of.problem.jacobian.shape)

    def through(self, given: dict[str, Any], wrench: FloatArray) -> FloatArray:
        """dM^-1 f (6 n,) of wrenches f (6 n,)."""
        f = wrench.reshape(-1, 6)
        out = np.zeros(f.shape)
        if "inv_mass" in given:
            out[:, :3] = given["inv_mass"][:, None] * f[:, :3]
        if "inv_inertia" in given:
            out[:, 3:] = np.einsum("ijk,ik->ij", given["inv_inertia"], f[:, 3:])
        return out.ravel()
