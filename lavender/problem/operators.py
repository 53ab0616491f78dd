"""Quantities derived from a problem's data at their first use: A, J, the judge's metric, velocities."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import ArrayLike, FloatArray, IntArray, mark_read_only
from lavender.base.deadline import FORMING, TooLate
from lavender.base.errors import CapabilityError, InputError, TooLarge
from lavender.base.lazy_import import issparse
from lavender.base.lazy_import import sparse as sp
from lavender.problem.data import ProblemData, check_rhs
from lavender.problem.derived import Derived, cached_property, computed_once
from lavender_ext.core import assemble
from lavender_ext.core.assemble import dense_to_csr
from lavender_ext.core.checks import MAX_MAGNITUDE, has_entry_above, make_instance
from lavender_ext.core.problem import LAWS as FRICTION_NUMBER
from lavender_ext.core.problem import Data, clip_zero_to_bounds, multiply_body_jacobian
from lavender_ext.factor import sparse
from lavender_ext.factor.linear import LinearSystem
from lavender_ext.judge import measure

# [-] A matrix counts as positive semidefinite if A + SEMIDEFINITE_SHIFT D has a Cholesky factor, with D = diag(d).
# Rounding of the entries can cause negative eigenvalues of about -m 2^-53 in the metric of D.
SEMIDEFINITE_SHIFT = 1e-12
# If entries of J and M^-1 do not exceed this, A_ii cannot exceed MAX_MAGNITUDE and is not checked.
MAX_SAFE_ENTRY = 1e15
MAX_INDEXABLE_ENTRIES = (
    2**31
)  # A with this many entries or more is not formed: its indices have 32 bits.
# Fields and cached properties that depend neither on the law of friction nor on b, and those that do not depend on b.
SHARED_ARRAYS = (
    "csr",
    "jacobian",
    "whitened",
    "bandwidth",
    "_compressed",
    "_couplings",
    "_matrix_asymmetry",
)
FIELDS_BESIDES_RHS = (
    "cones",
    "matrix",
    "rows",
    "friction",
    "compliance",
    "key",
    "names",
    "name",
    "copy",
    "precision",
    "law",
    "angular",
)
# Key in `Derived.cache` of the values of FIELDS_BESIDES_RHS, for the next problem with another b.
BESIDES_RHS_KEY = "lavender.problem.operators: fields besides b"


class Operators(ProblemData):
    """A, J, and the arrays that kernels and the judge read, derived from the fields of a problem."""

    def _check_magnitudes(self) -> None:
        """Raise InputError now, not in a solve, if large entries of J, M^-1 or the compliance make A_ii too large."""
        r, general, c = self.rows, self.generalized, self.compliance
        if general is not None:
            is_large = general.operator.has_entry_above(MAX_SAFE_ENTRY) or has_entry_above(
                MAX_SAFE_ENTRY, c
            )
        else:
            is_large = r is not None and has_entry_above(
                MAX_SAFE_ENTRY, c, r.jac, r.arm_a, r.arm_b, r.inv_mass, r.inv_inertia
            )
        if is_large:
            self.metric  # noqa: B018

    @classmethod
    def _from_checked_data(cls, view: Data, friction: str, name: str, rest: tuple[Any, Any]) -> Any:
        """Build a problem over J and M without copies, from data that `lavender.io.mujoco` has checked.

        The arrays are read-only, and no entry of J and M^-1 exceeds `MAX_SAFE_ENTRY`. `rest` is a function and its
        arguments; the function returns b, cones, generalized, compliance, key and names when one of them is first read.
        """
        return make_instance(
            cls,
            {
                "derived": Derived(view),
                "friction": friction,
                "precision": "float64",
                "name": name,
                "_rest": rest,
            },
        )

    def _share_operator(self, other: Operators) -> None:
        """Give a problem with the same A, and another law or b, the arrays of this one that depend on neither."""
        known = self.__dict__
        law = FRICTION_NUMBER[other.friction]
        b = other.b
        for name in SHARED_ARRAYS:
            if name in known:
                other.__dict__[name] = known[name]
        if "csr_data" in known:
            other.__dict__["csr_data"] = known["csr_data"].with_law(law, b)
        if "data" in known and self.rows is not None:
            other.__dict__["data"] = known["data"].with_law(law, b)
        if self.derived.view is not None and self.derived.view.ready:
            other.derived.view = self.derived.view.with_law(law, b)

    def has_operator_of(self, other: Operators) -> bool:
        """Return whether two problems share the arrays of A and of the blocks, as `updated(b=...)` makes them."""
        p, q = self.generalized, other.generalized
        return (
            self.cones is other.cones
            and self.friction == other.friction
            and self.matrix is other.matrix
            and self.rows is other.rows
            and self.compliance is other.compliance
            and (p is q or (p is not None and q is not None and p.operator is q.operator))
        )

    def _with_rhs(self, b: FloatArray, generalized: Any, guess: FloatArray | None) -> Any:
        """Return a problem of the same A with another right-hand side b (m,) [m/s], used without a copy."""
        check_rhs(b)
        derived = Derived()
        same = self.derived.cache.get(BESIDES_RHS_KEY) or {
            name: getattr(self, name) for name in FIELDS_BESIDES_RHS
        }
        derived.cache[BESIDES_RHS_KEY] = same
        values = {
            "b": b,
            "generalized": generalized,
            "guess": guess,
            "derived": derived,
            "qp": None,
        }
        other: Operators = make_instance(type(self), same | values)
        self._share_operator(other)
        if generalized is not None and derived.view is None:
            other._set_view()
        return other

    @property
    def asymmetry(self) -> float:
        """Asymmetry max |A - A^T| / max |A| [-]; exactly 0 with J and M.

        If this is rounding (up to 1e-14), but the maximum of |A_ij - A_ji| / sqrt(d_i d_j) is not (above 1e-10), the
        value is that maximum: entries of heavy bodies are small compared with entries of light bodies.
        """
        return 0.0 if self.matrix is None else self._matrix_asymmetry

    @cached_property
    def bandwidth(self) -> tuple[int, int]:
        """Lower and upper half bandwidth of A: the maximum of i - j and of j - i over the stored entries."""
        return sparse.bandwidth(*self._compressed[:2])

    @property
    def max_bandwidth(self) -> int:
        """Upper bound of the half bandwidth of A, without forming A of bodies or of J and M."""
        if self.rows is not None:
            return self._couplings[1]
        return max(self.bandwidth) if self.generalized is None else int(self.metric.max_bandwidth)

    @cached_property
    def _matrix_asymmetry(self) -> float:
        """Value of `asymmetry` of a matrix."""
        return float(sparse.measure_asymmetry(*self._compressed, self.metric.d))

    @property
    def is_symmetric(self) -> bool:
        """Whether A = A^T up to rounding of its entries (1e-14 of the largest, and 1e-10 of sqrt(d_i d_j))."""
        return self.matrix is None or self._matrix_asymmetry <= 1e-14

    @cached_property
    def is_semidefinite(self) -> bool:
        """Whether A is symmetric and x.A x >= 0 for every x, up to rounding; always True with J and M."""
        if self.matrix is None or not self.csr.nnz:
            return True
        if not self.is_symmetric:
            return False
        with np.errstate(all="ignore"):  # Overflow raises no warning.
            scale = sp.diags_array(1.0 / np.sqrt(self.d))
            a = scale @ self.csr @ scale
            a = sp.csr_array(
                0.5 * (a + a.T)
            )  # Make the pattern, and entries that differ by rounding, symmetric.
        a.sort_indices()
        try:
            system = LinearSystem((a.indptr.astype(np.int32), a.indices.astype(np.int32)))
            system.analyse()
        except OverflowError as error:
            raise TooLarge(
                f"A cannot be factored: {error}. Use a sweep solver, which needs no factor"
            ) from None
        return bool(system.factor(a.data, None, SEMIDEFINITE_SHIFT) == 0)

    @computed_once
    def data(self) -> Data:
        """Arrays for sweep kernels: pointers, d, nu, steps, and the rows of bodies, or A if there are no rows."""
        if self.rows is None:
            return self.csr_data
        r = self.rows
        arms, masses = (r.arm_a, r.arm_b), (r.inv_mass, r.inv_inertia)
        rows = (
            r.jac,
            r.joint_body,
            r.normal,
            r.tangent,
            *arms,
            r.contact_body,
            *masses,
            self.compliance,
        )
        data = self._make_data(rows=rows)
        self._check_diagonal(data)
        return data

    @computed_once
    def csr_data(self) -> Data:
        """Arrays for sweep kernels over A in compressed rows; A is formed if J and M are given."""
        data = self._make_data(csr=self._compressed)
        if self.rows is not None:
            data.copy_velocity_weight(self.metric)
        if self.generalized is not None and self.metric.reference_energy >= 0.0:
            data.share_reference(self.metric)
        return data

    @computed_once
    def metric(self) -> Data:
        """Arrays for the judge: `data`, or in generalised coordinates J, M, d and Y = J L^-1 D^-1/2."""
        view = self.derived.view
        if view is None:
            return self.data
        try:
            view.compute_derived_numbers()
        except OverflowError as error:
            raise TooLarge(
                f"the problem is too large: {error}: split it, for example by islands"
            ) from None
        self._check_diagonal(view)
        return view

    def _check_diagonal(self, data: Data) -> None:
        """Raise InputError if an entry of A's diagonal exceeds MAX_MAGNITUDE."""
        i = data.outside
        if i >= 0:
            raise InputError(
                f"A_ii = J_i M^-1 J_i^T + compliance of {self.row_name(i)} (row {i}) is {data.d[i]:g} 1/kg; at most "
                f"{MAX_MAGNITUDE:g} is needed: another unit of mass, or of the row's velocity, brings it nearer to 1"
            )

    def _make_data(self, **operator: Any) -> Data:
        return Data(self.cones._blocks, self.b, FRICTION_NUMBER[self.friction], **operator)

    @computed_once
    def csr(self) -> sp.csr_array:
        """A (m, m) in compressed rows with int32 indices, read-only."""
        if issparse(self.matrix):
            return self.matrix
        indptr, indices, data = self._compressed
        return sp.csr_array((data, indices, indptr), shape=(self.m, self.m))

    @computed_once
    def _couplings(self) -> tuple[float, int]:
        """Number of pairs of rows that share a body, and the largest distance of two such rows; (0, 0) without bodies.

        Pairs that share both bodies count twice. The numbers are stored because the estimated time of every solver
        depends on them.
        """
        if self.rows is None:
            return 0.0, 0
        entries, *lists = assemble.bound_delassus_entries(self.data)
        return float(entries), assemble.bound_delassus_bandwidth(self.data, *lists)

    @property
    def max_entries(self) -> float:
        """Number of entries of A, or an upper bound if A is not formed."""
        if self.matrix is not None or "_compressed" in self.__dict__:
            return float(len(self._compressed[1]))
        bound = self._couplings[0] if self.rows is not None else self.metric.entries_of_matrix
        return min(float(bound), float(self.m) ** 2)

    def check_matrix_fits(self) -> None:
        """Raise TooLarge if A in compressed rows may have more entries than 32-bit indices reach."""
        if self.matrix is None and "_compressed" not in self.__dict__:
            bound = (
                self._couplings[0] if self.generalized is None else self.metric.entries_of_matrix
            )
            self._check_entry_count(bound)

    def _check_entry_count(self, bound: float) -> None:
        """Raise TooLarge if this upper bound of the number of entries of A off the diagonal is too large."""
        # Pairs of blocks that share both bodies were counted twice. Rows of J without entries have a diagonal entry.
        if min(bound + self.m, self.m**2) >= MAX_INDEXABLE_ENTRIES:
            data = "rows" if self.generalized is None else "J and M"
            raise TooLarge(
                f"A may have {bound:.3g} entries, above 2^31 - 1: use a solver that takes {data}"
            )

    @computed_once
    def _compressed(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Arrays (indptr, indices, data) of A for kernels and the judge.

        They are stored separately because callers can replace the arrays of the matrix object `csr`. A = Y Y^T +
        diag(compliance) is bitwise symmetric: both triangles are summed in the same order.
        """
        if self.generalized is not None:
            self._check_entry_count(self.metric.entries_of_matrix)
            # A kernel is used instead of SciPy, which a first solve with a time limit would have to import.
            y = self.metric.whitened()
            arrays = assemble.form_gram_matrix(
                *y, self.generalized.nv, self.compliance, FORMING.deadline
            )
            if arrays is None:
                raise TooLate("the time limit ended the forming of A")
        elif self.rows is not None:
            bound, start, blocks = assemble.bound_delassus_entries(self.data)
            self._check_entry_count(bound)
            arrays = assemble.form_delassus_matrix(self.data, min(bound, self.m**2), start, blocks)
        else:
            return dense_to_csr(self.matrix)
        indptr, indices, data = map(mark_read_only, arrays)
        return indptr, indices, data

    @computed_once
    def whitened(self) -> sp.csr_array:
        """Y (m, nv) with J M^-1 J^T = Y Y^T, read-only; only in generalised coordinates.

        Raises
        ------
        CapabilityError
            The problem is not in generalised coordinates.
        """
        if self.generalized is None:
            raise CapabilityError(
                f"Y exists only in generalised coordinates, and this problem was given as {self.operator}"
            )
        return _mark_matrix_read_only(
            sp.csr_array(self.metric.whitened(), shape=(self.m, self.generalized.nv))
        )

    @computed_once
    def jacobian(self) -> sp.csr_array:
        """J as a read-only CSR matrix: (m, 6 n) with rows, (m, nv) in generalised coordinates.

        Raises
        ------
        CapabilityError
            The problem was given as a matrix.
        """
        if self.generalized is not None:
            return self.generalized.jac
        if self.rows is None:
            raise CapabilityError("this problem was given as a matrix; its Jacobian is not known")
        return _mark_matrix_read_only(self.rows.jacobian(self.cones))

    @property
    def d(self) -> FloatArray:
        """Metric of the judge (m,) [1/kg]: the diagonal of A, with replacements for entries that are not positive."""
        return self.metric.d

    @computed_once
    def vanished_rows(self) -> IntArray:
        """Rows with A_ii = 0 only by underflow, since J_i M^-1 J_i^T has products of nonzero entries."""
        empty: IntArray = self.metric.empty
        if not len(empty):
            return empty
        if self.generalized is not None:
            # Since M is positive definite, A_ii = 0 of a nonzero row of J is an underflow.
            pattern = self.generalized.jac[empty]
        elif self.rows is not None:
            inverse = self.rows.inverse_mass_matrix().astype(bool).astype(float)
            pattern = self.rows.jacobian(self.cones)[empty].astype(bool).astype(float) @ inverse
        else:
            return empty[:0]
        pattern.eliminate_zeros()
        return empty[np.diff(pattern.indptr) > 0]

    def delassus(self) -> Any:
        """Return A (m, m) [1/kg]: the matrix of the problem, or J M^-1 J^T + diag(compliance) as CSR."""
        return self.csr if self.matrix is None else self.matrix

    def dense(self) -> FloatArray:
        """Return A (m, m) [1/kg] as a new dense array."""
        return self.matrix.copy() if isinstance(self.matrix, np.ndarray) else self.csr.toarray()

    def slack(self, impulse: ArrayLike) -> FloatArray:
        """Compute w = A lambda - b (m,) [m/s] from the problem's data, for `impulse` (m,) [N s]."""
        w = np.empty(self.m)
        measure.compute_slack(self.metric, self.make_start(impulse), w)
        return w

    def velocity(self, impulse: ArrayLike) -> FloatArray:
        """Compute v+ = v* + M^-1 J^T lambda [m/s, rad/s] for `impulse` (m,) [N s].

        Its shape is (n, 6) with rows, (nv,) in generalised coordinates.

        Raises
        ------
        CapabilityError
            The problem was given as a matrix.
        """
        general = self.rows if self.generalized is None else self.generalized
        if general is None:
            raise CapabilityError(
                "this problem was given as a matrix; J and M are needed for velocities"
            )
        return general.v_free + self.compute_velocity_change(self.make_start(impulse))

    def compute_velocity_change(self, impulse: FloatArray) -> FloatArray:
        """Compute M^-1 J^T x of impulses x (m,), in the shape of `velocity`; the problem is not given as a matrix."""
        if self.generalized is not None:
            return self.generalized.change(impulse)
        assert self.rows is not None
        v = np.zeros((self.rows.n_bodies, 6))
        measure.write_velocity_change(self.data, impulse, v)
        return v

    def energy_change(self, impulse: ArrayLike) -> float:
        """Compute the change of the kinetic energy [J] by `impulse` (m,) [N s]: its work lambda.J (v* + v+) / 2.

        A solution of contacts with target 0 never gains energy.

        Raises
        ------
        CapabilityError
            The problem was given as a matrix.
        """
        velocity = self.velocity(impulse)
        velocity += self.rows.v_free if self.generalized is None else self.generalized.v_free  # type: ignore[union-attr]
        if self.generalized is not None:
            relative = self.generalized.velocity_of(velocity)
        else:
            relative = np.empty(self.m)
            multiply_body_jacobian(self.data, velocity, relative)
        with np.errstate(
            over="ignore", invalid="ignore"
        ):  # Large impulses may overflow without a warning.
            return float(0.5 * (self.make_start(impulse) @ relative))

    def start(self) -> FloatArray:
        """Return Pi(0) (m,) [N s], the zero impulse clipped to the bounds, as a new array."""
        return self._start.copy()

    @cached_property
    def _start(self) -> FloatArray:
        """Pi(0) (m,) [N s], an array that callers must not change."""
        start: FloatArray = clip_zero_to_bounds(self.cones.lower, self.cones.upper)
        return start


def _mark_matrix_read_only(matrix: sp.csr_array) -> sp.csr_array:
    """Mark the arrays of a matrix read-only, and return it."""
    for array in (matrix.data, matrix.indices, matrix.indptr):
        mark_read_only(array)
    return matrix
