"""Problems from a matrix, from rows of bodies, from J and M, and from the problem of another step."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from lavender.base.arrays import (
    ArrayLike,
    FloatArray,
    IntArray,
    as_array,
    check_unmasked,
    precision_of,
    shape_of,
)
from lavender.base.errors import InputError
from lavender.problem.cones import Cones, kinds_of
from lavender.problem.data import Names, checked_matrix
from lavender.problem.findex import arrays_of, blocks_of, order_of
from lavender.problem.friction import check_shape
from lavender.problem.generalized import Generalized
from lavender.problem.operators import Operators
from lavender.problem.program import convert_program, unpack_program
from lavender.problem.rows import Rows
from lavender_ext.core.problem import rows_velocity

P = TypeVar("P", bound="Builders")

#: What every method that makes a problem passes on to `Problem`.
SHARED = ("name", "names", "key", "friction", "guess", "compliance", "precision", "copy")
BOUNDS = ("lower", "upper", "mu", "tangents", "patch_radius", "rolling", "shape")  # of rows of bodies


def check_keywords(method: str, given: Iterable[str], own: Sequence[str] = ()) -> None:
    """Raise InputError at a keyword that `Problem.method` does not take; the message names those that it takes."""
    for name in given:
        if name not in SHARED:
            takes = ", ".join(f"{word}=" for word in (*own, *SHARED))
            raise InputError(f"Problem.{method} has no argument {name}=; it takes {takes}")


class Builders(Operators):
    """Ways to make a problem."""

    @classmethod
    def linear(cls: type[P], A: Any, b: ArrayLike, **more: Any) -> P:
        """A lambda = b: every row unbounded. A (m, m) [1/kg], b (m,) [m/s]."""
        check_keywords("linear", more)
        b = as_array("b", b, (None,), unit="m/s")
        return cls(b, Cones.free(len(b)), A, **more)

    @classmethod
    def lcp(
        cls: type[P], A: Any, b: ArrayLike, lower: ArrayLike = 0.0, upper: ArrayLike = np.inf, **more: Any
    ) -> P:
        """Boxed LCP: lower <= lambda <= upper complementary to A lambda - b; bounds scalar or (m,) [N s]."""
        check_keywords("lcp", more, ("lower", "upper"))
        b = as_array("b", b, (None,), unit="m/s")
        bounds = [
            as_array(n, x, (len(b),), finite=False, unit="N s")
            for n, x in (("lower", lower), ("upper", upper))
        ]
        return cls(b, Cones.bounded(*bounds), A, **more)

    @classmethod
    def contact(
        cls: type[P],
        A: Any,
        b: ArrayLike,
        mu: ArrayLike,
        patch_radius: ArrayLike | None = None,
        *,
        rolling: ArrayLike | None = None,
        **more: Any,
    ) -> P:
        """Contacts only, m / k rows each: normal, up to two tangents, spin with `patch_radius`, two with `rolling`.

        Parameters
        ----------
        A : (m, m) 1/kg, array or sparse
        b : (m,) m/s
            Normal first in every contact.
        mu : scalar, (k,) or (k, 2)
            One for each contact. A scalar stands for all of them, which then have two tangents, or for a single one.
            Two: an ellipse, see `Cones.contacts`.
        patch_radius : scalar or (k,) m, optional
            Gives each contact a spin row.
        rolling : scalar or (k,) m, optional
            mu_r: gives each contact two rows that roll, after the others; two tangents are needed.

        Raises
        ------
        InputError
            The rows do not part among the contacts; mu > 0 where contacts have no row for friction.
        """
        check_keywords("contact", more, ("mu", "patch_radius", "rolling"))
        b = as_array("b", b, (None,), unit="m/s")
        check_unmasked("mu", mu)
        if len(shape_of("mu", mu)) > 1:
            return cls(b, Cones.contacts(mu, 2, patch_radius, rolling=rolling), A, **more)
        turns = (patch_radius is not None) + 2 * (rolling is not None)
        if np.ndim(mu) == 0:
            each = 3 + turns
            mu = np.full(len(b) // each if len(b) % each == 0 else 1, mu)
        mu = as_array("mu", mu, (None,))
        if (len(mu) == 0) != (len(b) == 0) or (len(mu) and len(b) % len(mu)):
            raise InputError(
                f"b has {len(b)} rows for {len(mu)} values of mu; the same number of rows for each "
                "contact is needed"
            )
        tangents = len(b) // len(mu) - 1 - turns if len(mu) else 2 * (rolling is not None)
        if not 0 <= tangents <= 2:
            raise InputError(
                f"{len(b)} rows for {len(mu)} contacts; a contact has a normal, up to two tangents, "
                "spin with patch_radius, and two rows that roll with rolling"
            )
        if patch_radius is not None:
            patch_radius = as_array("patch_radius", patch_radius, (len(mu),), unit="m")
        elif tangents == 0 and np.any(mu > 0.0):
            raise InputError(
                f"mu has {len(mu)} values for {len(b)} rows, so each contact is a normal alone, without a row for "
                "friction: give one mu for each contact (normal and tangents together), or mu = 0"
            )
        return cls(b, Cones.contacts(mu, tangents, patch_radius, rolling=rolling), A, **more)

    @classmethod
    def from_findex(
        cls: type[P],
        A: Any,
        b: ArrayLike,
        lower: ArrayLike,
        upper: ArrayLike,
        findex: ArrayLike,
        **more: Any,
    ) -> P:
        """The arrays of engines (ODE, Bullet, DART), as they are: friction that follows its normal, tangent by tangent.

        Where the normals do not stand right before the rows that follow them, the rows of the problem are those of the
        arrays in another order, `Problem.findex_order(findex)`. A `guess` is in the order of the arrays; `key` and
        `names` are of the problem's blocks.

        Parameters
        ----------
        A : (m, m) 1/kg, array or sparse
        b : (m,) m/s
        lower, upper : scalar or (m,) N s
            Where findex < 0; where it is not, upper is mu [-] and lower, there -mu, is not read, as in these engines.
        findex : (m,) int
            Row of the normal whose impulse bounds this one, |lambda_i| <= upper_i lambda_findex; -1: constant bounds.

        Raises
        ------
        InputError
            A findex out of range, of its own row, or of a row that is no normal [0, inf]; more than two rows that
            follow one; mu that is negative or not finite; lower > upper.

        Examples
        --------
        >>> import numpy as np
        >>> import lavender as lv
        >>> A, b = np.eye(3), [10.0, 9.0, -1.0]  # pressed on, and dragged along both tangents
        >>> problem = lv.Problem.from_findex(A, b, [0.0, -0.5, -0.5], [np.inf, 0.5, 0.5], [-1, 0, 0])
        >>> lv.solve(problem, tol=1e-9).impulse.tolist()  # N s: the first slides, the second holds
        [10.0, 5.0, -1.0]
        """
        check_keywords("from_findex", more, ("lower", "upper", "findex"))
        b = as_array("b", b, (None,), unit="m/s")
        order, cones = blocks_of(lower, upper, findex, len(b))
        if (order[1:] < order[:-1]).any():
            matrix = checked_matrix(A, len(b), True)
            if more.get("guess") is not None:
                more["guess"] = as_array("guess", more["guess"], (len(b),), unit="N s")[order]
            return cls(b[order], cones, matrix[order][:, order], **more)
        return cls(b, cones, A, **more)

    @staticmethod
    def findex_order(findex: ArrayLike) -> IntArray:
        """(m,) row of the arrays given to `from_findex` for each row of its problem.

        >>> import lavender as lv
        >>> lv.Problem.findex_order([-1, -1, 0, 0, 1, 1]).tolist()  # all normals first, as Bullet has them
        [0, 2, 3, 1, 4, 5]
        """
        return order_of(findex)

    def to_findex(self) -> tuple[Any, FloatArray, FloatArray, FloatArray, IntArray]:
        """(A, b, lower, upper, findex) as ODE, Bullet and DART have them, of the rows in this problem's order.

        Raises
        ------
        InputError
            A disk, or the law "cone": findex has neither.
        """
        lower, upper, findex = arrays_of(self.cones)
        if self.law == "cone":
            raise InputError(
                "findex means Coulomb friction, not the law 'cone': pass problem.relaxed('coulomb')"
            )
        return self.delassus(), self.b, lower, upper, findex

    @classmethod
    def from_rows(
        cls: type[P],
        rows: Rows,
        target: ArrayLike = 0.0,
        *,
        lower: ArrayLike = -np.inf,
        upper: ArrayLike = np.inf,
        mu: ArrayLike = 0.0,
        tangents: ArrayLike | None = None,
        patch_radius: ArrayLike | None = None,
        rolling: ArrayLike | None = None,
        shape: str = "disk",
        **more: Any,
    ) -> P:
        """Problem of a step from factored rows: b = target - J v*.

        Parameters
        ----------
        rows : Rows
        target : scalar or (m,) m/s
            Wanted relative velocity after the step: 0 holds, +depth/dt pushes out (depth positive inside), -e v_n
            bounces off an approach v_n < 0. A gap is a negative depth.
        lower, upper : scalar or (mj,) N s
            Bounds of the joint rows.
        mu : scalar or (c,)
        tangents : int or (c,), optional
            Tangent rows of each contact, 0 to 2. Default: two where mu > 0.
        patch_radius : scalar or (c,) m, optional
            Gives each contact a spin row.
        shape : {"disk", "box"}
            Of friction in two tangents; see `Cones.contacts`. Two coefficients: replace(problem, cones=...).
        rolling : scalar or (c,) m, optional
            mu_r: gives each contact two rows that roll about its two tangents; all contacts need two.
        **more
            As `Problem`: name, friction, ...; the example of `Rows` is a whole stack.

        Raises
        ------
        InputError
            mu > 0 at a contact without tangents and spin, which no row could feel.

        Examples
        --------
        A ball of 2 kg and 0.1 m, 0.01 m deep in the ground, is out of it after the step:

        >>> import numpy as np
        >>> import lavender as lv
        >>> dt, depth = 1 / 60, 0.01
        >>> ball = lv.Rows(
        ...     inv_mass=[0.5],
        ...     inv_inertia=[np.eye(3) / (0.4 * 2 * 0.1**2)],
        ...     v_free=[[0.0, 0.0, -9.81 * dt, 0.0, 0.0, 0.0]],
        ...     contact_body=[(-1, 0)],
        ...     normal=[(0.0, 0.0, 1.0)],
        ...     tangent=[(1.0, 0.0, 0.0)],
        ...     arm_a=[(0.0, 0.0, 0.0)],
        ...     arm_b=[(0.0, 0.0, -0.09)],
        ... )
        >>> impulse = lv.solve(lv.Problem.from_rows(ball, target=depth / dt), tol=1e-9).impulse
        >>> v = ball.v_free[0, 2] + 0.5 * impulse[0]  # m/s
        >>> round(float(v * dt), 6)  # m: it rises by its depth
        0.01
        """
        check_keywords("from_rows", more, ("target", *BOUNDS))
        if not isinstance(rows, Rows):
            raise InputError(f"rows is a {type(rows).__name__}; a Rows is needed")
        mu = as_array("mu", mu, (rows.n_contacts,))
        if tangents is None:
            tangents = 2 * (mu > 0.0).astype(np.int32)
        tangents = as_array("tangents", tangents, mu.shape, dtype=np.int32)
        contacts = _contacts(mu, tangents, patch_radius, rolling, check_shape("shape", shape))
        joints = _joints(rows, lower, upper)
        cones = joints + contacts if rows.n_joints else contacts
        m = cones.n_rows
        target = as_array("target", target, (m,), unit="m/s")
        made, jv = cls(np.zeros(m), cones, rows=rows, **more), np.zeros(m + 1)
        rows_velocity(made.data, rows.v_free, jv)
        made._aim(target - jv[:m])
        return made

    @classmethod
    def from_jacobian(
        cls: type[P],
        J: Any,
        M: Any,
        v_free: ArrayLike,
        *,
        target: ArrayLike = 0.0,
        cones: Cones,
        compliance: ArrayLike | None = None,
        friction: str = "coulomb",
        names: Sequence[str] | None = None,
        dof_names: Sequence[str] | None = None,
        **more: Any,
    ) -> P:
        """Problem of a step in generalised coordinates: w = J v+ - target + compliance lambda.

        Parameters
        ----------
        J : (m, nv) array or sparse
            Rows in the order of `cones`, e.g. `Cones.free(6) + Cones.contacts(0.5, count=8)`; of a contact its normal,
            then its two tangents.
        M : (nv, nv) array or sparse, or a sequence of square blocks, one for each kinematic tree
            Mass matrix, symmetric positive definite. J and M are copied, whatever `copy` says.
        v_free : (nv,) m/s, rad/s
            v*, the velocity after the step without constraint impulses.
        target : scalar or (m,) m/s
            Wanted relative velocity after the step: 0 holds, +depth/dt pushes out (depth positive inside), -e v_n
            bounces off an approach v_n < 0. A gap is a negative depth.
        cones : Cones
        compliance : scalar or (m,) 1/kg, optional
        friction : {"coulomb", "cone"}
        precision : {"float64", "float32"}, optional
            Default: float32 where J, M and v_free are arrays of float32; they are widened exactly.
        names, dof_names : sequence of str (k,), (nv,), optional
            Names of blocks and of velocities.

        Examples
        --------
        A cart of 2 kg with a pole of 1 kg and 0.5 m runs with its tip into a wall, friction 0.5 in one tangent:

        >>> import numpy as np
        >>> import lavender as lv
        >>> c, s = 0.5 * np.cos(0.3), 0.5 * np.sin(0.3)
        >>> M = [[3.0, c], [c, 0.25]]  # of cart and hinge
        >>> J = [[1.0, c], [0.0, s]]  # velocity of the tip off the wall, and along it
        >>> cones = lv.Cones.contacts(0.5, tangents=1)
        >>> problem = lv.Problem.from_jacobian(J, M, v_free=[-1.0, 0.2], cones=cones)
        >>> solution = lv.solve(problem, tol=1e-9)
        >>> solution.impulse.round(3).tolist()  # N s: it slides, 0.579 = 0.5 x 1.158
        [1.158, -0.579]

        The same with the tip 0.01 m inside the wall, and a step of 1/60 s:

        >>> inside = problem.updated(target=[0.01 * 60, 0.0])
        >>> pushed = lv.solve(inside, tol=1e-9)
        >>> round(float((inside.generalized.velocity_of(inside.velocity(pushed.impulse)))[0] / 60), 6)  # m
        0.01
        """
        check_keywords("from_jacobian", more, ("target", "cones", "dof_names"))
        generalized = J if isinstance(J, Generalized) else Generalized(J, M, v_free, dof_names)
        m = generalized.m
        if isinstance(cones, Cones) and cones.n_rows != m:
            hint = (
                " (a contact has a normal and two tangents, or tangents=0, 1)" if np.any(cones.kind) else ""
            )
            raise InputError(f"J has {m} rows; {cones.n_rows} are needed, as the cones have{hint}")
        more.setdefault("precision", precision_of(J, *(M if isinstance(M, (list, tuple)) else [M]), v_free))
        target = as_array("target", target, (m,), unit="m/s")
        if compliance is not None:
            compliance = as_array("compliance", compliance, (m,), unit="1/kg")
        return cls(
            generalized.bias(target),  # what is not finite, the problem refuses
            cones,
            friction=friction,
            compliance=compliance,
            names=names,
            generalized=generalized,
            **more,
        )

    @classmethod
    def from_qp(
        cls: type[P],
        P: Any,
        q: ArrayLike | None = None,
        G: Any = None,
        h: ArrayLike | None = None,
        A: Any = None,
        b: ArrayLike | None = None,
        lb: ArrayLike | None = None,
        ub: ArrayLike | None = None,
        **more: Any,
    ) -> P:
        """A convex quadratic program: min 1/2 x.P x + q.x subject to G x <= h, A x = b, lb <= x <= ub.

        If P is positive definite, x are generalised velocities of the mass matrix P, and every solver of bounded rows
        takes the problem. `lavender.solve_qp` gives x and the multipliers, or `problem.qp.solution(solution)` those of
        a solution by `lavender.solve`.

        Parameters
        ----------
        P : (n, n) array or sparse, or a `qpsolvers.Problem`, which is given alone
            Symmetric, both triangles, positive semidefinite. If it is singular (its Cholesky factor has a pivot of at
            most 1e-13 of the diagonal entry), the problem has x and the multipliers as unknowns, and only solvers of
            quadratic programs take it: `auto` selects piqp, clarabel or osqp, the first that is installed.
        q : (n,)
        G, h : (mi, n) array or sparse, and (mi,), optional
            Entries of h may be inf; from 1e20 on they are.
        A, b : (me, n) array or sparse, and (me,), optional
        lb, ub : (n,), optional
            Entries may be infinite; from 1e20 on, in size, they are.
        **more
            As `Problem`: name, guess, ...

        Zeros are left out of dense matrices, which are then solved as sparse ones; all arrays are copied.

        Raises
        ------
        InputError
            Shapes that do not fit, NaN, lb > ub; P not symmetric, or not positive semidefinite, with its least
            eigenvalue.

        Examples
        --------
        >>> import numpy as np
        >>> import lavender as lv
        >>> P, q = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([1.0, 1.0])
        >>> problem = lv.Problem.from_qp(P, q, A=np.ones((1, 2)), b=[1.0], lb=np.zeros(2), ub=[0.7, 0.7])
        >>> answer = lv.solve_qp(problem)
        >>> answer.x.round(9).tolist(), answer.y.round(9).tolist(), answer.z_box.round(9).tolist()
        ([0.3, 0.7], [-1.95], [0.0, 0.1])
        """
        check_keywords("from_qp", more, ("P", "q", "G", "h", "A", "b", "lb", "ub"))
        qp = convert_program(unpack_program((P, q, G, h, A, b, lb, ub)))
        if qp.is_singular:
            n, m = len(qp.q), len(qp.target)
            more.setdefault("names", Names(n + m, partial(_names_of_program, n, m)))
        return cls(**qp.problem_fields(), qp=qp, **more)

    def updated(
        self: P,
        *,
        J: Any = None,
        M: Any = None,
        v_free: ArrayLike | None = None,
        b: ArrayLike | None = None,
        target: ArrayLike | None = None,
        guess: ArrayLike | None = None,
    ) -> P:
        """The same structure with new numbers: what is not given stays.

        Parameters
        ----------
        J, M, v_free : as in `from_jacobian`
            Only in generalised coordinates; copied, so that a loop may fill the same arrays again.
        b : (m,) m/s, optional
            The right-hand side itself; or
        target : scalar or (m,) m/s, optional
            b = target - J v*.
        guess : (m,) N s, optional
            Default: none, as it belongs to other numbers.

        Raises
        ------
        InputError
            J, M, v_free or target without J and M; both b and target, or neither with a new J or v*.
        """
        general = self.generalized
        new = (J, M, v_free, target)
        if general is None and any(x is not None for x in new):
            raise InputError("J, M, v_free and target go with a problem in generalised coordinates; give b")
        if b is not None and target is not None:
            raise InputError("give b or target, not both")
        if b is None and target is None and (J is not None or v_free is not None):
            raise InputError("with a new J or v_free the right-hand side is another: give target or b")
        if general is not None and any(x is not None for x in (J, M, v_free)):
            general = (
                general.with_jacobian(J, v_free)
                if M is None
                else Generalized(
                    general.jac if J is None else J,
                    general.mass if M is None else M,
                    general.v_free if v_free is None else v_free,
                    general.names,
                )
            )
        if general is not None and general.m != self.m:
            raise InputError(f"J has {general.m} rows; {self.m} are needed, as the problem has")
        if target is not None and general is not None:
            with np.errstate(over="ignore", invalid="ignore"):  # what is not finite, the problem refuses
                b = as_array("target", target, (self.m,), unit="m/s") - general.velocity_of(general.v_free)
        # Private here, so that nothing else is copied a second time.
        given = self.b if b is None else as_array("b", b, (self.m,), unit="m/s")
        warm = None if guess is None else as_array("guess", guess, (self.m,), unit="N s")
        qp = self.qp.with_bias(given) if self.has_singular_program else None
        return replace(self, generalized=general, b=given, guess=warm, qp=qp, copy=False)


def _names_of_program(n: int, m: int) -> list[str]:
    return [f"variable {i}" for i in range(n)] + [f"constraint {i}" for i in range(m)]


def _joints(rows: Rows, lower: ArrayLike, upper: ArrayLike) -> Cones:
    """The joints' blocks with bounds of their rows (mj,) [N s]."""
    low, high = (
        as_array(name, x, (len(rows.jac),), finite=False, unit="N s")
        for name, x in (("lower", lower), ("upper", upper))
    )
    none = np.zeros(rows.n_joints)
    return Cones(rows.joint_ptr, none.astype(np.int32), low, high, mu=none, patch_radius=none)


def _contacts(mu: FloatArray, tangents: IntArray, patch_radius: Any, rolling: Any, shape: str) -> Cones:
    """Contacts of 0 to 2 tangents each (c,); with a radius all have a spin row, with mu_r two that roll."""
    spin, rolls, c = patch_radius is not None, rolling is not None, len(mu)
    least, most = (int(tangents.min()), int(tangents.max())) if c else (2, 2)
    if least < 0 or most > 2:
        raise InputError("tangents must be 0, 1 or 2 for each contact")
    if rolls and least < 2:
        raise InputError(
            f"contact {int(np.argmin(tangents))} has {least} tangents; rolling needs two, about which it "
            "rolls: give tangents=2"
        )
    if least == 0 and not spin:
        smooth = np.flatnonzero((mu > 0.0) & (tangents == 0))
        if len(smooth):
            raise InputError(
                f"contact {smooth[0]} has mu {mu[smooth[0]]:g} and no tangent to feel it: give tangents=2, or mu 0"
            )
    if least == most:
        return Cones.contacts(mu, most, patch_radius, rolling=rolling, shape=shape)
    ptr = np.concatenate([[0], np.cumsum(1 + tangents + spin + 2 * rolls)]).astype(np.int32)
    kind = kinds_of(np.ones(c, bool), spin=spin, rolls=rolls)
    free, none = np.full(int(ptr[-1]), np.inf), np.zeros(c)
    cones = Cones(
        ptr=ptr, kind=kind, lower=-free, upper=free, mu=mu,
        patch_radius=none if patch_radius is None else patch_radius, rolling=none if rolling is None else rolling,
    )  # fmt: skip
    return cones.shaped("box") if shape == "box" else cones
