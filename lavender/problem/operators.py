"""What follows from a problem's data, worked out at first use and kept: A, J, the metric, velocities."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import ArrayLike, FloatArray, IntArray, read_only
from lavender.base.errors import CapabilityError, InputError, TooLarge
from lavender.base.lazy_import import issparse
from lavender.base.lazy_import import sparse as sp
from lavender.problem.data import ProblemData
from lavender.problem.derived import Derived, cached_property, once
from lavender_ext.core import assemble
from lavender_ext.core.assemble import dense_to_csr
from lavender_ext.core.checks import MOST, largest
from lavender_ext.core.problem import LAWS as FRICTION_NUMBER
from lavender_ext.core.problem import Data, general_data, zero_impulse
from lavender_ext.factor import sparse
from lavender_ext.judge import measure

# A matrix counts as positive semidefinite where A + SHIFT D has a Cholesky factor, D = diag(d): entries that were
# rounded leave negative eigenvalues of about m 2^-53.
SHIFT = 1e-12
USUAL = 1e15  # of J and M^-1: sums of their products stay below MOST
MOST_ENTRIES = 2**31  # of A, from which on 32-bit indices do not reach them


class Operators(ProblemData):
    """A, J and what kernels and the judge read, of the problem's data."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.matrix is None and self._is_extreme():
            self.metric  # noqa: B018 - refused here, and not in a solve

    @classmethod
    def _of_engine(cls, **given: Any) -> Any:
        """From read-only arrays that `export.numbers` has let in, over J and M; nothing is beyond USUAL: adopted."""
        made, derived = object.__new__(cls), Derived()
        given["derived"], given["precision"], given["copy"] = derived, "float64", True
        derived.view = general_data(
            given["cones"]._blocks, given["b"], given["generalized"].operator, given["compliance"],
            FRICTION_NUMBER[given["friction"]],
        )  # fmt: skip
        object.__setattr__(made, "__dict__", given)
        return made

    def _is_extreme(self) -> bool:
        """Whether A_ii may be beyond MOST: numbers of J and M^-1 so large that A_ii must be formed to know."""
        if self.compliance is not None and largest(self.compliance) > USUAL:
            return True
        if self.generalized is not None:
            return bool(self.generalized.operator.is_beyond(USUAL))
        r = self.rows
        return r is not None and any(
            largest(x.reshape(-1)) > USUAL for x in (r.jac, r.arm_a, r.arm_b, r.inv_mass, r.inv_inertia)
        )

    @property
    def asymmetry(self) -> float:
        """max |A - A^T| / max |A|; exactly 0 with J and M.

        Where that is rounding (1e-14), and |A_ij - A_ji| / sqrt(d_i d_j) is none, more than 1e-10, its largest: beside
        light bodies entries of heavy ones are small.
        """
        return 0.0 if self.matrix is None else self._scan[2]

    @cached_property
    def bandwidth(self) -> tuple[int, int]:
        """Lower and upper half bandwidth of A: the largest i - j and j - i of a stored entry."""
        if self.rows is None:
            return self._scan[:2]
        return sparse.bandwidth(*self._compressed[:2])

    @cached_property
    def _scan(self) -> tuple[int, int, float]:
        return sparse.scan(*self._compressed, self.d)

    @property
    def is_symmetric(self) -> bool:
        """A = A^T up to rounding of its entries (1e-14 of the largest, and 1e-10 of sqrt(d_i d_j))."""
        return self.asymmetry <= 1e-14

    @cached_property
    def is_semidefinite(self) -> bool:
        """A is symmetric and x.A x >= 0 for every x, to rounding; always with J and M."""
        if self.matrix is None:
            return True
        if not self.is_symmetric:
            return False
        with np.errstate(all="ignore"):  # what overflows warns nobody
            scale = sp.diags_array(1.0 / np.sqrt(self.d))
            return semidefinite(scale @ self.csr @ scale)

    @once
    def data(self) -> Data:
        """What kernels that sweep read: pointers, d, nu, steps. Of the rows where there are rows, else of A."""
        if self.rows is None:
            return self.csr_data
        r = self.rows
        made = self._data(
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
        self._check_diagonal(made)
        return made

    @once
    def csr_data(self) -> Data:
        """The same over A in compressed rows; forms A where J and M are given."""
        data = self._data(csr=self._compressed)
        if self.rows is not None:
            data.weigh_as(self.metric)
        if self.generalized is not None and self.metric.reference_energy >= 0.0:
            data.share_reference(self.metric)
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
            raise TooLarge(f"the problem is too large: {error}") from None
        self._check_diagonal(view)
        return view

    def _check_diagonal(self, data: Data) -> None:
        i = data.outside
        if i >= 0:
            raise InputError(
                f"A_ii = J_i M^-1 J_i^T + compliance of {self.row_name(i)} (row {i}) is {data.d[i]:g} 1/kg; at most "
                f"{MOST:g} is needed: another unit of mass, or of the row's velocity, brings it nearer to 1"
            )

    def _data(self, **operator: Any) -> Data:
        return Data(self.cones._blocks, self.b, FRICTION_NUMBER[self.friction], **operator)

    @once
    def csr(self) -> sp.csr_array:
        """A in compressed rows (m, m), int32 indices, read-only."""
        if issparse(self.matrix):
            return self.matrix
        indptr, indices, data = self._compressed
        return sp.csr_array((data, indices, indptr), shape=(self.m, self.m))

    @once
    def _meetings(self) -> float:
        # Rows of bodies that meet, those that share both twice; counted once, as time limits ask it of every candidate.
        return float(assemble.bound(self.data)[0]) if self.rows is not None else 0.0

    @property
    def most_entries(self) -> float:
        """Entries that A has, or can have at most where it is not formed."""
        if self.matrix is not None or "_compressed" in self.__dict__:
            return float(len(self._compressed[1]))
        most = self._meetings if self.rows is not None else self.metric.entries_of_a
        return min(float(most), float(self.m) ** 2)

    @once
    def _compressed(self) -> tuple[IntArray, IntArray, FloatArray]:
        # (indptr, indices, data) of A. Kernels and the judge read these: `csr` is an object whose arrays whoever
        # has it may exchange.
        if self.generalized is not None:
            return self._product()
        if self.rows is not None:
            most, start, blocks = assemble.bound(self.data)
            most = min(most, self.m**2)  # blocks that share both bodies count twice
            if most >= MOST_ENTRIES:
                raise TooLarge(
                    f"A would have up to {most} entries, more than 32-bit indices reach: "
                    "use a solver that reads rows"
                )
            indptr, indices, data = assemble.delassus(self.data, most, start, blocks)
            return read_only(indptr), read_only(indices), read_only(data)
        return dense_to_csr(self.matrix)

    def _product(self) -> tuple[IntArray, IntArray, FloatArray]:
        # A = Y Y^T + diag(compliance): symmetric to the bit, as both triangles are summed in the same order.
        most = min(self.metric.entries_of_a + self.m, self.m**2)  # rows of no velocity have their compliance
        if most >= MOST_ENTRIES:
            raise TooLarge(
                f"A would have up to {most:.3g} entries, more than 32-bit indices reach: use a solver that takes "
                "J and M as they are (operator 'generalized')"
            )
        assert self.generalized is not None
        y = self.metric.whitened()  # without SciPy, which a first solve under a limit has no time to load
        indptr, indices, data = assemble.gram(*y, self.generalized.nv, self.compliance)
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

    @once
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

    def start(self) -> FloatArray:
        """Pi(0) (m,) [N s]: doing nothing, clipped to the bounds; a new array."""
        return self._start.copy()

    @property
    def _start(self) -> FloatArray:
        kept = self.derived
        if kept.start is None:
            kept.start = zero_impulse(self.cones.lower, self.cones.upper)
        return kept.start


def _read_only(matrix: sp.csr_array) -> sp.csr_array:
    for part in (matrix.data, matrix.indices, matrix.indptr):
        read_only(part)
    return matrix


def semidefinite(a: Any) -> bool:
    """Return whether a sparse symmetric matrix of unit diagonal, plus SHIFT, has a Cholesky factor.

    Raises
    ------
    TooLarge
        The factor would have 2^31 entries or more.
    """
    n = a.shape[0]
    if n <= 400:
        try:
            np.linalg.cholesky((a + SHIFT * sp.eye_array(n)).toarray())
        except np.linalg.LinAlgError:
            return False
        return True
    panels, values = panels_of(a)
    return bool(panels.factor(values, np.ones(n), SHIFT, 0.0) == 0)


def panels_of(a: Any) -> tuple[sparse.SparsePanels, FloatArray]:
    """Analyse a sparse symmetric matrix with a full diagonal: what factors it as L L^T, and its entries.

    Raises
    ------
    TooLarge
        The factor would have 2^31 entries or more.
    """
    a = sp.csr_array(0.5 * (a + a.T))  # entries that differ by rounding, and a symmetric pattern
    a.sort_indices()
    try:
        panels = sparse.SparsePanels(a.indptr.astype(np.int32), a.indices.astype(np.int32), False)
    except OverflowError as error:
        raise TooLarge(f"A cannot be factored: {error}") from None
    return panels, a.data
