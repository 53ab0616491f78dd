"""Worlds by the thousand: the arrays of many problems, as trainers and engines hold them, without an object for each.

`lavender.solve_many(batch)` solves them, `lavender.residual_many(batch, impulses)` judges; `batch[i]` is a `Problem`.
Arrays are read where they stand, in float32 or float64: what is made of one world is made when its turn comes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, overload

import numpy as np

from lavender.base.arrays import (
    FLOAT_DTYPES,
    ArrayLike,
    FloatArray,
    as_array,
    as_floats,
    check_sizes,
    check_unmasked,
    one_of,
    places,
    precision_of,
    several,
    shape_of,
)
from lavender.base.errors import InputError
from lavender.problem import FRICTION, Problem
from lavender.problem.cones import Cones
from lavender.problem.generalized import MAX_ASYMMETRY, MAX_ASYMMETRY_FLOAT32
from lavender.problem.rows import Rows
from lavender_ext.batch.many import PLACE, Worlds
from lavender_ext.core.problem import LAWS, zero_impulse

__all__ = ["Batch"]

ERRORS = ("raise", "status")
FIELDS = ("inv_mass", "inv_inertia", "v_free", "jac", "normal", "tangent", "arm_a", "arm_b")  # of bodies
PAIRS = ("joint_body", "contact_body")


class Batch(Sequence[Problem]):
    """n problems in generalised coordinates in a few arrays: w = J v+ - target + compliance lambda in each.

    Three layouts: stacked, all worlds of one size; padded, with `count`; ragged, with `row_ptr`, one array of all rows.
    Arrays of float32 and float64 are read in place where each world's numbers stand row by row, and must not
    change while results are read; others are copied. Where all of J, M and v_free are float32, so is `precision`.

    Parameters
    ----------
    J : (n, m, nv), or ragged (rows of all worlds, nv), or of worlds of several nv one array of all entries
        Rows in the order of the cones.
    M : (n, nv, nv), or (nv, nv) of all; or one array of all entries
        Or lower triangles in compressed rows of one pattern, as MuJoCo holds them: (values (n, entries), indices,
        indptr), columns ascending in each row and the diagonal last.
    v_free : (n, nv), or one array (with `velocity_ptr`), m/s, rad/s
    target : scalar, (m,), (n, m), or ragged one array of all rows, m/s
    cones : Cones, or a sequence of n of them
        Of each world, or of the rows of all worlds one after the other, without what pads them.
    compliance : as target, 1/kg, optional
    mu : (n, k) or ragged one array of all blocks, optional
        Coefficients of friction, world by world, in the place of those of the cones.
    friction : {"coulomb", "cone"}
    count : (n,) int, optional
        Rows of each world where J (n, m, nv) has room for m: the first ones count.
    row_ptr : (n + 1,) int, optional
        First row of each world, then the number of rows.
    velocity_ptr : (n + 1,) int, optional
        The same of velocities, where their number differs; with `row_ptr`.

    Raises
    ------
    InputError
        Shapes that do not fit. What is wrong with the numbers of one world is told where it is solved, by its number.

    Examples
    --------
    A block of 1 to 3 kg on the ground, pushed along by 2 m/s:

    >>> import numpy as np
    >>> import lavender as lv
    >>> mass = np.array([1.0, 2.0, 3.0])
    >>> J = np.broadcast_to(np.eye(2)[::-1], (3, 2, 2))  # normal: upwards; tangent: along
    >>> v_free = np.tile([2.0, -1.0], (3, 1))
    >>> cones = lv.Cones.contacts(0.5, tangents=1)
    >>> batch = lv.Batch(J, mass[:, None, None] * np.eye(2), v_free, cones=cones)
    >>> many = lv.solve_many(batch, tol=1e-9)
    >>> many.impulse.round(6).tolist()  # N s
    [[1.0, -0.5], [2.0, -1.0], [3.0, -1.5]]
    >>> many.velocity.round(6)[0].tolist(), many.success.all().item()
    ([1.5, 0.0], True)
    """

    def __init__(
        self,
        J: Any,
        M: Any,
        v_free: Any,
        *,
        target: Any = 0.0,
        cones: Cones | Sequence[Cones],
        compliance: Any = None,
        mu: Any = None,
        friction: str = "coulomb",
        count: ArrayLike | None = None,
        row_ptr: ArrayLike | None = None,
        velocity_ptr: ArrayLike | None = None,
    ) -> None:
        friction = one_of("friction", friction, FRICTION)
        values, *pattern = M if isinstance(M, tuple) else (M,)
        jac, mass, free = (as_floats(name, x) for name, x in (("J", J), ("M", values), ("v_free", v_free)))
        if row_ptr is not None and count is None:
            rows = _pointers("row_ptr", row_ptr)
            if jac.ndim == 2 and velocity_ptr is None:
                n, nv = len(rows) - 1, jac.shape[1]
                velocities = nv * np.arange(n + 1)
            elif velocity_ptr is not None:
                n, velocities = len(rows) - 1, _pointers("velocity_ptr", velocity_ptr)
            else:
                raise InputError(
                    f"J has shape {jac.shape}; ragged it is (rows of all worlds, nv), or one array of "
                    "all entries with velocity_ptr"
                )
            if len(velocities) != n + 1:
                raise InputError(f"velocity_ptr is of {len(velocities) - 1} worlds, row_ptr of {n}")
            sizes, nvs = np.diff(rows), np.diff(velocities)
            self.shape: tuple[int, ...] = (int(rows[-1]),)
            self.velocity_shape: tuple[int, ...] = (int(velocities[-1]),)
            room = None
        elif row_ptr is None and velocity_ptr is None and jac.ndim == 3:
            n, room, nv = jac.shape
            sizes = np.full(n, room) if count is None else check_counts("count", count, n, room)
            nvs = np.full(n, nv)
            rows, velocities = room * np.arange(n + 1), nv * np.arange(n + 1)
            self.shape, self.velocity_shape = (n, room), (n, nv)
        else:
            raise InputError(
                f"J has shape {jac.shape}; stacked it is (n, m, nv), ragged (rows, nv) with row_ptr"
            )
        self._n, self.friction = n, friction
        self.precision = precision_of(*(np.asarray(x) for x in (jac, mass, free)))
        self.at = at = np.zeros((n, len(PLACE)), np.int64)
        at[:, PLACE["rows"]], at[:, PLACE["velocities"]] = sizes, nvs
        at[:, PLACE["row"]], at[:, PLACE["velocity"]] = rows[:-1], velocities[:-1]
        self._place_cones(cones)
        self._pattern = check_triangle(pattern, nvs, mass) if pattern else None
        if room is not None and mass.ndim == 2 and not pattern:
            mass = np.broadcast_to(mass, (n, *mass.shape))
        square = (None, None) if room is None else ((room, nv), (nv, nv))
        jac, at[:, PLACE["jac"]], self._jac_row = _matrices("J", jac, n, square[0], sizes * nvs)
        if self._pattern is None:
            mass, at[:, PLACE["mass"]], self._mass_row = _matrices("M", mass, n, square[1], nvs * nvs)
        else:
            entries = len(self._pattern[1])
            (mass, at[:, PLACE["mass"]]), self._mass_row = _vectors("M", mass, n, entries, None), 0
        free, at[:, PLACE["free"]] = _vectors("v_free", free, n, nv if room is not None else None, nvs)
        goal, at[:, PLACE["target"]] = _vectors("target", target, n, room, sizes)
        soft, at[:, PLACE["soft"]] = _vectors(
            "compliance", 0.0 if compliance is None else compliance, n, room, sizes
        )
        self._arrays: Any = (jac, mass, free, goal, soft, self._frictions(mu))

    # -- other ways to make one ------------------------------------------------------------------------

    @classmethod
    def of_matrices(
        cls,
        A: Any,
        b: ArrayLike,
        *,
        cones: Cones | Sequence[Cones],
        mu: Any = None,
        friction: str = "coulomb",
    ) -> Batch:
        """Of matrices A (n, m, m) [1/kg] and b (n, m) [m/s]; each becomes a `Problem` when its turn comes."""
        matrix, rhs = as_floats("A", A), as_floats("b", b)
        if matrix.ndim != 3 or matrix.shape[1] != matrix.shape[2] or rhs.shape != matrix.shape[:2]:
            raise InputError(f"A has shape {matrix.shape} and b {rhs.shape}; (n, m, m) and (n, m) are needed")
        n, m = rhs.shape
        made = cls._of_form(n, m, friction, precision_of(matrix, rhs))
        made._place_cones(cones)
        at, place = made.at, PLACE
        flat, at[:, place["jac"]], made._jac_row = _matrices("A", matrix, n, (m, m), None)
        goal, at[:, place["target"]] = _vectors("b", rhs, n, m, None)
        made._arrays = flat, None, None, goal, None, made._frictions(mu)
        return made

    @classmethod
    def of_bodies(cls, fields: Mapping[str, Any], **bounds: Any) -> Batch:
        """Of rows of bodies: fields of `Rows` and bounds of `Problem.from_rows`, stacked or one for all worlds.

        Parameters
        ----------
        fields : mapping
            `inv_mass` (n, bodies), `v_free` (n, bodies, 6), `normal` (n, c, 3), ...; what has the dimensions of one
            world, such as `contact_body` (c, 2), is shared. At least one field is stacked.
        **bounds
            `target`, `mu`, ..., the same way: (m,) or (n, m); and words such as friction.
        """
        known = {"inv_mass": 1, "inv_inertia": 3, "v_free": 2, "jac": 2, "joint_ptr": 1, "joint_body": 2, "normal": 2,
                 "tangent": 2, "arm_a": 2, "arm_b": 2, "contact_body": 2}  # fmt: skip
        if not isinstance(fields, Mapping):
            raise InputError(f"fields is {fields!r:.60}; a mapping of arrays of Rows is needed")
        unknown = set(fields) - set(known)
        if unknown:
            raise InputError(f"fields has {sorted(unknown)}; the arrays of Rows are {', '.join(known)}")
        for name, x in (*fields.items(), *bounds.items()):
            shape_of(name, x)
            check_unmasked(name, x)
        parts = {name: np.asarray(x) for name, x in fields.items()}
        more = {name: np.asarray(x) if np.ndim(x) else x for name, x in bounds.items() if x is not None}
        lengths = {len(x) for name, x in parts.items() if x.ndim == known[name] + 1}
        lengths |= {len(x) for x in more.values() if isinstance(x, np.ndarray) and x.ndim == 2}
        if len(lengths) != 1:
            raise InputError(
                f"stacked arrays are of {sorted(lengths)} worlds; one number of them, in at least one array, is needed"
            )
        n = lengths.pop()
        made = cls._of_form(n, 0, more.get("friction", "coulomb"), "float64")
        made._bodies = parts, more, {name for name, x in parts.items() if x.ndim > known[name]}
        if n:
            first = made[0]
            made.shape, made.precision = (n, first.m), first.precision
            made.at[:, PLACE["rows"]], made.at[:, PLACE["row"]] = first.m, first.m * np.arange(n)
            nv = 6 * first.rows.n_bodies if first.rows is not None else 0
            made.velocity_shape = (n, nv)
            made.at[:, PLACE["velocities"]], made.at[:, PLACE["velocity"]] = nv, nv * np.arange(n)
            made.at[:, PLACE["blocks"]] = first.cones.n_blocks
        return made

    @classmethod
    def _of_form(cls, n: int, m: int, friction: Any, precision: str) -> Batch:
        made: Batch = object.__new__(cls)
        friction = one_of("friction", friction, FRICTION)
        made._n, made.friction, made.precision, made._arrays = n, friction, precision, None
        made.shape, made.velocity_shape = (n, m), (n, 0)
        made.at = np.zeros((n, len(PLACE)), np.int64)
        made.at[:, PLACE["rows"]], made.at[:, PLACE["row"]] = m, m * np.arange(n)
        return made

    names_of: Callable[[int], Sequence[str]] | None = None  # of the blocks of a world
    contact_counts: np.ndarray | None = None  # (n,) contacts with rows; None if not known
    _shared = True
    _pattern: tuple[np.ndarray, np.ndarray] | None = None
    _jac_row = _mass_row = 0
    # Of `of_bodies`: fields, bounds, and which fields are stacked.
    _bodies: tuple[dict[str, Any], dict[str, Any], set[str]] | None = None

    # -- blocks ----------------------------------------------------------------------------------------

    def _place_cones(self, cones: Any) -> None:
        """One Cones of all worlds, or of each; where each world's blocks and rows begin there."""
        at, sizes = self.at, self.at[:, PLACE["rows"]]
        if not isinstance(cones, Cones):
            cones = _joined(cones, len(self))
        self.cones = cones
        if cones.has_round and self.friction != "cone":
            raise InputError(
                "a round cone of more than two tangents has no Coulomb law: give friction='cone'"
            )
        if len(self) and (sizes == cones.n_rows).all():
            at[:, PLACE["blocks"]] = cones.n_blocks
            return
        self._shared = False
        first = _firsts(sizes)
        if len(self) and first[-1] + sizes[-1] != cones.n_rows:
            each = (
                f", or {sizes[0]} of each"
                if (sizes == sizes[0]).all()
                else "; one Cones of each world goes only where all have as many rows: give a list of them"
            )
            raise InputError(
                f"cones have {cones.n_rows} rows; {first[-1] + sizes[-1]} of all worlds are needed, without what "
                f"pads them{each}"
            )
        ends = first + sizes
        block, last = np.searchsorted(cones.ptr, first), np.searchsorted(cones.ptr, ends)
        off = np.flatnonzero((cones.ptr[block] != first) | (cones.ptr[last] != ends))
        if len(off):
            raise InputError(
                f"a block of the cones begins in world {off[0]} and ends in the next; or their sizes differ"
            )
        at[:, PLACE["block"]], at[:, PLACE["blocks"]], at[:, PLACE["cone_row"]] = block, last - block, first

    def _frictions(self, mu: Any) -> np.ndarray | None:
        """mu of all worlds, flat."""
        if mu is None:
            return None
        k = self.at[:, PLACE["blocks"]]
        each = self.cones.n_blocks if self._shared else None
        found, self.at[:, PLACE["mu"]] = _vectors("mu", mu, len(self), each, k)
        return found

    def _cones_of(self, i: int, mu: FloatArray | None = None) -> Cones:
        """Blocks of world i, with their own mu (k,) where it is given."""
        place = self.at[i]
        block, k = (int(place[PLACE[name]]) for name in ("block", "blocks"))
        c = self.cones
        if self._shared and mu is None:
            return c
        part = c._take_blocks(np.arange(block, block + k))
        if mu is None:
            return part
        check_sizes("mu", mu, "-")
        return replace(part, mu=mu)

    def __getstate__(self) -> dict[str, Any]:
        # Copies and pickles hold the names themselves: what makes them may hold an engine's model.
        if self.names_of is None:
            return self.__dict__
        return self.__dict__ | {"names_of": tuple(map(self.names_of, range(len(self)))).__getitem__}

    # -- a sequence of problems ------------------------------------------------------------------------

    @property
    def row_counts(self) -> np.ndarray:
        """(n,) rows of each world."""
        return self.at[:, PLACE["rows"]].copy()

    def __len__(self) -> int:
        return self._n

    @overload
    def __getitem__(self, i: int) -> Problem: ...
    @overload
    def __getitem__(self, i: Any) -> list[Problem]: ...
    def __getitem__(self, i: Any) -> Any:
        """World i as a `Problem`, made of copies, or a list of several; InputError where numbers are no problem's."""
        i = places(i, self._n)
        if isinstance(i, list):
            return [self[j] for j in i]
        if self._bodies is not None:
            return self._of_bodies(i, *self._bodies)
        jac, mass, free, target, soft, mu = (self._part(i, which) for which in range(6))
        own = self._cones_of(i, None if mu is None else as_array("mu", mu, (None,)))
        if mass is None:
            return Problem(target, own, jac, friction=self.friction, precision=self.precision)
        return Problem.from_jacobian(
            jac, mass, free, target=target, cones=own, compliance=soft, friction=self.friction,
            precision=self.precision, names=None if self.names_of is None else self.names_of(i),
        )  # fmt: skip

    def _of_bodies(self, i: int, parts: dict[str, Any], more: dict[str, Any], stacked: set[str]) -> Problem:
        of: dict[str, Any] = {name: x[i] if name in stacked else x for name, x in parts.items()}
        own: dict[str, Any] = {name: x[i] if np.ndim(x) == 2 else x for name, x in more.items()}
        problem = Problem.from_rows(Rows(**of), **own)
        if i and problem.m != self.shape[1]:
            raise InputError(
                f"it has {problem.m} rows, the first world {self.shape[1]}: give tangents=, which mu 0 leaves out"
            )
        return problem

    def _part(self, i: int, which: int) -> Any:
        """One array of world i, as it stands."""
        place = self.at[i]
        m, nv, k = (int(place[PLACE[name]]) for name in ("rows", "velocities", "blocks"))
        array = self._arrays[which]
        first = int(place[PLACE[("jac", "mass", "free", "target", "soft", "mu")[which]]])
        if array is None:
            return None
        if which == 1 and self._pattern is not None:
            ptr, col = self._pattern
            row, whole = np.repeat(np.arange(nv), np.diff(ptr)), np.zeros((nv, nv), array.dtype)
            whole[row, col] = whole[col, row] = array[first : first + len(col)]
            return whole
        if self._arrays[1] is None:
            nv = m  # of A in the place of J
        if which < 2:
            rows, stride = ((m, self._jac_row), (nv, self._mass_row))[which]
            size = array.itemsize
            return (
                np.lib.stride_tricks.as_strided(
                    array[first:], (rows, nv), ((stride or nv) * size, size), writeable=False
                )
                if rows * nv
                else np.zeros((rows, nv), array.dtype)
            )
        return array[first : first + (nv, m, m, k)[which - 2]]

    def rows_of(self, i: int) -> slice:
        """Where world i stands in an impulse of all, flat."""
        first, m = (int(self.at[i, PLACE[name]]) for name in ("row", "rows"))
        return slice(first, first + m)

    def start(self, i: int) -> FloatArray:
        """Zero impulses (m,) [N s] of world i, clipped to its bounds."""
        if self._arrays is None:
            return self[i].start()
        first, m = (int(self.at[i, PLACE[name]]) for name in ("cone_row", "rows"))
        return zero_impulse(self.cones.lower[first : first + m], self.cones.upper[first : first + m])

    def impulses(self, name: str, given: Any) -> FloatArray:
        """Impulses of all worlds [N s], of the batch's shape, finite or not, as a new flat array."""
        array = as_array(name, given, self.shape, finite=False, unit="N s")
        return array.reshape(-1).copy()

    def worlds(self, impulse: FloatArray, velocity: FloatArray, cold: bool) -> Worlds:
        """What the compiled loop works on; results into impulse and velocity, flat."""
        made = Worlds(self.at, impulse, velocity, cold)
        if self._bodies is not None and (read := self._read_bodies()):
            made.of_bodies(*read)
        elif self._arrays is None or self.cones.has_ellipse:
            made.of_objects([], [None] * len(self), [])
        else:
            mass = self._arrays[1]
            allowed = (
                MAX_ASYMMETRY_FLOAT32 if mass is not None and mass.dtype == np.float32 else MAX_ASYMMETRY
            )
            made.of_arrays(
                self._arrays,
                (self._jac_row, self._mass_row),
                self._pattern,
                self.cones._blocks,
                LAWS[self.friction],
                allowed,
            )
        return made

    def _read_bodies(self) -> Any:
        """What the compiled loop reads of bodies; None where worlds differ in more than numbers of one layout."""
        parts, more, _ = self._bodies  # type: ignore[misc]
        stacked = {name for name, x in more.items() if np.ndim(x) == 2}
        if not stacked <= {"target", "compliance", "mu"} or "guess" in more or not len(self):
            return None
        try:
            first = self[0]
        except InputError:
            return None
        rows, n, mu = first.rows, len(self), more.get("mu", 0.0)
        if rows is None or first.m != self.shape[1] or np.ndim(parts.get("joint_ptr", 0)) == 2:
            return None
        if "mu" in stacked and (mu.shape[1] != rows.n_contacts or ((mu > 0.0) != (mu[0] > 0.0)).any()):
            return None
        one: dict[str, Any] = {name: getattr(rows, name) for name in (*FIELDS, *PAIRS)}
        goal = 0.0 if "target" in stacked else more.get("target", 0.0)
        one["target"] = np.array(np.broadcast_to(goal, first.m), float)
        one |= {"compliance": first.compliance, "mu": first.cones.mu[rows.n_joints :]}
        found = {}
        for name, own in one.items():
            x, kind = {**parts, **more}.get(name, own), np.int32 if name in PAIRS else np.float64
            if np.ndim(x) <= own.ndim:
                found[name] = np.ascontiguousarray(own), 0
            elif x.shape == (n, *own.shape) and (
                x.dtype in FLOAT_DTYPES if kind is np.float64 else _are_indices(x)
            ):
                found[name] = np.ascontiguousarray(x, kind), own.size
            else:
                return None
        fields = [found[name] for name in (*FIELDS, "target", "compliance", "mu")]
        sizes = rows.n_bodies, rows.n_joints, rows.n_contacts
        return fields, [found[name] for name in PAIRS], *sizes, first.cones._blocks, LAWS[first.friction]

    def __repr__(self) -> str:
        return f"<Batch of {self._n} worlds, impulses {self.shape}, {self.precision}>"


# -- what is given ------------------------------------------------------------------------------------


def _are_indices(x: np.ndarray) -> bool:
    """Whether all are whole numbers of 32 bits."""
    return x.dtype.kind == "i" and (x.itemsize <= 4 or bool(((x >= -(2**31)) & (x < 2**31)).all()))


def _firsts(sizes: Any) -> np.ndarray:
    """Where each begins that follows the other."""
    return (
        np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int64) if len(sizes) else np.zeros(0, np.int64)
    )


def _pointers(name: str, given: Any) -> np.ndarray:
    ptr = as_array(name, given, (None,), dtype=np.int32).astype(np.int64)
    if not len(ptr) or ptr[0] != 0 or (np.diff(ptr) < 0).any():
        raise InputError(f"{name} must start with 0 and not fall: the first of each world, then their number")
    return ptr


def check_triangle(given: Sequence[Any], nvs: Any, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (indptr, indices) of lower triangles that worlds of nvs velocities share, from (indices, indptr)."""
    if len(given) != 2:
        raise InputError(f"M is a tuple of {1 + len(given)}; (values, indices, indptr) is needed")
    col, ptr = (
        as_array(name, x, (None,), dtype=np.int32)
        for name, x in zip(("indices of M", "indptr of M"), given, strict=True)
    )
    nv = len(ptr) - 1
    row = np.repeat(np.arange(nv), np.maximum(np.diff(ptr), 0))
    sound = nv >= 0 and ptr[:1] == 0 and (np.diff(ptr) > 0).all() and len(row) == len(col)
    if (
        not sound
        or (col[ptr[1:] - 1] != np.arange(nv)).any()
        or not (np.diff(col)[np.diff(row) == 0] > 0).all()
    ):
        raise InputError("M's rows must ascend to a last entry on the diagonal; lower triangles are needed")
    if (nvs != nv).any() or values.ndim != 2 or values.shape[1] != len(col):
        raise InputError(
            f"M has values of shape {values.shape} for {len(col)} entries of {nv} velocities; (worlds, entries), and "
            f"one number of velocities in all worlds, are needed"
        )
    return ptr, col


def check_counts(name: str, given: Any, n: int, capacity: int) -> np.ndarray:
    """Numbers of rows of n worlds (n,), each from 0 to the rows that J has; InputError names the first other one."""
    count = as_array(name, given, (n,), dtype=np.int32).astype(np.int64)
    bad = np.flatnonzero((count < 0) | (count > capacity))
    if len(bad):
        raise InputError(
            f"{name} of world {bad[0]} is {count[bad[0]]}; 0 to {capacity}, the rows that J has, are needed"
        )
    return count


def _flat(x: np.ndarray) -> np.ndarray:
    """All that an array spans in memory, as one dimension; its steps are whole numbers from 0 up."""
    if not x.size:
        return np.zeros(0, x.dtype)
    length = 1 + sum((n - 1) * s // x.itemsize for n, s in zip(x.shape, x.strides, strict=True))
    return np.lib.stride_tricks.as_strided(x, (length,), (x.itemsize,), writeable=False)


def _strided(x: np.ndarray) -> bool:
    """Whether each world stands row by row in memory."""
    whole = all(s >= 0 and s % x.itemsize == 0 for s in x.strides)
    return whole and x.flags.aligned and (x.shape[-1] < 2 or x.strides[-1] == x.itemsize)


def _matrices(
    name: str, x: np.ndarray, n: int, each: tuple[int, int] | None, sizes: Any
) -> tuple[np.ndarray, Any, int]:
    """Matrices of n worlds: flat, where each begins, and numbers from one row to the next (0: no more than it has).

    each: shape of every one; None: as many entries as `sizes` says, one after the other.
    """
    if each is None:
        return *_ragged(name, x, sizes), 0
    if x.shape != (n, *each):
        raise InputError(f"{name} has shape {x.shape}; {(n, *each)} is needed")
    if not _strided(x) or (each[0] > 1 and x.strides[1] < each[1] * x.itemsize):
        x = np.ascontiguousarray(x)
    row = x.strides[1] // x.itemsize if each[0] > 1 else each[1]
    return _flat(x), np.arange(n) * (x.strides[0] // x.itemsize), row


def _vectors(name: str, given: Any, n: int, each: int | None, sizes: Any) -> tuple[np.ndarray, Any]:
    """Vectors of n worlds, flat, and where each begins; a scalar, or one of one world, is of all."""
    x = as_floats(name, given)
    if x.ndim == 0:
        return np.full(int(np.max(sizes, initial=0)), float(x)), 0
    if each is None:
        return _ragged(name, x, sizes)
    if x.shape == (each,):
        return np.ascontiguousarray(x), 0
    if x.shape != (n, each):
        raise InputError(f"{name} has shape {x.shape}; {(n, each)} or ({each},) is needed")
    x = x if _strided(x) else np.ascontiguousarray(x)
    return _flat(x), np.arange(n) * (x.strides[0] // x.itemsize)


def _ragged(name: str, x: np.ndarray, sizes: Any) -> tuple[np.ndarray, Any]:
    """Numbers of all worlds one after the other, and where each begins."""
    total = int(np.sum(sizes))
    if x.size != total:
        raise InputError(
            f"{name} has shape {x.shape}; {total} numbers are needed, those of all worlds one after the other"
        )
    return np.ascontiguousarray(x).reshape(-1), _firsts(sizes)


def _joined(cones: Any, n: int) -> Cones:
    """The blocks of n worlds one after the other."""
    each = several("cones", cones, f"Cones, one for each of {n} worlds,")
    if len(each) != n or not all(isinstance(c, Cones) for c in each):
        raise InputError(f"cones is a Cones, or one for each of {n} worlds; {len(each)} things came")
    return Cones._concatenate(each)
