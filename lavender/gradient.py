"""Derivatives of a solution by the problem's data, and where they do not exist.

A solution lambda with w = A lambda - b is a root of the natural map F of natural.pxd, block by block. Where every
block is inside one case (it sticks, slides, is open, at a bound, free), F is smooth, and with z = D^1/2 lambda

    G dz = P D^-1/2 (db - dA lambda) + D^1/2 dl + (dPi/de) de,    G = I - P + P H,   H = D^-1/2 A D^-1/2      (1)
    dA lambda = dJ v' + J M^-1 (dJ^T lambda - dM v') + dtheta lambda,   v' = M^-1 J^T lambda                  (2)
    dv = dv* + v'',   v'' = M^-1 (J^T dlambda + dJ^T lambda - dM v'),   dw = A dlambda + dA lambda - db        (3)

e are the reaches of contacts (mu, mu r, mu_r), l the bounds that act. With cotangents c of lambda, x of w and y of v,

    G^T q = D^-1/2 (c + J M^-1 y + A^T x),   s = D^-1/2 P^T q - x,   p = M^-1 (y - J^T s)                     (4)
    b: s    l: D^1/2 q    e: (dPi/de)^T q    A: -s lambda^T    theta: -s lambda                               (5)
    J: lambda p^T - s v+^T    M: -p v'^T    v*: y - J^T s   (target and v* given, so that b follows J and v*)

(the implicit function theorem and its adjoint). G is singular where rows repeat others; then

    G_eps = G + eps P,    dz <- dz + G_eps^-1 (r - G dz)                                                      (6)

ends at one of the solutions (Rockafellar 1976), and I - G_eps^-1 G, repeated, leaves of a random vector what is not
determined.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lavender._arrays import FloatArray, as_array, as_csr
from lavender._derived import cached_property
from lavender._later import issparse, lapack
from lavender._later import sparse as sp
from lavender.cones import CONTACT_BOX, CONTACT_ELLIPSE, ROW
from lavender.errors import CapabilityError, InputError
from lavender.lu import sparse_lu
from lavender.problem import OPERATORS, Problem, check_problem
from lavender.residuals import at_floor, residual
from lavender.states import States, linear_of
from lavender_ext.core.problem import rows_velocity
from lavender_ext.derivative.linear import CASES, Linear, adjoint_all, wrench

if TYPE_CHECKING:
    from lavender.motion import Motions

__all__ = ["Derivative", "Derivatives", "Gradient", "Tangent", "Unique", "derivative", "derivatives"]

ACCEPTED = 1e-8  # relative residual of an answer that is differentiated, or its floor
DENSE = 400  # rows of the system up to which it is dense
SINGULAR = 1e-12  # least pivot over the largest, from which on rows count as repeating others
SHIFT = 1e-11  # eps of (6)
TURNS = 8  # of (6): what is 1e-11 of the diagonal is off by 2^-8 then, what is 1e-9 by 1e-16
ENOUGH = 1e-14  # of the largest entry, below which a turn changes nothing
PROBES = 2  # random vectors that show what is not determined
UNMOVED = 1e-6  # of the largest entry of a probe, up to which one is rounding
MANY = 10.0  # errors of the answer within which a switch counts as one: they are estimates of first order
LOW, HIGH, FREE = CASES["low"], CASES["high"], CASES["free"]
U = 2.0**-53

Flags = npt.NDArray[np.bool_]


BODIES = ("jac", "normal", "tangent", "arm_a", "arm_b", "inv_mass", "inv_inertia")
# What can be differentiated by, and how the problems are given that have it; of `jvp` mu= stands for coefficients, too.
INPUTS = {
    **dict.fromkeys(("b", "lower", "upper", "mu", "coefficients", "patch_radius", "rolling"), OPERATORS),
    "A": ("matrix",),
    **dict.fromkeys(("target", "v_free", "compliance", "J"), ("rows", "generalized")),
    "M": ("generalized",),
    **dict.fromkeys(BODIES, ("rows",)),
}


@dataclass(frozen=True, eq=False)
class Unique:
    """What of an answer, and of its derivative, the problem determines. `str()` says what it does not."""

    impulse: Flags  # (m,) the row's impulse
    slack: Flags  # (m,) the row's slack, and velocity along it
    velocity: bool  # every body's; of a matrix that of all slacks
    target: Flags  # (m,) whether b of this row may change alone with no block changing its state
    _problem: Problem = field(repr=False)

    def __bool__(self) -> bool:
        return bool(self.impulse.all() and self.slack.all() and self.target.all())

    def __str__(self) -> str:
        lines = []
        for name, flags in (("impulse", self.impulse), ("slack", self.slack), ("target", self.target)):
            off = np.flatnonzero(~flags)
            if len(off):
                some = ", ".join(self._problem.row_name(int(i)) for i in off[:3])
                lines.append(f"{name}: not of {len(off)} rows ({some}{', ...' if len(off) > 3 else ''})")
        return "; ".join(lines) or "all of it is unique"


class _System:
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


class _Parts:
    """Where the coefficients of contacts stand: first row of what slides, spin or second side, and what rolls."""

    def __init__(self, problem: Problem) -> None:
        c = problem.cones
        self.mu, self.radius = c.mu, c.patch_radius
        self.first = np.where(c.n_tangents > 0, c.ptr[:-1] + 1, -1)
        self.ellipse = c.kind == CONTACT_ELLIPSE
        self.second = np.where(self.ellipse, c.ptr[:-1] + 2, c.apart_rows)
        self.two = self.ellipse | (c.kind == CONTACT_BOX)
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


class Gradient:
    """Gradients of a scalar by the data of a problem, of cotangents of its solution: `Derivative.vjp`.

    Each is worked out when first asked for, and has the shape of the data; its unit is the scalar's over the data's.
    What a problem has no data of is refused (CapabilityError).

    b, target : (m,)
        By b as it is given; by the target of a problem with J and M, which is the same.
    v_free : (nv,) or (n, 6)
        By v*, b = target - J v* following.
    lower, upper : (m,)
        By the bounds that act, 0 on other rows. Where lower = upper half of it each: both move together.
    mu, patch_radius, rolling : (k,)
        By the fields of `Cones`.
    coefficients : (k, 2)
        By mu_1 and mu_2 of ellipses and boxes; of other contacts by mu, 0.
    compliance : (m,)
    A : (m, m)
        Entry by entry: dense, or of a sparse A in its pattern.
    J, M : sparse, (m, nv), (nv, nv)
        In the patterns of J and M, target and v* given; by M as a symmetric matrix. `full` has them whole.
    jac, normal, tangent, arm_a, arm_b, inv_mass, inv_inertia : as in `Rows`
        By the arrays of bodies, target and v* given; by normals and tangents as free vectors: of a turn only the part
        along it counts.
    """

    def __init__(
        self,
        of: Derivative,
        q: FloatArray,
        s: FloatArray,
        y: FloatArray | None,
        c: FloatArray | None,
        moved: tuple[FloatArray, ...] | None = None,  # v_free, p
    ) -> None:
        self._of, self._q, self._s, self._y, self._c = of, q, s, y, c
        self._kept: dict[str, Any] = {}
        if moved is not None:
            self._kept["v_free"], self.__dict__["_p"] = moved

    def __getattr__(self, name: str) -> Any:
        if name not in INPUTS:
            raise AttributeError(f"a gradient has no {name!r}; it has {', '.join(INPUTS)}")
        if name not in self._kept:
            operator = self._of.problem.operator
            if operator not in INPUTS[name]:
                raise CapabilityError(
                    f"{name} is of problems given as {' or '.join(INPUTS[name])}, and this one was given as {operator}"
                )
            if name in BODIES:
                self._kept |= self._of._bodies.back(self)
            else:
                self._kept[name] = getattr(self, f"_by_{name}")()
        return self._kept[name]

    def _by_b(self) -> FloatArray:
        return self._s

    _by_target = _by_b

    def _by_v_free(self) -> FloatArray:
        o = self._of
        found = -o._wrench(self._s)
        return (found if self._y is None else self._y + found).reshape(o._velocities())

    @cached_property
    def _pull(self) -> FloatArray:
        # by an impulse that is moved and held: c + A^T-part of what its push changes
        o, c = self._of, 0.0 if self._c is None else self._c
        matrix, compliance = o.problem.matrix, o.problem.compliance
        if matrix is not None:
            return np.asarray(c - matrix.T @ self._s)
        assert compliance is not None
        return np.asarray(c + o._along(self._p) - compliance * self._s)

    def _by_lower(self, acts: int = LOW) -> FloatArray:
        o = self._of
        c, case = o.problem.cones, o._linear.case
        bound = (case == LOW) | (case == HIGH)
        half = 0.5 * self._pull
        return np.where(bound & (c.lower == c.upper), half, np.where(case == acts, self._pull, 0.0))

    def _by_upper(self) -> FloatArray:
        return self._by_lower(HIGH)

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

    @cached_property
    def _p(self) -> FloatArray:
        # p of (4)
        o = self._of
        z = o._moved(self._s)
        return -z if self._y is None else o._through_mass(self._y) - z

    def _pairs(self, name: str) -> list[tuple[FloatArray, FloatArray]]:
        # (5) of A, J or M as a sum of u v^T
        o = self._of
        if name == "A":
            return [(-self._s, o._impulse)]
        if name == "J":
            return [(o._impulse, self._p), (-self._s, o._velocity)]
        return [(-0.5 * self._p, o._change), (-0.5 * o._change, self._p)]

    def _by_J(self) -> sp.csr_array:
        return _on(self._of.problem.jacobian, *self._pairs("J"))

    def _by_M(self) -> sp.csr_array:
        general = self._of.problem.generalized
        assert general is not None
        return _on(general.mass, *self._pairs("M"))

    def full(self, name: str) -> FloatArray:
        """The whole of A, J or M, a dense array with entries outside its pattern, too."""
        getattr(self, name)  # refuses what is not there
        return np.asarray(sum(np.outer(u, v) for u, v in self._pairs(name)))


@dataclass(frozen=True, eq=False)
class Tangent:
    """How a solution changes along a change of the data: `Derivative.jvp`."""

    slack: FloatArray  # (m,) m/s, of w
    _velocity: FloatArray | None
    _impulse: FloatArray
    _of: Derivative = field(repr=False)

    @property
    def impulse(self) -> FloatArray:
        """(m,) N s; CapabilityError where rows repeat others, so that it is not unique."""
        if not self._of.unique.impulse.all():
            raise CapabilityError(f"impulses are not unique here: {self._of.unique}; slack and velocity are")
        return self._impulse

    @property
    def velocity(self) -> FloatArray:
        """v+ (nv,) or (n, 6) [m/s, rad/s]; CapabilityError of a matrix."""
        if self._velocity is None:
            raise CapabilityError("this problem was given as a matrix; velocities need J and M")
        return self._velocity


class Derivative:
    """The derivative of a solution, prepared once: gradients by `vjp`, directions by `jvp`, and whether it exists.

    Made by `lavender.derivative`.
    """

    def __init__(self, problem: Problem, impulse: FloatArray, linear: Linear) -> None:
        self.problem, self._impulse, self._linear = problem, impulse, linear
        disk = problem.disk
        self._regular = linear.prepare(disk.csr_data if disk.generalized is None else disk.metric)

    @cached_property
    def _root(self) -> FloatArray:
        root: FloatArray = self._linear.root
        return root / self.problem.cones.stretch if self.problem.cones.has_ellipse else root

    @cached_property
    def _slack(self) -> FloatArray:
        w: FloatArray = self._linear.slack
        return w / self.problem.cones.stretch if self.problem.cones.has_ellipse else w

    @cached_property
    def _places(self) -> Any:
        return np.flatnonzero(self._linear.place >= 0)

    def _velocities(self) -> tuple[int, ...]:
        """Shape of the velocities; CapabilityError of a matrix."""
        p = self.problem
        if p.generalized is not None:
            return (p.generalized.nv,)
        if p.rows is None:
            raise CapabilityError("this problem was given as a matrix; velocities need J and M")
        return p.rows.n_bodies, 6

    @cached_property
    def _system(self) -> _System:
        """Where the kernel has no factor: many rows, or rows that repeat others."""
        n, p = self._linear, self.problem
        if n.rows <= DENSE:
            return _System(n.matrix, n.rows)
        at, scale = self._places, sp.diags_array(1.0 / self._root[self._places])
        pi, one = self._p_matrix(), sp.eye_array(n.rows)
        h = scale @ p.csr[at][:, at] @ scale
        return _System(lambda shift: sp.csc_array(one - pi + pi @ (h + shift * one)), n.rows)

    @property
    def _solver(self) -> Any:
        return self._linear if self._regular else self._system

    @property
    def _singular(self) -> bool:
        return not self._regular and self._system.singular

    def _p_matrix(self) -> sp.csr_array:
        c = self.problem.cones
        block = np.repeat(np.arange(c.n_blocks), np.diff(c.ptr))
        alone = (c.kind == ROW)[block]
        width = np.where(alone, 1, np.diff(c.ptr)[block])
        indptr = np.concatenate([[0], np.cumsum(width)])
        first = np.where(alone, np.arange(c.n_rows), c.ptr[block])
        columns = np.arange(indptr[-1]) + np.repeat(first - indptr[:-1], width)
        found = sp.csr_array((self._linear.p, columns, indptr), shape=(c.n_rows, c.n_rows))
        return sp.csr_array(found[self._places][:, self._places])

    # -- products --------------------------------------------------------------------------------

    def _through_mass(self, y: FloatArray) -> FloatArray:
        """M^-1 y (nv,)."""
        p = self.problem
        if p.generalized is not None:
            return p.generalized.solve(y)
        rows = p.rows
        assert rows is not None
        out, y = np.empty((rows.n_bodies, 6)), y.reshape(-1, 6)
        out[:, :3] = rows.inv_mass[:, None] * y[:, :3]
        out[:, 3:] = np.einsum("ijk,ik->ij", rows.inv_inertia, y[:, 3:])
        return out.ravel()

    def _along(self, v: FloatArray) -> FloatArray:
        """J v (m,) of velocities (nv,)."""
        p = self.problem
        if p.generalized is not None:
            return p.generalized.velocity_of(v)
        out = np.empty(p.m)
        rows_velocity(p.data, v.reshape(-1, 6), out)
        return out

    def _wrench(self, x: FloatArray) -> FloatArray:
        """J^T x (nv,)."""
        p = self.problem
        if p.rows is None:
            return np.asarray(p.jacobian.T @ x)
        out = np.empty((p.rows.n_bodies, 6))
        wrench(p.data, np.ascontiguousarray(x), out)
        return out.ravel()

    def _moved(self, x: FloatArray) -> FloatArray:
        """M^-1 J^T x (nv,)."""
        if self.problem.generalized is not None:
            return self.problem.generalized.change(np.ascontiguousarray(x))
        return self._through_mass(self._wrench(x))

    def _a(self, x: FloatArray, back: bool = False) -> FloatArray:
        """A x, or A^T x."""
        p = self.problem
        if p.matrix is not None:
            return np.asarray((p.matrix.T if back else p.matrix) @ x)
        assert p.compliance is not None
        return self._along(self._moved(x)) + p.compliance * x

    @cached_property
    def _change(self) -> FloatArray:
        return self._moved(self._impulse)

    @cached_property
    def _velocity(self) -> FloatArray:
        p = self.problem
        free = p.generalized.v_free if p.generalized is not None else p.rows.v_free.ravel()  # type: ignore[union-attr]
        return free + self._change

    @cached_property
    def _parts(self) -> _Parts:
        return _Parts(self.problem)

    @cached_property
    def _axes(self) -> tuple[Any, FloatArray, FloatArray]:
        # Rows of ellipses, where root_j = c / e_j: what de_j changes in z and, through P, in y.
        rows = np.flatnonzero(np.repeat(self._parts.ellipse, np.diff(self.problem.cones.ptr)))
        rows = rows[self.problem.cones.friction_rows[rows]]
        root, e = self._root[rows], self.problem.cones.reach[rows]
        lam, w = self._impulse[rows], self._slack[rows]
        live = e > 0.0
        e = np.where(live, e, 1.0)
        return rows, np.where(live, root * lam / e, 0.0), np.where(live, (root * lam + w / root) / e, 0.0)

    @cached_property
    def _bodies(self) -> Any:
        return _Bodies(self)

    def _solve(self, r: FloatArray) -> FloatArray:
        """G x = r of all rows."""
        out, at = r.copy(), self._places
        out[at] = 0.0
        known = self._linear.times(self._a(out / self._root) / self._root) if out.any() else 0.0
        out[at] = self._solver.solve((r - known)[at])
        return out

    # -- both ways -------------------------------------------------------------------------------

    def vjp(self, *, velocity: Any = None, impulse: Any = None, slack: Any = None) -> Gradient:
        """Gradients of velocity . v+ + impulse . lambda + slack . w by all data, at the cost of one linear solve.

        Parameters
        ----------
        velocity : (nv,) or (n, 6), optional
            Cotangent of the velocities after the step, its unit the scalar's over m/s (rad/s).
        impulse : (m,), optional
            Cotangent of the impulses, per N s.
        slack : (m,), optional
            Cotangent of w, per m/s.

        Raises
        ------
        InputError
            A cotangent of another shape, not finite, or none at all.
        CapabilityError
            `velocity` of a matrix; an `impulse` that weighs what is not unique (`unique` says which rows).
        """
        p = self.problem
        if velocity is None and impulse is None and slack is None:
            raise InputError("give velocity=, impulse= or slack=: what the scalar weighs of the solution")
        x = y = given = None
        if velocity is not None:
            y = as_array("velocity", velocity, self._velocities()).reshape(-1)
        if impulse is not None:
            given = as_array("impulse", impulse, (p.m,))
        c = np.zeros(p.m) if given is None else given.copy()
        if slack is not None:
            x = as_array("slack", slack, (p.m,))
            c += self._a(x, True)
        general = p.generalized
        if general is not None and self._regular:
            order, stretch = general.order, p.cones.stretch if p.cones.has_ellipse else None
            c = c if stretch is None else c * stretch
            q, s, *moved = self._linear.adjoint(y if y is None or order is None else y[order], c)
            s = s if stretch is None else s * stretch
            if x is None:
                return Gradient(self, q, s, y, given, tuple(map(general._given, moved)))
            return Gradient(self, q, s - x, y, given)
        if y is not None:
            c += self._along(self._through_mass(y))
        scaled, at, q = (c / self._root)[self._places], self._places, np.zeros(p.m)
        # Slacks and velocities are unique where A is that of bodies and the law is convex.
        if p.matrix is not None or p.law == "coulomb" or impulse is not None:
            self._refuse_undetermined(scaled)
        q[at] = self._solver.solve(scaled, True)
        s = self._linear.times(q, True) / self._root
        return Gradient(self, q, s if x is None else s - x, y, given)

    def _refuse_undetermined(self, c: FloatArray) -> None:
        if not self._singular:
            return
        size = float(np.linalg.norm(c))
        if any(abs(float(x @ c)) > UNMOVED * size for x in self._null):
            raise CapabilityError(
                f"what is asked for is not unique here: {self.unique}. Ask for velocities, slacks, or sums of impulses "
                "that are"
            )

    def jvp(self, **changes: Any) -> Tangent:
        """How the solution changes along changes of the data, at the cost of one solve.

        Parameters
        ----------
        b, target, v_free, lower, upper, mu, patch_radius, rolling, compliance, A, J, M : array-like, optional
            Changes of the data that bear these names, of their shapes; mu also (k, 2). b= is a change of b itself;
            with target=, v_free= and J= b = target - J v* follows. M must be symmetric.
        jac, normal, tangent, arm_a, arm_b, inv_mass, inv_inertia : array-like, optional
            Changes of the arrays of bodies, `Rows`.

        Returns
        -------
        Tangent
            `.impulse` (m,) [N s], `.slack` (m,) [m/s], `.velocity` [m/s, rad/s], each per unit of the change.

        Raises
        ------
        InputError
            A name that this problem has no data of, another shape, numbers that are not finite, or none at all.
        """
        p, n = self.problem, self._linear
        given = self._checked(changes)
        r, push = np.zeros(p.m), np.zeros(p.m)  # push: dA lambda - db
        for name in ("b", "target"):
            push -= given.get(name, 0.0)
        case = self._linear.case
        for name, at in (("lower", LOW), ("upper", HIGH)):
            if name in given:
                r += np.where(case == at, self._root * given[name], 0.0)
        wanted = [given.get(name) for name in ("mu", "patch_radius", "rolling")]
        if any(x is not None for x in wanted):
            r += self._by_reach(self._parts.reaches(*wanted))
        dv: Any = None if p.matrix is not None else np.zeros(self._velocity.shape)
        if "A" in given:
            push += given["A"] @ self._impulse
        if "compliance" in given:
            push += given["compliance"] * self._impulse
        dj = self._bodies.jacobian(given) if p.rows is not None else given.get("J")
        if p.rows is not None and "J" in given:
            dj = given["J"] if dj is None else dj + given["J"]
        pulled = None  # dJ^T lambda - dM v'
        if dj is not None:
            push += dj @ self._velocity
            pulled = dj.T @ self._impulse
        if "M" in given:
            pulled = (0.0 if pulled is None else pulled) - given["M"] @ self._change
        if pulled is not None:
            dv += self._through_mass(pulled)
        if "inv_mass" in given or "inv_inertia" in given:
            dv += self._bodies.through(given, self._wrench(self._impulse))
        if dv is not None and dv.any():
            push += self._along(dv)
        if "v_free" in given:
            free = given["v_free"].ravel()
            push += self._along(free)
            dv = dv + free
        dz = self._solve(r - n.times(push / self._root))
        impulse = dz / self._root
        slack = self._a(impulse) + push
        if dv is not None:
            dv = (dv + self._moved(impulse)).reshape(self._velocities())
        return Tangent(slack, dv, impulse, self)

    def _by_reach(self, de: FloatArray) -> FloatArray:
        n = self._linear
        if not self.problem.cones.has_ellipse:
            return n.times(de, False, True)
        rows, own, through = self._axes
        x, y, rest = np.zeros(len(de)), np.zeros(len(de)), de.copy()
        x[rows], y[rows], rest[rows] = own * de[rows], through * de[rows], 0.0
        return n.times(rest, False, True) + x - n.times(y)

    def _checked(self, changes: dict[str, Any]) -> dict[str, Any]:
        p, out = self.problem, {}
        known = [name for name, of in INPUTS.items() if p.operator in of and name != "coefficients"]
        for name, value in changes.items():
            if name not in known:
                raise InputError(
                    f"{name!r} is no data of this problem ({p.operator}): there are {', '.join(known)}"
                )
            if name in ("A", "J", "M"):
                like = p.matrix if name == "A" else p.jacobian if name == "J" else p.generalized.mass  # type: ignore[union-attr]
                out[name] = as_csr(name, value) if issparse(value) else as_array(name, value, like.shape)
                if out[name].shape != like.shape:
                    raise InputError(f"{name} has shape {out[name].shape}; {like.shape} is needed")
                if name == "M" and abs(out[name] - out[name].T).max() > 1e-12 * abs(out[name]).max():
                    raise InputError("the change of M is not symmetric; M is: give both triangles")
            elif name in ("mu", "patch_radius", "rolling"):
                shape: tuple[int, ...] = (p.n_blocks,)
                out[name] = as_array(
                    name, value, (*shape, 2) if name == "mu" and np.ndim(value) == 2 else shape
                )
            elif name in BODIES or name == "v_free":
                like = getattr(p.rows if p.rows is not None else p.generalized, name)
                out[name] = as_array(name, value, like.shape)
            else:
                out[name] = as_array(name, value, (p.m,))
        if not out:
            raise InputError(f"give a change of the data: {', '.join(known)}")
        return out

    # -- whether it exists -----------------------------------------------------------------------

    @cached_property
    def _null(self) -> FloatArray:
        return self._system.probes(False) if self._singular else np.zeros((0, self._linear.rows))

    @cached_property
    def unique(self) -> Unique:
        """What is unique of the solution, row by row: rows that repeat others share their impulse in many ways."""
        p, m = self.problem, self.problem.m
        impulse, slack, target, velocity = np.ones((3, m), bool)[0], np.ones(m, bool), np.ones(m, bool), True
        at = self._places
        for z in self._null:
            x = np.zeros(m)
            x[at] = z
            size = np.abs(x).max()
            moved = np.abs(self._a(x / self._root) / self._root)
            impulse &= np.abs(x) <= UNMOVED * size
            slack &= moved <= UNMOVED * size
            velocity = velocity and bool(moved.max() <= UNMOVED * size)
        for q in self._system.probes(True) if self._singular else ():
            x = np.zeros(m)
            x[at] = q
            target &= np.abs(self._linear.times(x, True)) <= UNMOVED * np.abs(x).max()
        return Unique(impulse, slack, velocity, target, p)

    @cached_property
    def states(self) -> States:
        """What each block does; `within` is how far Newton's next step would move it, and rounding."""
        n, p = self._linear, self.problem
        with np.errstate(all="ignore"):
            size = np.abs(self._a_of_sizes()) + np.abs(p.b)
            rounding = U * size / self._root * np.random.default_rng(0).choice([-1.0, 1.0], p.m)
            error = np.zeros(p.m)
            for r in (-n.residual, n.times(rounding)):
                dz = self._solve(r)
                ds = self._a(dz / self._root) / self._root
                error += np.abs(dz - ds) / self._root
            error += 4.0 * U * size / self._root**2
        return States(p, n, np.nan_to_num(error, nan=np.inf))

    def _a_of_sizes(self) -> FloatArray:
        """|A| |lambda|, or no less where A is not formed."""
        p, x = self.problem, np.abs(self._impulse)
        if p.matrix is not None or p.rows is not None:
            return np.asarray(abs(p.csr) @ x)
        y = abs(p.whitened)
        assert p.compliance is not None
        return np.asarray(y @ (y.T @ x) + p.compliance * x)

    @property
    def distance(self) -> FloatArray:
        """(k,) N s (N m s on angular rows): of each block to its nearest other state, inf without one."""
        return self.states.margin

    @property
    def distance_in_errors(self) -> FloatArray:
        """(k,) the same over the solution's own error there."""
        with np.errstate(divide="ignore", invalid="ignore"):
            found: FloatArray = np.where(self.distance == 0.0, 0.0, self.distance / self.states.within)
        return found

    @cached_property
    def switching(self) -> tuple[int, ...]:
        """Blocks within ten errors of another state: there are several derivatives, this one is of `states[i].name`."""
        return tuple(int(i) for i in np.flatnonzero(self.distance_in_errors <= MANY))

    @property
    def exists(self) -> bool:
        """No block is about to switch, and every target may change alone."""
        return not self.switching and bool(self.unique.target.all())

    @property
    def motions(self) -> Motions:
        """The motions that solve this problem, as `lavender.motions` finds them when first asked.

        Under Coulomb's law there may be several: a gradient is then of this one, whose choice it does not know.
        """
        from lavender.motion import motions_of

        return motions_of(self.problem.disk)

    def __str__(self) -> str:
        words = [repr(self.states)]
        if self.switching:
            names = ", ".join(
                self.problem.row_name(int(self.problem.cones.ptr[i])) for i in self.switching[:3]
            )
            words.append(f"{len(self.switching)} about to switch ({names}): one of several derivatives")
        if not self.unique:
            words.append(f"not unique: {self.unique}")
        return "; ".join(words)


class _Bodies:
    """The chain from J and M^-1 to the arrays of `Rows`.

    A row of a contact along an axis a is (-a, -arm_a x a, a, arm_b x a), one that turns (0, -a, 0, a), on the columns
    of both bodies; t2 = n x t1.
    """

    def __init__(self, of: Derivative) -> None:
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


def _on(pattern: Any, *pairs: tuple[FloatArray, FloatArray]) -> sp.csr_array:
    """Sum of u v^T on the pattern of a matrix in compressed rows."""
    row = np.repeat(np.arange(pattern.shape[0]), np.diff(pattern.indptr))
    data = sum(u[row] * v[pattern.indices] for u, v in pairs)
    return sp.csr_array((data, pattern.indices, pattern.indptr), shape=pattern.shape)


def derivative(problem: Problem, solution: Any) -> Derivative:
    """The derivative of a problem's solution by all of its data, prepared once.

    Parameters
    ----------
    problem : Problem
    solution : Solution, or (m,) N s
        Any solver's answer, or an impulse; the judge must accept it to 1e-8, or to its floor.

    Returns
    -------
    Derivative
        `.vjp(velocity=, impulse=)` gives gradients by all data, `.jvp(b=, mu=, ...)` changes of the answer; `.states`,
        `.distance`, `.switching`, `.unique` and `.motions` say where it is one of several or does not exist.

    Raises
    ------
    InputError
        An impulse of the wrong length, or an answer with a larger residual: of another problem, or not solved.

    References
    ----------
    Dontchev, Rockafellar, Implicit Functions and Solution Mappings, 2009; the derivation is in docs/derivatives.md.

    Examples
    --------
    A box of 1 kg slides and its friction takes mu times its weight: dv/dmu = -1 N s / 1 kg.

    >>> import numpy as np
    >>> import lavender as lv
    >>> problem = lv.Problem.contact(np.eye(3), [1.0, -5.0, 0.0], mu=[0.5])  # w = v + A lambda
    >>> d = lv.derivative(problem, lv.solve(problem, tol=1e-12))
    >>> d.states, d.switching
    (1 slides, ())
    >>> d.vjp(slack=[0.0, 1.0, 0.0]).mu.tolist()  # m/s
    [-1.0]
    """
    check_problem(problem)
    x = problem.impulse_array(getattr(solution, "impulse", solution))
    linear = linear_of(problem, x)
    if not (linear.relative <= ACCEPTED or at_floor(linear.relative, linear.floor)):
        found = residual(problem, x, "float64")
        if not (found.nothing_to_do and found.rounds):
            raise InputError(
                f"this is no solution of this problem: its relative residual is {found.relative:.2e}; a derivative "
                f"needs {ACCEPTED:g} or the floor ({found.floor:.1e}): solve with tol=1e-10, or give the problem that "
                "it solves"
            )
    return Derivative(problem, x, linear)


class Derivatives(Sequence[Derivative]):
    """Derivatives of many problems; `vjp` of all of them is one compiled call where they are of J and M.

    Made by `lavender.derivatives`.
    """

    def __init__(self, of: list[Derivative]) -> None:
        self._of = of

    def __len__(self) -> int:
        return len(self._of)

    def __getitem__(self, i: Any) -> Any:
        return self._of[i]

    @cached_property
    def _together(self) -> tuple[Any, ...] | None:
        """The kernel's objects, and where velocities, rows and results of each stand end to end; None: not all can."""
        plain = all(
            d._regular and d.problem.generalized is not None
            and d.problem.generalized.order is None and not d.problem.cones.has_ellipse
            for d in self._of
        )  # fmt: skip
        if not plain:
            return None
        sizes = [(d.problem.generalized.nv, d.problem.m) for d in self._of]  # type: ignore[union-attr]
        nv, m = np.array(sizes, np.int64).reshape(-1, 2).T
        ends = (np.concatenate([[0], np.cumsum(x)]) for x in (nv, m, 2 * (nv + m)))
        return ([d._linear for d in self._of], *ends)

    def vjp(self, *, velocity: Any = None, impulse: Any = None) -> list[Gradient]:
        """Gradients of each problem; cotangents are sequences, one for each, or arrays with problems first.

        Raises
        ------
        InputError
            Another number of cotangents than of problems; as `Derivative.vjp`.
        CapabilityError
            As `Derivative.vjp`.
        """
        for name, x in (("velocity", velocity), ("impulse", impulse)):
            if x is not None and len(x) != len(self):
                raise InputError(
                    f"{name} has {len(x)} cotangents for {len(self)} problems; one for each is needed"
                )
        if velocity is None and impulse is None:
            raise InputError("give velocity= or impulse=: what the scalar weighs of the solutions")
        together = self._together
        if together is None or not self._of:
            nothing = [None] * len(self)
            pairs = zip(
                self._of,
                nothing if velocity is None else velocity,
                nothing if impulse is None else impulse,
                strict=True,
            )
            return [d.vjp(velocity=y, impulse=c) for d, y, c in pairs]
        linears, of_nv, of_m, ends = together
        y = None if velocity is None else _end_to_end("velocity", velocity, of_nv)
        c = np.zeros(of_m[-1]) if impulse is None else _end_to_end("impulse", impulse, of_m)
        given, out = (None if impulse is None else c.copy()), np.empty(ends[-1])
        adjoint_all(linears, of_nv, np.empty(0) if y is None else y, of_m, c, ends, out)
        found = []
        rows, columns, starts = of_m.tolist(), of_nv.tolist(), ends.tolist()
        for i, d in enumerate(self._of):
            m, n, at = rows[i + 1] - rows[i], columns[i + 1] - columns[i], starts[i]
            s = at + m
            f = s + m
            found.append(
                Gradient(
                    d,
                    out[at:s],
                    out[s:f],
                    None if y is None else y[columns[i] : columns[i + 1]],
                    None if given is None else given[rows[i] : rows[i + 1]],
                    (out[f : f + n], out[f + n : f + 2 * n]),
                )
            )
        return found


def _end_to_end(name: str, given: Any, at: Any) -> FloatArray:
    """Cotangents of many problems as one array, checked."""
    sizes = np.diff(at)
    if isinstance(given, np.ndarray) and given.ndim == 2 and (sizes == given.shape[1]).all():
        return as_array(name, given.reshape(-1), (None,)).copy()
    parts = [
        as_array(f"{name}[{i}]", x, (int(n),)) for i, (x, n) in enumerate(zip(given, sizes, strict=True))
    ]
    return np.concatenate(parts) if parts else np.zeros(0)


def derivatives(problems: Iterable[Problem], solutions: Iterable[Any]) -> Derivatives:
    """`derivative` of each of many problems, as `solve_many` solves them.

    Parameters
    ----------
    problems : iterable of Problem
    solutions : iterable of Solution, or (m,) N s
        One for each.

    Returns
    -------
    Derivatives
        A sequence; its `vjp` takes cotangents of all.

    Raises
    ------
    InputError
        Another number of solutions than of problems, or as `derivative`, which names the problem.
    """
    if isinstance(problems, Problem):
        raise InputError("problems is one Problem; a list of them is needed, or `derivative`")
    given, answers = list(problems), list(solutions)
    if len(given) != len(answers):
        raise InputError(f"{len(answers)} solutions for {len(given)} problems; one for each is needed")
    found = []
    for i, (problem, solution) in enumerate(zip(given, answers, strict=True)):
        try:
            found.append(derivative(problem, solution))
        except InputError as error:
            raise InputError(f"problem {i}: {error}") from None
    return Derivatives(found)
