"""Generalised coordinates: J and M of articulated bodies, as simulators hold them.

    w = J v+ - target + compliance lambda,   v+ = v* + M^-1 J^T lambda,   A = J M^-1 J^T + diag(compliance)

M is factored once, M = L^T D L, rows from the last to the first: in the order of a kinematic tree, where parents
come before their children, leaves are eliminated first and nothing fills in. Any other matrix is put into an order
that fills in less; see `lavender_ext/core/generalized.pxd`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lavender.base.arrays import (
    FloatArray,
    IntArray,
    as_array,
    as_csr,
    as_names,
    borrowed,
    equal,
    precision_of,
    read_only,
    whole_number,
)
from lavender.base.errors import InputError
from lavender.base.lazy_import import issparse
from lavender.base.lazy_import import sparse as sp
from lavender.problem.derived import cached_property
from lavender_ext.core import generalized as kernels
from lavender_ext.core.assemble import dense_to_csr, mirrored, stacked
from lavender_ext.core.checks import LEAST, plain
from lavender_ext.factor.graph import least_degree

ASYMMETRY = 1e-12  # -, of sqrt(M_ii M_jj): above any rounding of sums over bodies, below anything meant
ASYMMETRY32 = 2.0**-16  # the same of an M in float32, of which the lower triangle is taken
MESH = 400  # velocities from which on the order of trees is looked for: below, a factor costs less than the search
FACTORS = 20  # of a matrix like M that the solves of a problem take: what an order that fills in costs
FULL = 50_000_000  # entries of a factor in the order given, beyond which it is not looked at
MET = 100  # trees that meet a tree, in the mean, beyond which no order keeps J^T J sparse
Compressed = tuple[IntArray, IntArray, FloatArray]
ANY = (None,)  # the shape of an array of any length


class Generalized:
    """J, M and v* of one step in generalised coordinates; frozen, M factored and checked.

    Parameters
    ----------
    jac : (m, nv) array or sparse
        J: row i of J times generalised velocities is the velocity of constraint row i [m/s or rad/s].
    mass : (nv, nv) array or sparse, or a sequence of square blocks, kg or kg m^2
        M, symmetric positive definite; blocks stand on the diagonal, one for each kinematic tree.
    v_free : (nv,) m/s, rad/s
        v*, the velocity without constraint impulses.
    names : sequence of str (nv,), optional
        Names of the velocities, for messages.

    J and M are copied into compressed rows; the arrays given are not kept, and stay as they are.

    Raises
    ------
    InputError
        Shapes that do not fit, numbers that are not finite, M not symmetric or not positive definite: the velocity
        where that shows is named.
    """

    v_free: FloatArray  # (nv,) m/s, rad/s
    names: tuple[str, ...] | None
    order: IntArray | None  # (nv,) velocity that stands at each place of the factor; None: as given
    operator: kernels.Operator  # J, M and M's factor in that order, for kernels

    def __init__(self, jac: Any, mass: Any, v_free: Any, names: Sequence[str] | None = None) -> None:
        m_lower, n = _lower(mass, names)
        j = _rows(jac, n)
        self._fill(j, m_lower, as_array("v_free", v_free, (n,), unit="m/s, rad/s"), names)

    @classmethod
    def compressed(
        cls,
        jac: Compressed,
        mass: Compressed,
        v_free: Any,
        names: Sequence[str] | None = None,
        like: kernels.Operator | None = None,
    ) -> Generalized:
        """From (indptr, indices, data) of J and of M's lower triangle with its diagonal, columns ascending.

        The quick way for adapters, whose engines hold these arrays: int32 and float64, adopted as they are. Only
        finiteness and definiteness are checked. `like` is the operator of a problem before, whose pattern of M's factor
        serves again where M's entries stand in the same places.
        """
        made = object.__new__(cls)
        n = len(mass[0]) - 1
        for name, x in (("J", jac[2]), ("M", mass[2])):
            if plain(x, ANY, True, False) is None:
                as_array(name, x, ANY, copy=False)  # which finds the words
        free = plain(v_free, (n,), True, False)
        if free is None:
            free = as_array("v_free", v_free, (n,), unit="m/s, rad/s", copy=False)
        made._fill(jac, mass, free, names, like)
        return made

    @classmethod
    def laid_out(cls, jac: Compressed, mass: Compressed) -> Generalized:
        """As `compressed`, from arrays that were checked, without M's factor and v*: `shifted` has them."""
        made = object.__new__(cls)
        made._lay_out(jac, mass, len(mass[0]) - 1)
        made.__dict__["names"] = None
        return made

    def with_jacobian(self, jac: Any = None, v_free: Any = None) -> Generalized:
        """The same M with another J or v* (None: the same)."""
        if jac is None:  # the same J, M and factor
            made = object.__new__(Generalized)
            free = self.v_free if v_free is None else v_free
            made.__dict__.update(
                self.__dict__, v_free=as_array("v_free", free, (self.nv,), unit="m/s, rad/s")
            )
            return made
        if self.order is not None:
            return Generalized(jac, self.mass, self.v_free if v_free is None else v_free, self.names)
        velocity = (
            self.v_free if v_free is None else as_array("v_free", v_free, (self.nv,), unit="m/s, rad/s")
        )
        made = object.__new__(Generalized)
        made._fill(_rows(jac, self.nv), self.operator.mass, velocity, self.names)
        return made

    def with_scaled_rows(self, scale: FloatArray) -> Generalized:
        """Return the same M, factor and v* with row i of J multiplied by scale[i], scale (m,) > 0."""
        indptr, indices, data = self.operator.jac
        data = data * np.repeat(scale, np.diff(indptr))
        kept = data != 0.0
        if not kept.all():  # products that vanished
            indptr = np.append(0, np.cumsum(kept))[indptr].astype(np.int32)
            indices, data = indices[kept], data[kept]
        made = object.__new__(Generalized)
        operator = kernels.Operator(indptr, indices, read_only(data), *self.operator.mass, self.operator)
        operator.share_factor(self.operator)
        made.__dict__.update(v_free=self.v_free, names=self.names, order=self.order, operator=operator)
        return made

    def shifted(self, d: FloatArray, momentum: FloatArray | None = None) -> Generalized:
        """The same J, M + diag(d) with d (nv,) in the same order, and the same v* or that with this M v* (nv,)."""
        indptr, indices, data = self.operator.mass
        data = data.copy()
        data[indptr[1:] - 1] += d if self.order is None else d[self.order]
        as_array("M", data, ANY, copy=False)
        made = object.__new__(Generalized)
        operator = kernels.Operator(*self.operator.jac, indptr, indices, data, self.operator)
        made.__dict__.update(names=self.names, order=self.order, operator=operator)
        made._factor()
        made.__dict__["v_free"] = self.v_free if momentum is None else read_only(made.solve(momentum))
        return made

    def _fill(
        self,
        jac: Compressed,
        mass: Compressed,
        v_free: FloatArray,
        names: Sequence[str] | None,
        like: kernels.Operator | None = None,
    ) -> None:
        n = len(v_free)
        self.__dict__["v_free"] = v_free
        self.__dict__["names"] = None if names is None else as_names("velocities", names, n)
        self._lay_out(jac, mass, n, like)
        self._factor()

    def _lay_out(
        self, jac: Compressed, mass: Compressed, n: int, like: kernels.Operator | None = None
    ) -> None:
        """J and M in an order in which M's factor has few entries."""
        put = self.__dict__
        put["order"] = None
        try:
            operator = kernels.Operator(*jac, *mass, like, FULL)
        except MemoryError:
            operator = None
        if operator is None or (operator.fill > 0 and _worth_ordering(operator.work, len(mass[1]), n)):
            order = _order(mass, n)
            other = kernels.Operator(*_permuted_columns(jac, order), *_permuted_lower(mass, order))
            if operator is None or other.fill < operator.fill:
                put["order"], operator = read_only(order), other
        if n >= MESH and put["order"] is None:
            apart = _apart(jac, operator.parents)
            if apart is not None:
                put["order"] = read_only(apart)
                operator = kernels.Operator(*_permuted_columns(jac, apart), *_permuted_lower(mass, apart))
        put["operator"] = operator

    def _factor(self) -> None:
        self.operator.factor()
        at = self.operator.failed
        if at >= 0:
            at = at if self.order is None else int(self.order[at])
            raise InputError(
                f"M is not positive definite: the pivot of {self.velocity_name(at)} is no more than rounding of its "
                f"diagonal entry, or less than {LEAST:g} (another unit of mass or length brings it nearer to 1); a "
                "body without mass or inertia needs some (MuJoCo: armature), or the velocity must be left out"
            )

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"Generalized is frozen; {name} cannot be set (make another)")

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"Generalized is frozen; {name} cannot be deleted")

    @property
    def m(self) -> int:
        """Rows of J."""
        return int(self.operator.m)

    @property
    def nv(self) -> int:
        """Generalised velocities."""
        return int(self.operator.n)

    def velocity_name(self, i: int) -> str:
        """Name of velocity i; InputError if there is no such velocity."""
        i = whole_number("i", i, high=self.nv - 1)
        return f"velocity {i}" if self.names is None else self.names[i]

    @cached_property
    def jac(self) -> sp.csr_array:
        """J (m, nv) in compressed rows, as given but for entries that are zero."""
        return sp.csr_array(self._columns(self.operator.jac), shape=(self.m, self.nv))

    def _columns(self, jac: Compressed) -> tuple[FloatArray, IntArray, IntArray]:
        indptr, indices, data = jac
        if self.order is not None:
            # Sorted in place: of a copy, for kernels read these arrays.
            back = sp.csr_array((data.copy(), self.order[indices], indptr), shape=(self.m, self.nv))
            back.sort_indices()
            indices, data = back.indices, back.data
        return read_only(data), read_only(indices), read_only(indptr)

    @cached_property
    def mass(self) -> sp.csr_array:
        """M (nv, nv) in compressed rows, both triangles."""
        indptr, indices, data = mirrored(*self.operator.mass)
        whole = sp.csr_array((data, indices, indptr), shape=(self.nv, self.nv))
        whole.eliminate_zeros()
        if self.order is not None:
            place = np.argsort(self.order)
            whole = sp.csr_array(whole[place][:, place])
        whole.sort_indices()
        for part in (whole.data, whole.indices, whole.indptr):
            read_only(part)
        return whole

    @cached_property
    def trees(self) -> IntArray:
        """Tree of each velocity (nv,): those that M couples, directly or through others; numbered in order."""
        label = _trees_of(self.operator.parents)
        if self.order is None:
            return read_only(label)
        given = np.empty_like(label)
        given[self.order] = label
        return read_only(np.unique(given, return_inverse=True)[1].astype(np.int32))

    def velocity_of(self, v: FloatArray) -> FloatArray:
        """J v (m,) [m/s, rad/s] of velocities v (nv,)."""
        own = as_array("v", v, (self.nv,), finite=False)
        out: FloatArray = self.operator.times(own if self.order is None else own[self.order])
        return out

    def bias(self, target: FloatArray) -> FloatArray:
        """b = target - J v* (m,) [m/s, rad/s] of targets (m,)."""
        v = self.v_free if self.order is None else self.v_free[self.order]
        b: FloatArray = self.operator.bias(v, as_array("target", target, (self.m,), finite=False))
        return b

    def momentum_of(self, v: FloatArray) -> FloatArray:
        """M v (nv,) [kg m/s] of velocities v (nv,)."""
        v = as_array("v", v, (self.nv,), finite=False)
        return self._given(self.operator.momentum(v if self.order is None else v[self.order]))

    def force(self, impulse: FloatArray) -> FloatArray:
        """J^T impulse (nv,) [N s] of impulses (m,)."""
        return self._given(self.operator.force(as_array("impulse", impulse, (self.m,), finite=False)))

    def solve(self, x: Any) -> FloatArray:
        """M^-1 x (nv,)."""
        x = as_array("x", x, (self.nv,))
        out = x.copy() if self.order is None else x[self.order]
        self.operator.solve(out)
        return self._given(out)

    def change(self, impulse: FloatArray) -> FloatArray:
        """M^-1 J^T impulse (nv,) [m/s, rad/s] of impulses (m,)."""
        x = self.operator.force(as_array("impulse", impulse, (self.m,), finite=False))
        self.operator.solve(x)
        return self._given(x)

    def _given(self, x: FloatArray) -> FloatArray:
        # from the factor's order to the order given
        if self.order is None:
            return x
        out = np.empty_like(x)
        out[self.order] = x
        return out

    def restrict(self, rows: Any, velocities: Any) -> Generalized:
        """These rows on these velocities alone; exact where M couples them to no others and J's rows touch none."""
        rows, velocities = np.asarray(rows, np.intp), np.asarray(velocities, np.intp)
        names = None if self.names is None else [self.names[i] for i in velocities]
        jac = sp.csr_array(self.jac[rows][:, velocities])
        mass = sp.csr_array(self.mass[velocities][:, velocities])
        return Generalized(jac, mass, self.v_free[velocities], names)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Generalized):
            return NotImplemented
        if self.names != other.names or not equal(self.v_free, other.v_free):
            return False
        return all(
            equal(getattr(a, n), getattr(b, n))
            for a, b in ((self.jac, other.jac), (self.mass, other.mass))
            for n in ("indptr", "indices", "data")
        )

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[Any, ...]:
        return Generalized, (self.jac, self.mass, self.v_free, self.names)

    def __repr__(self) -> str:
        return f"<Generalized {self.m} rows, {self.nv} velocities>"


# -- what is given ------------------------------------------------------------------------------------


def _rows(jac: Any, n: int) -> Compressed:
    sparse = issparse(jac)
    given = jac if sparse else borrowed("J", jac, (None, None))
    if len(given.shape) != 2 or given.shape[1] != n:
        raise InputError(f"J has shape {given.shape}; (any, {n}) is needed, as M has {n} velocities")
    return compressed("J", given) if sparse else dense_to_csr(given)


def _lower(mass: Any, names: Sequence[str] | None) -> tuple[Compressed, int]:
    blocks = mass if isinstance(mass, (list, tuple)) else [mass]
    allowed = ASYMMETRY32 if precision_of(*blocks) == "float32" else ASYMMETRY
    if isinstance(mass, (list, tuple)) and all(np.ndim(block) == 2 for block in mass) and mass:
        given = [as_array(f"block {i} of M", block, (None, None)) for i, block in enumerate(mass)]
        # dense ones warn from SciPy 1.18 on
        mass = sp.block_diag([sp.coo_array(block) for block in given], format="csr")
    lower = lower_of("M", mass, "give both triangles (Pinocchio's crba fills the upper one)", allowed, names)
    return lower, len(lower[0]) - 1


def lower_of(
    name: str, matrix: Any, hint: str, allowed: float = ASYMMETRY, names: Sequence[str] | None = None
) -> Compressed:
    """Lower triangle of a symmetric matrix, dense or sparse, with every entry of its diagonal, zero or not."""
    sparse = issparse(matrix)
    given = matrix if sparse else borrowed(name, matrix, (None, None))
    if len(given.shape) != 2 or given.shape[0] != given.shape[1]:
        raise InputError(f"{name} has shape {given.shape}; a square matrix is needed")
    lower, (i, j, worst) = (
        kernels.lower_of_rows(*compressed(name, given)) if sparse else kernels.lower_of_dense(given)
    )
    if worst > allowed:
        entries: Any = sp.csr_array(given) if sparse else given
        where = f"({i}, {j})" if names is None else f"({names[i]}, {names[j]})"
        above, below = float(entries[i, j]), float(entries[j, i])
        raise InputError(
            f"{name} is not symmetric: at {where} it is {above} above and {below} below the diagonal, or the other way "
            f"round; {hint}"
        )
    return lower


def compressed(name: str, given: Any, sign: float = 1.0) -> Compressed:
    """Rows of a sparse matrix times a sign, without entries that are zero, checked whole."""
    m, n = given.shape
    if given.format in ("csr", "csc") and m < 2**31 > n:
        made = stacked(n, [(given.indptr, given.indices, given.data, given.format == "csc", sign, m)])
        if made is not None:
            return made
    out = as_csr(name, given)  # what can be made to fit, and words for what cannot
    return stacked(n, [(out.indptr, out.indices, out.data, False, sign, m)])


# -- orders without fill -----------------------------------------------------------------------------


def _arrays(rows: Any, cols: Any, data: FloatArray, n: int) -> Compressed:
    at = np.lexsort((cols, rows))
    indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))]).astype(np.int32)
    return indptr, cols[at].astype(np.int32), np.ascontiguousarray(data[at])


def _permuted_lower(mass: Compressed, order: IntArray) -> Compressed:
    indptr, indices, data = mass
    place = np.argsort(order)
    rows, cols = place[np.repeat(np.arange(len(order)), np.diff(indptr))], place[indices]
    return _arrays(np.maximum(rows, cols), np.minimum(rows, cols), data, len(order))


def _permuted_columns(jac: Compressed, order: IntArray) -> Compressed:
    indptr, indices, data = jac
    rows = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
    return _arrays(rows, np.argsort(order)[indices], data, len(indptr) - 1)


def _worth_ordering(work: float, entries: int, n: int) -> bool:
    """Whether factors of so many multiply-adds cost more than a better order takes to be found, ns; n velocities.

    No order takes fewer than entries without fill, spread evenly: of a matrix that is nearly full none saves half.
    Measured on trees given in the wrong order, of 9 to 800 velocities: a search and the factor in its order 0.2 ms and
    0.13 us for each entry; a multiply-add 2 ns. A robot of 9 velocities whose root slides in two directions fills in
    by one entry.
    """
    least = 0.5 * (entries - n) * ((entries - n) / n + 1.0)
    return work > 2.0 * least and 2.0 * FACTORS * work > 4e5 + 130.0 * entries


def _order(mass: Compressed, n: int) -> IntArray:
    """Velocity at each place, eliminated from the last."""
    indptr, indices, _ = mass
    lower = sp.csr_array((np.ones(len(indices), np.int32), indices, indptr), shape=(n, n))
    return _eliminated(sp.csr_array(lower + lower.T))


def _eliminated(graph: sp.csr_array) -> IntArray:
    """Vertex at each place, the first eliminated last, since elimination begins there."""
    graph.setdiag(0)
    graph.eliminate_zeros()
    graph.sort_indices()
    order: IntArray = least_degree(graph.indptr.astype(np.int32), graph.indices.astype(np.int32))[::-1]
    return order


def _trees_of(parent: IntArray) -> IntArray:
    """Tree of each velocity from its parent, which stands before it, -1 at a root; numbered in order."""
    tree = (np.cumsum(parent < 0) - 1).tolist()
    for i, p in enumerate(parent.tolist()):
        if p >= 0:
            tree[i] = tree[p]
    return np.array(tree, np.int32)


def _apart(jac: Compressed, parent: IntArray) -> IntArray | None:
    """Velocity at each place where many trees may stand in any order, as vertices of a flex do; None: as they are.

    M does not fill in whatever the order of its trees, but N = M + J^T V J of Newton couples those that share a row.
    """
    roots, tree = np.flatnonzero(parent < 0), _trees_of(parent)
    indptr, indices, _ = jac
    on = sp.csr_array(
        (np.ones(len(indices), np.int32), tree[indices], indptr.copy()), shape=(len(indptr) - 1, len(roots))
    )
    on.sum_duplicates()
    if np.sum(np.diff(on.indptr).astype(float) ** 2) > MET * len(roots):
        return None
    met = sp.csr_array(on.T @ on)
    first = _eliminated(met)
    lower = sp.csr_array(sp.tril(met, -1) + sp.eye_array(len(roots)))
    pattern = lower.indptr.astype(np.int32), lower.indices.astype(np.int32)
    better = _permuted_lower((*pattern, lower.data), first)
    if kernels.pattern_fill(*better[:2]) >= kernels.pattern_fill(*pattern):
        return None
    place = np.empty(len(roots), np.int64)
    place[first] = np.arange(len(roots))
    order: IntArray = np.argsort(place[tree], kind="stable").astype(np.int32)
    return order
