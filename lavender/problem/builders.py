"""Build problems from a matrix, from rows of bodies, from J and M, and from the problem of another step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypedDict, TypeVar

import numpy as np

from lavender.base.arrays import (
    ArrayLike,
    FloatArray,
    IntArray,
    as_array,
    get_common_precision,
    get_shape,
    mark_read_only,
)
from lavender.base.errors import InputError, check_name
from lavender.base.lazy_import import issparse
from lavender.problem.cones import Cones
from lavender.problem.contact_rows import make_contacts, make_contacts_of_rows
from lavender.problem.data import check_matrix, check_rhs
from lavender.problem.findex import convert_from_findex, convert_to_findex, order_findex_rows
from lavender.problem.friction import SHAPES
from lavender.problem.generalized import Generalized
from lavender.problem.operators import Operators
from lavender.problem.program import make_quadratic_program
from lavender.problem.rows import Rows
from lavender_ext.core.problem import multiply_body_jacobian

if TYPE_CHECKING:
    from typing_extensions import Unpack

ProblemT = TypeVar("ProblemT", bound="Builders")


class NewProblemOptions(TypedDict, total=False):
    """Keywords that every method that builds a problem passes on to `Problem`, for type checkers."""

    name: str
    key: Any
    guess: ArrayLike | None
    precision: str
    copy: bool
    angular: ArrayLike | None


class ProblemOptions(NewProblemOptions, total=False):
    """`NewProblemOptions`, and further keywords of `Problem` that some of these methods take as explicit parameters."""

    names: Sequence[str] | None
    friction: str
    compliance: ArrayLike | None


def check_rhs_length(A: Any, b: FloatArray) -> None:
    """Raise an InputError about b if A is square and its number of rows differs from the length of b."""
    shape = A.shape if isinstance(A, np.ndarray) or issparse(A) else get_shape("A", A)
    if len(shape) == 2 and shape[0] == shape[1] != len(b):
        raise InputError(
            f"b [m/s] has shape {b.shape}; ({shape[0]},) is needed, as A has {shape[0]} rows"
        )


def check_options(method: str, options: Mapping[str, Any]) -> None:
    """Raise an InputError if options have a keyword of `Problem` that this method computes, such as cones."""
    for name in {"b", "cones", "matrix", "rows", "generalized", "qp"} & options.keys():
        raise InputError(
            f"{name} is a {type(options[name]).__name__}; Problem.{method} makes {name} from its other arguments and "
            f"takes no {name}: use Problem(...) or dataclasses.replace(problem, {name}=...)"
        )


class Builders(Operators):
    """Class methods that build a problem."""

    @classmethod
    def linear(
        cls: type[ProblemT], A: Any, b: ArrayLike, **more: Unpack[ProblemOptions]
    ) -> ProblemT:
        """Build the linear system A lambda = b, in which every row is unbounded.

        Parameters
        ----------
        A : (m, m) 1/kg, array or sparse
        b : (m,) m/s
        **more
            Keywords of `Problem`: name, names, ...
        """
        b = as_array("b", b, (None,), unit="m/s")
        check_rhs_length(A, b)
        check_options("linear", more)
        return cls(b, Cones.free(len(b)), A, **more)

    @classmethod
    def lcp(
        cls: type[ProblemT],
        A: Any,
        b: ArrayLike,
        lower: ArrayLike = 0.0,
        upper: ArrayLike = np.inf,
        **more: Unpack[ProblemOptions],
    ) -> ProblemT:
        """Build a boxed LCP: lower <= lambda <= upper complementary to w = A lambda - b.

        Parameters
        ----------
        A : (m, m) 1/kg, array or sparse
        b : (m,) m/s
        lower, upper : scalar or (m,) N s
        **more
            Keywords of `Problem`: name, names, ...
        """
        b = as_array("b", b, (None,), unit="m/s")
        check_rhs_length(A, b)
        named = (("lower", lower), ("upper", upper))
        bounds = [as_array(n, x, (len(b),), finite=False, unit="N s") for n, x in named]
        check_options("lcp", more)
        return cls(b, Cones.bounded(*bounds), A, **more)

    @classmethod
    def contact(
        cls: type[ProblemT],
        A: Any,
        b: ArrayLike,
        mu: ArrayLike,
        patch_radius: ArrayLike | None = None,
        *,
        rolling: ArrayLike | None = None,
        tangents: int | None = None,
        **more: Unpack[ProblemOptions],
    ) -> ProblemT:
        """Build a problem of k contacts with m / k rows each: normal, up to two tangents, spin, rolling.

        Parameters
        ----------
        A : (m, m) 1/kg, array or sparse
        b : (m,) m/s
            The normal is the first row of each contact.
        mu : scalar, (k,) or (k, 2)
            Coefficient of each contact. A scalar is used for all contacts if these have two tangents, otherwise for a
            single contact. Two coefficients for each contact define an ellipse, see `Cones.contacts`.
        patch_radius : scalar or (k,) m, optional
            If given, each contact has a spin row.
        rolling : scalar or (k,) m, optional
            mu_r: if given, the last two rows of each contact are rolling rows; two tangents are needed.
        tangents : {0, 1, 2}, optional
            Number of tangent rows of each contact. Default: as many as the rows and the values of mu leave.
        **more
            Keywords of `Problem`: name, names, ...

        Raises
        ------
        InputError
            The number of rows does not fit the number of contacts, or mu > 0 for contacts without friction rows. Or
            the contacts would have one tangent, and the rows are also those of contacts with two: give `tangents`.
        """
        b = as_array("b", b, (None,), unit="m/s")
        check_rhs_length(A, b)
        cones = make_contacts_of_rows("b", len(b), mu, tangents, patch_radius, rolling)
        check_options("contact", more)
        return cls(b, cones, A, **more)

    @classmethod
    def from_findex(
        cls: type[ProblemT],
        A: Any,
        b: ArrayLike,
        lower: ArrayLike,
        upper: ArrayLike,
        findex: ArrayLike,
        **more: Unpack[ProblemOptions],
    ) -> ProblemT:
        """Build a problem from the arrays of ODE, Bullet and DART, with a separate bound for each tangent.

        Friction rows must directly follow their normal row. If they do not, the problem's rows are a permutation of
        the arrays' rows, `Problem.findex_order(findex)`. `guess` is in the order of the arrays; `key` and `names`
        refer to the problem's blocks.

        Parameters
        ----------
        A : (m, m) 1/kg, array or sparse
        b : (m,) m/s
        lower, upper : scalar or (m,) N s
            Bounds of rows with findex < 0. On other rows, `upper` is mu [-] and `lower` is ignored, as in these
            engines.
        findex : (m,) int
            Index of the normal row that bounds this row by |lambda_i| <= upper_i lambda_findex; -1 for constant bounds.
        **more
            Keywords of `Problem`: name, names, ...

        Raises
        ------
        InputError
            A findex is out of range, is its own row, or refers to a row with bounds other than [0, inf]; more than two
            rows refer to one normal; mu is negative or not finite; lower > upper.

        Examples
        --------
        >>> import numpy as np
        >>> import lavender as lv
        >>> A, b = np.eye(3), [10.0, 9.0, -1.0]  # pressed on, and dragged along both tangents
        >>> problem = lv.Problem.from_findex(A, b, [0.0, -0.5, -0.5], [np.inf, 0.5, 0.5], [-1, 0, 0])
        >>> lv.solve(problem, tol=1e-9).impulse.tolist()  # [N s]: the first tangent slides, the second holds
        [10.0, 5.0, -1.0]
        """
        b = as_array("b", b, (None,), unit="m/s")
        order, cones = convert_from_findex(lower, upper, findex, len(b))
        if (order[1:] < order[:-1]).any():
            matrix = check_matrix(A, len(b), True)
            guess = more.get("guess")
            if guess is not None:
                more["guess"] = as_array("guess", guess, (len(b),), unit="N s")[order]
            return cls(b[order], cones, matrix[order][:, order], **more)
        return cls(b, cones, A, **more)

    @staticmethod
    def findex_order(findex: ArrayLike) -> IntArray:
        """Return the row of the arrays of `from_findex` for each row of its problem (m,).

        >>> import lavender as lv
        >>> lv.Problem.findex_order([-1, -1, 0, 0, 1, 1]).tolist()  # all normals first, as in Bullet
        [0, 2, 3, 1, 4, 5]
        """
        return order_findex_rows(findex)

    def to_findex(self) -> tuple[Any, FloatArray, FloatArray, FloatArray, IntArray]:
        """Return A, b, lower, upper and findex as ODE, Bullet and DART use them, in the order of this problem's rows.

        Raises
        ------
        InputError
            The problem has a disk or the law "cone", which findex cannot express.
        """
        lower, upper, findex = convert_to_findex(self.cones)
        if self.law == "cone":
            raise InputError("findex needs Coulomb's law: give problem.relaxed('coulomb')")
        return self.delassus(), self.b, lower, upper, findex

    @classmethod
    def from_rows(
        cls: type[ProblemT],
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
        **more: Unpack[ProblemOptions],
    ) -> ProblemT:
        """Build the problem of a step from rows of bodies, with b = target - J v*.

        Parameters
        ----------
        rows : Rows
        target : scalar or (m,) m/s
            Required relative velocity after the step: 0 stops the motion, +depth/dt removes a penetration (depth
            positive inside), -e v_n is a bounce after an approach v_n < 0. A gap is a negative depth.
        lower, upper : scalar or (mj,) N s
            Bounds of the joint rows.
        mu : scalar or (c,)
        tangents : int or (c,), optional
            Number of tangent rows of each contact, 0 to 2. Default: two if mu > 0, else none.
        patch_radius : scalar or (c,) m, optional
            If given, each contact has a spin row.
        shape : {"disk", "box"}
            Shape of friction in two tangents; see `Cones.contacts`. For two coefficients use
            replace(problem, cones=...).
        rolling : scalar or (c,) m, optional
            mu_r: if given, each contact has two rows for rolling about its two tangents; all contacts need two.
        **more
            Keywords of `Problem`: name, friction, ...

        Raises
        ------
        InputError
            mu > 0 for a contact without tangents and spin.

        Examples
        --------
        A ball of 2 kg and 0.1 m, 0.01 m deep in the ground, is out of it after the step (for a stack see `Rows`):

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
        if not isinstance(rows, Rows):
            raise InputError(f"rows is a {type(rows).__name__}; a Rows is needed")
        check_options("from_rows", more)
        mu = as_array("mu", mu, (rows.n_contacts,))
        if tangents is None:
            tangents = 2 * (mu > 0.0).astype(np.int32)
        tangents = as_array("tangents", tangents, mu.shape, dtype=np.int32)
        contacts = make_contacts(
            mu, tangents, patch_radius, rolling, check_name("shape", shape, SHAPES)
        )
        named = (("lower", lower), ("upper", upper))
        zeros = np.zeros(rows.n_joints)
        low, high = (
            as_array(name, x, (len(rows.jac),), finite=False, unit="N s") for name, x in named
        )
        joints = Cones(rows.joint_ptr, zeros, low, high, mu=zeros, patch_radius=zeros)
        cones = joints + contacts if rows.n_joints else contacts
        m = cones.n_rows
        target = as_array("target", target, (m,), unit="m/s")
        problem = cls(np.zeros(m), cones, rows=rows, **more)
        jv = np.zeros(m + 1)
        multiply_body_jacobian(problem.data, rows.v_free, jv)
        problem.b.setflags(write=True)  # No other code has access to the problem yet.
        problem.b[:] = target - jv[:m]
        check_rhs(mark_read_only(problem.b))
        return problem

    @classmethod
    def from_jacobian(
        cls: type[ProblemT],
        J: Any,
        M: Any,
        v_free: ArrayLike,
        *,
        target: ArrayLike = 0.0,
        cones: Cones | None = None,
        mu: ArrayLike | None = None,
        tangents: int | None = None,
        compliance: ArrayLike | None = None,
        friction: str = "coulomb",
        names: Sequence[str] | None = None,
        dof_names: Sequence[str] | None = None,
        **more: Unpack[NewProblemOptions],
    ) -> ProblemT:
        """Build the problem of a step in generalised coordinates: w = J v+ - target + compliance lambda.

        Parameters
        ----------
        J : (m, nv) array or sparse
            Rows in the order of `cones`, e.g. `Cones.free(6) + Cones.contacts(0.5, count=8)`; each contact has its
            normal first, then its two tangents.
        M : (nv, nv) array or sparse, or a sequence of square blocks, one for each kinematic tree
            Mass matrix, symmetric positive definite. J and M are always copied.
        v_free : (nv,) m/s, rad/s
            v*, the velocity after the step without constraint impulses.
        target : scalar or (m,) m/s
            Required relative velocity after the step: 0 stops the motion, +depth/dt removes a penetration (depth
            positive inside), -e v_n is a bounce after an approach v_n < 0. A gap is a negative depth.
        cones : Cones
        mu, tangents : optional
            Instead of `cones`, if all rows belong to contacts: as for `contact`.
        compliance : scalar or (m,) 1/kg, optional
        friction : {"coulomb", "cone"}
        precision : {"float64", "float32"}, optional
            Default: float32 if J, M and v_free are arrays of float32. They are converted to float64 exactly.
        names, dof_names : sequence of str (k,), (nv,), optional
            Names of blocks and of velocities.
        **more
            Keywords of `Problem`: name, guess, angular (which rows are in rad/s), ...

        Examples
        --------
        A cart of 2 kg has a pole of 1 kg and 0.5 m. Its tip hits a wall, with friction 0.5 in one tangent:

        >>> import numpy as np
        >>> import lavender as lv
        >>> c, s = 0.5 * np.cos(0.3), 0.5 * np.sin(0.3)
        >>> M = [[3.0, c], [c, 0.25]]  # velocities of cart and hinge
        >>> J = [[1.0, c], [0.0, s]]  # velocity of the tip away from the wall, and along it
        >>> cones = lv.Cones.contacts(0.5, tangents=1)
        >>> problem = lv.Problem.from_jacobian(J, M, v_free=[-1.0, 0.2], cones=cones)
        >>> solution = lv.solve(problem, tol=1e-9)
        >>> solution.impulse.round(3).tolist()  # N s: it slides, 0.579 = 0.5 x 1.158
        [1.158, -0.579]

        With the tip 0.01 m inside the wall, and a step of 1/60 s:

        >>> inside = problem.updated(target=[0.01 * 60, 0.0])
        >>> pushed = lv.solve(inside, tol=1e-9)
        >>> round(float((inside.generalized.velocity_of(inside.velocity(pushed.impulse)))[0] / 60), 6)  # m
        0.01
        """
        if (cones is None) == (mu is None):
            raise InputError(
                f"cones and mu are {'missing' if mu is None else 'both given'}; one of them is needed: mu= if all rows "
                "are those of contacts, else cones=, such as lavender.Cones.free(6) + lavender.Cones.contacts(0.5)"
            )
        if mu is None and tangents is not None:
            raise InputError(
                "tangents has no effect without mu: leave it out, or give mu in place of cones"
            )
        generalized = J if isinstance(J, Generalized) else Generalized(J, M, v_free, dof_names)
        m = generalized.m
        if cones is None:
            cones = make_contacts_of_rows("J", m, mu, tangents)
        elif isinstance(cones, Cones) and cones.n_rows != m:
            hint = (
                " (a contact has a normal and two tangents, or tangents=0, 1)"
                if np.any(cones.kind)
                else ""
            )
            raise InputError(f"J has {m} rows; {cones.n_rows} are needed, as the cones have{hint}")
        if "precision" not in more:
            more["precision"] = get_common_precision(
                J, *(M if isinstance(M, (list, tuple)) else [M]), v_free
            )
        return cls(
            generalized.bias(target),  # `Problem` rejects entries that are not finite.
            cones,
            friction=friction,
            compliance=compliance,
            names=names,
            generalized=generalized,
            **more,
        )

    @classmethod
    def from_qp(
        cls: type[ProblemT],
        P: Any,
        q: ArrayLike | None = None,
        G: Any = None,
        h: ArrayLike | None = None,
        A: Any = None,
        b: ArrayLike | None = None,
        lb: ArrayLike | None = None,
        ub: ArrayLike | None = None,
        **more: Unpack[ProblemOptions],
    ) -> ProblemT:
        """Build a convex quadratic program: min 1/2 x.P x + q.x subject to G x <= h, A x = b, lb <= x <= ub.

        If P is positive definite, x are generalised velocities with the mass matrix P, and every solver of bounded
        rows accepts the problem. `lavender.solve_qp` returns x and the multipliers; `problem.qp.solution(solution)`
        computes them from a solution of `lavender.solve`.

        Parameters
        ----------
        P : (n, n) array or sparse, or a `qpsolvers.Problem` as the only argument
            Symmetric, both triangles, positive semidefinite. If it is singular (its Cholesky factor has a pivot of at
            most 1e-13 of the diagonal entry), the unknowns of the problem are x and the multipliers, and only solvers
            of quadratic programs accept it: `auto` selects the first installed one of piqp, clarabel and osqp.
        q : (n,)
        G, h : (mi, n) array or sparse, and (mi,), optional
            Entries of h from 1e20 on count as inf.
        A, b : (me, n) array or sparse, and (me,), optional
        lb, ub : (n,), optional
            Entries of at least 1e20 in absolute value count as infinite.
        **more
            Keywords of `Problem`: name, guess, ...

        Zeros of dense matrices are dropped, and the program is stored as sparse matrices. All arrays are copied.

        Raises
        ------
        InputError
            The shapes disagree; an entry is NaN; lb > ub; P is not symmetric, or not positive semidefinite (the
            message has its smallest eigenvalue).

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
        qp = make_quadratic_program((P, q, G, h, A, b, lb, ub))
        fields: dict[str, Any] = qp.problem_fields() | dict(more)
        return cls(**fields, qp=qp)

    def updated(
        self: ProblemT,
        *,
        J: Any = None,
        M: Any = None,
        v_free: ArrayLike | None = None,
        b: ArrayLike | None = None,
        target: ArrayLike | None = None,
        guess: ArrayLike | None = None,
    ) -> ProblemT:
        """Return a problem of the same structure with new numbers; arguments that are omitted keep their values.

        Parameters
        ----------
        J, M, v_free : as in `from_jacobian`
            Only in generalised coordinates. They are copied, so a loop may reuse its arrays.
        b : (m,) m/s, optional
            New right-hand side.
        target : scalar or (m,) m/s, optional
            Given instead of b, which is then target - J v*.
        guess : (m,) N s, optional
            Default: no guess, because the old guess belongs to the old numbers.

        Raises
        ------
        InputError
            J, M, v_free or target for a problem that is not in generalised coordinates; both b and target; neither b
            nor target with a new J or v*.
        """
        general = self.generalized
        if general is None and not (J is None and M is None and v_free is None and target is None):
            raise InputError(
                f"J, M, v_free and target need generalised coordinates; the problem is given by {self.operator}"
            )
        if b is not None and target is not None:
            raise InputError(
                "b and target are both given; one of them determines the right-hand side"
            )
        if b is None and target is None and (J is not None or v_free is not None):
            raise InputError(
                "J or v_free is given without target and b; one of them is needed, since b = target - J v_free"
            )
        if general is not None and not (J is None and M is None and v_free is None):
            if M is None:
                general = general.with_jacobian(J, v_free)
            else:
                jac, free = (
                    general.jac if J is None else J,
                    general.v_free if v_free is None else v_free,
                )
                general = Generalized(jac, M, free, general.names)
        if general is not None and general.m != self.m:
            raise InputError(f"J has {general.m} rows; {self.m} are needed, as the problem has")
        if target is not None and general is not None:
            b = general.bias(target)
        # Copy arrays here, so that the new problem can use them with copy=False.
        rhs = self.b if b is None else as_array("b", b, (self.m,), unit="m/s")
        start = None if guess is None else as_array("guess", guess, (self.m,), unit="N s")
        if J is None and M is None and not self.has_singular_program:
            problem: ProblemT = self._with_rhs(rhs, general, start)
            return problem
        qp = self.qp.with_bias(rhs) if self.has_singular_program else None
        return replace(self, generalized=general, b=rhs, guess=start, qp=qp, copy=False)
