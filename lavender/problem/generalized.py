"""Generalised coordinates: J and M of articulated bodies, as simulators provide them.

    w = J v+ - target + compliance lambda,   v+ = v* + M^-1 J^T lambda,   A = J M^-1 J^T + diag(compliance)

M is factored once, M = L^T D L, from the last row to the first. If the velocities have the order of a kinematic tree,
with parents before their children, leaves are eliminated first, and there is no fill-in. Other matrices are reordered
to reduce fill-in; see `lavender_ext/core/generalized.pxd`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lavender.base.arrays import (
    FloatArray,
    IntArray,
    are_equal,
    as_array,
    as_array_view,
    as_csr,
    as_names,
    check_int,
    get_common_precision,
    mark_read_only,
)
from lavender.base.errors import InputError
from lavender.base.lazy_import import issparse
from lavender.base.lazy_import import sparse as sp
from lavender.problem.derived import cached_property
from lavender_ext.core import generalized as kernels
from lavender_ext.core.assemble import dense_to_csr, mirror_lower_triangle, stack_csr_matrices
from lavender_ext.core.checks import MAX_MAGNITUDE, MIN_MAGNITUDE, as_plain_array, make_instance
from lavender_ext.factor.graph import order_for_elimination

# M is rejected if |M_ij - M_ji| exceeds this fraction of sqrt(M_ii M_jj); rounding of sums in float64 causes less.
MAX_ASYMMETRY = 1e-12
# Value of MAX_ASYMMETRY for a float32 M, of which the lower triangle is used.
MAX_ASYMMETRY_FLOAT32 = 2.0**-16
# With fewer velocities, a factorisation costs less than the search of an order.
MIN_TREE_ORDERING_VELOCITIES = 400
# If the factor of M in the original order has more entries, another order is used.
MAX_FACTOR_ENTRIES = 50_000_000
# No order of trees is searched if each tree shares rows with more than this many trees on average, because J^T J then
# fills in under every order.
MAX_MEAN_TREE_COUPLINGS = 100
Compressed = tuple[IntArray, IntArray, FloatArray]
ANY_LENGTH = (None,)  # Shape of a one-dimensional array of any length.


class Generalized:
    """J, M and v* of one step in generalised coordinates. M is checked and factored; instances are immutable.

    Parameters
    ----------
    jac : (m, nv) array or sparse
        J: row i of J times generalised velocities is the velocity of constraint row i [m/s or rad/s].
    mass : (nv, nv) array or sparse, or a sequence of square blocks, kg or kg m^2
        M, symmetric positive definite; blocks are the diagonal blocks of M, one for each kinematic tree.
    v_free : (nv,) m/s, rad/s
        v*, the velocity without constraint impulses.
    names : sequence of str (nv,), optional
        Names of the velocities, for messages.

    J and M are copied to compressed rows.

    Attributes
    ----------
    order : (nv,) int or None
        Velocity of each row of the factor; None for the original order.
    operator : lavender_ext.core.generalized.Operator
        J, M and the factor of M in this order, for kernels.

    Raises
    ------
    InputError
        The shapes disagree; a number is not finite; M is not symmetric or not positive definite (the message names a
        velocity).
    """

    v_free: FloatArray
    names: tuple[str, ...] | None
    order: IntArray | None
    operator: kernels.Operator

    def __init__(
        self, jac: Any, mass: Any, v_free: Any, names: Sequence[str] | None = None
    ) -> None:
        lower, n = _convert_mass(mass, names)
        free = as_array("v_free", v_free, (n,), unit="m/s, rad/s")
        self._initialize(_convert_jacobian(jac, n), lower, free, names)

    @classmethod
    def from_compressed_rows(
        cls, jac: Compressed, mass: Compressed, v_free: Any, like: kernels.Operator | None = None
    ) -> Generalized:
        """Build the object from compressed rows of J and of the lower triangle of M, without copies.

        It is meant for adapters of engines that have these arrays. Only finiteness and definiteness are checked.

        Parameters
        ----------
        jac : (indptr, indices, data)
            J in compressed rows of int32 and float64, columns ascending.
        mass : (indptr, indices, data)
            Lower triangle of M with its diagonal, in the same form.
        v_free : (nv,) m/s, rad/s
        like : Operator, optional
            Operator of an earlier problem. The pattern of its factor is reused if the pattern of M is the same.
        """
        new = object.__new__(cls)
        n = len(mass[0]) - 1
        for name, x in (("J", jac[2]), ("M", mass[2])):
            if as_plain_array(x, ANY_LENGTH, True, False) is None:
                as_array(
                    name, x, ANY_LENGTH, copy=False
                )  # Raises an InputError that names the entry.
        free = as_plain_array(v_free, (n,), True, False)
        if free is None:
            free = as_array("v_free", v_free, (n,), unit="m/s, rad/s", copy=False)
        new._initialize(jac, mass, free, None, like)
        return new

    @classmethod
    def from_validated(cls, jac: Compressed, mass: Compressed) -> Generalized:
        """Build the object from checked compressed rows, without v* and without factoring M.

        `with_diagonal_shift` computes v* and the factor.
        """
        new = object.__new__(cls)
        new._make_operator(jac, mass, len(mass[0]) - 1)
        new.__dict__["names"] = None
        return new

    def with_jacobian(self, jac: Any = None, v_free: Any = None) -> Generalized:
        """Return a copy with another J or v*; None keeps the present one. M and its factor are shared."""
        if jac is None:
            free = self.v_free if v_free is None else v_free
            free = as_array("v_free", free, self.v_free.shape, unit="m/s, rad/s")
            return make_instance(Generalized, self.__dict__ | {"v_free": free})
        if self.order is not None:
            return Generalized(
                jac, self.mass, self.v_free if v_free is None else v_free, self.names
            )
        velocity = (
            self.v_free
            if v_free is None
            else as_array("v_free", v_free, (self.nv,), unit="m/s, rad/s")
        )
        new = object.__new__(Generalized)
        new._initialize(_convert_jacobian(jac, self.nv), self.operator.mass, velocity, self.names)
        return new

    def with_scaled_rows(self, scale: FloatArray) -> Generalized:
        """Return a copy with row i of J multiplied by scale[i], scale (m,) > 0; M, its factor and v* are shared."""
        indptr, indices, data = self.operator.jac
        data = data * np.repeat(scale, np.diff(indptr))
        is_nonzero = data != 0.0
        if not is_nonzero.all():  # Remove entries that underflowed to zero when they were scaled.
            indptr = np.append(0, np.cumsum(is_nonzero))[indptr].astype(np.int32)
            indices, data = indices[is_nonzero], data[is_nonzero]
        operator = kernels.Operator(
            indptr, indices, mark_read_only(data), *self.operator.mass, self.operator
        )
        operator.share_factor(self.operator)
        attributes = {
            "v_free": self.v_free,
            "names": self.names,
            "order": self.order,
            "operator": operator,
        }
        return make_instance(Generalized, attributes)

    def with_diagonal_shift(
        self, d: FloatArray | None, momentum: FloatArray | None = None
    ) -> Generalized:
        """Return a copy with M + diag(d), d (nv,) or None for 0, in the same order of elimination.

        With `momentum` (nv,) [kg m/s], v* is the solution of (M + diag(d)) v* = momentum.
        """
        indptr, indices, data = self.operator.mass
        if d is not None:
            data = data.copy()
            data[indptr[1:] - 1] += d if self.order is None else d[self.order]
            as_array("M", data, ANY_LENGTH, copy=False)
        new = object.__new__(Generalized)
        operator = kernels.Operator(*self.operator.jac, indptr, indices, data, self.operator)
        new.__dict__.update(names=self.names, order=self.order, operator=operator)
        new._factor()
        new.__dict__["v_free"] = (
            self.v_free if momentum is None else mark_read_only(new.solve(momentum))
        )
        return new

    def _initialize(
        self,
        jac: Compressed,
        mass: Compressed,
        v_free: FloatArray,
        names: Sequence[str] | None,
        like: kernels.Operator | None = None,
    ) -> None:
        """Set all attributes from checked arrays, and factor M."""
        n = len(v_free)
        attributes = self.__dict__
        attributes["v_free"] = v_free
        attributes["names"] = None if names is None else as_names("velocities", names, n)
        self._make_operator(jac, mass, n, like)
        self._factor()

    def _make_operator(
        self, jac: Compressed, mass: Compressed, n: int, like: kernels.Operator | None = None
    ) -> None:
        """Set `operator` and `order`, an order in which the factor of M has few entries."""
        attributes = self.__dict__
        attributes["order"] = None
        try:
            operator = kernels.Operator(*jac, *mass, like, MAX_FACTOR_ENTRIES)
        except MemoryError:
            operator = None
        if operator is None or operator.is_worth_ordering:
            indptr, indices, _ = mass
            lower = sp.csr_array((np.ones(len(indices), np.int32), indices, indptr), shape=(n, n))
            order = _order_by_degree(sp.csr_array(lower + lower.T))
            reordered = kernels.Operator(
                *_permute_columns(jac, order), *_permute_lower(mass, order)
            )
            if operator is None or reordered.fill < operator.fill:
                attributes["order"] = mark_read_only(order)
                operator = reordered
        if n >= MIN_TREE_ORDERING_VELOCITIES and attributes["order"] is None:
            tree_order = _order_trees(jac, operator.parents)
            if tree_order is not None:
                attributes["order"] = mark_read_only(tree_order)
                operator = kernels.Operator(
                    *_permute_columns(jac, tree_order), *_permute_lower(mass, tree_order)
                )
        attributes["operator"] = operator

    def _factor(self) -> None:
        """Factor M; raise InputError if it is not positive definite."""
        row = self.operator.factor()
        if row >= 0:
            velocity = row if self.order is None else int(self.order[row])
            raise InputError(
                f"M is not positive definite: the pivot of {self.velocity_name(velocity)} is rounding of its diagonal "
                f"entry, or below {MIN_MAGNITUDE:g} (change the unit): give it a mass or inertia (MuJoCo: armature)"
            )

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"{name} of a Generalized cannot be set: make another one")

    def __delattr__(self, name: str) -> None:
        raise AttributeError(
            f"{name} of a Generalized cannot be deleted, because the object is immutable"
        )

    @property
    def m(self) -> int:
        """Number of rows of J."""
        return int(self.operator.m)

    @property
    def nv(self) -> int:
        """Number of generalised velocities."""
        return int(self.operator.n)

    def velocity_name(self, i: int) -> str:
        """Return the name of velocity i; raise InputError if it does not exist."""
        i = check_int("i", i, high=self.nv - 1)
        return f"velocity {i}" if self.names is None else self.names[i]

    @cached_property
    def jac(self) -> sp.csr_array:
        """J (m, nv) in compressed rows, in the original order, without entries that are zero."""
        indptr, indices, data = self.operator.jac
        if self.order is not None:
            # Copy the data, because kernels read this array and `sort_indices` works in place.
            original = sp.csr_array(
                (data.copy(), self.order[indices], indptr), shape=(self.m, self.nv)
            )
            original.sort_indices()
            indices, data = original.indices, original.data
        arrays = mark_read_only(data), mark_read_only(indices), mark_read_only(indptr)
        return sp.csr_array(arrays, shape=(self.m, self.nv))

    @cached_property
    def mass(self) -> sp.csr_array:
        """M (nv, nv) in compressed rows, both triangles."""
        indptr, indices, data = mirror_lower_triangle(*self.operator.mass)
        mass = sp.csr_array((data, indices, indptr), shape=(self.nv, self.nv))
        mass.eliminate_zeros()
        if self.order is not None:
            position = np.argsort(self.order)
            mass = sp.csr_array(mass[position][:, position])
        mass.sort_indices()
        for array in (mass.data, mass.indices, mass.indptr):
            mark_read_only(array)
        return mass

    @cached_property
    def trees(self) -> IntArray:
        """Tree of each velocity (nv,): velocities that M couples, directly or indirectly, are one tree."""
        label = _label_trees(self.operator.parents)
        if self.order is None:
            return mark_read_only(label)
        original = np.empty_like(label)
        original[self.order] = label
        return mark_read_only(np.unique(original, return_inverse=True)[1].astype(np.int32))

    def velocity_of(self, v: FloatArray) -> FloatArray:
        """Compute J v (m,) [m/s, rad/s] for velocities v (nv,)."""
        v = as_array("v", v, (self.nv,), finite=False)
        out: FloatArray = self.operator.multiply_jacobian(
            v if self.order is None else v[self.order]
        )
        return out

    def bias(self, target: Any) -> FloatArray:
        """Compute b = target - J v* (m,) [m/s, rad/s] for a target, scalar or (m,)."""
        if type(target) is not float or not abs(target) <= MAX_MAGNITUDE:
            target = as_array("target", target, (self.m,), unit="m/s")
        result: FloatArray = target - self.multiply_by_v_free()
        return result

    def multiply_by_v_free(self) -> FloatArray:
        """Compute J v* (m,) [m/s, rad/s]."""
        v = self.v_free if self.order is None else self.v_free[self.order]
        result: FloatArray = self.operator.multiply_jacobian(v)
        return result

    def momentum_of(self, v: FloatArray) -> FloatArray:
        """Compute M v (nv,) [kg m/s] for velocities v (nv,)."""
        v = as_array("v", v, (self.nv,), finite=False)
        return self._in_original_order(
            self.operator.multiply_mass(v if self.order is None else v[self.order])
        )

    def force(self, impulse: FloatArray) -> FloatArray:
        """Compute J^T impulse (nv,) [N s] for impulses (m,)."""
        impulse = as_array("impulse", impulse, (self.m,), finite=False)
        return self._in_original_order(self.operator.multiply_jacobian_transpose(impulse))

    def solve(self, x: Any) -> FloatArray:
        """Compute M^-1 x (nv,)."""
        x = as_array("x", x, (self.nv,))
        out = x.copy() if self.order is None else x[self.order]
        self.operator.solve(out)
        return self._in_original_order(out)

    def change(self, impulse: FloatArray) -> FloatArray:
        """Compute the velocity change M^-1 J^T impulse (nv,) [m/s, rad/s] by impulses (m,)."""
        x = self.operator.multiply_jacobian_transpose(
            as_array("impulse", impulse, (self.m,), finite=False)
        )
        self.operator.solve(x)
        return self._in_original_order(x)

    def _in_original_order(self, x: FloatArray) -> FloatArray:
        """Permute x (nv,) from the order of the factor to the original order."""
        if self.order is None:
            return x
        out = np.empty_like(x)
        out[self.order] = x
        return out

    def restrict_to_rows_and_velocities(self, rows: Any, velocities: Any) -> Generalized:
        """Return J and M restricted to the given rows and velocities.

        The restriction loses nothing if neither M nor these rows of J couple these velocities to others.
        """
        rows, velocities = np.asarray(rows, np.intp), np.asarray(velocities, np.intp)
        names = None if self.names is None else [self.names[i] for i in velocities]
        jac = sp.csr_array(self.jac[rows][:, velocities])
        mass = sp.csr_array(self.mass[velocities][:, velocities])
        return Generalized(jac, mass, self.v_free[velocities], names)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Generalized):
            return NotImplemented
        if self.names != other.names or not are_equal(self.v_free, other.v_free):
            return False
        return all(
            are_equal(getattr(a, n), getattr(b, n))
            for a, b in ((self.jac, other.jac), (self.mass, other.mass))
            for n in ("indptr", "indices", "data")
        )

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[Any, ...]:
        if "v_free" not in self.__dict__:
            lower = extract_lower_triangle("M", self.mass, "")
            return Generalized.from_validated, (convert_to_compressed_rows("J", self.jac), lower)
        return Generalized, (self.jac, self.mass, self.v_free, self.names)

    def __repr__(self) -> str:
        return f"<Generalized {self.m} rows, {self.nv} velocities>"


# -- conversion of arguments --------------------------------------------------------------------------


def _convert_jacobian(jac: Any, n: int) -> Compressed:
    """Convert J to checked compressed rows."""
    array = jac
    compressed = dense_to_csr(jac)
    if compressed is None:
        array = jac if issparse(jac) else as_array_view("J", jac, (None, None))
    if len(array.shape) != 2 or array.shape[1] != n:
        raise InputError(
            f"J has shape {array.shape}; (any, {n}) is needed, as M has {n} velocities"
        )
    if compressed is None:
        compressed = (
            convert_to_compressed_rows("J", array) if issparse(jac) else dense_to_csr(array)
        )
    return compressed


def _convert_mass(mass: Any, names: Sequence[str] | None) -> tuple[Compressed, int]:
    """Return the checked lower triangle of M and the number of velocities."""
    blocks: Sequence[Any] = mass if isinstance(mass, (list, tuple)) else (mass,)
    max_asymmetry = (
        MAX_ASYMMETRY_FLOAT32 if get_common_precision(*blocks) == "float32" else MAX_ASYMMETRY
    )
    if blocks is mass and blocks and all(np.ndim(block) == 2 for block in blocks):
        arrays = [
            as_array(f"block {i} of M", block, (None, None)) for i, block in enumerate(blocks)
        ]
        # Convert the blocks to sparse arrays, because SciPy 1.18 warns about dense blocks.
        mass = sp.block_diag([sp.coo_array(block) for block in arrays], format="csr")
    hint = "give both triangles (Pinocchio's crba fills the upper one)"
    lower = extract_lower_triangle("M", mass, hint, max_asymmetry, names)
    return lower, len(lower[0]) - 1


def extract_lower_triangle(
    name: str,
    matrix: Any,
    hint: str,
    max_asymmetry: float = MAX_ASYMMETRY,
    names: Sequence[str] | None = None,
) -> Compressed:
    """Return the lower triangle of a dense or sparse symmetric matrix, with all diagonal entries, also zeros."""
    found = kernels.lower_triangle_of_dense(matrix, max_asymmetry)
    array = matrix
    if found is None:
        sparse = issparse(matrix)
        array = matrix if sparse else as_array_view(name, matrix, (None, None))
        if len(array.shape) != 2 or array.shape[0] != array.shape[1]:
            raise InputError(f"{name} has shape {array.shape}; a square matrix is needed")
        found = (
            kernels.lower_triangle_of_csr(*convert_to_compressed_rows(name, array))
            if sparse
            else kernels.lower_triangle_of_dense(array, max_asymmetry)
        )
    lower, (i, j, asymmetry) = found
    if asymmetry > max_asymmetry:
        entries: Any = sp.csr_array(array) if issparse(array) else array
        row, column = (i, j) if names is None else (names[i], names[j])
        at, mirrored = float(entries[i, j]), float(entries[j, i])
        raise InputError(
            f"{name} is not symmetric: it is {at} at ({row}, {column}) and {mirrored} at ({column}, {row}); {hint}"
        )
    return lower


def convert_to_compressed_rows(name: str, matrix: Any, sign: float = 1.0) -> Compressed:
    """Convert a sparse matrix times a sign to checked compressed rows, without entries that are zero."""
    m, n = matrix.shape
    if matrix.format in ("csr", "csc") and m < 2**31 > n:
        arrays = stack_csr_matrices(
            n, [(matrix.indptr, matrix.indices, matrix.data, matrix.format == "csc", sign, m)]
        )
        if arrays is not None:
            return arrays
    csr = as_csr(name, matrix)  # Convert other sparse types; raises InputError for invalid data.
    return stack_csr_matrices(n, [(csr.indptr, csr.indices, csr.data, False, sign, m)])


# -- orders with little fill-in ------------------------------------------------------------------------


def _compress_entries(rows: Any, cols: Any, data: FloatArray, n: int) -> Compressed:
    """Convert entries in any order to n compressed rows with sorted columns."""
    order = np.lexsort((cols, rows))
    indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))]).astype(np.int32)
    return indptr, cols[order].astype(np.int32), np.ascontiguousarray(data[order])


def _permute_lower(mass: Compressed, order: IntArray) -> Compressed:
    """Permute rows and columns of a symmetric matrix given by its lower triangle."""
    indptr, indices, data = mass
    position = np.argsort(order)
    rows = position[np.repeat(np.arange(len(order)), np.diff(indptr))]
    cols = position[indices]
    return _compress_entries(np.maximum(rows, cols), np.minimum(rows, cols), data, len(order))


def _permute_columns(jac: Compressed, order: IntArray) -> Compressed:
    """Permute the columns of compressed rows."""
    indptr, indices, data = jac
    rows = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
    return _compress_entries(rows, np.argsort(order)[indices], data, len(indptr) - 1)


def _order_by_degree(graph: sp.csr_array) -> IntArray:
    """Return a minimum-degree order of a graph's vertices, reversed: the first vertex is eliminated last."""
    graph.setdiag(0)
    graph.eliminate_zeros()
    graph.sort_indices()
    order: IntArray = order_for_elimination(
        graph.indptr.astype(np.int32), graph.indices.astype(np.int32)
    )[::-1]
    return order


def _label_trees(parent: IntArray) -> IntArray:
    """Return the number of each velocity's tree; parents (n,) precede their children and are -1 at roots."""
    tree = (np.cumsum(parent < 0) - 1).tolist()
    for i, p in enumerate(parent.tolist()):
        if p >= 0:
            tree[i] = tree[p]
    return np.array(tree, np.int32)


def _order_trees(jac: Compressed, parent: IntArray) -> IntArray | None:
    """Return an order of velocities that permutes whole trees to reduce fill-in, or None if it does not.

    The order of trees does not change the fill-in of M, but that of Newton's matrix N = M + J^T V J, which couples
    trees that share a row (for example the vertices of a flex, each of which is a tree).
    """
    roots = np.flatnonzero(parent < 0)
    tree = _label_trees(parent)
    indptr, indices, _ = jac
    trees_of_row = sp.csr_array(
        (np.ones(len(indices), np.int32), tree[indices], indptr.copy()),
        shape=(len(indptr) - 1, len(roots)),
    )
    trees_of_row.sum_duplicates()
    couplings = np.sum(np.diff(trees_of_row.indptr).astype(float) ** 2)
    if couplings > MAX_MEAN_TREE_COUPLINGS * len(roots):
        return None
    coupled = sp.csr_array(trees_of_row.T @ trees_of_row)
    tree_order = _order_by_degree(coupled)
    lower = sp.csr_array(sp.tril(coupled, -1) + sp.eye_array(len(roots)))
    pattern = lower.indptr.astype(np.int32), lower.indices.astype(np.int32)
    permuted = _permute_lower((*pattern, lower.data), tree_order)
    if kernels.count_fill_in(*permuted[:2]) >= kernels.count_fill_in(*pattern):
        return None
    position = np.empty(len(roots), np.int64)
    position[tree_order] = np.arange(len(roots))
    order: IntArray = np.argsort(position[tree], kind="stable").astype(np.int32)
    return order
