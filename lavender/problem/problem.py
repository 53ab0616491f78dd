"""`Problem`: the data, what follows from it, ways to make one, and its other forms."""

from __future__ import annotations

from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np

from lavender.base.arrays import ArrayLike, FloatArray, as_array, check_not_negative
from lavender.base.errors import InputError
from lavender.base.lazy_import import lazy_module
from lavender.base.lazy_import import sparse as sp
from lavender.problem.builders import Builders
from lavender.problem.cones import Cones
from lavender.problem.derived import once
from lavender_ext.core.checks import LEAST


@dataclass(frozen=True, eq=False)
class VelocityForm:
    """min 1/2 |y|^2 + 1/2 z^T diag(theta) z over y [sqrt J], z = scaled impulse, in the metric of d.

        K y + diag(theta) z - g  is complementary to  z,     y = K^T z,
        K = D^-1/2 J M^-1/2,  theta = compliance / d,  g = D^-1/2 b,  lambda = D^-1/2 z

    so that K K^T + diag(theta) = D^-1/2 A D^-1/2 and y is the mass-scaled change of velocity M^1/2 (v - v*).
    """

    jacobian: sp.csr_array  # K (m, 6 n), unit rows
    rhs: FloatArray  # g (m,) sqrt J
    theta: FloatArray  # (m,) -
    scale: FloatArray  # D^-1/2 (m,) sqrt kg

    def impulse(self, multiplier: FloatArray) -> FloatArray:
        """lambda (m,) [N s] of a multiplier z (m,) [sqrt J]."""
        return self.scale * multiplier


class Problem(Builders):
    """A constraint problem: find impulses lambda (m,) [N s] with w = A lambda - b [m/s] complementary to them.

    Usually made by `Problem.lcp`, `linear`, `contact`, `from_rows`, `from_jacobian` or `from_findex`.

    Parameters
    ----------
    b : (m,) m/s
        target - J v*: the relative velocity that the impulses must supply.
    cones : Cones
        Blocks and bounds.
    matrix : (m, m) array or sparse, 1/kg
        A, kept exactly as given (it may be asymmetric, indefinite or singular); or
    rows : Rows
        J and M^-1 of bodies; A = J M^-1 J^T + diag(compliance) is formed only if needed; or
    generalized : Generalized
        J and M in generalised coordinates; as with rows, A is formed only if needed.
    friction : {"coulomb", "cone"}
        Coulomb friction (non-associated), or its convex relaxation.
    compliance : (m,) 1/kg, not with a matrix
        Softness of each row, >= 0; added to the diagonal of A.
    guess : (m,) N s, optional
        Default warm start of every solve of this problem.
    key : (k,) uint64, optional
        Identity of each block, by which it is found again in the next step.
    names : sequence of str (k,), optional
        Names of the blocks, e.g. "hinge 7"; see `row_name`.
    name : str
    copy : bool
        True copies the arrays. False uses b, matrix, compliance and guess without a copy if their type fits; they are
        then shared with the caller and marked read-only.
    precision : {"float64", "float32"}, optional
        Precision in which an engine computed these numbers and computes its answers; `lavender.residual` then knows
        which error rounding alone explains. Default: that of `rows`. Problems are always solved in float64.
    qp : QuadraticProgram, optional
        The program that `Problem.from_qp` made this problem of; files hold it if P is singular.

    Raises
    ------
    InputError
        Wrong shapes, NaN or infinity, none or several of matrix, rows and generalized, or nnz >= 2^31.
    """

    def carry(self, previous: Any, keys: Any = None) -> FloatArray:
        """Start (m,) [N s] from the impulses of the step before: each block's by its key, the others Pi(0).

        A block that has changed its kind or its number of rows starts anew. Where a problem has no keys,
        impulses stay if both have the same blocks. Impulses of tangents are taken as they are: keep the directions of a
        contact's tangents from step to step.

        Parameters
        ----------
        previous : Solution, or (Problem, impulse)
            Of the step before; its problem has keys.
        keys : (k,) unsigned int, optional
            Of this problem's blocks; default: `key`.

        Raises
        ------
        InputError
            No solution, keys of another length, or keys here and none before.

        Examples
        --------
        >>> import numpy as np
        >>> import lavender as lv
        >>> first = lv.Problem.lcp(np.eye(3), [1.0, 2.0, 3.0], key=np.array([7, 8, 9]))
        >>> solution = lv.solve(first)
        >>> second = lv.Problem.lcp(np.eye(2), [3.1, 5.0], key=np.array([9, 4]))  # one stays, one is new
        >>> second.carry(solution).tolist()
        [3.0, 0.0]
        >>> lv.solve(second, impulse=second.carry(solution)).success
        True
        """
        if isinstance(previous, tuple) and len(previous) == 2 and isinstance(previous[0], Problem):
            before, impulse = previous[0], previous[0].impulse_array(previous[1])
        elif hasattr(previous, "residual") and hasattr(previous, "impulse"):
            before, impulse = previous.residual._problem, previous.impulse
        else:
            raise InputError(
                f"previous is a {type(previous).__name__}; a Solution, or (problem, impulse), is needed"
            )
        if keys is not None:
            if before.key is None:
                raise InputError("the problem of the step before has no keys: make it with key=")
            return replace(self, key=keys, copy=False).carry((before, impulse))
        start = self.start()
        old, new = before.cones, self.cones
        if self.key is None or before.key is None:
            if np.array_equal(old.ptr, new.ptr) and np.array_equal(old.kind, new.kind):
                start[:] = impulse
            return start
        place = {key: i for i, key in enumerate(before.key.tolist())}
        for block, key in enumerate(self.key.tolist()):
            i = place.get(key)
            if i is None or old.kind[i] != new.kind[block]:
                continue
            here, there = slice(new.ptr[block], new.ptr[block + 1]), slice(old.ptr[i], old.ptr[i + 1])
            if here.stop - here.start == there.stop - there.start:
                start[here] = impulse[there]
        return start

    # -- other forms -----------------------------------------------------------------------------

    def relaxed(self, friction: str = "cone") -> Problem:
        """The same problem under another friction law: "cone" is the convex relaxation.

        Raises
        ------
        InputError
            "coulomb" for round cones of more than two tangents.
        """
        return replace(self, friction=friction, copy=False)

    @property
    def disk(self) -> Problem:
        """The problem whose contacts are disks: this one, or where it has ellipses the same in stretched tangents.

        There mu is max(mu_1, mu_2), rows are `cones.stretch` as long and impulses those here over it. Both laws hold
        here as they hold there: friction takes most energy from sliding, lambda_t = -mu^2 w_t lambda_n / |mu w_t| with
        mu = diag(mu_1, mu_2). It is what solvers get and the judge measures; results come back in the
        rows of this problem.

        Examples
        --------
        An ellipse, mu 0.5 along the first tangent and 0.2 along the second:

        >>> import numpy as np
        >>> import lavender as lv
        >>> problem = lv.Problem.contact(np.eye(3), [10.0, 9.0, 9.0], mu=[(0.5, 0.2)])
        >>> impulse = lv.solve(problem, tol=1e-9).impulse
        >>> round(float(np.hypot(impulse[1] / 0.5, impulse[2] / 0.2) / impulse[0]), 6)  # it slides: on the rim
        1.0
        >>> problem.disk.cones.mu.tolist(), problem.disk.b.tolist()
        ([0.5], [10.0, 9.0, 3.6])
        """
        return self._disk if self.cones.has_ellipse else self

    def on_disk(self, impulse: FloatArray) -> FloatArray:
        """Impulses (m,) [N s] of this problem as those of `disk`."""
        if not self.cones.has_ellipse:
            return impulse
        with np.errstate(over="ignore"):  # an impulse may be as large as it likes
            return impulse / self.cones.stretch

    @once
    def _disk(self) -> Problem:
        # A' = S A S,   b' = S b,   lambda = S lambda',   w' = S w,   S = diag(stretch), 1 but at tangents of ellipses
        s, cones = self.cones.stretch, self.cones.disks
        guess = None if self.guess is None else self.on_disk(self.guess)
        more: dict[str, Any] = {"guess": guess, "key": self.key, "names": self.names, "name": self.name}
        more |= {"friction": self.friction, "precision": self.precision}
        if self.generalized is None:
            indptr, indices, data = self._compressed
            data = np.repeat(s, np.diff(indptr)) * data * s[indices]
            a = sp.csr_array((data, indices, indptr), shape=(self.m, self.m))
            made = Problem(s * self.b, cones, a, copy=False, **more)
        else:
            assert self.compliance is not None
            soft = s * s * self.compliance
            soft[soft < LEAST] = 0.0  # less than a compliance may have
            scaled = self.generalized.with_scaled_rows(s)
            made = Problem(s * self.b, cones, generalized=scaled, compliance=soft, copy=False, **more)
        if self.rows is not None:
            made.metric.weigh_as(self.metric, True)
        return made

    def boxed(self, normal_impulse: ArrayLike) -> Problem:
        """Friction bounded by fixed normals: |lambda_t| <= mu N on each tangent alone: a square, not the disk.

        Parameters
        ----------
        normal_impulse : scalar or (c,) N s
            N of each contact, in block order.
        """
        c = self.cones
        load = np.zeros(c.n_blocks)
        load[c.is_contact] = n = as_array("normal_impulse", normal_impulse, (len(c.normal_rows),), unit="N s")
        check_not_negative("normal_impulse", n)
        with np.errstate(over="ignore"):
            bound = as_array("mu N", c.reach * np.repeat(load, np.diff(c.ptr)), (self.m,), unit="N s")
        lower, upper = np.where(c.friction_rows, [-bound, bound], [c.lower, c.upper])
        names = None if self.names is None else [self.row_name(i) for i in range(self.m)]
        more: dict[str, Any] = {"matrix": self.csr} if self.generalized is None else {
            "generalized": self.generalized, "compliance": self.compliance
        }  # fmt: skip
        return Problem(
            self.b,
            Cones.bounded(lower, upper),
            guess=self.guess,
            names=names,
            name=self.name,
            copy=False,
            precision=self.precision,
            **more,
        )

    def velocity_form(self) -> VelocityForm:
        """The mass-scaled velocity form (see `VelocityForm`); not with a matrix.

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
        # M^-1 = L L^T by blocks; a singular inverse inertia (a pinned axis) has a root but no Cholesky factor.
        value, vector = np.linalg.eigh(rows.inv_inertia)
        root = vector * np.sqrt(np.maximum(value, 0.0))[:, None, :]
        half = replace(
            rows, inv_mass=np.sqrt(rows.inv_mass), inv_inertia=root, copy=False
        ).inverse_mass_matrix()
        k = sp.csr_array(sp.diags_array(scale) @ (jac @ half))
        return VelocityForm(k, scale * self.b, self.compliance * scale**2, scale)  # type: ignore[operator]

    def save(self, path: str | PathLike[str], **more: Any) -> None:
        """Write the problem to a file; `lavender.io.save`, whose options `more` are."""
        lazy_module("lavender.io").save(self, path, **more)
