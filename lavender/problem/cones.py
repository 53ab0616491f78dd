"""Blocks of a problem: the rows of each block and their bounds.

A block is one or more bounded rows (`ROW`), or a contact: a normal row, 0 to 2 tangent rows, optionally one spin row
(torsional friction), optionally two rolling rows. With lambda [N s] the bounds are

    ROW           lower <= lambda_i <= upper on each of its rows
    CONTACT       0 <= lambda_n,  |lambda_t| <= mu lambda_n
    CONTACT_SPIN  as CONTACT, and |lambda_s| <= mu r lambda_n with the patch radius r [m]
    CONTACT_BOX   0 <= lambda_n,  |lambda_1| <= mu lambda_n,  |lambda_2| <= mu q lambda_n: each of the two tangents has
                  its own bound, as in many engines; q = mu_2 / mu_1 is stored as `patch_radius`
    CONTACT_ELLIPSE  0 <= lambda_n,  |(lambda_1 / mu, lambda_2 / (mu q))| <= lambda_n. The problem is solved and judged
                  in stretched tangents, in which the ellipse is a disk of the larger coefficient (`Problem.disk`)
    ROUND         0 <= lambda_n, |lambda_T| <= mu lambda_n with the norm over three to five tangents: two sliding, one
                  spin, two rolling; each row is scaled by its own coefficient divided by mu, so that mu bounds all rows
    CONTACT_ROLLING  as CONTACT or CONTACT_SPIN with two tangents, and |lambda_r| <= mu_r lambda_n on two rolling rows;
                  mu_r [m] is the distance by which rolling moves the normal force
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import (
    ArrayLike,
    FloatArray,
    IntArray,
    are_equal,
    as_array,
    check_finite_and_in_range,
    check_int,
    check_nonnegative_magnitudes,
    check_not_nan,
    mark_read_only,
    resolve_index,
)
from lavender.base.errors import InputError, check_name
from lavender.problem.derived import cached_property
from lavender.problem.friction import (
    MIN_COEFFICIENT_RATIO,
    SHAPES,
    convert_ellipse_coefficients,
    make_contact_blocks,
    project_impulse,
)
from lavender_ext.core import blocks as kernels
from lavender_ext.core.checks import FAULT_NAMES, are_pointers_valid, make_instance

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
    "get_block_kinds",
    "project_impulse",
]

ROW, CONTACT, CONTACT_SPIN, ROUND, CONTACT_BOX, CONTACT_ROLLING, CONTACT_ELLIPSE = kernels.KINDS

CONES_FIELDS = ("ptr", "kind", "lower", "upper", "mu", "patch_radius", "rolling")
# For each kind of contact: its name, and its permitted rows, for messages.
CONTACT_ROWS = {
    CONTACT: (
        "a contact",
        "a normal and up to two tangents are allowed; a spin row needs CONTACT_SPIN",
    ),
    CONTACT_SPIN: (
        "a contact with spin",
        "a normal, up to two tangents and one spin row are allowed",
    ),
    ROUND: (
        "a round cone",
        "a normal and three to five tangents (2 sliding, 1 spin, 2 rolling) are allowed",
    ),
    CONTACT_BOX: ("a box", "a normal and two tangents are needed"),
    CONTACT_ROLLING: (
        "a contact with rolling",
        "a normal, two tangents, optionally a spin row, and two rolling rows are needed: 5 or 6",
    ),
    CONTACT_ELLIPSE: ("an ellipse", "a normal and two tangents are needed"),
}


@dataclass(frozen=True, eq=False, repr=False, init=False)
class Cones:
    """Bounds of k blocks with m rows, built by `Cones.free`, `Cones.bounded` and `Cones.contacts`, joined by `+`.

    Parameters
    ----------
    ptr : (k + 1,) int
        First row of each block, followed by m.
    kind : (k,) int
        Kind of each block: ROW, CONTACT, CONTACT_SPIN, ROUND, CONTACT_BOX, CONTACT_ROLLING or CONTACT_ELLIPSE.
    lower, upper : (m,) N s
        Bounds of the rows of ROW blocks, possibly infinite. The entries of contacts are not read.
    mu : (k,) -
        Coefficient of friction of each contact.
    patch_radius : (k,) m
        Contacts with spin: r; the spin row is bounded by mu r lambda_n [N m s]. CONTACT_BOX and CONTACT_ELLIPSE:
        mu_2 / mu_1 [-].
    rolling : (k,) m, optional
        mu_r of CONTACT_ROLLING: the rolling impulse is bounded by mu_r lambda_n [N m s] (Acary, Bourrier, Viano 2023).
        Default: 0.

    Raises
    ------
    InputError
        Shapes disagree; lower > upper or NaN bounds; a negative mu, patch radius or mu_r; a contact has more rows than
        its kind allows; a round cone has more than five tangents.

    Examples
    --------
    A hinge of five rows, a motor of up to 2 N s, and two contacts of one normal and two tangents each:

    >>> import lavender as lv
    >>> cones = lv.Cones.free(5) + lv.Cones.bounded([-2.0], [2.0]) + lv.Cones.contacts(0.5, count=2)
    >>> cones.n_blocks, cones.n_rows
    (8, 12)
    >>> cones.ptr.tolist()  # each free row is a separate block
    [0, 1, 2, 3, 4, 5, 6, 9, 12]
    >>> cones.mu[-2:].tolist(), cones.upper[5].item()
    ([0.5, 0.5], 2.0)
    """

    ptr: IntArray
    kind: IntArray
    lower: FloatArray
    upper: FloatArray
    mu: FloatArray
    patch_radius: FloatArray
    rolling: FloatArray
    _blocks: ClassVar[
        kernels.Blocks
    ]  # Set on each instance: the arrays of the fields as kernels read them.

    def __init__(
        self,
        ptr: ArrayLike,
        kind: ArrayLike,
        lower: ArrayLike,
        upper: ArrayLike,
        mu: ArrayLike,
        patch_radius: ArrayLike,
        rolling: ArrayLike | None = None,
    ) -> None:
        rolling = np.zeros(np.size(kind)) if rolling is None else rolling
        fields: tuple[Any, ...] = (ptr, kind, lower, upper, mu, patch_radius, rolling)
        blocks = kernels.make_blocks_from_copied_arrays(*fields)
        if blocks is None or blocks.fault:
            fields = _convert_fields(*fields)
            blocks = kernels.make_blocks_from_copied_arrays(*fields)
            if blocks.fault:
                _raise_fault(FAULT_NAMES[blocks.fault], int(blocks.index), fields)
        self.__dict__["_blocks"] = blocks

    if (
        not TYPE_CHECKING
    ):  # Hide `__getattr__` from type checkers, so that they report unknown names.

        def __getattr__(self, name: str) -> Any:
            # The arrays of the fields are created when one of them is first read.
            if name not in CONES_FIELDS:
                raise AttributeError(
                    f"'Cones' object has no attribute {name!r}", name=name, obj=self
                )
            self.__dict__.update(zip(CONES_FIELDS, self._blocks.arrays, strict=True))
            return self.__dict__[name]

    @classmethod
    def _from_blocks(cls, blocks: kernels.Blocks) -> Cones:
        """Wrap blocks; raise InputError if they have a fault."""
        if blocks.fault:
            _raise_fault(FAULT_NAMES[blocks.fault], int(blocks.index), blocks.arrays)
        return make_instance(cls, {"_blocks": blocks})

    @classmethod
    def _concatenate(cls, cones: Iterable[Cones]) -> Cones:
        """Concatenate the blocks of several cones."""
        blocks = kernels.concatenate_blocks([each._blocks for each in cones])
        if blocks is None:
            raise InputError(
                "the blocks together have more than 2^31 - 1 rows; 32-bit indices are needed"
            )
        return cls._from_blocks(blocks)

    def __repr__(self) -> str:
        contacts = int(np.count_nonzero(self.is_contact))
        return f"<Cones of {contacts} contacts and {len(self.kind) - contacts} other blocks, {self.ptr[-1]} rows>"

    @classmethod
    def bounded(cls, lower: ArrayLike, upper: ArrayLike) -> Cones:
        """Build one ROW block for each pair of bounds, lower <= lambda <= upper.

        Parameters
        ----------
        lower : (m,), N s
        upper : (m,) or scalar, N s

        Raises
        ------
        InputError
            The shapes differ, or no number lies between two bounds.
        """
        blocks = kernels.make_bounded_rows(lower, upper)
        if blocks is not None:
            return cls._from_blocks(blocks)
        low = as_array("lower", lower, (None,), finite=False, unit="N s")
        m = len(low)
        high = as_array("upper", upper, (m,), finite=False, unit="N s")
        return cls(np.arange(m + 1), np.zeros(m), low, high, np.zeros(m), np.zeros(m))

    @classmethod
    def free(cls, m: int) -> Cones:
        """Build m unbounded rows, each a separate block: a linear system."""
        return cls._from_blocks(kernels.make_free_rows(check_int("m", m, high=2**31 - 2)))

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
        """Build k contacts with the same rows: normal, tangents, spin if `patch_radius` is given, two rolling rows.

        Parameters
        ----------
        mu : scalar, (k,) or (k, 2), -
            Coefficient of each contact, or of each of its two tangents: the semi-axes of an ellipse,
            |(lambda_1 / mu_1, lambda_2 / mu_2)| <= lambda_n, or the half sides of a box.
        tangents : int, 0 to 5
            More than two form one round cone (ROUND), which has no patch radius.
        patch_radius : scalar or (k,) m, optional
        rolling : scalar or (k,) m, optional
            mu_r: adds two rows for rolling about the two tangents, |lambda_r| <= mu_r lambda_n.
        count : int, optional
            k, if mu is a scalar. Default: 1.
        shape : {"disk", "box"}
            Bound of two tangents: |lambda_t| <= mu lambda_n, or |lambda_i| <= mu_i lambda_n for each, as in many
            engines, which permits up to sqrt(2) times the impulse on the diagonal.

        Returns
        -------
        Cones

        Raises
        ------
        InputError
            A coefficient is negative, the shapes disagree, or this combination of rows has no kind.

        Examples
        --------
        Four skates with little friction along the first tangent and much along the second, as ellipses and as boxes:

        >>> import lavender as lv
        >>> skates = lv.Cones.contacts([(0.02, 0.8)] * 4)
        >>> skates.n_rows, skates.coefficients[0].tolist()
        (12, [0.02, 0.8])
        >>> skates.shaped("box") == lv.Cones.contacts([(0.02, 0.8)] * 4, shape="box")
        True
        """
        return cls._from_blocks(
            make_contact_blocks(mu, tangents, patch_radius, rolling, count, shape)
        )

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
        """Whether each block (k,) is a contact; else it consists of bounded rows."""
        return np.asarray(self.kind != ROW)

    @property
    def is_free(self) -> bool:
        """Whether every row is unbounded."""
        return bool(self._blocks.is_free)

    @property
    def is_bounded_rows(self) -> bool:
        """Whether every row has constant bounds, as in ROW blocks and contacts with only a normal row."""
        return bool(self._blocks.is_bounded_rows)

    @property
    def has_round(self) -> bool:
        """Whether a contact has more than two tangents in one cone."""
        return bool(self._blocks.has_round)

    @property
    def has_rolling(self) -> bool:
        """Whether a contact has two rolling rows with a separate bound (CONTACT_ROLLING)."""
        return bool(self._blocks.has_rolling)

    @property
    def is_box(self) -> npt.NDArray[np.bool_]:
        """Whether each block (k,) is a contact with a separate bound for each of two tangents."""
        return np.asarray(self.kind == CONTACT_BOX)

    @property
    def has_box(self) -> bool:
        """Whether a contact has a separate bound for each of two tangents."""
        return bool(self.is_box.any())

    @property
    def is_ellipse(self) -> npt.NDArray[np.bool_]:
        """Whether each block (k,) is a contact that bounds its two tangents by an ellipse."""
        return np.asarray(self.kind == CONTACT_ELLIPSE)

    @property
    def has_ellipse(self) -> bool:
        """Whether a contact bounds its two tangents by an ellipse."""
        return bool(self._blocks.has_ellipse)

    @property
    def stretch(self) -> FloatArray:
        """Factor of each row (m,) that converts ellipses to disks: mu_i / max(mu_1, mu_2) on tangents, else 1."""
        factor = np.ones(self.n_rows)
        ellipses = np.flatnonzero(self.kind == CONTACT_ELLIPSE)
        q = self.patch_radius[ellipses]
        factor[self.ptr[ellipses] + 1] = np.where(q > 1.0, 1.0 / q, 1.0)
        factor[self.ptr[ellipses] + 2] = np.where(q > 1.0, 1.0, q)
        return factor

    @property
    def ellipses_replaced_by_disks(self) -> Cones:
        """These blocks, with each ellipse replaced by a disk of its larger coefficient."""
        ellipse = self.is_ellipse
        kind = np.where(ellipse, CONTACT, self.kind)
        radius = np.where(ellipse, 0.0, self.patch_radius)
        mu = np.where(ellipse, self.coefficients.max(axis=1), self.mu)
        return replace(self, kind=kind, mu=mu, patch_radius=radius)

    @property
    def is_polyhedral(self) -> bool:
        """Whether every friction row has a separate bound, so that Coulomb's law is an LCP."""
        return not bool(np.any(self.n_together > 1))

    @property
    def n_together(self) -> IntArray:
        """Number of tangent rows of each block (k,) with the bound mu lambda_n of their norm; 0 for ROW."""
        return self.n_tangents - (self.kind == CONTACT_BOX)

    @property
    def coefficients(self) -> FloatArray:
        """Coefficients (k, 2) of the first and second tangent; they differ for boxes and ellipses; 0 for ROW."""
        mu = np.where(self.kind == ROW, 0.0, self.mu)
        second = mu * np.where(
            np.isin(self.kind, (CONTACT_BOX, CONTACT_ELLIPSE)), self.patch_radius, 1.0
        )
        return np.stack([np.where(mu <= MIN_COEFFICIENT_RATIO * second, 0.0, mu), second], axis=1)

    @cached_property
    def n_tangents(self) -> IntArray:
        """Number of tangent rows of each block (k,), 0 for ROW; spin and rolling rows count only in a round cone."""
        count = np.diff(self.ptr) - 1 - (self.kind == CONTACT_SPIN)
        count = np.where(self.kind == CONTACT_ROLLING, 2, count)
        return mark_read_only(np.where(self.kind == ROW, 0, count).astype(np.int32))

    def shaped(self, shape: str) -> Cones:
        """Return these blocks with another shape of friction.

        Parameters
        ----------
        shape : {"disk", "box"}
            A box with two different coefficients becomes an ellipse with "disk".

        Raises
        ------
        UnknownName
            The shape is unknown.
        InputError
            `shape` is "box", and a contact has two tangents and spin, or is a round cone; or `shape` is "disk", and a
            box has no friction along one tangent.
        """
        kind = self.kind.copy()
        radius = self.patch_radius.copy()
        has_pair = self.n_tangents > 1
        if check_name("shape", shape, SHAPES) == "box":
            bad = np.flatnonzero(
                has_pair & ~np.isin(self.kind, (CONTACT, CONTACT_BOX, CONTACT_ELLIPSE))
            )
            if len(bad):
                raise InputError(
                    f"block {bad[0]} has spin, rolling or over two tangents, which no box has"
                )
            kind[has_pair] = CONTACT_BOX
            radius[has_pair & (self.kind == CONTACT)] = 1.0
        else:
            box = np.flatnonzero(self.kind == CONTACT_BOX)
            ratio = convert_ellipse_coefficients(self.coefficients[box])[1]
            kind[box] = (
                CONTACT if ratio is None else np.where(ratio == 1.0, CONTACT, CONTACT_ELLIPSE)
            )
            radius[box] = 0.0 if ratio is None else np.where(ratio == 1.0, 0.0, ratio)
        return replace(self, kind=kind, patch_radius=radius)

    @property
    def contact_rows(self) -> npt.NDArray[np.bool_]:
        """Whether each row (m,) belongs to a contact."""
        return np.repeat(self.kind != ROW, np.diff(self.ptr))

    @property
    def friction_rows(self) -> npt.NDArray[np.bool_]:
        """Whether each row (m,) is a friction row: a row of a contact other than its normal."""
        mask = self.contact_rows
        mask[self.ptr[:-1]] = False
        return mask

    @cached_property
    def angular_rows(self) -> npt.NDArray[np.bool_]:
        """Whether each row (m,) is a spin or rolling row, so that its velocity is angular."""
        mask = np.zeros(self.n_rows, bool)
        rolling = self.rolling_rows[self.rolling_rows >= 0]
        mask[np.concatenate([self.spin_rows[self.spin_rows >= 0], rolling, rolling + 1])] = True
        return mark_read_only(mask)

    @property
    def normal_rows(self) -> IntArray:
        """Normal row of each contact (c,)."""
        return np.asarray(self.ptr[:-1][self.kind != ROW])

    @cached_property
    def friction_coefficient(self) -> FloatArray:
        """Friction coefficient of each row (m,): mu, mu r on `separate_rows` [m], mu_r on rolling rows [m], else 0."""
        size = np.diff(self.ptr)
        coefficient = np.repeat(np.where(self.kind == ROW, 0.0, self.mu), size)
        coefficient[self.ptr[:-1]] = 0.0
        has_apart, has_rolling = self.separate_rows >= 0, self.rolling_rows >= 0
        ellipse = self.ptr[:-1][self.kind == CONTACT_ELLIPSE] + 2
        coefficient[ellipse] *= self.patch_radius[self.kind == CONTACT_ELLIPSE]
        coefficient[self.separate_rows[has_apart]] *= self.patch_radius[has_apart]
        for k in (0, 1):
            coefficient[self.rolling_rows[has_rolling] + k] = self.rolling[has_rolling]
        return mark_read_only(coefficient)

    @cached_property
    def spin_rows(self) -> IntArray:
        """Spin row of each block (k,), -1 if it has none."""
        has_spin = (self.kind == CONTACT_SPIN) | (
            (self.kind == CONTACT_ROLLING) & (np.diff(self.ptr) == 6)
        )
        return mark_read_only(
            np.where(has_spin, self.ptr[:-1] + 1 + self.n_tangents, -1).astype(np.int32)
        )

    @cached_property
    def separate_rows(self) -> IntArray:
        """Row of each block (k,) with the bound mu patch_radius lambda_n: spin, second tangent of a box; -1 if none."""
        rows = np.where(self.kind == CONTACT_BOX, self.ptr[1:] - 1, self.spin_rows)
        return mark_read_only(rows.astype(np.int32))

    @cached_property
    def rolling_rows(self) -> IntArray:
        """First of the two separately bounded rolling rows of each block (k,), -1 if it has none."""
        return mark_read_only(
            np.where(self.kind == CONTACT_ROLLING, self.ptr[1:] - 2, -1).astype(np.int32)
        )

    def friction_components(self) -> Iterator[tuple[int, IntArray]]:
        """Yield (block, rows) of each friction component: rows with one bound of their norm.

        A contact has up to three: tangents, then spin or the second tangent of a box, then rolling.
        """
        tangents, apart, rolling = self.n_together, self.separate_rows, self.rolling_rows
        for i in np.flatnonzero(self.kind != ROW).tolist():
            first = self.ptr[i] + 1
            if tangents[i]:
                yield i, np.arange(first, first + tangents[i])  # pyright: ignore[reportArgumentType, reportCallIssue]
            if apart[i] >= 0:
                yield i, apart[i : i + 1]
            if rolling[i] >= 0:
                yield i, np.arange(rolling[i], rolling[i] + 2)  # pyright: ignore[reportArgumentType, reportCallIssue]

    def select(self, blocks: ArrayLike) -> Cones:
        """Return the selected blocks in the given order.

        Parameters
        ----------
        blocks : int, sequence of int, or mask (k,)

        Raises
        ------
        InputError
            A block does not exist.
        """
        try:
            indices = resolve_index(blocks, self.n_blocks, "block")
        except IndexError as error:
            raise InputError(f"blocks: {error}") from None
        return self._select_blocks(np.atleast_1d(np.array(indices, np.int32)))

    def _select_blocks(self, blocks: IntArray) -> Cones:
        """Return the blocks with these indices, which are not checked."""
        size = np.diff(self.ptr)[blocks]
        ptr = np.concatenate([[0], np.cumsum(size)]).astype(np.int32)
        rows = np.arange(ptr[-1]) + np.repeat(self.ptr[:-1][blocks] - ptr[:-1], size)
        kind, mu, radius, rolling = (
            x[blocks] for x in (self.kind, self.mu, self.patch_radius, self.rolling)
        )
        return Cones(ptr, kind, self.lower[rows], self.upper[rows], mu, radius, rolling)

    def __add__(self, other: object) -> Cones:
        """Append the blocks of `other`."""
        if not isinstance(other, Cones):
            return NotImplemented
        return Cones._concatenate((self, other))

    def __radd__(self, other: object) -> Cones:
        """Support `sum`, which starts with 0."""
        return self if other == 0 else NotImplemented

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Cones):
            return NotImplemented
        return all(map(are_equal, self._blocks.arrays, other._blocks.arrays))

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[Any, ...]:
        # Copies and pickles are built by the constructor, which marks their arrays read-only.
        return type(self), self._blocks.arrays


def _convert_fields(
    ptr: Any, kind: Any, lower: Any, upper: Any, mu: Any, patch_radius: Any, rolling: Any
) -> tuple[np.ndarray, ...]:
    """Convert the fields to arrays of the required types and shapes; raise InputError for invalid ones."""
    ptr = as_array("cones.ptr", ptr, (None,), dtype=np.int32)
    if not are_pointers_valid(ptr, 1):
        raise InputError(f"cones.ptr is {ptr.tolist()!s:.60}; it must start with 0 and increase")
    k = len(ptr) - 1
    m = int(ptr[-1])
    kind = as_array("cones.kind", kind, (k,), dtype=np.int32)
    if k and not np.isin(kind, kernels.KINDS).all():
        raise InputError(
            f"cones.kind holds {sorted(set(kind.tolist()))}; the kinds are ROW=0, CONTACT=1, CONTACT_SPIN=2, ROUND=3, "
            f"CONTACT_BOX={CONTACT_BOX}, CONTACT_ROLLING={CONTACT_ROLLING} and CONTACT_ELLIPSE={CONTACT_ELLIPSE}"
        )
    size = np.diff(ptr)
    # A round cone of up to two tangents, or a box of one, is a CONTACT.
    is_disk = ((kind == ROUND) & (size <= 3)) | ((kind == CONTACT_BOX) & (size <= 2))
    if is_disk.any():
        kind = mark_read_only(np.where(is_disk, CONTACT, kind).astype(np.int32))
    lower = as_array("lower", lower, (m,), finite=False, unit="N s")
    upper = as_array("upper", upper, (m,), finite=False, unit="N s")
    check_not_nan("lower", lower)
    check_not_nan("upper", upper)
    mu = as_array("mu", mu, (k,), unit="-")
    radius = as_array("patch_radius", patch_radius, (k,), unit="m")
    rolling = as_array("rolling", rolling, (k,), unit="m")
    return ptr, kind, lower, upper, mu, radius, rolling


def get_block_kinds(
    is_contact: Any, *, tangents: Any = 0, box: Any = False, spin: Any = False, rolling: Any = False
) -> IntArray:
    """Return the kind of each block (k,); blocks that are not contacts are ROW.

    Parameters
    ----------
    is_contact : (k,) bool
    tangents : int or (k,) int
        Number of tangents in one cone; more than two form a round cone.
    box, spin, rolling : bool or (k,) bool
        Whether each of two tangents has its own bound; whether the contact has a spin row; two rolling rows.
    """
    kind = np.where(
        np.asarray(spin), CONTACT_SPIN, np.where(np.asarray(tangents) > 2, ROUND, CONTACT)
    )
    kind = np.where(box, CONTACT_BOX, np.where(rolling, CONTACT_ROLLING, kind))
    return np.where(is_contact, kind, ROW).astype(np.int32)


def _raise_fault(fault: str, index: int, fields: tuple[np.ndarray, ...]) -> NoReturn:
    """Raise the InputError of a fault (`lavender_ext/core/faults.pxd`) of a block or row."""
    ptr, kind, lower, upper, mu, radius, rolling = fields
    if fault == "kind":
        name, requirement = CONTACT_ROWS[int(kind[index])]
        raise InputError(
            f"block {index} is {name} of {ptr[index + 1] - ptr[index]} rows; {requirement}"
        )
    if fault == "bounds":
        raise InputError(
            f"row {index}: lower = {lower[index]}, upper = {upper[index]}; a finite number between is needed"
        )
    if fault == "ratio":
        raise InputError(
            f"block {index} has mu_2 / mu_1 = {radius[index]:g}; 1e-18 to 1e18 is needed"
        )
    if fault in ("lower", "upper"):
        bound = lower if fault == "lower" else upper
        is_unread = np.isinf(bound) | np.repeat(kind != ROW, np.diff(ptr))
        check_finite_and_in_range(fault, np.where(is_unread, 0.0, bound), "N s")
    product = np.where(kind == ROW, 0.0, mu * radius)
    for name, x, unit in (
        ("mu", mu, "-"),
        ("patch_radius", radius, "m"),
        ("mu patch_radius (of boxes and ellipses mu_2)", product, "m"),
        ("rolling", rolling, "m"),
    ):
        check_nonnegative_magnitudes(name, x, unit)
    raise InputError(f"block {index} is invalid: {fault}")
