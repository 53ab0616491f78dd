"""Blocks of a problem: which rows belong together and what bounds them.

A block is one or more bounded rows (`ROW`), or a contact: normal row, then 0 to 2 tangent rows, then
perhaps one spin row, perhaps two rows that roll. With lambda [N s] the bounds are

    ROW           lower <= lambda_i <= upper on each of its rows
    CONTACT       0 <= lambda_n,  |lambda_t| <= mu lambda_n
    CONTACT_SPIN  the same, and |lambda_s| <= mu r lambda_n, r = patch radius [m]
    CONTACT_BOX   0 <= lambda_n,  |lambda_1| <= mu lambda_n,  |lambda_2| <= mu q lambda_n: two tangents, each by itself,
                  as most engines have it; q = mu_2 / mu_1 stands in the place of the patch radius
    CONTACT_ELLIPSE  0 <= lambda_n,  |(lambda_1 / mu, lambda_2 / (mu q))| <= lambda_n: the disk of tangents stretched
                  by their share of the larger coefficient, in which it is solved and judged (`Problem.disk`)
    ROUND         0 <= lambda_n, |lambda_T| <= mu lambda_n over three to five tangents together: two that slide, one
                  that spins, two that roll; each row scaled by its own coefficient over mu, so that one mu bounds all
    CONTACT_ROLLING  a contact of two tangents, perhaps with spin, and |lambda_r| <= mu_r lambda_n on the two that roll,
                  mu_r [m] the arm by which rolling moves the normal force; each part bounded by itself
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import (
    ArrayLike,
    FloatArray,
    IntArray,
    as_array,
    check_inside,
    check_not_nan,
    check_sizes,
    equal,
    places,
    read_only,
    shape_of,
    whole_number,
)
from lavender.base.errors import InputError
from lavender.problem.derived import cached_property
from lavender.problem.friction import (
    LEAST_SHARE,
    SHAPES,
    axes_of,
    check_parts,
    check_shape,
    sides_of,
    sizes_of,
)
from lavender_ext.core import blocks as kernels
from lavender_ext.core.checks import LEAST, MOST

__all__ = [
    "CONTACT",
    "CONTACT_BOX",
    "CONTACT_ELLIPSE",
    "CONTACT_ROLLING",
    "CONTACT_SPIN",
    "ROUND",
    "ROW",
    "SHAPES",
    "Cones",
    "kinds_of",
    "project",
]

ROW, CONTACT, CONTACT_SPIN, ROUND, CONTACT_BOX, CONTACT_ROLLING, CONTACT_ELLIPSE = kernels.KINDS

FIELDS = ("ptr", "kind", "lower", "upper", "mu", "patch_radius", "rolling")
REACH = "mu patch_radius (of boxes and ellipses mu_2)"
# Of each kind of contact: least and most rows, what it is called, and what it may have.
SIZES = {
    CONTACT: (1, 3, "a contact", "a normal and up to two tangents are known, and one spin row of CONTACT_SPIN"),
    CONTACT_SPIN: (2, 4, "a contact with spin", "a normal, up to two tangents and one spin row are known"),
    ROUND: (4, 6, "a round cone", "a normal and up to five tangents (two slide, one spins, two roll) are known"),
    CONTACT_BOX: (3, 3, "a box", "a normal and two tangents are known"),
    CONTACT_ROLLING: (5, 6, "a contact with rolling",
                      "a normal, two tangents, perhaps spin, and two that roll are needed: 5 rows or 6"),
    CONTACT_ELLIPSE: (3, 3, "an ellipse", "a normal and two tangents are needed"),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Cones:
    """Bounds of k blocks with m rows. Made by `Cones.free`, `Cones.bounded` and `Cones.contacts`; `+` joins them.

    Parameters
    ----------
    ptr : (k + 1,) int
        First row of each block, followed by m.
    kind : (k,) int
        ROW, CONTACT, CONTACT_SPIN, ROUND, CONTACT_BOX, CONTACT_ROLLING or CONTACT_ELLIPSE of each block.
    lower, upper : (m,) N s
        Bounds of the rows of ROW blocks, possibly infinite. Those of contacts are not read.
    mu : (k,) -
        Coefficient of friction of each contact.
    patch_radius : (k,) m
        Contacts with spin: r; their spin row is bounded by mu r lambda_n [N m s]. CONTACT_BOX and CONTACT_ELLIPSE:
        mu_2 / mu_1 [-].
    rolling : (k,) m, optional
        mu_r of CONTACT_ROLLING: the rolling impulse is bounded by mu_r lambda_n [N m s]; default 0. Acary, Bourrier,
        Viano 2023.

    Raises
    ------
    InputError
        Shapes that do not fit; lower > upper or NaN bounds; a negative mu, patch radius or mu_r; a contact with more
        rows than its kind has; a round cone of more than five tangents.

    Examples
    --------
    A hinge of five rows, a motor of at most 2 N s, and two contacts of one normal and two tangents each:

    >>> import lavender as lv
    >>> cones = lv.Cones.free(5) + lv.Cones.bounded([-2.0], [2.0]) + lv.Cones.contacts(0.5, count=2)
    >>> cones.n_blocks, cones.n_rows
    (8, 12)
    >>> cones.ptr.tolist()  # each free row is a block of its own
    [0, 1, 2, 3, 4, 5, 6, 9, 12]
    >>> cones.mu[-2:].tolist(), cones.upper[5].item()
    ([0.5, 0.5], 2.0)
    """

    ptr: IntArray  # (k + 1,) first row of each block, then m
    kind: IntArray  # (k,) ROW | CONTACT | CONTACT_SPIN | ROUND | CONTACT_BOX | CONTACT_ROLLING | CONTACT_ELLIPSE
    lower: FloatArray  # (m,) N s, read on ROW blocks, -inf allowed
    upper: FloatArray  # (m,) N s, read on ROW blocks, +inf allowed
    mu: FloatArray  # (k,) -, read on contacts
    patch_radius: FloatArray  # (k,) m, read on contacts with spin; on boxes and ellipses mu_2 / mu_1
    rolling: FloatArray = field(default_factory=tuple)  # type: ignore[arg-type]  # (k,) m, read on CONTACT_ROLLING; (): 0
    _blocks: ClassVar[kernels.Blocks]  # of an instance: the same arrays, as kernels read them

    if TYPE_CHECKING:  # what may be given; fields are arrays

        def __init__(
            self, ptr: ArrayLike, kind: ArrayLike, lower: ArrayLike, upper: ArrayLike, mu: ArrayLike,
            patch_radius: ArrayLike, rolling: ArrayLike = ...,
        ) -> None: ...  # fmt: skip

    def __post_init__(self) -> None:
        given: Any = self.rolling
        if isinstance(given, tuple) and not given:
            self.__dict__["rolling"] = np.zeros(np.size(self.kind))
        made = kernels.private(
            self.ptr, self.kind, self.lower, self.upper, self.mu, self.patch_radius, self.rolling
        )
        if made is None:
            made = self._checked()
        self._take(made)

    def _take(self, made: kernels.Blocks) -> None:
        self.__dict__.clear()
        self.__dict__["_blocks"] = made

    def __getattr__(self, name: str) -> Any:
        # Views are cut when one is first asked for.
        if name not in FIELDS:
            raise AttributeError(f"Cones have no {name}")
        self.__dict__.update(zip(FIELDS, self._blocks.arrays, strict=True))
        return self.__dict__[name]

    @classmethod
    def _of(cls, made: kernels.Blocks) -> Cones:
        cones = object.__new__(cls)
        cones._take(made)
        return cones

    @classmethod
    def _joined(cls, each: Iterable[Cones]) -> Cones:
        """The blocks of each, one after the other."""
        made = kernels.joined([cones._blocks for cones in each])
        if made is None:
            raise InputError("together these have more rows than 32-bit numbers count")
        return cls._of(made)

    def _checked(self) -> kernels.Blocks:
        # The long way: what can be made to fit, and words for what cannot.
        ptr = as_array("cones.ptr", self.ptr, (None,), dtype=np.int32)
        if len(ptr) == 0 or ptr[0] != 0 or np.any(np.diff(ptr) <= 0):
            raise InputError(
                "cones.ptr must start with 0 and increase: the first row of each block, then the number of "
                "rows"
            )
        k, m = len(ptr) - 1, int(ptr[-1])
        kind = as_array("cones.kind", self.kind, (k,), dtype=np.int32)
        if k and not np.isin(kind, kernels.KINDS).all():
            raise InputError(
                f"cones.kind holds {sorted(set(kind.tolist()))}; ROW=0, CONTACT=1, CONTACT_SPIN=2, ROUND=3, "
                f"CONTACT_BOX={CONTACT_BOX}, CONTACT_ROLLING={CONTACT_ROLLING}, CONTACT_ELLIPSE={CONTACT_ELLIPSE} are "
                "known"
            )
        size = np.diff(ptr)
        kind = _fitting(kind, size)
        lower = as_array("lower", self.lower, (m,), finite=False, unit="N s")
        upper = as_array("upper", self.upper, (m,), finite=False, unit="N s")
        check_not_nan("lower", lower)
        check_not_nan("upper", upper)
        contact_rows = np.repeat(kind != ROW, size)
        for name, bound in (("lower", lower), ("upper", upper)):
            check_inside(name, np.where(contact_rows | np.isinf(bound), 0.0, bound), "N s")
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
        mu = sizes_of("mu", self.mu, k)
        radius = sizes_of("patch_radius", self.patch_radius, k, "m")
        wide = ~((radius >= LEAST_SHARE) & (radius <= 1.0 / LEAST_SHARE))
        bad = np.flatnonzero((kind == CONTACT_ELLIPSE) & wide)
        if len(bad):
            raise InputError(
                f"block {bad[0]} is an ellipse with mu_2 / mu_1 = {radius[bad[0]]:g} in the place of the patch radius; "
                "1e-18 to 1e18 is needed"
            )
        check_sizes(REACH, np.where(kind == ROW, 0.0, mu * radius), "m")
        rolling = sizes_of("rolling", self.rolling, k, "m")
        return kernels.Blocks(ptr, kind, lower, upper, mu, radius, rolling)

    @classmethod
    def bounded(cls, lower: ArrayLike, upper: ArrayLike) -> Cones:
        """One ROW block for each pair of bounds, lower <= lambda <= upper: arrays (m,) [N s], or upper inf for all."""
        made = kernels.bounded_rows(lower, upper)
        if made is not None:
            return cls._of(made)
        low = as_array("lower", lower, (None,), finite=False, unit="N s")
        m = len(low)
        high = as_array("upper", upper, (m,), finite=False, unit="N s")
        return cls(
            np.arange(m + 1, dtype=np.int32), np.zeros(m, np.int32), low, high, np.zeros(m), np.zeros(m)
        )

    @classmethod
    def free(cls, m: int) -> Cones:
        """m unbounded rows, each its own block: a linear system."""
        return cls._of(kernels.free_rows(whole_number("m", m, high=2**31 - 2)))

    @classmethod
    def contacts(
        cls,
        mu: Any,
        tangents: int = 2,
        patch_radius: Any = None,
        *,
        rolling: Any = None,
        count: int | None = None,
        shape: str = "disk",
    ) -> Cones:
        """Contacts only, the same rows for each: normal, `tangents`, with a radius a spin row, then what rolls.

        Parameters
        ----------
        mu : scalar, (k,) or (k, 2)
            One for each contact, or one for each of its two tangents: of an ellipse,
            |(lambda_1 / mu_1, lambda_2 / mu_2)| <= lambda_n, or of a box.
        tangents : int, 0 to 5
            More than two make one round cone (ROUND) and take no patch radius.
        patch_radius : scalar or (k,) m, optional
        rolling : scalar or (k,) m, optional
            mu_r: gives each contact two rows that roll about its two tangents, |lambda_r| <= mu_r lambda_n.
        count : int, optional
            k, where mu is a scalar; default 1.
        shape : {"disk", "box"}
            What bounds two tangents: |lambda_t| <= mu lambda_n, or each by itself as in most engines,
            |lambda_i| <= mu_i lambda_n, which grips up to sqrt(2) more on the diagonal.

        Examples
        --------
        Four skates that glide along the first tangent and hold across, as ellipses and as boxes:

        >>> import lavender as lv
        >>> skates = lv.Cones.contacts([(0.02, 0.8)] * 4)
        >>> skates.n_rows, skates.coefficients[0].tolist()
        (12, [0.02, 0.8])
        >>> skates.shaped("box") == lv.Cones.contacts([(0.02, 0.8)] * 4, shape="box")
        True
        """
        if type(tangents) is not int or not 0 <= tangents <= 5:
            tangents = whole_number("tangents", tangents, 0, 5)
        box, pair = (
            check_shape("shape", shape) == "box",
            type(mu) is not float and len(shape_of("mu", mu)) > 1,
        )
        if patch_radius is not None or rolling is not None or tangents != 2:
            check_parts(mu, tangents, patch_radius is not None, rolling is not None, box, pair)
        ratio, sides = None, 0
        if box and tangents == 2:
            sides = CONTACT_BOX
            mu, ratio = sides_of(mu)
        elif pair and not box:
            mu, ratio = axes_of(mu)
            sides = 0 if ratio is None else CONTACT_ELLIPSE
        given = 1 if type(mu) is float or np.ndim(mu) == 0 else shape_of("mu", mu)[0]
        k = given if count is None else whole_number("count", count)
        if type(mu) is not float or not (mu == 0.0 or LEAST <= mu <= MOST):
            mu = sizes_of("mu", mu, k)
        if patch_radius is not None:
            patch_radius = sizes_of("patch_radius", patch_radius, k, "m")
        if rolling is not None:
            rolling = sizes_of("rolling", rolling, k, "m")
        if ratio is not None:
            patch_radius = np.ascontiguousarray(np.broadcast_to(ratio, (k,)))
        made = kernels.contacts(k, tangents, mu, patch_radius, rolling, sides)
        if made is None:
            if patch_radius is not None:
                check_sizes(REACH, np.broadcast_to(mu, (k,)) * patch_radius, "m")
            raise InputError(f"{k} contacts have more rows than 32-bit numbers count")
        return cls._of(made)

    @property
    def n_blocks(self) -> int:
        """Number of blocks, k."""
        return int(self._blocks.n_blocks)

    @property
    def n_rows(self) -> int:
        """Number of rows, m."""
        return int(self._blocks.n_rows)

    @property
    def is_contact(self) -> npt.NDArray[np.bool_]:
        """(k,) whether a block is a contact: a normal and what it bounds; else it is bounded rows."""
        return np.asarray(self.kind != ROW)

    @property
    def is_free(self) -> bool:
        """Every row is unbounded."""
        return bool(self._blocks.is_free)

    @property
    def is_bounded_rows(self) -> bool:
        """Every row has constant bounds: ROW blocks and contacts of a normal alone."""
        return bool(self._blocks.is_bounded_rows)

    @property
    def has_round(self) -> bool:
        """Some contact has more than two tangents in one cone."""
        return bool(self._blocks.has_round)

    @property
    def has_rolling(self) -> bool:
        """Some contact has two rows that roll, bounded by themselves."""
        return bool(self._blocks.has_rolling)

    @property
    def has_more_parts(self) -> bool:
        """Some contact has more than tangents and a row that spins, each with a bound of its own."""
        return self.has_rolling

    @property
    def is_box(self) -> npt.NDArray[np.bool_]:
        """(k,) whether a contact bounds each of its two tangents by itself."""
        return np.asarray(self.kind == CONTACT_BOX)

    @property
    def has_box(self) -> bool:
        """Some contact bounds each of its two tangents by itself."""
        return bool(self.is_box.any())

    @property
    def is_ellipse(self) -> npt.NDArray[np.bool_]:
        """(k,) whether a contact bounds its two tangents by an ellipse."""
        return np.asarray(self.kind == CONTACT_ELLIPSE)

    @property
    def has_ellipse(self) -> bool:
        """Some contact bounds its two tangents by an ellipse."""
        return bool(self._blocks.has_ellipse)

    @property
    def stretch(self) -> FloatArray:
        """(m,) length of each row where disks bound the same impulses: mu_i / max(mu_1, mu_2) on ellipses, else 1."""
        out, at = np.ones(self.n_rows), np.flatnonzero(self.kind == CONTACT_ELLIPSE)
        q = self.patch_radius[at]
        out[self.ptr[at] + 1] = np.where(q > 1.0, 1.0 / q, 1.0)
        out[self.ptr[at] + 2] = np.where(q > 1.0, 1.0, q)
        return out

    @property
    def disks(self) -> Cones:
        """The same blocks with a disk of the larger coefficient for each ellipse."""
        ellipse = self.kind == CONTACT_ELLIPSE
        return replace(
            self,
            kind=np.where(ellipse, CONTACT, self.kind).astype(np.int32),
            mu=np.where(ellipse, self.coefficients.max(axis=1), self.mu),
            patch_radius=np.where(ellipse, 0.0, self.patch_radius),
        )

    @property
    def is_polyhedral(self) -> bool:
        """No bound is round: every row of friction is bounded by itself, so that Coulomb's law is an LCP."""
        return not bool(np.any(self.n_together > 1))

    @property
    def n_together(self) -> IntArray:
        """(k,) tangent rows of each block that mu lambda_n bounds by their norm, 0 on ROW."""
        return self.n_tangents - (self.kind == CONTACT_BOX)

    @property
    def coefficients(self) -> FloatArray:
        """(k, 2) mu of the first and of the second tangent: mu twice, but of a box or ellipse; 0 on ROW."""
        mu = np.where(self.kind == ROW, 0.0, self.mu)
        second = mu * np.where(np.isin(self.kind, (CONTACT_BOX, CONTACT_ELLIPSE)), self.patch_radius, 1.0)
        return np.stack([np.where(mu <= LEAST_SHARE * second, 0.0, mu), second], axis=1)

    @cached_property
    def n_tangents(self) -> IntArray:
        """(k,) tangent rows of each block, 0 on ROW; rows that spin or roll, each with a bound of its own, are none."""
        own = np.diff(self.ptr) - 1 - (self.kind == CONTACT_SPIN)
        own = np.where(self.kind == CONTACT_ROLLING, 2, own)
        return read_only(np.where(self.kind == ROW, 0, own).astype(np.int32))

    def shaped(self, shape: str) -> Cones:
        """The same blocks with contacts of another shape, "disk" (of two coefficients an ellipse) or "box".

        Raises
        ------
        UnknownName
            No such shape.
        InputError
            A contact of two tangents and spin, or a round cone, as a box; a box without friction along one tangent as a
            disk.
        """
        kind, radius, two = self.kind.copy(), self.patch_radius.copy(), self.n_tangents > 1
        if check_shape("shape", shape) == "box":
            bad = np.flatnonzero(two & ~np.isin(self.kind, (CONTACT, CONTACT_BOX, CONTACT_ELLIPSE)))
            if len(bad):
                raise InputError(
                    f"block {bad[0]} has more rows than a normal and two tangents; no box bounds its spin or rolling"
                )
            kind[two], radius[two & (self.kind == CONTACT)] = CONTACT_BOX, 1.0
        else:
            box = np.flatnonzero(self.kind == CONTACT_BOX)
            ratio = axes_of(self.coefficients[box])[1]
            kind[box] = CONTACT if ratio is None else np.where(ratio == 1.0, CONTACT, CONTACT_ELLIPSE)
            radius[box] = 0.0 if ratio is None else np.where(ratio == 1.0, 0.0, ratio)
        return replace(self, kind=kind, patch_radius=radius)

    @property
    def contact_rows(self) -> npt.NDArray[np.bool_]:
        """(m,) whether a row is a contact's."""
        return np.repeat(self.kind != ROW, np.diff(self.ptr))

    @property
    def friction_rows(self) -> npt.NDArray[np.bool_]:
        """(m,) whether a row is a contact's other than its normal."""
        found = self.contact_rows
        found[self.ptr[:-1]] = False
        return found

    @property
    def normal_rows(self) -> IntArray:
        """(c,) the normal row of each contact."""
        return np.asarray(self.ptr[:-1][self.kind != ROW])

    @cached_property
    def reach(self) -> FloatArray:
        """(m,) largest impulse of each row over lambda_n: mu, mu r on `apart_rows`, mu_r on rolling; 0 on others."""
        size = np.diff(self.ptr)
        out = np.repeat(np.where(self.kind == ROW, 0.0, self.mu), size)
        out[self.ptr[:-1]] = 0.0
        apart, rolling = self.apart_rows >= 0, self.rolling_rows >= 0
        ellipse = self.ptr[:-1][self.kind == CONTACT_ELLIPSE] + 2
        out[ellipse] *= self.patch_radius[self.kind == CONTACT_ELLIPSE]
        out[self.apart_rows[apart]] *= self.patch_radius[apart]
        for k in (0, 1):
            out[self.rolling_rows[rolling] + k] = self.rolling[rolling]
        return read_only(out)

    @cached_property
    def spin_rows(self) -> IntArray:
        """(k,) the spin row of each block, -1 where it has none."""
        spins = (self.kind == CONTACT_SPIN) | ((self.kind == CONTACT_ROLLING) & (np.diff(self.ptr) == 6))
        return read_only(np.where(spins, self.ptr[:-1] + 1 + self.n_tangents, -1).astype(np.int32))

    @cached_property
    def apart_rows(self) -> IntArray:
        """(k,) the row of each block that mu patch_radius lambda_n bounds (spin, second side of a box), -1 without."""
        return read_only(
            np.where(self.kind == CONTACT_BOX, self.ptr[1:] - 1, self.spin_rows).astype(np.int32)
        )

    @cached_property
    def rolling_rows(self) -> IntArray:
        """(k,) the first of the two rows of each block that roll with a bound of their own, -1 where it has none."""
        return read_only(np.where(self.kind == CONTACT_ROLLING, self.ptr[1:] - 2, -1).astype(np.int32))

    def parts(self) -> Iterator[tuple[int, IntArray]]:
        """(block, rows of it that one bound holds together): tangents, then spin or second side, then what rolls."""
        tangents, apart, rolling = self.n_together, self.apart_rows, self.rolling_rows
        for i in np.flatnonzero(self.kind != ROW).tolist():
            first = self.ptr[i] + 1
            if tangents[i]:
                yield i, np.arange(first, first + tangents[i])
            if apart[i] >= 0:
                yield i, apart[i : i + 1]
            if rolling[i] >= 0:
                yield i, np.arange(rolling[i], rolling[i] + 2)

    def take(self, blocks: ArrayLike) -> Cones:
        """Return these blocks, by number or by a mask, in this order; InputError at a number that no block has."""
        try:
            chosen = places(blocks, self.n_blocks, "block")
        except IndexError as error:
            raise InputError(f"blocks: {error}") from None
        return self._take_blocks(np.array(chosen if isinstance(chosen, list) else [chosen], np.int32))

    def _take_blocks(self, blocks: IntArray) -> Cones:
        """`take` of numbers that are known to be those of blocks."""
        size = np.diff(self.ptr)[blocks]
        ptr = np.concatenate([[0], np.cumsum(size)]).astype(np.int32)
        rows = np.arange(ptr[-1]) + np.repeat(self.ptr[:-1][blocks] - ptr[:-1], size)
        return Cones(
            ptr=ptr,
            kind=self.kind[blocks],
            lower=self.lower[rows],
            upper=self.upper[rows],
            mu=self.mu[blocks],
            patch_radius=self.patch_radius[blocks],
            rolling=self.rolling[blocks],
        )

    def __add__(self, other: object) -> Cones:
        """These blocks, then those of `other`."""
        if not isinstance(other, Cones):
            return NotImplemented
        return Cones._joined((self, other))

    def __radd__(self, other: object) -> Cones:
        """What `sum` begins with is 0."""
        return self if other == 0 else NotImplemented

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Cones):
            return NotImplemented
        return all(map(equal, self._blocks.arrays, other._blocks.arrays))

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[Any, ...]:
        # Arrays stay read-only in copies and pickles.
        return type(self), self._blocks.arrays


def kinds_of(
    contact: Any, *, tangents: Any = 0, sides: Any = False, spin: Any = False, rolls: Any = False
) -> IntArray:
    """The kind of each block (k,), by what it is: bounded rows where it is no contact.

    Parameters
    ----------
    contact : (k,) bool
    tangents : int or (k,) int
        In one cone; more than two make a round one.
    sides, spin, rolls : bool or (k,) bool
        Bounds each of two tangents by itself; has a spin row; has two that roll.
    """
    kind = np.where(np.asarray(spin), CONTACT_SPIN, np.where(np.asarray(tangents) > 2, ROUND, CONTACT))
    kind = np.where(sides, CONTACT_BOX, np.where(rolls, CONTACT_ROLLING, kind))
    return np.where(contact, kind, ROW).astype(np.int32)


def _fitting(kind: IntArray, size: IntArray) -> IntArray:
    """The kinds, checked by their rows; a round cone of up to two tangents, or a box of one, is a contact."""
    flat = ((kind == ROUND) & (size <= 3)) | ((kind == CONTACT_BOX) & (size <= 2))
    if flat.any():
        kind = np.where(flat, CONTACT, kind).astype(np.int32)
        kind.flags.writeable = False
    for known, (least, most, name, needed) in SIZES.items():
        bad = np.flatnonzero((kind == known) & ((size < least) | (size > most)))
        if len(bad):
            raise InputError(f"block {bad[0]} is {name} of {size[bad[0]]} rows; {needed}")
    return kind


def project(cones: Cones, impulse: FloatArray) -> FloatArray:
    """Nearest feasible normal and rows, then each part of a contact onto its reach times lambda_n; (m,) [N s].

    This is the feasibility step of a sweep, not the projection onto the friction cone: the normal is
    clipped first and keeps its value.
    """
    if cones.has_ellipse:
        return cones.stretch * project(cones.disks, impulse / cones.stretch)
    out = np.clip(impulse, cones.lower, cones.upper)
    reach = cones.reach
    for i, rows in cones.parts():
        bound, size = reach[rows[0]] * out[cones.ptr[i]], np.hypot.reduce(out[rows])
        if len(rows) == 1:
            out[rows] = np.clip(out[rows], -bound, bound)
        elif size > bound:
            out[rows] *= bound / size
    return out
