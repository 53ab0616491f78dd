"""`Problem`: the complete class, with warm starts from the previous step and conversions to other forms."""

from __future__ import annotations

from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np

from lavender.base.arrays import ArrayLike, FloatArray, as_array, check_not_negative
from lavender.base.errors import InputError
from lavender.base.lazy_import import import_module_lazily
from lavender.base.lazy_import import sparse as sp
from lavender.problem.builders import Builders
from lavender.problem.cones import Cones
from lavender.problem.derived import computed_once
from lavender_ext.core.carry import carry_impulses_by_key
from lavender_ext.core.checks import MIN_MAGNITUDE


@dataclass(frozen=True, eq=False)
class VelocityForm:
    """A problem in mass-scaled velocities y [sqrt J] and scaled impulses z [sqrt J], in the metric of d.

        K y + diag(theta) z - g  is complementary to  z,     y = K^T z,
        K = D^-1/2 J M^-1/2,  theta = compliance / d,  g = D^-1/2 b,  lambda = D^-1/2 z

    Then K K^T + diag(theta) = D^-1/2 A D^-1/2, and y is the mass-scaled change of velocity M^1/2 (v - v*).
    """

    jacobian: sp.csr_array  # (m, 6 n) or (m, nv), CSR: K, with rows of norm 1.
    rhs: FloatArray  # (m,), sqrt J: g.
    theta: FloatArray  # (m,)
    scale: FloatArray  # (m,), sqrt kg: D^-1/2.

    def impulse(self, multiplier: FloatArray) -> FloatArray:
        """Compute lambda (m,) [N s] from a multiplier z (m,) [sqrt J]."""
        return self.scale * multiplier


class Problem(Builders):
    """A constraint problem: find impulses lambda (m,) [N s] with w = A lambda - b [m/s] complementary to them.

    Usually built by `Problem.lcp`, `linear`, `contact`, `from_rows`, `from_jacobian` or `from_findex`.

    Parameters
    ----------
    b : (m,) m/s
        target - J v*: the relative velocity that the impulses must supply.
    cones : Cones
        Blocks and bounds.
    matrix : (m, m) array or sparse, 1/kg
        A, stored without changes; it may be asymmetric, indefinite or singular. Exactly one of `matrix`, `rows` and
        `generalized` is given.
    rows : Rows
        J and M^-1 of bodies; A = J M^-1 J^T + diag(compliance) is formed only if needed.
    generalized : Generalized
        J and M in generalised coordinates; as with rows, A is formed only if needed.
    friction : {"coulomb", "cone"}
        Coulomb friction (non-associated), or its convex relaxation.
    compliance : (m,) 1/kg, not with a matrix
        Softness of each row, >= 0; added to the diagonal of A.
    guess : (m,) N s, optional
        Default warm start of every solve of this problem.
    key : (k,) uint64, optional
        Identity of each block, by which `carry` finds it in the problem of the next step.
    names : sequence of str (k,), optional
        Names of the blocks, e.g. "hinge 7"; see `row_name`.
    name : str
    copy : bool
        Whether to copy the arrays. If false, b, matrix, compliance and guess are used without a copy if their type
        fits; they are then shared with the caller and marked read-only.
    precision : {"float64", "float32"}, optional
        Precision in which an engine computed these numbers and its answers. `lavender.residual` derives from it the
        error that rounding alone can cause. Default: the precision of `rows`. Problems are always solved in float64.
    angular : (m,) bool, optional
        Rows with an angular velocity [rad/s], such as rows of hinges, for the units of texts (`row_unit`). Bodies
        and contacts show it themselves; it is needed for bounded rows of J and M.
    qp : QuadraticProgram, optional
        Quadratic program from which `Problem.from_qp` built this problem; files contain it only if P is singular.

    Raises
    ------
    InputError
        An array has a wrong shape, a NaN or an infinity; none or several of matrix, rows and generalized are given; or
        A has 2^31 or more entries.
    """

    def carry(self, previous: Any, keys: Any = None) -> FloatArray:
        """Build a start (m,) [N s] from the impulses of the previous step, which are assigned to blocks by their keys.

        `lavender.solve(problem, impulse=previous)` does the same.

        Blocks without a previous impulse, or with another kind or number of rows, start at Pi(0). Problems without keys
        must have the same blocks. Tangent impulses are not rotated: use the same tangent directions of a contact in
        every step.

        Parameters
        ----------
        previous : Solution, or (Problem, impulse)
            Result of the previous step; its problem has keys.
        keys : (k,) unsigned int, optional
            Keys of this problem's blocks. Default: `key`.

        Returns
        -------
        numpy.ndarray

        Raises
        ------
        InputError
            `previous` is not a solution; `keys` does not have k entries; a key names several blocks of one problem; or
            a problem has no keys, and the blocks of both differ or `keys` is given.

        Examples
        --------
        >>> import numpy as np
        >>> import lavender as lv
        >>> first = lv.Problem.lcp(np.eye(3), [1.0, 2.0, 3.0], key=np.array([7, 8, 9]))
        >>> solution = lv.solve(first)
        >>> second = lv.Problem.lcp(np.eye(2), [3.1, 5.0], key=np.array([9, 4]))  # one stays, one is new
        >>> second.carry(solution).tolist()
        [3.0, 0.0]
        >>> lv.solve(second, impulse=solution).success
        True
        """
        if isinstance(previous, tuple) and len(previous) == 2 and isinstance(previous[0], Problem):
            before = previous[0]
            impulse = previous[0].make_start(previous[1])
        elif hasattr(previous, "residual") and hasattr(previous, "impulse"):
            before = previous.residual._problem  # pyright: ignore[reportAttributeAccessIssue]
            impulse = previous.impulse
        else:
            given = "None" if previous is None else f"a {type(previous).__name__}"
            hint = (
                ": the first step has no start, solve it without impulse="
                if previous is None
                else ""
            )
            raise InputError(
                f"previous is {given}; a Solution, or (problem, impulse), is needed{hint}"
            )
        if keys is not None:
            if before.key is None:
                raise InputError("the problem of the previous step has no keys: build it with key=")
            return replace(self, key=keys, copy=False).carry((before, impulse))
        start, *repeated = self._carry(before, impulse)
        checked = (("this problem", self), ("the previous one", before))
        for (name, problem), repeats in zip(checked, repeated, strict=True):
            if repeats:
                values, counts = np.unique(problem.key, return_counts=True)
                raise InputError(
                    f"key {values[counts.argmax()]} of {name} names {counts.max()} blocks, so that impulses cannot be "
                    "assigned: give each block a key of its own"
                )
        if start is None:
            keyless = " and ".join(
                name
                for name, p in (("this problem", self), ("the previous one", before))
                if p.key is None
            )
            raise InputError(
                f"no keys in {keyless}, and the blocks differ ({self.cones.n_blocks} now, {before.cones.n_blocks} "
                "before): build both problems with key= (lv.RowBuilder does), or solve without impulse="
            )
        return start

    def _carry(self, before: Problem, impulse: FloatArray) -> tuple[FloatArray | None, bool, bool]:
        """Return a start as `carry` does or None, and whether this problem and `before` repeat a key."""
        old, new = before.cones, self.cones
        if self.key is None or before.key is None:
            is_same = np.array_equal(old.kind, new.kind) and np.array_equal(old.ptr, new.ptr)
            return (impulse.copy() if is_same else None), False, False
        start = self.start()
        return start, *carry_impulses_by_key(
            old._blocks, before.key, impulse, new._blocks, self.key, start
        )

    # -- other forms -----------------------------------------------------------------------------

    def relaxed(self, friction: str = "cone") -> Problem:
        """Return the problem with another friction law: "cone" is the convex relaxation of "coulomb".

        Raises
        ------
        InputError
            `friction` is "coulomb", and the problem has round cones of more than two tangents.
        """
        relaxed = replace(self, friction=friction, copy=False)
        self._share_operator(relaxed)
        return relaxed

    @property
    def disk(self) -> Problem:
        """The problem itself, or if it has ellipses an equivalent one in stretched tangents, whose contacts are disks.

        The mu of a disk is max(mu_1, mu_2). The rows of the equivalent problem are multiplied by `cones.stretch`, its
        impulses are divided by it. The friction laws of both problems are equivalent: friction maximises dissipation,
        lambda_t = -mu^2 w_t lambda_n / |mu w_t| with mu = diag(mu_1, mu_2). Solvers and the judge use the disks. Their
        results are converted to the rows of this problem.

        Examples
        --------
        An ellipse, mu 0.5 along the first tangent and 0.2 along the second:

        >>> import numpy as np
        >>> import lavender as lv
        >>> problem = lv.Problem.contact(np.eye(3), [10.0, 9.0, 9.0], mu=[(0.5, 0.2)])
        >>> impulse = lv.solve(problem, tol=1e-9).impulse
        >>> round(float(np.hypot(impulse[1] / 0.5, impulse[2] / 0.2) / impulse[0]), 6)  # it slides: on the boundary
        1.0
        >>> problem.disk.cones.mu.tolist(), problem.disk.b.tolist()
        ([0.5], [10.0, 9.0, 3.6])
        """
        return self._disk if self.cones.has_ellipse else self

    def on_disk(self, impulse: FloatArray) -> FloatArray:
        """Convert impulses (m,) [N s] of this problem to impulses of `disk`."""
        if not self.cones.has_ellipse:
            return impulse
        with np.errstate(over="ignore"):  # Large impulses may overflow without a warning.
            return impulse / self.cones.stretch

    @computed_once
    def _disk(self) -> Problem:
        """Problem in stretched tangents: A' = S A S, b' = S b, lambda = S lambda', w' = S w with S = diag(stretch)."""
        s, cones = self.cones.stretch, self.cones.ellipses_replaced_by_disks
        changes: dict[str, Any] = {
            "guess": None if self.guess is None else self.on_disk(self.guess)
        }
        if self.generalized is None:
            indptr, indices, data = self._compressed
            data = np.repeat(s, np.diff(indptr)) * data * s[indices]
            a = sp.csr_array((data, indices, indptr), shape=(self.m, self.m))
            changes |= {"matrix": a, "rows": None, "compliance": None}
        else:
            assert self.compliance is not None
            compliance = s * s * self.compliance
            compliance[compliance < MIN_MAGNITUDE] = (
                0.0  # A compliance must be 0 or at least MIN_MAGNITUDE.
            )
            changes |= {
                "generalized": self.generalized.with_scaled_rows(s),
                "compliance": compliance,
            }
        disk = replace(self, b=s * self.b, cones=cones, copy=False, **changes)
        if self.rows is not None:
            disk.metric.copy_velocity_weight(self.metric, True)
        return disk

    def boxed(self, normal_impulse: ArrayLike) -> Problem:
        """Return the problem with friction bounded by fixed normal impulses: |lambda_t| <= mu N on each tangent.

        Parameters
        ----------
        normal_impulse : scalar or (c,) N s
            N of each contact, in block order.

        Returns
        -------
        Problem
            An LCP; two tangents are bounded by a square instead of a disk.
        """
        c = self.cones
        normal_of_block = np.zeros(c.n_blocks)
        n = as_array("normal_impulse", normal_impulse, (len(c.normal_rows),), unit="N s")
        normal_of_block[c.is_contact] = n
        check_not_negative("normal_impulse", n)
        with np.errstate(over="ignore"):
            bound = as_array(
                "mu N",
                c.friction_coefficient * np.repeat(normal_of_block, np.diff(c.ptr)),
                (self.m,),
                unit="N s",
            )
        lower, upper = np.where(c.friction_rows, [-bound, bound], [c.lower, c.upper])
        names = None if self.names is None else [self.row_name(i) for i in range(self.m)]
        more: dict[str, Any] = (
            {"matrix": self.csr}
            if self.generalized is None
            else {"generalized": self.generalized, "compliance": self.compliance}
        )
        return Problem(
            self.b,
            Cones.bounded(lower, upper),
            guess=self.guess,
            names=names,
            name=self.name,
            copy=False,
            precision=self.precision,
            angular=self.angular_rows,
            **more,
        )

    def velocity_form(self) -> VelocityForm:
        """Compute the mass-scaled velocity form (see `VelocityForm`).

        Raises
        ------
        CapabilityError
            The problem was given as a matrix.
        """
        jac = self.jacobian
        scale = 1.0 / np.sqrt(self.d)
        if self.generalized is not None:
            k = sp.csr_array(sp.diags_array(scale) @ self.whitened)
            return VelocityForm(k, scale * self.b, self.compliance * scale**2, scale)  # type: ignore[operator]
        rows = self.rows
        assert rows is not None
        # Compute M^-1 = L L^T body by body, by eigenvalues, because the singular inverse inertia of a body with a
        # fixed axis has no Cholesky factor.
        value, vector = np.linalg.eigh(rows.inv_inertia)
        root = vector * np.sqrt(np.maximum(value, 0.0))[:, None, :]
        half = replace(
            rows, inv_mass=np.sqrt(rows.inv_mass), inv_inertia=root, copy=False
        ).inverse_mass_matrix()
        k = sp.csr_array(sp.diags_array(scale) @ (jac @ half))
        return VelocityForm(k, scale * self.b, self.compliance * scale**2, scale)  # type: ignore[operator]

    def save(self, path: str | PathLike[str], **more: Any) -> None:
        """Write the problem to a file by `lavender.io.save`; `more` are its options."""
        import_module_lazily("lavender.io").save(self, path, **more)
