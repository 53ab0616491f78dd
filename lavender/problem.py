"""The constraint problem of one step: w = A lambda - b, and what bounds lambda.

    A = J M^-1 J^T + diag(compliance)  [1/kg],   b = target - J v*  [m/s],   w = A lambda - b  [m/s]

`Problem` holds rows (J and M^-1 of bodies, `lavender/rows.py`), J and M in generalised coordinates
(`lavender/generalized.py`) or a matrix, one of them, and derives the rest on first use.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from os import PathLike
from typing import Any

import numpy as np
import scipy.sparse as sp

from lavender._arrays import (
    ArrayLike,
    FloatArray,
    IntArray,
    as_array,
    check_not_negative,
    equal,
    read_only,
    table_of,
)
from lavender._derived import Derived, once
from lavender._findex import arrays_of, blocks_of, order_of
from lavender.cones import CONTACT_ROLLING, ROUND, ROW, Cones, check_shape
from lavender.errors import CapabilityError, InputError
from lavender.generalized import Generalized
from lavender.rows import Rows
from lavender_ext.core import assemble
from lavender_ext.core.blocks import are_joints_then_contacts
from lavender_ext.core.problem import LAWS as FRICTION_NUMBER
from lavender_ext.core.problem import Data, dense_to_csr, general_data, nothing_done, rows_velocity
from lavender_ext.judge import measure
from lavender_ext.pivot import principal

__all__ = ["LAWS", "OPERATORS", "Problem", "VelocityForm"]

FRICTION = tuple(FRICTION_NUMBER)
# A solver that takes a law takes every law before it that it contains: linear < lcp < coulomb | cone.
LAWS = ("linear", "lcp", "coulomb", "cone")
# How A is given.
OPERATORS = ("rows", "matrix", "generalized")


class Names(Sequence[str]):
    """Names of blocks that are made when they are first asked for; equal to a tuple of the same words."""

    def __init__(self, count: int, make: Callable[[], Sequence[str]]) -> None:
        self._count, self._make = count, make
        self._made: tuple[str, ...] | None = None

    def _words(self) -> tuple[str, ...]:
        if self._made is None:
            self._made = tuple(self._make())
        return self._made

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, i: Any) -> Any:
        return self._words()[i]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, (Names, tuple)) and self._words() == tuple(other)

    def __hash__(self) -> int:
        return hash(self._words())

    def __reduce__(self) -> tuple[Any, ...]:
        return tuple, (self._words(),)


@dataclass(frozen=True)
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


@dataclass(frozen=True, eq=False)
class Problem:
    """Find lambda (m,) [N s] with w = A lambda - b [m/s] complementary to it on every block.

    Parameters
    ----------
    b : (m,) m/s
        target - J v*: the relative velocity that the impulses must make up for.
    cones : Cones
        Blocks and bounds.
    matrix : (m, m) array or sparse, 1/kg
        A, kept exactly as given (asymmetric, indefinite and singular are legal); or
    rows : Rows
        J and M^-1; A is then J M^-1 J^T + diag(compliance) and is formed only on request; or
    generalized : Generalized
        J and M in generalised coordinates; the same.
    friction : {"coulomb", "cone"}
        Exact Coulomb friction (non-associated), or its convex relaxation.
    compliance : (m,) 1/kg, not with a matrix
        Softness of each row, >= 0.
    guess : (m,) N s, optional
        Warm start that travels with the problem.
    key : (k,) uint64, optional
        Identity of each block across steps.
    names : sequence of str (k,), optional
        Names of blocks, e.g. "hinge 7"; see `row_name`.
    name : str
    copy : bool
        True leaves the arrays given as they are. False adopts those that already fit (b, matrix, compliance, guess):
        they are shared, and marked read-only for the giver, too.

    Raises
    ------
    InputError
        Wrong shapes, NaN or infinity, none or several of matrix, rows and generalized, nnz >= 2^31.
    """

    b: FloatArray
    cones: Cones
    matrix: Any = None
    rows: Rows | None = None
    friction: str = "coulomb"
    compliance: FloatArray | None = None
    guess: FloatArray | None = None
    key: Any = None
    names: Sequence[str] | None = None
    name: str = ""
    copy: bool = field(default=True, repr=False)
    generalized: Generalized | None = None
    derived: Derived = field(init=False, repr=False)

    def __post_init__(self) -> None:
        put = object.__setattr__
        if not isinstance(self.cones, Cones):
            raise InputError(
                f"cones is a {type(self.cones).__name__}; a Cones is needed (Cones.bounded, Cones.contacts)"
            )
        m, k = self.cones.n_rows, self.cones.n_blocks
        put(self, "derived", Derived())
        put(self, "b", as_array("b", self.b, (m,), unit="m/s", copy=self.copy))
        if (self.matrix is None) + (self.rows is None) + (self.generalized is None) != 2:
            raise InputError("give matrix=, rows= or generalized=, one of them")
        if self.friction not in FRICTION:
            raise InputError(f"friction is {self.friction!r}; {' or '.join(map(repr, FRICTION))} is needed")
        if self.friction != "cone" and self.cones.has_round:
            raise InputError(
                "a round cone of more than two tangents has no Coulomb law here: give friction='cone'"
            )
        if self.rows is not None:
            self._check_rows(self.rows, m, k)
        elif self.generalized is not None:
            self._check_generalized(self.generalized, m)
        else:
            put(self, "matrix", _checked_matrix(self.matrix, m, self.copy))
            if sp.issparse(self.matrix):  # checked arrays; those of the object anybody may exchange
                put(self, "_compressed", (self.matrix.indptr, self.matrix.indices, self.matrix.data))
            if self.compliance is not None:
                raise InputError("compliance goes with rows; in a matrix it is already on the diagonal of A")
        if self.guess is not None:
            put(self, "guess", as_array("guess", self.guess, (m,), unit="N s", copy=self.copy))
        if self.key is not None:
            key = np.asarray(self.key)
            if (
                key.shape != (k,)
                or key.dtype.kind not in "ui"
                or (key.dtype.kind == "i" and key.size and key.min() < 0)
            ):
                raise InputError(
                    f"key has shape {key.shape} and dtype {key.dtype}; ({k},) unsigned 64-bit is needed"
                )
            put(self, "key", read_only(key.astype(np.uint64)))
        if self.names is not None:
            names = self.names if isinstance(self.names, Names) else tuple(map(str, self.names))
            if isinstance(self.names, str) or len(names) != k:
                raise InputError(f"{len(names)} names for {k} blocks; one for each block is needed")
            put(self, "names", names)
        put(self, "name", str(self.name))
        put(self, "copy", True)  # of what was given here: another problem made of this one says so itself

    def _check_rows(self, rows: Rows, m: int, k: int) -> None:
        if not isinstance(rows, Rows):
            raise InputError(f"rows is a {type(rows).__name__}; a Rows is needed")
        self._check_compliance(m)
        kj = rows.n_joints
        if kj + rows.n_contacts == k and are_joints_then_contacts(self.cones._blocks, rows.joint_ptr):
            return
        kind = self.cones.kind
        if (
            kj + rows.n_contacts != k
            or np.any(kind[:kj] != ROW)
            or np.any(kind[kj:] == ROW)
            or self.cones.has_round
        ):
            raise InputError(
                f"rows has {kj} joints and {rows.n_contacts} contacts; cones must have as many ROW "
                f"blocks, then contacts (it has {k} blocks)"
            )
        if not np.array_equal(self.cones.ptr[: kj + 1], rows.joint_ptr):
            raise InputError("cones.ptr and rows.joint_ptr disagree about the rows of the joints")

    def _check_generalized(self, generalized: Generalized, m: int) -> None:
        if not isinstance(generalized, Generalized):
            raise InputError(f"generalized is a {type(generalized).__name__}; a Generalized is needed")
        if generalized.m != m:
            raise InputError(f"J has {generalized.m} rows; {m} are needed, as the cones have")
        self._check_compliance(m)
        self.derived.view = general_data(
            self.cones._blocks, self.b, generalized.operator, self.compliance, FRICTION_NUMBER[self.friction]
        )

    def _check_compliance(self, m: int) -> None:
        put = object.__setattr__
        if self.compliance is None:
            put(self, "compliance", read_only(np.zeros(m)))
            return
        put(self, "compliance", as_array("compliance", self.compliance, (m,), unit="1/kg", copy=self.copy))
        check_not_negative("compliance", self.compliance)

    # -- constructors ---------------------------------------------------------------------------

    @classmethod
    def linear(cls, A: Any, b: ArrayLike, **more: Any) -> Problem:
        """A lambda = b: every row unbounded. A (m, m) [1/kg], b (m,) [m/s]."""
        b = as_array("b", b, (None,), unit="m/s")
        return cls(b, Cones.free(len(b)), A, **more)

    @classmethod
    def lcp(
        cls, A: Any, b: ArrayLike, lower: ArrayLike = 0.0, upper: ArrayLike = np.inf, **more: Any
    ) -> Problem:
        """Boxed LCP: lower <= lambda <= upper complementary to A lambda - b; bounds scalar or (m,) [N s]."""
        b = as_array("b", b, (None,), unit="m/s")
        bounds = [
            as_array(n, x, (len(b),), finite=False, unit="N s")
            for n, x in (("lower", lower), ("upper", upper))
        ]
        return cls(b, Cones.bounded(*bounds), A, **more)

    @classmethod
    def contact(
        cls,
        A: Any,
        b: ArrayLike,
        mu: ArrayLike,
        patch_radius: ArrayLike | None = None,
        *,
        rolling: ArrayLike | None = None,
        **more: Any,
    ) -> Problem:
        """Contacts only, m / k rows each: normal, up to two tangents, spin with `patch_radius`, two with `rolling`.

        Parameters
        ----------
        A : (m, m) 1/kg, array or sparse
        b : (m,) m/s
            Normal first in every contact.
        mu : scalar or (k,)
            One for each contact. A scalar stands for all of them, which then have two tangents, or for a single one.
        patch_radius : scalar or (k,) m, optional
            Gives each contact a spin row.
        rolling : scalar or (k,) m, optional
            mu_r: gives each contact two rows that roll, after the others; two tangents are needed.

        Raises
        ------
        InputError
            The rows do not part among the contacts; mu > 0 where contacts have no row for friction.
        """
        b = as_array("b", b, (None,), unit="m/s")
        turns = (patch_radius is not None) + 2 * (rolling is not None)
        if np.ndim(mu) == 0:
            each = 3 + turns
            mu = np.full(max(1, len(b) // each) if len(b) % each == 0 else 1, mu)
        mu = as_array("mu", np.asarray(mu), (None,))
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
        cls, A: Any, b: ArrayLike, lower: ArrayLike, upper: ArrayLike, findex: ArrayLike, **more: Any
    ) -> Problem:
        """The arrays of engines (ODE, Bullet, DART), as they are: friction that follows its normal, tangent by tangent.

        Where the normals do not stand right before the rows that follow them, the rows of the problem are those of the
        arrays in another order, `Problem.findex_order(findex)`.

        Parameters
        ----------
        A : (m, m) 1/kg, array or sparse
        b : (m,) m/s
        lower, upper : scalar or (m,) N s
            Where findex < 0; where it is not, upper is mu [-].
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
        b = as_array("b", b, (None,), unit="m/s")
        order, cones = blocks_of(lower, upper, findex, len(b))
        if (order[1:] < order[:-1]).any():
            matrix = _checked_matrix(A, len(b), True)
            return cls(b[order], cones, matrix[order][:, order], **more)
        return cls(b, cones, A, **more)

    @staticmethod
    def findex_order(findex: ArrayLike) -> IntArray:
        """(m,) row of the arrays given to `from_findex` for each row of its problem.

        >>> import lavender as lv
        >>> lv.Problem.findex_order([-1, -1, 0, 0, 1, 1]).tolist()  # all normals first, as Bullet has them
        [0, 2, 3, 1, 4, 5]

        Raises
        ------
        InputError
            As `from_findex`.
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
        cls,
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
    ) -> Problem:
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
        rolling : scalar or (c,) m, optional
            mu_r: gives each contact two rows that roll about its two tangents; all contacts need two.
        shape : {"disk", "box"}
            Of friction in two tangents; see `Cones.contacts`. Two coefficients: replace(problem, cones=...).
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
        if not isinstance(rows, Rows):
            raise InputError(f"rows is a {type(rows).__name__}; a Rows is needed")
        kj, c, mj = rows.n_joints, rows.n_contacts, len(rows.jac)
        mu = as_array("mu", mu, (c,))
        if tangents is None:
            tangents = np.where(mu > 0.0, 2, 0)
        tangents = as_array("tangents", tangents, (c,), dtype=np.int32)
        if c and (tangents.min() < 0 or tangents.max() > 2):
            raise InputError("tangents must be 0, 1 or 2 for each contact")
        spin, rolls = patch_radius is not None, rolling is not None
        if rolls and c and tangents.min() < 2:
            raise InputError(
                f"contact {int(np.argmin(tangents))} has {tangents.min()} tangents; rolling needs two, about which it "
                "rolls: give tangents=2"
            )
        smooth = np.flatnonzero((mu > 0.0) & (tangents == 0))
        if len(smooth) and not spin:
            raise InputError(
                f"contact {smooth[0]} has mu {mu[smooth[0]]:g} and no tangent to feel it: give tangents=2, or mu 0"
            )
        ptr = np.concatenate([rows.joint_ptr, mj + np.cumsum(1 + tangents + spin + 2 * rolls)]).astype(
            np.int32
        )
        kind = np.repeat(np.array([ROW, CONTACT_ROLLING if rolls else 1 + spin], np.int32), [kj, c])
        m = int(ptr[-1])
        low, high = np.full(m, -np.inf), np.full(m, np.inf)
        low[:mj] = as_array("lower", lower, (mj,), finite=False, unit="N s")
        high[:mj] = as_array("upper", upper, (mj,), finite=False, unit="N s")
        both = np.zeros((3, kj + c))
        both[0, kj:] = mu
        both[1, kj:] = 0.0 if patch_radius is None else as_array("patch_radius", patch_radius, (c,), unit="m")
        both[2, kj:] = 0.0 if rolling is None else as_array("rolling", rolling, (c,), unit="m")
        cones = Cones(
            ptr=ptr, kind=kind, lower=low, upper=high, mu=both[0], patch_radius=both[1], rolling=both[2]
        )
        if check_shape("shape", shape) == "box":
            cones = cones.shaped("box")
        target = as_array("target", target, (m,), unit="m/s")
        jv = np.zeros(m + 1)
        # b = target - J v*: the slack kernel with lambda = 0 and v = v* gives J v* - 0.
        blank = cls(np.zeros(m), cones, rows=rows, **more)
        rows_velocity(blank.data, np.ascontiguousarray(rows.v_free), jv)
        return replace(blank, b=target - jv[:m], copy=False)

    @classmethod
    def from_jacobian(
        cls,
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
    ) -> Problem:
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
        names, dof_names : sequence of str (k,), (nv,), optional
            Names of blocks and of velocities.

        Raises
        ------
        InputError
            As `Generalized` and `Problem`.

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
        generalized = J if isinstance(J, Generalized) else Generalized(J, M, v_free, dof_names)
        m = generalized.m
        if isinstance(cones, Cones) and cones.n_rows != m:
            hint = (
                " (a contact has a normal and two tangents, or tangents=0, 1)" if np.any(cones.kind) else ""
            )
            raise InputError(f"J has {m} rows; {cones.n_rows} are needed, as the cones have{hint}")
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

    def updated(
        self,
        *,
        J: Any = None,
        M: Any = None,
        v_free: ArrayLike | None = None,
        b: ArrayLike | None = None,
        target: ArrayLike | None = None,
        guess: ArrayLike | None = None,
    ) -> Problem:
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
        if target is not None and general is not None:
            with np.errstate(over="ignore", invalid="ignore"):  # what is not finite, the problem refuses
                b = as_array("target", target, (self.m,), unit="m/s") - general.velocity_of(general.v_free)
        # Private here, so that nothing else is copied a second time.
        given = self.b if b is None else as_array("b", b, (self.m,), unit="m/s")
        warm = None if guess is None else as_array("guess", guess, (self.m,), unit="N s")
        return replace(self, generalized=general, b=given, guess=warm, copy=False)

    # -- size and kind --------------------------------------------------------------------------

    @property
    def m(self) -> int:
        """Number of rows."""
        return len(self.b)

    @property
    def operator(self) -> str:
        """How A is given, of OPERATORS: "rows", "matrix" or "generalized"."""
        return "rows" if self.rows is not None else "matrix" if self.generalized is None else "generalized"

    @property
    def n_blocks(self) -> int:
        """Number of blocks, k."""
        return self.cones.n_blocks

    @cached_property
    def law(self) -> str:
        """Problem class, from what the blocks hold: "linear", "lcp", "coulomb" or "cone"."""
        if self.cones.is_free:
            return "linear"
        return "lcp" if self.cones.is_bounded_rows else self.friction

    @cached_property
    def asymmetry(self) -> float:
        """max |A - A^T| / max |A|; exactly 0 with J and M."""
        if self.matrix is None:
            return 0.0
        gap, big = self._scan[2:]
        return gap / big if big > 0.0 else 0.0

    @cached_property
    def bandwidth(self) -> tuple[int, int]:
        """Lower and upper half bandwidth of A: the largest i - j and j - i of a stored entry."""
        if self.rows is None:
            return self._scan[:2]
        return principal.bandwidth(*self._compressed[:2])

    @cached_property
    def _scan(self) -> tuple[int, int, float, float]:
        return principal.scan(*self._compressed)

    @property
    def is_symmetric(self) -> bool:
        """A = A^T up to rounding of its entries (1e-14 of the largest)."""
        return self.asymmetry <= 1e-14

    # -- derived, computed once ------------------------------------------------------------------

    @once
    def data(self) -> Data:
        """What kernels that sweep read: pointers, d, nu, steps. Of the rows where there are rows, else of A."""
        if self.rows is None:
            return self.csr_data
        r = self.rows
        return self._data(
            rows=(
                r.jac,
                r.joint_body,
                r.normal,
                r.tangent,
                r.arm_a,
                r.arm_b,
                r.contact_body,
                r.inv_mass,
                r.inv_inertia,
                self.compliance,
            )
        )

    @once
    def csr_data(self) -> Data:
        """The same over A in compressed rows; forms A where J and M are given."""
        data = self._data(csr=self._compressed)
        if self.rows is not None:
            data.weigh_as(self.metric)
        if self.generalized is not None and self.metric.start_energy >= 0.0:
            data.set_start(self.metric.start_energy, self.metric.start_velocity)
        return data

    @once
    def metric(self) -> Data:
        """What the judge reads: `data`, or in generalised coordinates J and M as they are, d, Y = J L^-1 D^-1/2."""
        view = self.derived.view
        if view is None:
            return self.data
        try:
            view.prepare()
        except OverflowError as error:
            raise InputError(f"the problem is too large: {error}") from None
        return view

    def _data(self, **operator: Any) -> Data:
        return Data(self.cones._blocks, self.b, FRICTION_NUMBER[self.friction], **operator)

    @once
    def csr(self) -> sp.csr_array:
        """A in compressed rows (m, m), int32 indices, read-only."""
        if sp.issparse(self.matrix):
            return self.matrix
        indptr, indices, data = self._compressed
        return sp.csr_array((data, indices, indptr), shape=(self.m, self.m))

    @once
    def _compressed(self) -> tuple[IntArray, IntArray, FloatArray]:
        # (indptr, indices, data) of A. Kernels and the judge read these: `csr` is an object whose arrays whoever
        # has it may exchange.
        if self.generalized is not None:
            return self._product()
        if self.rows is not None:
            most, start, blocks = assemble.bound(self.data)
            if most >= 2**31:
                raise InputError(
                    f"A would have up to {most} entries, more than 32-bit indices reach: "
                    "use a solver that reads rows"
                )
            indptr, indices, data = assemble.delassus(self.data, most, start, blocks)
            return read_only(indptr), read_only(indices), read_only(data)
        return dense_to_csr(self.matrix)

    def _product(self) -> tuple[IntArray, IntArray, FloatArray]:
        # A = Y Y^T + diag(compliance): symmetric to the bit, as both triangles are summed in the same order.
        y = self.whitened
        most = float(np.sum(np.bincount(y.indices, minlength=1).astype(float) ** 2))
        if most >= 2**31:
            raise InputError(
                f"A would have up to {most:.3g} entries, more than 32-bit indices reach: use a solver that takes "
                "J and M as they are (operator 'generalized')"
            )
        indptr, indices, data = assemble.gram(y.data, y.indices, y.indptr, y.shape[1], self.compliance)
        return read_only(indptr), read_only(indices), read_only(data)

    @once
    def whitened(self) -> sp.csr_array:
        """Y (m, nv) with J M^-1 J^T = Y Y^T, read-only; only in generalised coordinates.

        Raises
        ------
        CapabilityError
            The problem was given otherwise.
        """
        if self.generalized is None:
            raise CapabilityError(
                f"this problem was given as {self.operator}; Y is known in generalised coordinates "
                "(Problem.from_jacobian)"
            )
        return _read_only(sp.csr_array(self.metric.whitened(), shape=(self.m, self.generalized.nv)))

    @once
    def jacobian(self) -> sp.csr_array:
        """J as CSR, read-only: (m, 6 n) with rows, (m, nv) in generalised coordinates.

        Raises
        ------
        CapabilityError
            The problem was given as a matrix.
        """
        if self.generalized is not None:
            return self.generalized.jac
        if self.rows is None:
            raise CapabilityError(
                "this problem was given as a matrix; its Jacobian is not known (make it with "
                "Problem.from_rows or Problem.from_jacobian)"
            )
        return _read_only(self.rows.jacobian(self.cones))

    @property
    def d(self) -> FloatArray:
        """(m,) 1/kg: diagonal of A with fallbacks, the judge's metric."""
        return self.metric.d

    @property
    def vanished_rows(self) -> IntArray:
        """Rows with A_ii = 0 only because products of small numbers vanish: J_i has an entry where M^-1 has one."""
        empty: IntArray = self.metric.empty
        if not len(empty):
            return empty
        if self.generalized is not None:
            pattern = self.generalized.jac[empty]  # M is positive definite
        elif self.rows is not None:
            inverse = self.rows.inverse_mass_matrix().astype(bool).astype(float)
            pattern = self.rows.jacobian(self.cones)[empty].astype(bool).astype(float) @ inverse
        else:
            return empty[:0]
        pattern.eliminate_zeros()
        return empty[np.diff(pattern.indptr) > 0]

    def delassus(self) -> Any:
        """A (m, m) [1/kg]: the matrix as given, or J M^-1 J^T + diag(compliance) as CSR."""
        return self.csr if self.matrix is None else self.matrix

    def dense(self) -> FloatArray:
        """A (m, m) [1/kg] as a new dense array."""
        return self.matrix.copy() if isinstance(self.matrix, np.ndarray) else self.csr.toarray()

    def slack(self, impulse: ArrayLike) -> FloatArray:
        """w = A lambda - b (m,) [m/s], recomputed from the problem's data."""
        w = np.empty(self.m)
        measure.slack(self.metric, self.impulse_array(impulse), w)
        return w

    def velocity(self, impulse: ArrayLike) -> FloatArray:
        """v+ = v* + M^-1 J^T lambda [m/s, rad/s]: (n, 6) with rows, (nv,) in generalised coordinates.

        Raises
        ------
        CapabilityError
            The problem was given as a matrix.
        """
        if self.generalized is not None:
            return self.generalized.v_free + self.generalized.change(self.impulse_array(impulse))
        if self.rows is None:
            raise CapabilityError(
                "this problem was given as a matrix; velocities need J and M (make it with "
                "Problem.from_rows or Problem.from_jacobian)"
            )
        v = np.zeros((self.rows.n_bodies, 6))
        measure.velocity_change(self.data, self.impulse_array(impulse), v)
        return self.rows.v_free + v

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

    def start(self) -> FloatArray:
        """Pi(0) (m,) [N s]: doing nothing, clipped to the bounds; a new array."""
        return self._start.copy()

    @once
    def _start(self) -> FloatArray:
        return nothing_done(self.cones.lower, self.cones.upper)

    def impulse_array(self, impulse: ArrayLike, name: str = "impulse") -> FloatArray:
        """A writable private copy of `impulse`, checked: (m,) [N s], finite."""
        if type(impulse) is np.ndarray and impulse.dtype == np.float64 and impulse.shape == self.b.shape:
            own = impulse.copy()
            if measure.all_finite(own):
                return own
        return as_array(name, impulse, (self.m,), unit="N s").copy()

    # -- names -----------------------------------------------------------------------------------

    def block_of(self, row: int) -> int:
        """Block that holds a row."""
        return int(np.searchsorted(self.cones.ptr, row, side="right")) - 1

    def row_name(self, row: int) -> str:
        """Name of a row, e.g. "hinge 7, axis 2" or "contact 3, tangent 1".

        Raises
        ------
        InputError
            No such row.
        """
        if not 0 <= row < self.m:
            raise InputError(f"row {row} of a problem of {self.m} rows")
        i = self.block_of(row)
        offset, size, kind = row - int(self.cones.ptr[i]), int(np.diff(self.cones.ptr)[i]), self.cones.kind[i]
        spin, roll = self.cones.spin_rows[i], self.cones.rolling_rows[i]
        if kind == ROW:
            name = self.names[i] if self.names else f"row {row}" if size == 1 else f"joint {i}"
            return name if size == 1 else f"{name}, axis {offset}"
        first_contact = 0 if self.rows is None else self.rows.n_joints
        if self.generalized is not None:
            first_contact = int(np.count_nonzero(self.cones.kind[:i] == ROW))
        name = self.names[i] if self.names else f"contact {i - first_contact}"
        if offset == 0:
            return f"{name}, normal"
        if kind == ROUND and offset > 2:
            return f"{name}, spin" if offset == 3 else f"{name}, roll {offset - 3}"
        if 0 <= roll <= row:
            return f"{name}, roll {row - roll + 1}"
        return f"{name}, spin" if row == spin else f"{name}, tangent {offset}"

    # -- other forms -----------------------------------------------------------------------------

    def relaxed(self, friction: str = "cone") -> Problem:
        """The same problem under another friction law: "cone" is the convex relaxation.

        Raises
        ------
        InputError
            "coulomb" for round cones of more than two tangents.
        """
        return replace(self, friction=friction, copy=False)

    def stretched(self, scale: ArrayLike) -> Problem:
        """The same problem with rows `scale` times as long, whose impulses are those here over `scale`.

            A' = S A S,   b' = S b,   lambda = S lambda',   w' = S w,   S = diag(scale)

        Rows of bodies become a matrix. A disk of stretched tangents is an ellipse of those here.

        Parameters
        ----------
        scale : scalar or (m,)
            Above 0; of a contact's normal 1.

        Raises
        ------
        InputError
            A scale that is not above 0, or not 1 at the normal of a contact.

        Examples
        --------
        An ellipse, mu 0.5 along the first tangent and 0.2 along the second:

        >>> import numpy as np
        >>> import lavender as lv
        >>> A, b = np.eye(3), np.array([10.0, 9.0, 9.0])
        >>> scale = np.array([1.0, 1.0, 0.2 / 0.5])
        >>> ellipse = lv.Problem.contact(A, b, [0.5]).stretched(scale)
        >>> impulse = scale * lv.solve(ellipse, tol=1e-9).impulse
        >>> round(float(np.hypot(impulse[1] / 0.5, impulse[2] / 0.2) / impulse[0]), 6)  # it slides: on the rim
        1.0
        """
        s = as_array("scale", scale, (self.m,))
        c = self.cones
        normal = c.ptr[:-1][c.kind != ROW]
        wrong = np.flatnonzero(~(s > 0.0))
        if len(wrong) or np.any(s[normal] != 1.0):
            i = int(wrong[0]) if len(wrong) else int(normal[s[normal] != 1.0][0])
            needed = "a number above 0" if len(wrong) else "1"
            raise InputError(f"scale of {self.row_name(i)} is {s[i]}; {needed} is needed")
        rows = np.repeat(c.kind == ROW, np.diff(c.ptr))
        low, high = (np.where(rows, x / s, x) for x in (c.lower, c.upper))
        cones = Cones(ptr=c.ptr, kind=c.kind, lower=low, upper=high, mu=c.mu, patch_radius=c.patch_radius)
        guess = None if self.guess is None else self.guess / s
        more: dict[str, Any] = {"guess": guess, "key": self.key, "names": self.names, "name": self.name}
        more["friction"] = self.friction
        if self.generalized is None:
            a = sp.csr_array(sp.diags_array(s) @ self.csr @ sp.diags_array(s))
            return Problem(s * self.b, cones, a, copy=False, **more)
        g = self.generalized
        jac = sp.csr_array(sp.diags_array(s) @ g.jac)
        assert self.compliance is not None
        made = Generalized(jac, g.mass, g.v_free, g.names)
        return Problem(
            s * self.b, cones, generalized=made, compliance=s * s * self.compliance, copy=False, **more
        )

    def boxed(self, normal_impulse: ArrayLike) -> Problem:
        """Friction bounded by fixed normals: |lambda_t| <= mu N on each tangent alone: a square, not the disk.

        Parameters
        ----------
        normal_impulse : scalar or (c,) N s
            N of each contact, in block order.
        """
        c = self.cones
        contact = np.flatnonzero(c.kind != ROW)
        n = as_array("normal_impulse", normal_impulse, (len(contact),), unit="N s")
        check_not_negative("normal_impulse", n)
        lower, upper = c.lower.copy(), c.upper.copy()
        for i, load in zip(contact, n, strict=True):
            j, end = c.ptr[i], c.ptr[i + 1]
            bound = np.full(end - j, c.mu[i] * load)
            if c.apart_rows[i] >= 0:
                bound[c.apart_rows[i] - j] *= c.patch_radius[i]
            if c.rolling_rows[i] >= 0:
                bound[-2:] = c.rolling[i] * load
            lower[j + 1 : end], upper[j + 1 : end] = -bound[1:], bound[1:]
            upper[j] = np.inf
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
            **more,
        )

    def velocity_form(self) -> VelocityForm:
        """The mass-scaled velocity form (see `VelocityForm`); not with a matrix.

        Raises
        ------
        CapabilityError
            The problem was given as a matrix.
        InputError
            An inverse inertia is so large that its principal values overflow.
        """
        jac = self.jacobian
        scale = 1.0 / np.sqrt(self.d)
        if self.generalized is not None:
            k = sp.csr_array(sp.diags_array(scale) @ self.whitened)
            return VelocityForm(k, scale * self.b, self.compliance * scale**2, scale)  # type: ignore[operator]
        rows = self.rows
        assert rows is not None
        n = rows.n_bodies
        # M^-1 = L L^T by blocks; a singular inverse inertia (a pinned axis) has a root but no Cholesky factor.
        value, vector = np.linalg.eigh(rows.inv_inertia) if n else (np.zeros((0, 3)), np.zeros((0, 3, 3)))
        root = vector * np.sqrt(np.maximum(value, 0.0))[:, None, :]
        beyond = np.flatnonzero(~np.isfinite(root).all(axis=(1, 2)))
        if len(beyond):
            raise InputError(
                f"inv_inertia [1/(kg m2)] of body {beyond[0]} has principal values beyond float64; {len(beyond)} "
                "bodies in all: give it in other units, or take a solver that needs no velocity form"
            )
        half = replace(
            rows, inv_mass=np.sqrt(rows.inv_mass), inv_inertia=root, copy=False
        ).inverse_mass_matrix()
        k = sp.csr_array(sp.diags_array(scale) @ (jac @ half))
        return VelocityForm(k, scale * self.b, self.compliance * scale**2, scale)  # type: ignore[operator]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Problem):
            return NotImplemented
        if not all(
            equal(getattr(self, n), getattr(other, n))
            for n in (
                "b",
                "cones",
                "rows",
                "generalized",
                "friction",
                "compliance",
                "guess",
                "key",
                "names",
                "name",
            )
        ):
            return False
        if sp.issparse(self.matrix) and sp.issparse(other.matrix):
            return all(
                equal(getattr(self.matrix, n), getattr(other.matrix, n))
                for n in ("indptr", "indices", "data")
            )
        return type(self.matrix) is type(other.matrix) and equal(self.matrix, other.matrix)

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[Any, ...]:
        # Copies and pickles hold what was given; derived numbers are made anew, arrays stay read-only.
        return type(self), tuple(f.name != "copy" and getattr(self, f.name) for f in fields(self) if f.init)

    def __repr__(self) -> str:
        kind = self.operator if self.matrix is None else "CSR" if sp.issparse(self.matrix) else "dense"
        name = f"{self.name!r}, " if self.name else ""
        return (
            f"<Problem {name}{self.law}, {_many(self.m, 'row')} in {_many(self.n_blocks, 'block')}, {kind}>"
        )

    def _repr_html_(self) -> str:
        """For notebooks: what it is, as a small table."""
        contacts = int(np.count_nonzero(self.cones.kind != ROW))
        facts = {
            "law": self.law,
            "rows": self.m,
            "contacts": contacts,
            "other blocks": self.n_blocks - contacts,
            "given by": repr(self).rpartition(", ")[2].rstrip(">"),
        }
        return table_of(facts, self.name or "Problem")

    def save(self, path: str | PathLike[str], **more: Any) -> None:
        """Write the problem to a file; `lavender.io.save`, whose options `more` are.

        Raises
        ------
        InputError
            The suffix is of no format, or the file cannot be written.
        """
        from lavender.io import save

        save(self, path, **more)


def _many(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def _read_only(matrix: sp.csr_array) -> sp.csr_array:
    for part in (matrix.data, matrix.indices, matrix.indptr):
        read_only(part)
    return matrix


def _checked_matrix(matrix: Any, m: int, copy: bool) -> Any:
    if not sp.issparse(matrix):
        return as_array("A", matrix, (m, m), unit="1/kg", copy=copy)
    if matrix.shape != (m, m):
        raise InputError(f"A has shape {matrix.shape}; ({m}, {m}) is needed, as b has {m} rows")
    if matrix.nnz >= 2**31:
        raise InputError(
            f"A has {matrix.nnz} nonzeros, more than 32-bit indices reach; give J and M^-1 instead "
            "(Problem.from_rows)"
        )
    if matrix.dtype.kind not in "buif":
        raise InputError(f"A has dtype {matrix.dtype}; real numbers are needed")
    given = sp.csr_array(matrix, copy=copy)
    try:
        given.check_format(full_check=True)  # kernels trust every index
    except ValueError as error:
        raise InputError(
            f"A is not a valid compressed matrix ({error}); check its indices and pointers"
        ) from None
    as_array("A", given.data, (None,), unit="1/kg", copy=False)
    return _canonical(given, m)


def _canonical(a: sp.csr_array, m: int) -> sp.csr_array:
    if not a.has_canonical_format:
        a = a.copy()
        a.sum_duplicates()
    parts = [
        read_only(np.ascontiguousarray(x, t))
        for x, t in ((a.data, np.float64), (a.indices, np.int32), (a.indptr, np.int32))
    ]
    return sp.csr_array(tuple(parts), shape=(m, m))
