"""Arrays of many problems (worlds), as trainers and engines store them, without an object for each world.

`lavender.solve_many(batch)` solves the problems, `lavender.residual_many(batch, impulses)` judges impulses, and
`batch[i]` is a `Problem`. Arrays of float32 or float64 are read in place. Arrays derived from a world's data, such as
A, are computed when the world is solved.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, overload

import numpy as np

from lavender.base.arrays import (
    ArrayLike,
    FloatArray,
    as_array,
    as_float_array,
    check_choice,
    check_nonnegative_magnitudes,
    check_sequence,
    get_common_precision,
    get_shape,
    resolve_index,
)
from lavender.base.errors import InputError
from lavender.problem import FRICTION_LAWS, Problem
from lavender.problem.cones import Cones
from lavender.problem.data import convert_keys
from lavender.problem.engine_record import EngineRecord
from lavender.problem.generalized import MAX_ASYMMETRY, MAX_ASYMMETRY_FLOAT32
from lavender_ext.batch.many import PLACE, Worlds
from lavender_ext.core.carry import carry_impulses_of_worlds
from lavender_ext.core.checks import are_lower_triangles_valid, are_pointers_valid
from lavender_ext.core.problem import LAWS

ERRORS = ("raise", "status")
#: Offsets and sizes of a world, as the kernels number them.
WORLD = np.dtype([(name, np.int64) for name in sorted(PLACE, key=PLACE.__getitem__)])


class Batch(Sequence[Problem]):
    """n problems in generalised coordinates, w = J v+ - target + compliance lambda, stored in a few arrays.

    There are three layouts: stacked (all worlds have the same number of rows), padded (with `count`: rows beyond a
    world's count are ignored) and ragged (with `row_ptr`: the rows of all worlds are concatenated). Arrays of float32
    and float64 in which each world is stored row by row are read in place; they must not change while results are
    read. Other arrays are copied. If J, M and v_free are float32, `precision` is "float32".

    Parameters
    ----------
    J : (n, m, nv), ragged (rows of all worlds, nv), or with `velocity_ptr` one array of all entries
        Rows in the order of the cones.
    M : (n, nv, nv), (nv, nv) for all worlds, or one array of all entries
        It may also be given as lower triangles in compressed rows with one pattern, as in MuJoCo: (values (n,
        entries), indices, indptr), with columns ascending in each row and the diagonal last.
    v_free : (n, nv), or one array (with `velocity_ptr`), m/s, rad/s
    target : scalar, (m,), (n, m), or ragged one array of all rows, m/s
    cones : Cones, or a sequence of n of them
        Blocks of each world, or of the concatenated rows of all worlds, without padding rows.
    compliance : 1/kg, optional
        Shapes as for `target`.
    mu : (n, k) or ragged one array of all blocks, optional
        Coefficients of friction of each world, which replace `cones.mu`.
    friction : {"coulomb", "cone"}
    count : (n,) int, optional
        Number of rows of each world, if J (n, m, nv) is padded to m rows at the end.
    row_ptr : (n + 1,) int, optional
        First row of each world, followed by the number of rows.
    velocity_ptr : (n + 1,) int, optional
        First velocity of each world, followed by the number of all velocities. Needed, together with `row_ptr`, if
        worlds have different numbers of velocities.
    key : (n, k), (k,) for all worlds, or ragged one array of all blocks, unsigned int, optional
        Identity of each block in its world, by which `make_start` finds it in the batch of another step.

    Raises
    ------
    InputError
        The shapes disagree. Invalid numbers of a world are reported when it is solved, with its index.

    Examples
    --------
    Blocks of 1 to 3 kg that slide on the ground at 2 m/s:

    >>> import numpy as np
    >>> import lavender as lv
    >>> mass = np.array([1.0, 2.0, 3.0])
    >>> J = np.broadcast_to(np.eye(2)[::-1], (3, 2, 2))  # normal: upwards; tangent: along the motion
    >>> v_free = np.tile([2.0, -1.0], (3, 1))
    >>> cones = lv.Cones.contacts(0.5, tangents=1)
    >>> batch = lv.Batch(J, mass[:, None, None] * np.eye(2), v_free, cones=cones)
    >>> many = lv.solve_many(batch, tol=1e-9)
    >>> many.impulse.round(6).tolist()  # N s
    [[1.0, -0.5], [2.0, -1.0], [3.0, -1.5]]
    >>> (many.velocity.round(6)[0] + 0.0).tolist(), many.success.all().item()
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
        key: Any = None,
    ) -> None:
        friction = check_choice("friction", friction, FRICTION_LAWS)
        values, *pattern = M if isinstance(M, tuple) else (M,)
        jac, mass, free = (
            as_float_array(name, x) for name, x in (("J", J), ("M", values), ("v_free", v_free))
        )
        if row_ptr is not None and count is None:
            rows = _check_world_pointers("row_ptr", row_ptr)
            if jac.ndim == 2 and velocity_ptr is None:
                n = len(rows) - 1
                nv = jac.shape[1]
                velocities = nv * np.arange(n + 1)
            elif velocity_ptr is not None:
                n = len(rows) - 1
                velocities = _check_world_pointers("velocity_ptr", velocity_ptr)
            else:
                raise InputError(
                    f"J has shape {jac.shape}; a ragged batch needs (rows of all worlds, nv), or "
                    "with velocity_ptr one array of all entries"
                )
            if len(velocities) != n + 1:
                raise InputError(
                    f"velocity_ptr has {len(velocities) - 1} worlds, row_ptr {n}; equal numbers are needed"
                )
            sizes, nvs = rows[1:] - rows[:-1], velocities[1:] - velocities[:-1]
            self.shape: tuple[int, ...] = (int(rows[-1]),)
            self.velocity_shape: tuple[int, ...] = (int(velocities[-1]),)
            capacity = None
        elif row_ptr is None and velocity_ptr is None and jac.ndim == 3:
            n, capacity, nv = jac.shape
            sizes = (
                np.full(n, capacity)
                if count is None
                else check_row_counts("count", count, n, capacity)
            )
            nvs = np.full(n, nv)
            rows, velocities = capacity * np.arange(n + 1), nv * np.arange(n + 1)
            self.shape, self.velocity_shape = (n, capacity), (n, nv)
        else:
            raise InputError(
                f"J has shape {jac.shape}; (n, m, nv) is needed, or with row_ptr (rows, nv)"
            )
        self._n, self.friction = n, friction
        self.precision = get_common_precision(*(np.asarray(x) for x in (jac, mass, free)))
        self.at = at = np.zeros(n, WORLD)
        at["rows"] = sizes
        at["velocities"] = nvs
        at["row"] = rows[:-1]
        at["velocity"] = velocities[:-1]
        self._set_cones(cones)
        self._pattern = check_shared_lower_triangles(pattern, nvs, mass) if pattern else None
        shapes: Sequence[Any] = 4 * (None,)
        if capacity is not None:
            shapes = (capacity, nv), (nv, nv), (nv,), (capacity,)
        jac_shape, mass_shape, velocity_shape, row_shape = shapes
        if self._pattern is not None:
            mass_shape = (len(self._pattern[1]),)
        jac, at["jac"], self._jac_row = _flatten("J", jac, n, jac_shape, sizes * nvs)
        mass, at["mass"], self._mass_row = _flatten("M", mass, n, mass_shape, nvs * nvs)
        free, at["free"], _ = _flatten("v_free", free, n, velocity_shape, nvs)
        goal, at["target"], _ = _flatten("target", target, n, row_shape, sizes)
        compliance = 0.0 if compliance is None else compliance
        soft, at["soft"], _ = _flatten("compliance", compliance, n, row_shape, sizes)
        if mu is not None:
            mu_shape = (self.cones.n_blocks,) if self._has_shared_cones else None
            mu, at["mu"], _ = _flatten("mu", mu, n, mu_shape, at["blocks"])
        self._arrays: Any = (jac, mass, free, goal, soft, mu)
        self.key = None if key is None else self._convert_keys(key)

    @classmethod
    def _from_valid_rows(
        cls,
        jac: FloatArray,
        mass: FloatArray,
        pattern: Any,
        free: FloatArray,
        target: FloatArray,
        compliance: FloatArray,
        cones: Cones,
        places: np.ndarray,
    ) -> Batch:
        """Build a ragged batch under the cone law from contiguous float64 arrays, without the checks of `__init__`.

        `mass` (n, entries) are lower triangles with the pattern (indptr, indices). `places` (2, n + 1) are the first
        row and the first block of each world, and their ends.
        """
        batch = cls.__new__(cls)
        (n, nv) = free.shape
        (rows, blocks) = places
        batch._n = n
        batch.friction = "cone"
        batch.precision = "float64"
        batch.shape = target.shape
        batch.velocity_shape = (n * nv,)
        batch.cones = cones
        batch._has_shared_cones = False
        batch._pattern = pattern
        batch._jac_row = nv
        batch._mass_row = mass.shape[1]
        batch._arrays = (
            jac.reshape(-1),
            mass.reshape(-1),
            free.reshape(-1),
            target,
            compliance,
            None,
        )
        batch.at = at = np.zeros(n, WORLD)
        at["rows"] = rows[1:] - rows[:-1]
        at["velocities"] = nv
        at["blocks"] = blocks[1:] - blocks[:-1]
        at["row"] = at["target"] = at["soft"] = at["cone_row"] = rows[:-1]
        at["jac"] = nv * rows[:-1]
        at["mass"] = mass.shape[1] * np.arange(n)
        at["block"] = blocks[:-1]
        at["free"] = at["velocity"] = nv * np.arange(n)
        return batch

    #: Motions of the worlds that an engine moves by accelerations, `lavender.io.engine_motion.EngineMotions`.
    engine_motions: Any = MappingProxyType({})
    # Function that returns the names of a world's blocks.
    names_of: Callable[[int], Sequence[str]] | None = None
    # Function that returns which rows of a world are angular, as the argument `angular` of `Problem`.
    angular_of: Callable[[int], Any] | None = None
    contact_counts: np.ndarray | None = (
        None  # (n,) Number of contacts with rows; None if it is not known.
    )
    key: np.ndarray | None = None  # uint64: key of each block, world after world.
    _has_shared_cones = True

    # -- blocks ----------------------------------------------------------------------------------------

    def _set_cones(self, cones: Any) -> None:
        """Store the cones of all worlds or of each world, and the offsets of each world's blocks and rows in them."""
        at = self.at
        sizes = self.at["rows"]
        if not isinstance(cones, Cones):
            parts = check_sequence("cones", cones, f"Cones, one for each of {len(self)} worlds,")
            if len(parts) != len(self) or not all(isinstance(c, Cones) for c in parts):
                raise InputError(
                    f"cones has {len(parts)} entries; a Cones, or one for each world, is needed"
                )
            cones = Cones._concatenate(parts)
        self.cones = cones
        if cones.has_round and self.friction != "cone":
            raise InputError(
                "Coulomb's law is not supported for a round cone of more than two tangents: give friction='cone'"
            )
        if len(self) and (sizes == cones.n_rows).all():
            at["blocks"] = cones.n_blocks
            return
        self._has_shared_cones = False
        first = _compute_offsets(sizes)
        if len(self) and first[-1] + sizes[-1] != cones.n_rows:
            alternative = (
                f", or {sizes[0]} of each"
                if (sizes == sizes[0]).all()
                else "; one Cones for all worlds needs worlds of equal size: give a list of Cones"
            )
            raise InputError(
                f"cones have {cones.n_rows} rows; {first[-1] + sizes[-1]} are needed, the rows of all "
                f"worlds without padding rows{alternative}"
            )
        ends = first + sizes
        block, last = cones.ptr.searchsorted(first), cones.ptr.searchsorted(ends)
        bad = ((cones.ptr[block] != first) | (cones.ptr[last] != ends)).nonzero()[0]
        if len(bad):
            raise InputError(
                f"the blocks of the cones do not begin and end with the {sizes[bad[0]]} rows of world "
                f"{bad[0]}; every block must belong to one world: give a list with one Cones for each world"
            )
        at["block"] = block
        at["blocks"] = last - block
        at["cone_row"] = first

    def _get_cones_of_world(self, i: int, mu: FloatArray | None = None) -> Cones:
        """Return the blocks of world i, with mu (k,) if it is given."""
        block, k = self.at[i]["block"], self.at[i]["blocks"]
        if self._has_shared_cones and mu is None:
            return self.cones
        cones = self.cones._select_blocks(np.arange(block, block + k))  # pyright: ignore[reportArgumentType]
        if mu is None:
            return cones
        check_nonnegative_magnitudes("mu", mu, "-")
        return replace(cones, mu=mu)

    def _convert_keys(self, key: Any) -> np.ndarray:
        """Convert the argument `key` to an array of the keys of all blocks, world after world."""
        blocks = self.at["blocks"]
        if len(self) and (blocks == blocks[0]).all():
            shape = len(self), int(blocks[0])
            if get_shape("key", key) in (shape[1:], shape):
                key = np.broadcast_to(np.asarray(key), shape).reshape(-1)
        return convert_keys(key, int(blocks.sum()))

    # -- starts ------------------------------------------------------------------------------------------

    def make_start(self, previous: Any) -> FloatArray:
        """Return a start [N s] of the batch's shape from the result of another step.

        The impulses of each world are assigned to its blocks by their keys, as `Problem.carry` does: blocks without a
        previous impulse start at zero. Worlds without keys must have the same blocks in both steps. `solve_many` calls
        this for `impulse=`.

        Parameters
        ----------
        previous : Solutions of a batch, or (Batch, impulse)
            With as many worlds, in the same order.

        Raises
        ------
        InputError
            The numbers of worlds differ, or the blocks of a world do and a batch has no keys, or a world repeats a key.
        """
        if isinstance(previous, tuple) and len(previous) == 2 and type(previous[0]) is Batch:
            before = previous[0]
            impulse = before.flatten_impulses("impulse", previous[1])
        elif type(getattr(previous, "problems", None)) is Batch:
            before = previous.problems
            impulse = previous.flat_impulses[0]
        else:
            raise InputError(
                f"impulse is a {type(previous).__name__}; an array of the batch's shape, Solutions of a batch, or "
                "(Batch, impulse), is needed"
            )
        if len(before) != len(self):
            raise InputError(
                f"impulse is of {len(before)} worlds; a start of {len(self)} worlds is needed"
            )
        start = np.zeros(math.prod(self.shape))
        if self.key is None or before.key is None:
            i = self._find_other_blocks(before)
            if i is not None:
                raise InputError(
                    f"impulse is of worlds with other blocks (world {i}: {before.at['rows'][i]} rows before, "
                    f"{self.at['rows'][i]} now); give both batches a key= of each block, by which impulses are "
                    "assigned, or an array of this batch's shape"
                )
            start[self._list_rows()] = impulse[before._list_rows()]
            return start.reshape(self.shape)
        bad, is_old = carry_impulses_of_worlds(
            before.cones._blocks,
            before._list_places(),
            before.key,
            impulse,
            self.cones._blocks,
            self._list_places(),
            self.key,
            start,
        )
        if bad >= 0:
            which = "the previous batch" if is_old else "this batch"
            raise InputError(
                f"world {bad} of {which} repeats a key, so that impulses cannot be assigned: give each of its blocks "
                "a key of its own"
            )
        return start.reshape(self.shape)

    def _find_other_blocks(self, before: Batch) -> int | None:
        """Return the first world whose blocks are others than in the batch of another step, or None."""
        if self is before:
            return None
        at, old = self.at, before.at
        differs = (at["rows"] != old["rows"]) | (at["blocks"] != old["blocks"])
        if differs.any():
            return int(differs.argmax())
        # All worlds have the blocks of the first one if both batches have one set of blocks.
        is_shared = self._has_shared_cones and before._has_shared_cones
        own, previous = (np.stack([np.diff(x.cones.ptr), x.cones.kind]) for x in (self, before))
        for i in range(min(len(self), 1) if is_shared else len(self)):
            a, b, k = int(at["block"][i]), int(old["block"][i]), int(at["blocks"][i])
            if not np.array_equal(own[:, a : a + k], previous[:, b : b + k]):
                return i
        return None

    def _list_rows(self) -> np.ndarray:
        """Return the places of the rows of all worlds in a flat array of impulses, without padding rows."""
        sizes = self.at["rows"]
        first = self.at["row"] - _compute_offsets(sizes)
        return np.arange(int(sizes.sum())) + np.repeat(first, sizes)

    def _list_places(self) -> np.ndarray:
        """Return the columns (n, 5) that `carry_impulses_of_worlds` reads."""
        columns = [self.at[name] for name in ("block", "blocks", "cone_row", "row")]
        return np.stack([*columns, _compute_offsets(self.at["blocks"])], axis=1)

    def stack_free_velocities(self) -> FloatArray:
        """Return v* of all worlds (n, nv) [m/s, rad/s] of a stacked batch, in float64."""
        nv = self.velocity_shape[1]
        return self._arrays[2][self.at["free"][:, None] + np.arange(nv)].astype(float)

    def _get_keys_of_world(self, i: int) -> np.ndarray | None:
        """Return the keys of the blocks (k,) of world i, or None."""
        if self.key is None:
            return None
        first = int(self.at["blocks"][:i].sum())
        return self.key[first : first + int(self.at["blocks"][i])]

    def __getstate__(self) -> dict[str, Any]:
        # Copies and pickles hold the results, because the functions may hold an engine's model.
        functions = {"names_of": self.names_of, "angular_of": self.angular_of}
        return self.__dict__ | {
            name: tuple(map(function, range(len(self)))).__getitem__
            for name, function in functions.items()
            if function is not None
        }

    # -- a sequence of problems ------------------------------------------------------------------------

    @property
    def row_counts(self) -> np.ndarray:
        """Number of rows of each world (n,)."""
        return self.at["rows"].copy()

    def __len__(self) -> int:
        return self._n

    @overload
    def __getitem__(self, i: int) -> Problem: ...
    @overload
    def __getitem__(self, i: Any) -> list[Problem]: ...
    def __getitem__(self, i: Any) -> Any:
        """Return world i as a `Problem` made of copies, or a list of problems; raise InputError for invalid numbers."""
        i = resolve_index(i, self._n)
        if isinstance(i, list):
            return [self[j] for j in i]
        return self.get_world(i)

    def get_world(self, i: int, named: bool = True) -> Problem:
        """Return world i as a `Problem` made of copies, with or without names of blocks and units of rows."""
        world = dict(zip(WORLD.names, self.at[i].item(), strict=True))  # type: ignore[arg-type]
        jac, mass, free, target, compliance, mu = (
            self._get_array_of_world(world, k) for k in range(6)
        )
        cones = self._get_cones_of_world(i, None if mu is None else as_array("mu", mu, (None,)))
        problem = Problem.from_jacobian(
            jac,
            mass,
            free,
            target=target,
            cones=cones,
            compliance=compliance,
            friction=self.friction,
            precision=self.precision,
            names=None if self.names_of is None or not named else self.names_of(i),
            angular=None if self.angular_of is None or not named else self.angular_of(i),
            key=self._get_keys_of_world(i) if named else None,
        )
        if i in self.engine_motions:
            problem._set_record(EngineRecord(self.engine_motions[i]))
        return problem

    def _get_array_of_world(self, world: dict[str, int], which: int) -> Any:
        """Return an array of a world (0: J, 1: M, 2: v*, 3: target, 4: compliance, 5: mu), or None."""
        array = self._arrays[which]
        m = world["rows"]
        nv = world["velocities"]
        k = world["blocks"]
        first = world[("jac", "mass", "free", "target", "soft", "mu")[which]]
        if array is None:
            return None
        if which == 1 and self._pattern is not None:
            ptr, col = self._pattern
            row = np.repeat(np.arange(nv), np.diff(ptr))
            dense = np.zeros((nv, nv), array.dtype)
            dense[row, col] = dense[col, row] = array[first : first + len(col)]
            return dense
        if which < 2:
            rows, stride = ((m, self._jac_row), (nv, self._mass_row))[which]
            if not rows * nv:
                return np.zeros((rows, nv), array.dtype)
            strides = (stride or nv) * array.itemsize, array.itemsize
            return np.lib.stride_tricks.as_strided(
                array[first:], (rows, nv), strides, writeable=False
            )
        return array[first : first + (nv, m, m, k)[which - 2]]

    def rows_of(self, i: int) -> slice:
        """Return the slice of world i in a flat array of all impulses."""
        first = int(self.at[i]["row"])
        return slice(first, first + int(self.at[i]["rows"]))

    def flatten_impulses(self, name: str, value: Any) -> FloatArray:
        """Convert impulses [N s] of the batch's shape, or a result for such a batch, to a new flat array.

        Numbers need not be finite.
        """
        array = as_array(
            name, getattr(value, "impulse", value), self.shape, finite=False, unit="N s"
        )
        return array.reshape(-1).copy()

    def make_kernel_worlds(self, impulse: FloatArray, velocity: FloatArray, cold: bool) -> Worlds:
        """Build the data of the compiled loop, which writes results to the flat arrays `impulse` and `velocity`."""
        worlds = Worlds(
            self.at.view(np.int64).reshape(len(self), len(PLACE)), impulse, velocity, cold
        )
        if self.cones.has_ellipse:
            worlds.set_from_problems([], [None] * len(self), [])
        else:
            is_single = self._arrays[1].dtype == np.float32
            strides = (self._jac_row, self._mass_row)
            law = LAWS[self.friction]
            asymmetry = MAX_ASYMMETRY_FLOAT32 if is_single else MAX_ASYMMETRY
            worlds.set_from_arrays(
                self._arrays, strides, self._pattern, self.cones._blocks, law, asymmetry
            )
        return worlds

    def __repr__(self) -> str:
        return f"<Batch of {self._n} worlds, impulses {self.shape}, {self.precision}>"


# -- conversion of arguments --------------------------------------------------------------------------


def _compute_offsets(sizes: Any) -> np.ndarray:
    """Compute the offsets of consecutive parts from their sizes."""
    return sizes.cumsum(dtype=np.int64) - sizes


def _check_world_pointers(name: str, value: Any) -> np.ndarray:
    """Convert pointers of worlds to an array (n + 1,); raise InputError for invalid ones."""
    ptr = as_array(name, value, (None,), dtype=np.int32)
    if not are_pointers_valid(ptr, 0):
        raise InputError(
            f"{name} is {ptr.tolist()!s:.60}; it must start with 0 and must not decrease: the first index "
            "of each world, then their total number"
        )
    return ptr.astype(np.int64)


def check_shared_lower_triangles(
    arrays: Sequence[Any], nvs: Any, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return (indptr, indices) of lower triangles that worlds of nvs velocities share, from (indices, indptr)."""
    if len(arrays) != 2:
        raise InputError(
            f"M is a tuple of {1 + len(arrays)} arrays; (values, indices, indptr) are needed"
        )
    col, ptr = (
        as_array(name, x, (None,), dtype=np.int32)
        for name, x in zip(("indices of M", "indptr of M"), arrays, strict=True)
    )
    nv = len(ptr) - 1
    if not are_lower_triangles_valid(ptr, col):
        raise InputError(
            "the indices and indptr of M do not describe a lower triangle; every row needs ascending columns, "
            "with the diagonal entry last"
        )
    if (nvs != nv).any() or values.ndim != 2 or values.shape[1] != len(col):
        raise InputError(
            f"values of M have shape {values.shape}, and its pattern has {len(col)} entries of {nv} "
            f"velocities; (worlds, {len(col)}) is needed, and {nv} velocities in every world"
        )
    return ptr, col


def check_row_counts(name: str, value: Any, n: int, capacity: int) -> np.ndarray:
    """Return the numbers of rows of n worlds (n,); raise InputError unless they are from 0 to the rows of J."""
    count = as_array(name, value, (n,), dtype=np.int32).astype(np.int64)
    bad = np.flatnonzero((count < 0) | (count > capacity))
    if len(bad):
        raise InputError(
            f"{name} of world {bad[0]} is {count[bad[0]]}; 0 to {capacity}, the number of rows of J, is needed"
        )
    return count


def _flatten(
    name: str, value: Any, n: int, shape: tuple[int, ...] | None, sizes: Any
) -> tuple[np.ndarray, Any, int]:
    """Return the numbers of n worlds as a flat array, the offset of each world in it, and the stride of its rows.

    Parameters
    ----------
    name : str
    value : array
        An array of `shape` for each world, in place of which one array serves all worlds; a number, except for
        matrices.
    shape : tuple of int or None
        If None, the arrays of the worlds are concatenated, have the numbers of entries `sizes` (n,), and the stride 0,
        which means that rows are contiguous.
    """
    x = as_float_array(name, value)
    if x.ndim == 0 and name not in ("J", "M"):
        return np.full(int(sizes.max(initial=0)), float(x)), 0, 0
    if shape is None:
        total = int(sizes.sum())
        if x.size != total:
            raise InputError(
                f"{name} has shape {x.shape}; {total} numbers are needed, world after world"
            )
        return np.ascontiguousarray(x).reshape(-1), _compute_offsets(sizes), 0
    if x.shape == shape:
        x = np.broadcast_to(x, (n, *shape))
    if x.shape != (n, *shape):
        raise InputError(f"{name} has shape {x.shape}; {(n, *shape)} or {shape} is needed")
    size = x.itemsize
    is_matrix = len(shape) == 2 and shape[0] > 1
    # Arrays are read in place if each world is stored row by row in aligned memory.
    has_item_strides = (
        all(stride >= 0 and stride % size == 0 for stride in x.strides) and x.flags.aligned
    )
    has_contiguous_rows = x.shape[-1] < 2 or x.strides[-1] == size
    if not (has_item_strides and has_contiguous_rows) or (
        is_matrix and x.strides[1] < shape[1] * size
    ):
        x = np.ascontiguousarray(x)
    if x.flags.c_contiguous:
        flat = x.reshape(-1)
    else:  # A flat view of the memory that the array spans.
        length = 1 + sum(
            (k - 1) * stride // size for k, stride in zip(x.shape, x.strides, strict=True)
        )
        flat = np.lib.stride_tricks.as_strided(
            x, (length if x.size else 0,), (size,), writeable=False
        )
    return (
        flat,
        np.arange(n) * (x.strides[0] // size),
        x.strides[1] // size if is_matrix else shape[-1],
    )
