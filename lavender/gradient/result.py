"""Gradients by the data of a problem, each worked out when it is asked for."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError, InputError
from lavender.base.lazy_import import issparse
from lavender.base.lazy_import import sparse as sp
from lavender.problem import OPERATORS
from lavender.problem.derived import cached_property

MATRICES = ("A", "J", "M")
BODIES = ("jac", "normal", "tangent", "arm_a", "arm_b", "inv_mass", "inv_inertia")
# What can be differentiated by, and how the problems are given that have it; of `jvp` mu= stands for coefficients, too.
INPUTS = {
    **dict.fromkeys(("b", "lower", "upper", "mu", "coefficients", "patch_radius", "rolling"), OPERATORS),
    "A": ("matrix",),
    **dict.fromkeys(("target", "v_free", "compliance", "J"), ("rows", "generalized")),
    "M": ("generalized",),
    **dict.fromkeys(BODIES, ("rows",)),
}


REACHES = ("mu", "patch_radius", "rolling")
# A change of these at one of several rows that share a load contradicts the others.
ALONE = ("b", "target", "compliance", "A", "J", "jac", "normal", "tangent", "arm_a", "arm_b")


class _Input:
    """A gradient by one name, kept where it was worked out (its descriptor gives way to the instance's own)."""

    def __init__(self, name: str) -> None:
        self.name, self.operators, self.alone = name, INPUTS[name], name in ALONE
        self.work_out = None if name in BODIES else getattr(Gradient, f"_by_{name}")

    def __get__(self, gradient: Any, owner: Any = None) -> Any:
        if gradient is None:
            return self
        name, of = self.name, gradient._of
        if self.operators is not OPERATORS and of.problem.operator not in self.operators:
            raise CapabilityError(
                f"{name} is of problems given as {' or '.join(self.operators)}, and this one was given as "
                f"{of.problem.operator}"
            )
        if self.alone and not of._plain:
            of._refuse_alone(f"no derivative by {name} exists here")
        if name in (*REACHES, "coefficients") and not of._plain:
            of._refuse_reach("mu" if name == "coefficients" else name)
        if self.work_out is None:
            gradient.__dict__.update(of._bodies.back(gradient))
            return gradient.__dict__[name]
        found = gradient.__dict__[name] = self.work_out(gradient)
        return found


class Gradient:
    """Gradients of a scalar by the data of a problem, of cotangents of its solution: `Derivative.vjp`.

    Each is worked out when first asked for, and has the shape of the data; its unit is the scalar's over the data's.
    What a problem has no data of is refused (CapabilityError), and where rows share a load in many ways
    (`Derivative.unique.target`) what changes one of them alone: targets, J, arms, compliance; under the cone law, in
    which a contact slides off at mu times its speed, coefficients of those that slide.

        b, target            (m,): by b as it is given; by the target of a problem with J and M, the same
        v_free               (nv,) or (n, 6): by v*, b = target - J v* following
        lower, upper         (m,): by the bounds that act; of lower = upper, which move together, half of it each
        mu, patch_radius, rolling   (k,): by the fields of `Cones`
        coefficients         (k, 2): by mu_1 and mu_2 of ellipses and boxes; of other contacts by mu, 0
        compliance           (m,)
        A                    (m, m): entry by entry; dense, or of a sparse A in its pattern
        J, M                 (m, nv), (nv, nv), sparse, in their patterns; M as symmetric; `full` has them whole
        jac, normal, tangent, arm_a, arm_b, inv_mass, inv_inertia   as in `Rows`

    By J, M and the arrays of bodies with target and v* given. Normals and tangents count as free vectors: of a turn
    only the part along it does.
    """

    def __init__(self, of: Any, made: FloatArray) -> None:
        self._of, self._made = of, made  # q, s (m), f (nv), c (m)

    @property
    def _q(self) -> FloatArray:
        return self._made[: self._of.m]

    @property
    def _s(self) -> FloatArray:
        m = self._of.m
        return self._made[m : 2 * m]

    @property
    def _f(self) -> FloatArray:
        # y - J^T s
        m = self._of.m
        return self._made[2 * m : len(self._made) - m]

    @cached_property
    def _p(self) -> FloatArray:
        return np.asarray(self._of._through_mass(self._f))

    @property
    def _c(self) -> FloatArray:
        return self._made[len(self._made) - self._of.m :]

    def __repr__(self) -> str:
        return f"<Gradient of {self._of.m} rows by {', '.join(self._of.inputs)}>"

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"a gradient has no {name!r}; it has {', '.join(INPUTS)}")

    def _by_b(self) -> FloatArray:
        m = self._of.m
        return self._made[m : 2 * m]

    _by_target = _by_b

    def _by_v_free(self) -> FloatArray:
        return self._f.reshape(self._of._velocities())

    @cached_property
    def _pull(self) -> FloatArray:
        # by an impulse that is moved and held: c + A^T-part of what its push changes
        o, matrix, compliance = self._of, self._of.problem.matrix, self._of.problem.compliance
        if matrix is not None:
            return np.asarray(self._c - matrix.T @ self._s)
        assert compliance is not None
        return np.asarray(self._c + o._along(self._p) - compliance * self._s)

    def _by_lower(self) -> FloatArray:
        return self._of._acting[0] * self._pull

    def _by_upper(self) -> FloatArray:
        return self._of._acting[1] * self._pull

    @cached_property
    def _reach(self) -> FloatArray:
        o = self._of
        e = o._linear.times(self._q, True, True)
        if o.problem.cones.has_ellipse:
            rows, own, through = o._axes
            e[rows] = own * self._q[rows] - through * o._linear.times(self._q, True)[rows]
        return e

    def _by_mu(self) -> FloatArray:
        parts = self._of._parts
        return parts.gather(self._reach, parts.first) + parts.radius * parts.gather(self._reach, parts.second)

    def _by_coefficients(self) -> FloatArray:
        parts = self._of._parts
        second = np.where(parts.two, parts.gather(self._reach, parts.second), 0.0)
        first = np.where(parts.two, parts.gather(self._reach, parts.first), self.mu)
        return np.stack([first, second], axis=1)

    def _by_patch_radius(self) -> FloatArray:
        parts = self._of._parts
        return parts.mu * parts.gather(self._reach, parts.second)

    def _by_rolling(self) -> FloatArray:
        parts = self._of._parts
        return parts.gather(self._reach, parts.rolls)

    def _by_compliance(self) -> FloatArray:
        return -self._s * self._of._impulse

    def _by_A(self) -> Any:
        o = self._of
        if issparse(o.problem.matrix):
            return _on(o.problem.matrix, (-self._s, o._impulse))
        return -np.outer(self._s, o._impulse)

    def _pairs(self, name: str) -> list[tuple[FloatArray, FloatArray]]:
        # (5) of A, J or M as a sum of u v^T
        o = self._of
        if name == "A":
            return [(-self._s, o._impulse)]
        p = self._p
        if name == "J":
            return [(o._impulse, p), (-self._s, o._velocity)]
        return [(-0.5 * p, o._change), (-0.5 * o._change, p)]

    def _by_J(self) -> sp.csr_array:
        return _on(self._of.problem.jacobian, *self._pairs("J"))

    def _by_M(self) -> sp.csr_array:
        general = self._of.problem.generalized
        assert general is not None
        return _on(general.mass, *self._pairs("M"))

    def full(self, name: str) -> FloatArray:
        """The whole of A, J or M, a dense array with entries outside its pattern, too."""
        if name not in MATRICES:
            raise InputError(f"full is of {', '.join(MATRICES)}; {name!r} is no matrix with a pattern")
        getattr(self, name)  # refuses what is not there
        return np.asarray(sum(np.outer(u, v) for u, v in self._pairs(name)))


def _on(pattern: Any, *pairs: tuple[FloatArray, FloatArray]) -> sp.csr_array:
    """Sum of u v^T on the pattern of a matrix in compressed rows."""
    row = np.repeat(np.arange(pattern.shape[0]), np.diff(pattern.indptr))
    data = sum(u[row] * v[pattern.indices] for u, v in pairs)
    return sp.csr_array((data, pattern.indices, pattern.indptr), shape=pattern.shape)


for _name in INPUTS:
    setattr(Gradient, _name, _Input(_name))
