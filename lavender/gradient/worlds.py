"""Gradients of the worlds of a batch in one compiled loop, as arrays of the batch's shape.

    solutions = lavender.solve_many(batch, tol=1e-10)
    gradients = lavender.derivatives(batch, solutions).vjp(velocity=y)      # y (n, nv)
    gradients.v_free, gradients.mu, gradients.J                             # (n, nv), (n, k), (n, m, nv)

The formulas are (4) and (5) of `lavender.gradient.derivative`. A world that the loop does not support (a singular or
large system, a residual above the accepted one) is differentiated as a problem of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, resolve_index
from lavender.base.errors import CapabilityError, InputError
from lavender.batch.data import Batch
from lavender.gradient.derivative import MAX_ACCEPTED_RESIDUAL, Derivative, derivative
from lavender.gradient.result import Gradient
from lavender.gradient.system import MAX_KERNEL_ROWS
from lavender.problem.derived import cached_property
from lavender_ext.batch.many import adjoin_worlds
from lavender_ext.judge.measure import all_finite


class WorldGradients(Sequence[Gradient]):
    """Gradients of a scalar by the data of a batch, in the shapes of the batch; `[i]` is the `Gradient` of world i.

    Parameters
    ----------
    b, target, compliance : shape of the impulses
    v_free : shape of the velocities
    mu : (n, k), or if worlds have cones of their own all blocks
        By the coefficient of each block; 0 for bounded rows.
    J, M : (n, m, nv), (n, nv, nv)
        Of a stacked batch, with entries outside of the sparsity pattern; M is symmetric.
    """

    def __init__(self, of: WorldDerivatives, cotangents: dict[str, Any]) -> None:
        batch = of.batch
        self._of = of
        self._cotangents = cotangents
        rows, velocities = int(np.prod(batch.shape)), int(np.prod(batch.velocity_shape))
        self._rows = np.zeros((3, rows))  # q, s and e
        self._velocities = np.zeros((3, velocities))  # f, p and v'
        flat = [
            None if x is None else np.ascontiguousarray(x, float).reshape(-1)
            for x in cotangents.values()
        ]
        worlds = batch.make_kernel_worlds(of.impulse.copy(), np.zeros(velocities), False)
        left = list(range(len(batch)))
        if all(x is None or all_finite(x) for x in flat) and len(batch):
            left = adjoin_worlds(
                worlds,
                MAX_KERNEL_ROWS,
                MAX_ACCEPTED_RESIDUAL,
                flat,
                [*self._rows, *self._velocities],
            )
        self._separate = {i: self._differentiate(i) for i in left}
        for i, gradient in self._separate.items():
            place = of.place(i)
            s, e = gradient._s, gradient._by_row_coefficient
            self._rows[:, place[0]] = gradient._q, s, e
            d = gradient._derivative
            self._velocities[:, place[1]] = gradient._f, gradient._p, d._velocity_change

    def _differentiate(self, i: int) -> Gradient:
        """Return the gradient of world i as a problem of its own."""
        rows, velocities = self._of.place(i)
        own = {
            name: None
            if x is None
            else np.reshape(x, -1)[velocities if name == "velocity" else rows]
            for name, x in self._cotangents.items()
        }
        try:
            return self._of[i].vjp(**own)
        except InputError as error:
            raise InputError(f"world {i}: {error}") from None

    def __len__(self) -> int:
        return len(self._of)

    def __getitem__(self, i: Any) -> Any:
        i = resolve_index(i, len(self))
        if isinstance(i, list):
            return [self[j] for j in i]
        return self._separate.get(i) or self._differentiate(i)

    def _check(self, name: str) -> None:
        """Raise the error of a world in which this gradient does not exist."""
        for i, gradient in self._separate.items():
            try:
                getattr(gradient, name)
            except CapabilityError as error:
                raise CapabilityError(f"world {i}: {error}") from None

    @cached_property
    def target(self) -> FloatArray:
        """By the targets of the rows."""
        self._check("target")
        return self._rows[1].reshape(self._of.batch.shape)

    b = target

    @cached_property
    def compliance(self) -> FloatArray:
        """By the compliances of the rows."""
        self._check("compliance")
        return -self.target * self._of.impulse.reshape(self._of.batch.shape)

    @cached_property
    def v_free(self) -> FloatArray:
        """By the velocities without constraint impulses."""
        return self._velocities[0].reshape(self._of.batch.velocity_shape)

    @cached_property
    def mu(self) -> FloatArray:
        """By the coefficients of friction of the blocks."""
        self._check("mu")
        batch = self._of.batch
        at, cones = batch.at, batch.cones
        sizes = at["blocks"]
        within = np.arange(int(sizes.sum())) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        block = within + np.repeat(at["block"], sizes)
        shift = np.repeat(at["row"] - at["cone_row"], sizes)
        first = cones.ptr[block] + 1 + shift
        has_friction = cones.n_tangents[block] > 0
        out = np.where(has_friction, self._rows[2][np.where(has_friction, first, 0)], 0.0)
        second = cones.separate_rows[block]
        paired = (second >= 0) & has_friction
        out[paired] += (cones.patch_radius[block] * self._rows[2][second + shift])[paired]
        return out.reshape(len(sizes), cones.n_blocks) if batch._has_shared_cones else out

    def _stack(self) -> tuple[FloatArray, ...]:
        """Return lambda and s (n, m), and p, v' and v+ (n, nv), of a stacked batch."""
        batch = self._of.batch
        if len(batch.shape) != 2:
            raise CapabilityError(
                "gradients by J and M of all worlds need a stacked batch; gradients[i] has those of world i"
            )
        rows, velocities = batch.shape, batch.velocity_shape
        impulse, s = self._of.impulse.reshape(rows), self._rows[1].reshape(rows)
        p, change = (x.reshape(velocities) for x in self._velocities[1:])
        return impulse, s, p, change, batch.stack_free_velocities() + change

    @cached_property
    def J(self) -> FloatArray:
        """By the rows of a stacked batch, for fixed targets and v*."""
        self._check("J")
        impulse, s, p, _, velocity = self._stack()
        return impulse[:, :, None] * p[:, None, :] - s[:, :, None] * velocity[:, None, :]

    @cached_property
    def M(self) -> FloatArray:
        """By the mass matrices of a stacked batch, symmetric, for fixed targets and v*."""
        _, _, p, change, _ = self._stack()
        product = p[:, :, None] * change[:, None, :]
        return -0.5 * (product + product.transpose(0, 2, 1))


class WorldDerivatives(Sequence[Derivative]):
    """Derivatives of the worlds of a batch at their solutions; `[i]` is the `Derivative` of world i."""

    def __init__(self, batch: Batch, impulse: FloatArray) -> None:
        self.batch = batch
        self.impulse = impulse  # Flat array of all impulses [N s].

    def place(self, i: int) -> tuple[slice, slice]:
        """Return the slices of world i in flat arrays of impulses and of velocities."""
        first, count = (int(self.batch.at[i][name]) for name in ("velocity", "velocities"))
        return self.batch.rows_of(i), slice(first, first + count)

    def __len__(self) -> int:
        return len(self.batch)

    def __getitem__(self, i: Any) -> Any:
        i = resolve_index(i, len(self))
        if isinstance(i, list):
            return [self[j] for j in i]
        return derivative(self.batch[i], self.impulse[self.place(i)[0]])

    def vjp(
        self, *, velocity: Any = None, impulse: Any = None, slack: Any = None
    ) -> WorldGradients:
        """Compute the gradients of the sum of velocity . v+ + impulse . lambda + slack . w over all worlds.

        Parameters
        ----------
        velocity : shape of the batch's velocities, optional
        impulse, slack : shape of the batch's impulses, optional
            Cotangents as for `Derivative.vjp`.

        Raises
        ------
        InputError
            A shape or number is not valid, all cotangents are None, or the impulse of a world is not a solution.
        CapabilityError
            As `Derivative.vjp` of a world.
        """
        batch = self.batch
        cotangents = {"velocity": velocity, "impulse": impulse, "slack": slack}
        if all(x is None for x in cotangents.values()):
            raise InputError("all cotangents are None; velocity, impulse or slack is needed")
        for name, x in cotangents.items():
            needed = batch.velocity_shape if name == "velocity" else batch.shape
            if x is not None and np.shape(x) != needed:
                raise InputError(f"{name} has shape {np.shape(x)}; {needed} is needed")
        return WorldGradients(self, cotangents)
