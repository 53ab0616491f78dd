"""Blocks of a problem: which rows belong together and what bounds them.

A block is one or more bounded rows (`ROW`), or a contact: normal row, then 0 to 2 tangent rows, then
perhaps one spin row. With lambda [N s] the bounds are

    ROW           lower <= lambda_i <= upper on each of its rows
    CONTACT       0 <= lambda_n,  |lambda_t| <= mu lambda_n
    CONTACT_SPIN  the same, and |lambda_s| <= mu r lambda_n, r = patch radius [m]
    ROUND         0 <= lambda_n, |lambda_T| <= mu lambda_n over three to five tangents together: two that slide, one
                  that spins, two that roll; each row scaled by its own coefficient over mu, so that one mu bounds all
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from lavender._arrays import FloatArray, IntArray, as_array, check_not_nan, check_not_negative, equal
from lavender.errors import InputError
from lavender_ext.core.problem import BOUNDED, FREE, KINDS, ROUND_CONES, Blocks, shape_of

__all__ = ["CONTACT", "CONTACT_SPIN", "ROUND", "ROW", "Cones", "project"]

ROW, CONTACT, CONTACT_SPIN, ROUND = KINDS


_FIELDS = tuple(
    (name, np.dtype(np.int32 if name in ("ptr", "kind") else np.float64))
    for name in ("ptr", "kind", "lower", "upper", "mu", "patch_radius")
)


@dataclass(frozen=True, eq=False)
class Cones:
    """Bounds of every block; use the class methods unless blocks are mixed.

    Raises
    ------
    InputError
        Shapes that do not fit, lower > upper, NaN bounds, negative mu or patch radius, a contact with
        more rows than normal, two tangents and spin, a round cone of more than five tangents.
    """

    ptr: IntArray  # (k + 1,) first row of each block, then m
    kind: IntArray  # (k,) ROW | CONTACT | CONTACT_SPIN | ROUND
    lower: FloatArray  # (m,) N s, read on ROW blocks, -inf allowed
    upper: FloatArray  # (m,) N s, read on ROW blocks, +inf allowed
    mu: FloatArray  # (k,) -, read on contacts
    patch_radius: FloatArray  # (k,) m, read on CONTACT_SPIN

    def __post_init__(self) -> None:
        if not self._adopt():
            self._check()

    def _adopt(self) -> bool:
        # Arrays as they should be, copied, in one pass; where anything is amiss `_check` finds the words.
        own = []
        for name, dtype in _FIELDS:
            given = getattr(self, name)
            if type(given) is not np.ndarray or given.dtype is not dtype or given.ndim != 1:
                return False
            own.append(given.copy())
        bits, blocks = shape_of(*own)
        if bits < 0:
            return False
        for (name, _), value in zip(_FIELDS, own, strict=True):
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        self._remember(bits, blocks)
        return True

    def _remember(self, bits: int, blocks: Blocks) -> None:
        put = self.__dict__
        put["_blocks"] = blocks
        for name, bit in (("is_free", FREE), ("is_bounded_rows", BOUNDED), ("has_round", ROUND_CONES)):
            put[name] = bool(bits & bit)

    @cached_property
    def _blocks(self) -> Blocks:
        # what kernels read
        return Blocks(*(getattr(self, name) for name, _ in _FIELDS))

    def _check(self) -> None:
        ptr = as_array("cones.ptr", self.ptr, (None,), dtype=np.int32)
        if len(ptr) == 0 or ptr[0] != 0 or np.any(np.diff(ptr) <= 0):
            raise InputError(
                "cones.ptr must start with 0 and increase: the first row of each block, then the number of "
                "rows"
            )
        k, m = len(ptr) - 1, int(ptr[-1])
        kind = as_array("cones.kind", self.kind, (k,), dtype=np.int32)
        if k and not np.isin(kind, (ROW, CONTACT, CONTACT_SPIN, ROUND)).all():
            raise InputError(
                f"cones.kind holds {sorted(set(kind.tolist()))}; ROW=0, CONTACT=1, CONTACT_SPIN=2, ROUND=3 are known"
            )
        size = np.diff(ptr)
        if np.any(kind == ROUND):
            flat = (kind == ROUND) & (size <= 3)
            if flat.any():  # with up to two tangents it is a contact
                kind = np.where(flat, CONTACT, kind).astype(np.int32)
                kind.flags.writeable = False
            bad = np.flatnonzero((kind == ROUND) & (size > 6))
            if len(bad):
                raise InputError(
                    f"block {bad[0]} is a round cone of {size[bad[0]]} rows; a normal and up to five tangents "
                    "(two slide, one spins, two roll) are known"
                )
        bad = np.flatnonzero((kind != ROW) & (kind != ROUND) & ((size < kind) | (size > kind + 2)))
        if len(bad):
            raise InputError(
                f"block {bad[0]} is a contact of {size[bad[0]]} rows; a contact has a normal, up to "
                "two tangents, "
                "and one spin row if it is CONTACT_SPIN"
            )
        lower = as_array("lower", self.lower, (m,), finite=False, unit="N s")
        upper = as_array("upper", self.upper, (m,), finite=False, unit="N s")
        check_not_nan("lower", lower)
        check_not_nan("upper", upper)
        contact_rows = np.repeat(kind != ROW, size)
        bad = np.flatnonzero(~contact_rows & ~((lower <= upper) & (lower < np.inf) & (upper > -np.inf)))
        if len(bad):
            i = bad[0]
            raise InputError(
                f"row {i}: lower = {lower[i]}, upper = {upper[i]}; lower <= upper is needed, "
                "and a number between them"
            )
        if contact_rows.any():
            # One spelling for rows whose bounds are never read, so that equal problems compare equal.
            lower, upper = lower.copy(), upper.copy()
            lower[contact_rows], upper[contact_rows] = -np.inf, np.inf
            normal = ptr[:-1][kind != ROW]
            lower[normal] = 0.0
            lower.flags.writeable = upper.flags.writeable = False
        mu = as_array("mu", self.mu, (k,))
        check_not_negative("mu", mu)
        radius = as_array("patch_radius", self.patch_radius, (k,), unit="m")
        check_not_negative("patch_radius", radius)
        for name, value in zip(
            ("ptr", "kind", "lower", "upper", "mu", "patch_radius"),
            (ptr, kind, lower, upper, mu, radius),
            strict=True,
        ):
            object.__setattr__(self, name, value)

    @classmethod
    def _trusted(cls, *values: np.ndarray) -> Cones:
        # For arrays this module has just made; nothing is checked again.
        cones = object.__new__(cls)
        bits, blocks = shape_of(*values)
        if bits < 0:  # numbers that another engine should not have held
            return cls(*values)
        cones._remember(bits, blocks)
        put = cones.__dict__
        for (name, _), value in zip(_FIELDS, values, strict=True):
            value.flags.writeable = False
            put[name] = value
        return cones

    @classmethod
    def bounded(cls, lower: FloatArray, upper: FloatArray) -> Cones:
        """One ROW block for each pair of bounds; arrays (m,) [N s]."""
        m = len(lower)
        return cls(
            np.arange(m + 1, dtype=np.int32), np.zeros(m, np.int32), lower, upper, np.zeros(m), np.zeros(m)
        )

    @classmethod
    def free(cls, m: int) -> Cones:
        """m unbounded rows, each its own block: a linear system."""
        return cls._trusted(
            np.arange(m + 1, dtype=np.int32),
            np.zeros(m, np.int32),
            np.full(m, -np.inf),
            np.full(m, np.inf),
            np.zeros(m),
            np.zeros(m),
        )

    @classmethod
    def contacts(
        cls, mu: Any, tangents: int = 2, patch_radius: Any = None, *, count: int | None = None
    ) -> Cones:
        """Contacts only, the same rows for each: normal, `tangents`, and with a radius a spin row.

        Parameters
        ----------
        mu : scalar or (k,)
        tangents : int, 0 to 5
            More than two make one round cone (ROUND) and take no patch radius.
        patch_radius : scalar or (k,) m, optional
        count : int, optional
            k, where mu is a scalar; default 1.
        """
        if (
            isinstance(tangents, bool)
            or not isinstance(tangents, (int, np.integer))
            or not 0 <= tangents <= 5
        ):
            raise InputError(f"tangents is {tangents!r}; a whole number from 0 to 5 is needed")
        spin = patch_radius is not None
        if tangents > 2 and spin:
            raise InputError(
                f"{tangents} tangents make a round cone, which bounds spin itself: no patch_radius"
            )
        if count is not None and (
            isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 0
        ):
            raise InputError(f"count is {count!r}; a whole number of contacts is needed")
        if type(mu) is not float:
            mu = np.asarray(mu, float)
        k = count if count is not None else len(mu) if isinstance(mu, np.ndarray) and mu.ndim else 1
        mu = as_array("mu", mu, (k,))
        size = 1 + tangents + spin
        radius = (
            np.zeros(k) if patch_radius is None else as_array("patch_radius", patch_radius, (k,), unit="m")
        )
        m = k * size
        kind = np.empty(k, np.int32)
        kind.fill(ROUND if tangents > 2 else CONTACT_SPIN if spin else CONTACT)
        return cls._trusted(
            np.arange(0, m + 1, size, dtype=np.int32), kind, np.zeros(m), np.zeros(m), mu, radius
        )

    @property
    def n_blocks(self) -> int:
        """Number of blocks, k."""
        return len(self.kind)

    @property
    def n_rows(self) -> int:
        """Number of rows, m."""
        return int(self.ptr[-1])

    @cached_property
    def is_free(self) -> bool:
        """Every row is unbounded."""
        return bool(
            np.all(self.kind == ROW) and np.all(np.isneginf(self.lower)) and np.all(np.isposinf(self.upper))
        )

    @cached_property
    def is_bounded_rows(self) -> bool:
        """Every row has constant bounds: ROW blocks and contacts of a normal alone."""
        return bool(np.all((self.kind == ROW) | (np.diff(self.ptr) == 1)))

    @cached_property
    def has_round(self) -> bool:
        """Some contact has more than two tangents in one cone."""
        return bool(np.any(self.kind == ROUND))

    @property
    def n_tangents(self) -> IntArray:
        """(k,) tangent rows of each block, 0 on ROW."""
        own = np.diff(self.ptr) - 1 - (self.kind == CONTACT_SPIN)
        return np.where(self.kind == ROW, 0, own).astype(np.int32)

    def __add__(self, other: object) -> Cones:
        """These blocks, then those of `other`."""
        if not isinstance(other, Cones):
            return NotImplemented
        pairs = [(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)]
        ptr = np.concatenate([self.ptr, self.n_rows + other.ptr[1:]])
        return Cones._trusted(ptr.astype(np.int32), *(np.concatenate(pair) for pair in pairs[1:]))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Cones):
            return NotImplemented
        return all(equal(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[Any, ...]:
        # Arrays stay read-only in copies and pickles.
        return type(self), tuple(getattr(self, f.name) for f in fields(self))


def project(cones: Cones, impulse: FloatArray) -> FloatArray:
    """Nearest feasible normal and rows, then tangents and spin onto mu lambda_n; (m,) [N s].

    This is the feasibility step of a sweep, not the projection onto the friction cone: the normal is
    clipped first and keeps its value.
    """
    out = np.clip(impulse, cones.lower, cones.upper)
    tangents = cones.n_tangents
    for i in np.flatnonzero((cones.kind != ROW) & (np.diff(cones.ptr) > 1)):
        j, end, nt = cones.ptr[i], cones.ptr[i + 1], tangents[i]
        bound = cones.mu[i] * out[j]
        t = out[j + 1 : j + 1 + nt]
        size = np.hypot.reduce(t) if nt else 0.0
        if size > bound:
            t *= bound / size
        if cones.kind[i] == CONTACT_SPIN:
            spin = bound * cones.patch_radius[i]
            out[end - 1] = np.clip(out[end - 1], -spin, spin)
    return out
