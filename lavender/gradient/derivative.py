"""Derivative of one solution: preparation, products in both directions, and checks of existence.

A solution λ with w = A λ − b is a root of the error map of the judge (docs/residual.md). In scaled
variables z = √d λ, s = w/√d and y = z − s, and with Π for the projection onto the admissible
impulses of each block, this root and its differential are

::

    F = z − Π(y) = 0                                                                      (1)
    (I − P) dz + P ds = ∂Π/∂e de + √d dl         P = ∂Π/∂y, e: mu, mu r, mu_r; l: bounds that act

For each block, (1) gives these equations, with ŵ = w_t/|w_t|:

    row inside its bounds       dw = 0
    contact sticks              dw = 0
    row at a bound l            dλ = dl
    contact open                dλ = 0
    contact slides, tangents    dλ_t = −(dμ λ_n + μ dλ_n) ŵ − (μ λ_n/|w_t|)(I − ŵ ŵᵀ) dw_t
    contact slides, normal      Coulomb: dw_n = 0; cone: dw_n = dμ |w_t| + μ ŵ·dw_t

Spin and rolling rows have equations of the same form; an ellipse is a disk with scaled tangents, a
round cone a disk of up to five tangents. With H = D^−½ A D^−½, (1) becomes one linear system for
dz:

::

    G dz = P (db − dA λ)/√d + √d dl + ∂Π/∂e de,      G = I − P + P H                      (2)
    dA λ = dJ v' + J M⁻¹ (dJᵀ λ − dM v') + dθ λ,     v' = M⁻¹ Jᵀ λ                        (3)

For a scalar function with the gradient c by λ and y by v⁺ (not the y of (1)), one solve with Gᵀ
gives the gradients by all data:

::

    Gᵀ q = (c + J M⁻¹ y)/√d,    s = Pᵀ q/√d,    p = M⁻¹ (y − Jᵀ s)
    b: s    e: (∂Π/∂e)ᵀ q    A: −s λᵀ    θ: −s λ    v*: y − Jᵀ s    J: λ pᵀ − s v⁺ᵀ    M: −p v'ᵀ

The implicit function theorem (Dontchev and Rockafellar 2009) requires a regular G. If rows are
redundant, G is singular, and (2) is solved with G + εP, ε = 1e-11, and refined iteratively to one
of its solutions. Solves with random right-hand sides detect the entries of dz that (2) does not
determine.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import FloatArray, as_array, as_csr
from lavender.base.errors import CapabilityError, InputError
from lavender.base.lazy_import import issparse
from lavender.gradient.result import COEFFICIENT_INPUTS, INPUTS, MATRICES, CoefficientRows, Gradient
from lavender.gradient.system import MAX_KERNEL_ROWS, System, factor_dense
from lavender.judge.residuals import measure_residual
from lavender.judge.states import States, compute_states, judge_and_linearise_impulse
from lavender.problem import Problem, check_problem
from lavender.problem.derived import cached_property
from lavender_ext.core.problem import multiply_body_jacobian
from lavender_ext.derivative.linear import CASES, Linear, write_body_wrenches

# A solution is rejected if its relative residual exceeds this and its round-off floor.
MAX_ACCEPTED_RESIDUAL = 1e-8
MAX_NULL_ENTRY = (
    1e-6  # Entries of a null vector up to this fraction of its largest entry count as rounding.
)
# A right-hand side of G x = r counts as unsolvable if its cosine with a null vector of G^T is larger than this.
MAX_NULL_COSINE = 1e-3
# `Derivative.switching` reports blocks within this many estimated errors of another state. The factor covers that the
# error is estimated to first order only.
SWITCHING_ERRORS = 10.0
UNIT_ROUNDOFF = 2.0**-53

Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Unique:
    """Uniqueness of a solution and of its derivative. `str()` lists the rows that are not unique.

    Parameters
    ----------
    impulse : (m,) bool
        Whether the impulse of the row is unique.
    slack : (m,) bool
        Whether the slack of the row, and the velocity along it, is unique.
    velocity : bool
        Whether the velocities of all bodies are unique; for a matrix, whether all slacks are.
    target : (m,) bool
        Whether a derivative by b of this row alone exists: b can change without a change of any block's state.
    """

    impulse: Flags
    slack: Flags
    velocity: bool
    target: Flags
    _problem: Problem = field(repr=False)

    def __bool__(self) -> bool:
        return bool(self.impulse.all() and self.slack.all() and self.target.all())

    def __str__(self) -> str:
        lines = []
        for name, flags in (
            ("impulse", self.impulse),
            ("slack", self.slack),
            ("target", self.target),
        ):
            rows = np.flatnonzero(~flags)
            if len(rows):
                names = ", ".join(self._problem.row_name(int(i)) for i in rows[:3])
                lines.append(
                    f"{name}: not of {len(rows)} rows ({names}{', ...' if len(rows) > 3 else ''})"
                )
        return "; ".join(lines) or "all quantities are unique"


@dataclass(frozen=True, eq=False)
class Tangent:
    """Change of a solution along a change of the data, computed by `Derivative.jvp`.

    Parameters
    ----------
    slack : (m,), m/s
        Change of w per unit of the change of the data.
    """

    slack: FloatArray
    _velocity: FloatArray | None
    _impulse: FloatArray
    _derivative: Derivative = field(repr=False)

    @property
    def impulse(self) -> FloatArray:
        """Change of the impulses (m,) [N s]; CapabilityError if they are not unique (linearly dependent rows)."""
        unique = self._derivative.unique
        if not unique.impulse.all():
            raise CapabilityError(f"impulses of this problem are not unique ({unique}); slacks are")
        return self._impulse

    @property
    def velocity(self) -> FloatArray:
        """Change of v+ (nv,) or (n, 6) [m/s, rad/s]; CapabilityError for a problem given as a matrix."""
        self._derivative._velocity_shape()
        assert self._velocity is not None
        return self._velocity


class Derivative:
    """Derivative of a solution: gradients by `vjp`, directional derivatives by `jvp`, checks of existence.

    It is built by `lavender.derivative`.
    """

    def __init__(self, problem: Problem, linear: Linear) -> None:
        self.problem = problem
        self._linear = linear
        self.m = problem.m
        if not linear.tried and linear.rows <= MAX_KERNEL_ROWS:
            factor_dense(problem.disk, linear)
        regular = linear.regular if linear.rows <= MAX_KERNEL_ROWS else self._system.of_kernel
        general = problem.generalized
        # The kernel can compute `vjp` if it has a factor of G and if rows and velocities are in the original order.
        in_order = general is None or general.order is None
        self._uses_kernel = regular and not problem.cones.has_ellipse and in_order

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle problem and impulse only; the copy computes the derivative again."""
        return derivative, (self.problem, self._impulse)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of this problem's data by which there are gradients."""
        return tuple(
            name for name, operators in INPUTS.items() if self.problem.operator in operators
        )

    @cached_property
    def _system(self) -> System:
        return System(self.problem.disk, self._linear)

    @cached_property
    def _impulse(self) -> FloatArray:
        impulse: FloatArray = self._linear.impulse
        return impulse * self.problem.cones.stretch if self.problem.cones.has_ellipse else impulse

    @cached_property
    def _root(self) -> FloatArray:
        root: FloatArray = self._linear.root
        return root / self.problem.cones.stretch if self.problem.cones.has_ellipse else root

    @cached_property
    def _system_rows(self) -> Any:
        """Rows in which G is not the identity."""
        return np.flatnonzero(self._linear.system_row >= 0)

    def _velocity_shape(self) -> tuple[int, ...]:
        """Return the shape of the velocities; raise CapabilityError for a problem given as a matrix."""
        p = self.problem
        if p.generalized is not None:
            return (p.generalized.nv,)
        if p.rows is None:
            raise CapabilityError(
                "the problem was given as a matrix A, without velocities; build it with Problem.from_rows or "
                "Problem.from_jacobian"
            )
        return p.rows.n_bodies, 6

    # -- products --------------------------------------------------------------------------------

    def _apply_inverse_mass(self, y: FloatArray) -> FloatArray:
        """Compute M^-1 y (nv,)."""
        p = self.problem
        if p.generalized is not None:
            return p.generalized.solve(y)
        rows = p.rows
        assert rows is not None
        out = np.empty((rows.n_bodies, 6))
        y = y.reshape(-1, 6)
        out[:, :3] = rows.inv_mass[:, None] * y[:, :3]
        out[:, 3:] = np.einsum("ijk,ik->ij", rows.inv_inertia, y[:, 3:])
        return out.ravel()

    def _apply_jacobian(self, v: FloatArray) -> FloatArray:
        """Compute J v (m,) for velocities (nv,)."""
        p = self.problem
        if p.generalized is not None:
            return p.generalized.velocity_of(v)
        out = np.empty(p.m)
        multiply_body_jacobian(p.data, v.reshape(-1, 6), out)
        return out

    def _apply_a(self, x: FloatArray, transpose: bool = False) -> FloatArray:
        """Compute A x or A^T x (m,)."""
        p = self.problem
        if p.matrix is not None:
            return np.asarray((p.matrix.T if transpose else p.matrix) @ x)
        assert p.compliance is not None
        return self._apply_jacobian(p.compute_velocity_change(x).ravel()) + p.compliance * x

    @cached_property
    def _velocity_change(self) -> FloatArray:
        return self.problem.compute_velocity_change(self._impulse).ravel()

    @cached_property
    def _velocity(self) -> FloatArray:
        p = self.problem
        free = p.generalized.v_free if p.generalized is not None else p.rows.v_free.ravel()  # type: ignore[union-attr]
        return free + self._velocity_change

    @cached_property
    def _coefficient_rows(self) -> CoefficientRows:
        return CoefficientRows(self.problem)

    @cached_property
    def _bound_weights(self) -> FloatArray:
        """Weights (2, m) of the gradients by lower and upper bounds: 1 if active, 1/2 each if the bounds are equal."""
        case, c = self._linear.case, self.problem.cones
        is_active = np.array([case == CASES["low"], case == CASES["high"]], np.float64)
        return np.where(is_active.any(axis=0) & (c.lower == c.upper), 0.5, is_active)

    @cached_property
    def _ellipse_terms(self) -> tuple[Any, FloatArray, FloatArray]:
        """Friction rows j of ellipses, and -dz_j/de_j and -dy_j/de_j there, with y = z - D^-1/2 w.

        The derivatives are not zero, because D_j^1/2 of an ellipse's row is proportional to 1 / e_j.
        """
        rows = np.flatnonzero(
            np.repeat(self._coefficient_rows.ellipse, np.diff(self.problem.cones.ptr))
        )
        rows = rows[self.problem.cones.friction_rows[rows]]
        root = self._root[rows]
        e = self.problem.cones.friction_coefficient[rows]
        lam = self._impulse[rows]
        w = (self._linear.slack / self.problem.cones.stretch)[rows]
        has_friction = e > 0.0
        e = np.where(has_friction, e, 1.0)
        dz_de = np.where(has_friction, root * lam / e, 0.0)
        return rows, dz_de, np.where(has_friction, (root * lam + w / root) / e, 0.0)

    def _solve(self, r: FloatArray, check: bool = False) -> FloatArray:
        """Solve G x = r on all rows; with `check`, raise CapabilityError if there is no solution."""
        x = r.copy()
        rows = self._system_rows
        # On rows outside of the system, G is the identity: move their contribution to the right-hand side.
        x[rows] = 0.0
        rhs = r
        if x.any():
            rhs = r - self._linear.multiply_projection_derivative(
                self._apply_a(x / self._root) / self._root
            )
        rhs = rhs[rows]
        if check and self._system.has_null_component(rhs, MAX_NULL_COSINE, True):
            self._check_row_changes("no derivative along this change exists")
        x[rows] = self._system.solve(rhs)
        return x

    def _check_row_changes(self, message: str) -> None:
        """Raise CapabilityError if data of a single row cannot change because other rows share its load."""
        if not self._system.singular:
            return
        rows = np.flatnonzero(~self.unique.target)
        if len(rows):
            names = ", ".join(self.problem.row_name(int(i)) for i in rows[:3])
            raise CapabilityError(
                f"{message}: {names}{', ...' if len(rows) > 3 else ''} share a load with other rows, of "
                "which another opens if the data of one change: use derivatives by v_free and M, by mu under "
                "Coulomb's law, or give these rows compliance"
            )

    def _check_coefficient_changes(self, name: str) -> None:
        """Raise CapabilityError if a coefficient of one contact cannot change under the cone law.

        Under this law, a sliding contact has w_n = mu |w_t| + mu r |w_s| + mu_r |w_r|, so a change of a coefficient
        acts like a change of the normal's target.
        """
        if self.problem.law != "cone" or not self._system.singular:
            return
        cones = self.problem.cones
        rows = self._system_rows
        ones = np.ones(cones.n_blocks)
        changes = (ones if name == key else None for key in COEFFICIENT_INPUTS)
        de = self._coefficient_rows.compute_row_coefficient_changes(*changes)
        r = self._apply_coefficient_change(de)[rows]
        # An entry of r depends only on the coefficient of its own block: test each block separately.
        block = np.repeat(np.arange(cones.n_blocks), np.diff(cones.ptr))[rows]
        size = MAX_NULL_COSINE * np.sqrt(np.bincount(block, r * r))
        for q in self._system.draw_null_vectors(True):
            if (np.abs(np.bincount(block, q * r)) > size * float(np.linalg.norm(q))).any():
                self._check_row_changes(
                    f"no derivative by {name} of one contact (jvp: of several) exists"
                )

    # -- adjoint and forward products ------------------------------------------------------------

    def vjp(self, *, velocity: Any = None, impulse: Any = None, slack: Any = None) -> Gradient:
        """Compute the gradients of velocity . v+ + impulse . lambda + slack . w by all data, by one linear solve.

        Parameters
        ----------
        velocity : (nv,) or (n, 6), optional
            Cotangent of the velocities after the step [1/(m/s), 1/(rad/s), times the unit of the scalar].
        impulse : (m,), optional
            Cotangent of the impulses [1/(N s), times the unit of the scalar].
        slack : (m,), optional
            Cotangent of w [1/(m/s), times the unit of the scalar].

        Returns
        -------
        Gradient

        Raises
        ------
        InputError
            A cotangent has a wrong shape or is not finite, or no cotangent is given.
        CapabilityError
            `velocity` is given for a problem in matrix form, or a cotangent weighs impulses that are not unique (see
            `unique`).
        """
        p = self.problem
        if velocity is None and impulse is None and slack is None:
            raise InputError(
                "no cotangent of the solution is given; give velocity=, impulse= or slack="
            )
        adjoint = self._linear.adjoint(velocity, impulse, slack) if self._uses_kernel else None
        if adjoint is not None:
            return Gradient(self, adjoint)
        y = (
            None
            if velocity is None
            else as_array("velocity", velocity, self._velocity_shape()).reshape(-1)
        )
        c = np.zeros(p.m) if impulse is None else as_array("impulse", impulse, (p.m,))
        x = None if slack is None else as_array("slack", slack, (p.m,))
        return Gradient(
            self, (self._linear.adjoint if self._uses_kernel else self._solve_adjoint)(y, c, x)
        )

    def _solve_adjoint(
        self, y: FloatArray | None, c: FloatArray, x: FloatArray | None
    ) -> FloatArray:
        """Return q, s (m), f = y - J^T s (nv) and c (m) of (4), concatenated. A problem given as a matrix has no f."""
        p = self.problem
        rhs = c.copy()
        if x is not None:
            rhs += self._apply_a(x, True)
        if y is not None:
            rhs += self._apply_jacobian(self._apply_inverse_mass(y))
        scaled = (rhs / self._root)[self._system_rows]
        q = np.zeros(p.m)
        # Slacks and velocities are unique if A comes from bodies or J and M and the law is convex: no check is needed.
        needs_check = p.matrix is not None or p.law == "coulomb" or c.any()
        if needs_check and self._system.has_null_component(scaled, MAX_NULL_ENTRY, False):
            raise CapabilityError(
                f"the requested gradient is not unique: {self.unique}. Use cotangents of velocities, of "
                "slacks, or of sums of impulses, which are unique"
            )
        q[self._system_rows] = self._system.solve(scaled, True)
        s = self._linear.multiply_projection_derivative(q, True) / self._root
        if x is not None:
            s -= x
        if p.matrix is not None:
            return np.concatenate([q, s, c])
        if p.rows is None:
            force = np.asarray(p.jacobian.T @ s)
        else:
            wrench = np.empty((p.rows.n_bodies, 6))
            write_body_wrenches(p.data, np.ascontiguousarray(s), wrench)
            force = wrench.ravel()
        return np.concatenate([q, s, (0.0 if y is None else y) - force, c])

    def jvp(self, **changes: Any) -> Tangent:
        """Compute the change of the solution along changes of the data, by one linear solve.

        Parameters
        ----------
        b, target, v_free, lower, upper, mu, patch_radius, rolling, compliance, A, J, M : array-like, optional
            Changes of the data with these names, in the shapes of the data; mu also (k, 2). `b` is the change of b
            itself; for changes of `target`, `v_free` and `J`, the change of b = target - J v* is computed. A change of
            M must be symmetric.

        Returns
        -------
        Tangent
            `.impulse` (m,) [N s], `.slack` (m,) [m/s], `.velocity` [m/s, rad/s], each per unit of the change.

        Raises
        ------
        InputError
            The problem has no data of this name, a shape is wrong, a number is not finite, or no change is given.
        CapabilityError
            No derivative along this change exists.
        """
        p, linear = self.problem, self._linear
        data = self._check_changes(changes)
        r, dw = (
            np.zeros(p.m),
            np.zeros(p.m),
        )  # dw = dA lambda - db is the change of w at constant impulses.
        for name in ("b", "target"):
            dw -= data.get(name, 0.0)
        for name, weight in zip(("lower", "upper"), self._bound_weights, strict=True):
            r += weight * self._root * data.get(name, 0.0)
        coefficients = [data.get(name) for name in COEFFICIENT_INPUTS]
        if any(x is not None for x in coefficients):
            de = self._coefficient_rows.compute_row_coefficient_changes(*coefficients)
            r += self._apply_coefficient_change(de)
        dv: Any = None if p.matrix is not None else np.zeros(self._velocity.shape)
        if "A" in data:
            dw += data["A"] @ self._impulse
        if "compliance" in data:
            dw += data["compliance"] * self._impulse
        dj = data.get("J")
        momentum: Any = 0.0  # dJ^T lambda - dM v' of equation (2) in `lavender.gradient`
        if dj is not None:
            dw += dj @ self._velocity
            momentum = dj.T @ self._impulse
        if "M" in data:
            momentum = momentum - data["M"] @ self._velocity_change
        if np.ndim(momentum):
            dv += self._apply_inverse_mass(momentum)
        if dv is not None and dv.any():
            dw += self._apply_jacobian(dv)
        if "v_free" in data:
            free = data["v_free"].ravel()
            dw += self._apply_jacobian(free)
            dv = dv + free
        dz = self._solve(r - linear.multiply_projection_derivative(dw / self._root), True)
        impulse = dz / self._root
        slack = self._apply_a(impulse) + dw
        if dv is not None:
            dv = (dv + p.compute_velocity_change(impulse).ravel()).reshape(self._velocity_shape())
        return Tangent(slack, dv, impulse, self)

    def _apply_coefficient_change(self, de: FloatArray) -> FloatArray:
        """Compute (dPi/de) de (m,) for changes de (m,) of the rows' coefficients e, including the change of D by e."""
        linear = self._linear
        if not self.problem.cones.has_ellipse:
            return linear.multiply_projection_derivative(de, False, True)
        rows, dz_de, dy_de = self._ellipse_terms
        dz = np.zeros(len(de))
        dy = np.zeros(len(de))
        others = de.copy()
        dz[rows] = dz_de * de[rows]
        dy[rows] = dy_de * de[rows]
        others[rows] = 0.0
        changed: FloatArray = linear.multiply_projection_derivative(others, False, True) + dz
        return changed - linear.multiply_projection_derivative(dy)

    def _check_changes(self, changes: dict[str, Any]) -> dict[str, Any]:
        """Convert the changes of data to arrays; raise InputError for invalid ones."""
        p = self.problem
        out = {}
        names = [name for name in self.inputs if name != "coefficients"]
        for name, value in changes.items():
            if name not in names:
                raise InputError(
                    f"{name!r} is not among the data of this problem ({p.operator}): there are {', '.join(names)}"
                )
            if name in MATRICES:
                if name == "M":
                    like = p.generalized.mass  # type: ignore[union-attr]
                else:
                    like = p.matrix if name == "A" else p.jacobian
                out[name] = (
                    as_csr(name, value) if issparse(value) else as_array(name, value, like.shape)
                )
                if out[name].shape != like.shape:
                    raise InputError(f"{name} has shape {out[name].shape}; {like.shape} is needed")
                if (
                    name == "M"
                    and abs(out[name] - out[name].T).max() > 1e-12 * abs(out[name]).max()
                ):
                    raise InputError(
                        "the change of M must be symmetric, because M is: give both triangles"
                    )
            elif name in COEFFICIENT_INPUTS:
                is_pair = name == "mu" and np.ndim(value) == 2
                out[name] = as_array(name, value, (p.n_blocks, 2) if is_pair else (p.n_blocks,))
            elif name == "v_free":
                like = getattr(p.rows if p.rows is not None else p.generalized, name)
                out[name] = as_array(name, value, like.shape)
            else:
                out[name] = as_array(name, value, (p.m,))
        if not out:
            raise InputError(
                f"no change of the data is given; give at least one of {', '.join(names)}"
            )
        return out

    # -- existence -------------------------------------------------------------------------------

    @cached_property
    def unique(self) -> Unique:
        """Uniqueness of impulse, slack and target by row; linearly dependent rows can share a load in many ways."""
        p = self.problem
        m = self.problem.m
        impulse = np.ones((3, m), bool)[0]
        slack = np.ones(m, bool)
        target = np.ones(m, bool)
        velocity = True
        rows = self._system_rows
        for z in self._system.draw_null_vectors(False):
            x = np.zeros(m)
            x[rows] = z
            limit = MAX_NULL_ENTRY * np.abs(x).max()
            slack_change = np.abs(self._apply_a(x / self._root) / self._root)
            impulse &= np.abs(x) <= limit
            slack &= slack_change <= limit
            velocity = velocity and bool(slack_change.max() <= limit)
        for q in self._system.draw_null_vectors(True):
            x = np.zeros(m)
            x[rows] = q
            change = np.abs(self._linear.multiply_projection_derivative(x, True))
            target &= change <= MAX_NULL_ENTRY * np.abs(x).max()
        return Unique(impulse, slack, velocity, target, p)

    @cached_property
    def states(self) -> States:
        """State of each block, as `solution.states`."""
        return compute_states(self.problem, self._impulse, self._linear)

    @cached_property
    def _estimated_error(self) -> FloatArray:
        """Estimated error of each block (k,) [N s]: the size of the next step of Newton's method plus rounding."""
        linear, p = self._linear, self.problem
        with np.errstate(all="ignore"):
            x = np.abs(self._impulse)
            if p.generalized is None:
                size = np.abs(p.b) + abs(p.csr) @ x
            else:  # An upper bound of |A| |lambda|, which does not form A.
                y = abs(p.whitened)
                assert p.compliance is not None
                size = np.abs(p.b) + (y @ (y.T @ x) + p.compliance * x)
            rounding = (
                UNIT_ROUNDOFF
                * size
                / self._root
                * np.random.default_rng(0).choice([-1.0, 1.0], p.m)
            )
            error = np.zeros(p.m)
            for r in (-linear.residual, linear.multiply_projection_derivative(rounding)):
                dz = self._solve(r)
                ds = self._apply_a(dz / self._root) / self._root
                error += np.abs(dz - ds) / self._root
            error += 4.0 * UNIT_ROUNDOFF * size / self._root**2
        first = p.cones.ptr[:-1]
        return np.maximum.reduceat(np.nan_to_num(error, nan=np.inf), first) if len(first) else error

    @property
    def distance(self) -> FloatArray:
        """Distance of each block (k,) [N s; N m s on angular rows] to its nearest other state; inf without one."""
        return self.states.margin

    @property
    def distance_in_errors(self) -> FloatArray:
        """`distance` (k,) divided by the block's estimated error: the next step of Newton's method plus rounding."""
        with np.errstate(divide="ignore", invalid="ignore"):
            distance: FloatArray = np.where(
                self.distance == 0.0, 0.0, self.distance / self._estimated_error
            )
        return distance

    @cached_property
    def switching(self) -> tuple[int, ...]:
        """Indices of the blocks within ten estimated errors of another state.

        If there is such a block, the derivative differs between the states; this object has the derivative for the
        present states (`states[i].name`).
        """
        return tuple(int(i) for i in np.flatnonzero(self.distance_in_errors <= SWITCHING_ERRORS))

    @property
    def exists(self) -> bool:
        """Whether the derivative exists: no block is about to switch, and each target can change separately."""
        return not self.switching and bool(self.unique.target.all())

    def __repr__(self) -> str:
        return f"<Derivative of {self.m} rows: {self}>"

    def __str__(self) -> str:
        notes = [repr(self.states)]
        if self.switching:
            rows = self.problem.cones.ptr[list(self.switching[:3])]
            names = ", ".join(self.problem.row_name(int(row)) for row in rows)
            notes.append(
                f"{len(self.switching)} about to switch ({names}): one of several derivatives"
            )
        if not self.unique:
            notes.append(f"not unique: {self.unique}")
        return "; ".join(notes)


def derivative(problem: Problem, solution: Any) -> Derivative:
    """Prepare the derivative of a problem's solution by all of its data.

    Parameters
    ----------
    problem : Problem
    solution : Solution, or (m,) N s
        Solution of any solver, or an impulse. Its relative residual must be at most 1e-8, or at the round-off floor.

    Returns
    -------
    Derivative
        `.vjp(velocity=, impulse=)` computes gradients by all data, `.jvp(b=, mu=, ...)` changes of the solution.
        `.states`, `.distance`, `.switching` and `.unique` show whether the derivative exists and is unique.

    Raises
    ------
    InputError
        The impulse has the wrong length, or its residual is too large.

    References
    ----------
    Dontchev, Rockafellar, Implicit Functions and Solution Mappings, 2009; the derivation is in the module's
    docstring.

    Examples
    --------
    A box of 1 kg slides, with the friction mu times its weight: dv/dmu = -1 N s / 1 kg.

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
    impulse = problem.make_start(getattr(solution, "impulse", solution))
    linear = judge_and_linearise_impulse(problem, impulse, MAX_KERNEL_ROWS)
    if not linear.above_floor <= MAX_ACCEPTED_RESIDUAL:
        error = measure_residual(problem, impulse, "float64")
        if not (error.nothing_to_do and error.rounds):
            raise InputError(
                "the impulse is not a solution of this problem: its relative residual is "
                f"{error.relative:.2e}; at most {MAX_ACCEPTED_RESIDUAL:g}, or the round-off floor "
                f"({error.roundoff_floor:.1e}), is needed: solve with tol=1e-10"
            )
    return Derivative(problem, linear)
