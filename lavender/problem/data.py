"""Fields of a `Problem`: validation, sizes, names of blocks and rows, equality and pickling."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lavender.base.arrays import (
    ArrayLike,
    FloatArray,
    are_equal,
    as_array,
    as_csr,
    as_names,
    check_choice,
    check_finite,
    check_finite_and_in_range,
    check_int,
    check_nonnegative_magnitudes,
    check_unmasked,
    format_html_table,
    get_labels,
    get_shape,
    mark_read_only,
)
from lavender.base.errors import InputError
from lavender.base.lazy_import import issparse
from lavender.problem.cones import Cones
from lavender.problem.derived import Derived, cached_property, late_field
from lavender.problem.engine_record import EngineRecord
from lavender.problem.generalized import Generalized
from lavender.problem.rows import Rows
from lavender_ext.core.blocks import are_joints_then_contacts
from lavender_ext.core.checks import MIN_MAGNITUDE, is_rhs_valid
from lavender_ext.core.problem import LAWS as FRICTION_NUMBER
from lavender_ext.core.problem import make_generalized_data
from lavender_ext.judge import measure

FRICTION_LAWS = tuple(FRICTION_NUMBER)
# Friction laws. A law contains the laws before it, but neither of the last two contains the other. A solver that
# supports a law supports the laws that it contains.
LAWS = ("linear", "lcp", "coulomb", "cone")
# Forms of A: rows of bodies, a matrix, or J and M in generalised coordinates.
OPERATORS = ("rows", "matrix", "generalized")
# Precisions in which a problem's data were computed, and in which its solutions are computed.
PRECISIONS = ("float64", "float32")


class Names(Sequence[str]):
    """Names of blocks that are created at their first use; equal to a tuple of the same names.

    Parameters
    ----------
    count : int
        Number of names.
    make_names : callable
        Function that returns the names.
    """

    def __init__(self, count: int, make_names: Callable[[], Sequence[str]]) -> None:
        self._count, self._make_names = count, make_names

    @cached_property
    def _names(self) -> tuple[str, ...]:
        return tuple(self._make_names())

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, i: Any) -> Any:
        return self._names[i]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, (Names, tuple)) and self._names == tuple(other)

    def __hash__(self) -> int:
        return hash(self._names)

    def __reduce__(self) -> tuple[Any, ...]:
        return tuple, (self._names,)


@dataclass(frozen=True, eq=False, init=False)
class ProblemData:
    """Checked fields of a `Problem`; derived classes compute everything that follows from them."""

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
    precision: str = ""
    qp: Any = field(default=None, repr=False, compare=False)
    angular: Any = None
    derived: Derived = field(init=False, repr=False)
    #: The engine's answer to the step, if an importer made the problem.
    record: EngineRecord | None = field(default=None, init=False, repr=False, compare=False)

    def __init__(
        self,
        b: ArrayLike,
        cones: Cones,
        matrix: Any = None,
        rows: Rows | None = None,
        friction: str = "coulomb",
        compliance: ArrayLike | None = None,
        guess: ArrayLike | None = None,
        key: Any = None,
        names: Sequence[str] | None = None,
        name: str = "",
        copy: bool = True,
        generalized: Generalized | None = None,
        precision: str = "",
        qp: Any = None,
        angular: ArrayLike | None = None,
    ) -> None:
        if not isinstance(cones, Cones):
            raise InputError(
                f"cones is a {type(cones).__name__}; a lavender.Cones is needed: Cones.contacts"
            )
        m, k = cones.n_rows, cones.n_blocks
        rhs = as_array("b", b, (m,), unit="m/s", copy=copy)
        check_rhs(rhs)
        missing = (matrix is None) + (rows is None) + (generalized is None)
        if missing != 2:
            raise InputError(
                f"{3 - missing} of matrix=, rows= and generalized= are given; one is needed"
            )
        if not isinstance(friction, str) or friction not in FRICTION_LAWS:
            hint = " (a separate bound for each tangent is a shape of the contacts: shape='box')"
            is_shape = isinstance(friction, str) and friction in ("box", "pyramid", "pyramidal")
            raise InputError(
                f"friction is {friction!r}; 'coulomb' or 'cone' is needed{hint if is_shape else ''}"
            )
        friction = str(friction)  # NumPy's strings have another repr.
        if precision is None or (isinstance(precision, str) and not precision):
            precision = getattr(rows, "precision", "float64")
        if type(precision) is not str or precision != "float64":
            precision = check_choice("precision", precision, PRECISIONS)
        if friction != "cone" and cones.has_round:
            raise InputError("a round cone of more than two tangents needs friction='cone'")
        # `copy` applies to this call only: problems derived from this one copy by default.
        fields = self.__dict__
        fields.update(
            {
                "b": rhs,
                "cones": cones,
                "matrix": matrix,
                "rows": rows,
                "friction": friction,
                "compliance": None,
                "guess": None,
                "key": None,
                "names": names,
                "name": str(name),
                "copy": True,
                "generalized": generalized,
                "precision": precision,
                "qp": qp,
                "angular": angular,
                "derived": Derived(),
                "law": _find_law(cones, friction),
            }
        )
        if matrix is None:
            soft = 0.0 if compliance is None else compliance
            fields["compliance"] = as_array("compliance", soft, (m,), unit="1/kg", copy=copy)
            check_nonnegative_magnitudes("compliance", fields["compliance"], "1/kg")
        elif compliance is not None:
            raise InputError("compliance is given with a matrix A: add it to the diagonal")
        if rows is not None:
            self._check_rows(rows, k)
        elif generalized is not None:
            if not isinstance(generalized, Generalized):
                raise InputError(
                    f"generalized is a {type(generalized).__name__}; a Generalized is needed"
                )
            if generalized.m != m:
                raise InputError(f"J has {generalized.m} rows; {m} are needed, as the cones have")
            self._set_view()
        else:
            matrix = fields["matrix"] = check_matrix(matrix, m, copy)
            if issparse(matrix):
                # Store the checked arrays separately, because callers can replace the arrays of the matrix object.
                fields["_compressed"] = (matrix.indptr, matrix.indices, matrix.data)
        if guess is not None:
            fields["guess"] = as_array("guess", guess, (m,), finite=False, unit="N s", copy=copy)
            check_finite("guess [N s]", fields["guess"])
        if key is not None:
            fields["key"] = convert_keys(key, k)
        if angular is not None:
            flags = as_array("angular", angular, (m,))
            others = flags[(flags != 0.0) & (flags != 1.0)]
            if len(others):
                raise InputError(f"angular holds {others[0]:g}; True or False is needed")
            fields["angular"] = mark_read_only(flags.astype(bool))
        if names is not None and not (isinstance(names, Names) and len(names) == k):
            fields["names"] = as_names("blocks", names, k)
        self._check_magnitudes()

    def _check_magnitudes(self) -> None:
        """Raise InputError if an entry of A's diagonal may be too large."""

    def _check_rows(self, rows: Rows, k: int) -> None:
        """Raise InputError if the rows do not fit the cones of k blocks."""
        if not isinstance(rows, Rows):
            raise InputError(f"rows is a {type(rows).__name__}; a Rows is needed")
        kj = rows.n_joints
        if kj + rows.n_contacts == k and are_joints_then_contacts(
            self.cones._blocks, rows.joint_ptr
        ):
            return
        contact = self.cones.is_contact
        if (
            kj + rows.n_contacts != k
            or contact[:kj].any()
            or not contact[kj:].all()
            or self.cones.has_round
        ):
            raise InputError(
                f"rows has {kj} joints and {rows.n_contacts} contacts, and cones has {k} blocks; a block of "
                "bounded rows for each joint, then a contact block (not ROUND) for each contact are needed"
            )
        raise InputError(
            f"cones.ptr begins with {self.cones.ptr[: kj + 1].tolist()!s:.60} and rows.joint_ptr is "
            f"{rows.joint_ptr.tolist()!s:.60}; cones.ptr must begin with rows.joint_ptr"
        )

    def _set_view(self) -> None:
        """Set the view for kernels of a problem in generalised coordinates."""
        assert self.generalized is not None
        law = FRICTION_NUMBER[self.friction]
        data = self.cones._blocks, self.b, self.generalized.operator, self.compliance, law
        self.derived.view = make_generalized_data(*data)

    # -- size and kind --------------------------------------------------------------------------

    @property
    def m(self) -> int:
        """Number of rows."""
        return len(self.b)

    @property
    def operator(self) -> str:
        """Form of A: "rows", "matrix" or "generalized" (see `OPERATORS`)."""
        return (
            "rows"
            if self.rows is not None
            else "matrix"
            if self.generalized is None
            else "generalized"
        )

    @property
    def has_singular_program(self) -> bool:
        """Whether this is a quadratic program with a singular P, which only solvers of quadratic programs accept."""
        return self.qp is not None and self.qp.is_singular

    @property
    def n_blocks(self) -> int:
        """Number of blocks, k."""
        return self.cones.n_blocks

    @cached_property
    def law(self) -> str:
        """Problem class, determined by the blocks: "linear", "lcp", "coulomb" or "cone"."""
        return _find_law(self.cones, self.friction)

    if TYPE_CHECKING:

        def carry(self, previous: Any, keys: Any = None) -> FloatArray: ...  # noqa: D102

    def make_start(self, impulse: Any, name: str = "impulse", finite: bool = True) -> FloatArray:
        """Return the impulse (m,) [N s] that an argument `impulse=` of any function means, as a writable array.

        Parameters
        ----------
        impulse : (m,) N s, Solution, or (Problem, impulse)
            Impulses of an earlier problem are assigned to the blocks by their keys (`carry`). A pandas Series is
            aligned by its index, which has the numbers or the names of all rows (`row_name`).
        name : str
            Name of the argument in messages.
        finite : bool
            Whether to reject numbers that are not finite.

        Raises
        ------
        InputError
            The array has a wrong shape or is not finite, or the impulses cannot be assigned to the blocks.
        """
        if (
            type(impulse) is np.ndarray
            and impulse.dtype == np.float64
            and impulse.shape == self.b.shape
        ):
            copied = impulse.copy()
            if not finite or measure.all_finite(copied):
                return copied
        is_pair = (
            isinstance(impulse, tuple) and len(impulse) == 2 and isinstance(impulse[0], ProblemData)
        )
        if is_pair or (hasattr(impulse, "impulse") and hasattr(impulse, "residual")):
            return self.carry(impulse)
        if (labels := get_labels(impulse)) is not None:
            impulse = self._align_by_row(name, impulse, labels)
        shape = get_shape(name, impulse)
        if len(shape) == 1 and shape != self.b.shape and name == "impulse":
            raise InputError(
                f"impulse [N s] has shape {shape}; {self.b.shape} is needed. If it is from a step with other contacts, "
                "give the solution of that step: its impulses are assigned to blocks by their keys"
            )
        array = as_array(name, impulse, (self.m,), finite=False, unit="N s")
        if finite:
            check_finite(f"{name} [N s]", array)
        return array.copy()

    def _align_by_row(self, name: str, series: Any, labels: Sequence[Any]) -> np.ndarray:
        """Return the numbers of a pandas Series in the order of the rows, by its labels: numbers or names of rows."""
        values, places = np.asarray(series), {label: i for i, label in enumerate(labels)}
        names = [self.row_name(i) for i in range(self.m)]
        for wanted in (range(self.m), names):
            if len(places) == len(labels) == self.m == len(set(wanted)) and all(
                label in places for label in wanted
            ):
                return values[[places[label] for label in wanted]]
        unknown = [x for x in labels if x not in names and x not in range(self.m)]
        reason = (
            f"the label {unknown[0]!r}, which is no row"
            if unknown
            else "no label, or two, for a row"
        )
        raise InputError(
            f"{name} [N s] is a {type(series).__name__} whose index has {reason}; the numbers 0 to {self.m - 1} or the "
            f"names of all rows are needed, such as {names[0] if names else 'row 0'!r} (problem.row_name), or an array"
        )

    # -- names -----------------------------------------------------------------------------------

    def block_of(self, row: int) -> int:
        """Return the block of a row.

        Raises
        ------
        InputError
            The problem has no such row.
        """
        row = check_int("row", row, high=self.m - 1)
        return int(np.searchsorted(self.cones.ptr, row, side="right")) - 1

    def block_name(self, block: int) -> str:
        """Return the name of a block, e.g. "hinge 7" or "contact 3".

        Raises
        ------
        InputError
            The problem has no such block.
        """
        block = check_int("block", block, high=self.n_blocks - 1)
        return (
            self.names[block]
            if self.names
            else self.row_name(int(self.cones.ptr[block])).rsplit(", ", 1)[0]
        )

    def row_name(self, row: int) -> str:
        """Return the name of a row, e.g. "hinge 7, axis 2" or "contact 3, tangent 1".

        Raises
        ------
        InputError
            The problem has no such row.
        """
        block = self.block_of(row)
        offset = row - int(self.cones.ptr[block])
        size = int(np.diff(self.cones.ptr)[block])
        spin, roll = self.cones.spin_rows[block], self.cones.rolling_rows[block]
        if not self.cones.is_contact[block]:
            name = (
                self.names[block] if self.names else f"row {row}" if size == 1 else f"joint {block}"
            )
            return name if size == 1 else f"{name}, axis {offset}"
        first_contact = 0 if self.rows is None else self.rows.n_joints
        if self.generalized is not None:
            first_contact = block - int(np.count_nonzero(self.cones.is_contact[:block]))
        name = self.names[block] if self.names else f"contact {block - first_contact}"
        if offset == 0:
            return f"{name}, normal"
        if self.cones.n_together[block] > 2 and offset > 2:
            return f"{name}, spin" if offset == 3 else f"{name}, roll {offset - 3}"
        if 0 <= roll <= row:
            return f"{name}, roll {row - roll + 1}"
        return f"{name}, spin" if row == spin else f"{name}, tangent {offset}"

    @cached_property
    def angular_rows(self) -> npt.NDArray[np.bool_]:
        """Whether the velocity of each row (m,) is angular [rad/s].

        Spin and rolling rows are, rows of joints without a linear part, and the rows that the field `angular` declares.
        """
        mask = np.zeros(self.m, bool) if self.angular is None else self.angular.copy()
        mask |= self.cones.angular_rows
        if self.rows is not None:
            linear = self.rows.jac.reshape(-1, 4, 3)[:, ::2]
            mask[: len(linear)] |= ~linear.any(axis=(1, 2)) & self.rows.jac.any(axis=1)
        return mark_read_only(mask)

    def row_unit(self, row: int) -> str:
        """Return the unit of a row's velocity error: "m/s", or "rad/s" on an angular row with nu = d.

        Raises
        ------
        InputError
            The problem has no such row.
        """
        block = self.block_of(row)
        is_converted = bool(self.cones.is_contact[block])
        if self.rows is not None and block < self.rows.n_joints:
            bodies = self.rows.joint_body[block]
            is_converted = bool(self.rows.inv_mass[bodies[bodies >= 0]].any())
        return "rad/s" if self.angular_rows[row] and not is_converted else "m/s"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ProblemData):
            return NotImplemented
        compared = (
            f.name
            for f in fields(self)
            if f.init and f.compare and f.name not in ("matrix", "copy")
        )
        if not all(are_equal(getattr(self, name), getattr(other, name)) for name in compared):
            return False
        if issparse(self.matrix) and issparse(other.matrix):
            return all(
                are_equal(getattr(self.matrix, n), getattr(other.matrix, n))
                for n in ("indptr", "indices", "data")
            )
        return type(self.matrix) is type(other.matrix) and are_equal(self.matrix, other.matrix)

    __hash__ = None  # type: ignore[assignment]

    @property
    def engine_motion(self) -> Any:
        """The `answer` of `record`, a `lavender.io.engine_motion.EngineMotion`; None without one."""
        return None if self.record is None else self.record.answer

    def _set_record(self, record: EngineRecord) -> None:
        """Set `record`, for importers: nothing that is computed from the problem depends on it but `residual`."""
        self.__dict__["record"] = record

    def __reduce__(self) -> tuple[Any, ...]:
        # Copies and pickles hold the fields, and the motion of an engine that `residual` judges: derived values are
        # computed again, and arrays stay read-only.
        motion = self.engine_motion
        state = {} if motion is None else {"record": EngineRecord(motion)}
        values = tuple(f.name != "copy" and getattr(self, f.name) for f in fields(self) if f.init)
        return type(self), values, state

    def __repr__(self) -> str:
        kind = self.operator if self.matrix is None else "CSR" if issparse(self.matrix) else "dense"
        name = f"{self.name!r}, " if self.name else ""
        counts = (self.m, "row"), (self.n_blocks, "block")
        size = " in ".join(f"{n} {noun}" if n == 1 else f"{n} {noun}s" for n, noun in counts)
        return f"<Problem {name}{self.law}, {size}, {kind}>"

    def _repr_html_(self) -> str:
        """Return a small HTML table of the problem for notebooks."""
        contacts = int(np.count_nonzero(self.cones.is_contact))
        facts = {
            "law": self.law,
            "rows": self.m,
            "contacts": contacts,
            "other blocks": self.n_blocks - contacts,
            "given by": repr(self).rpartition(", ")[2].rstrip(">"),
        }
        return format_html_table(facts, self.name or "Problem")


def _find_law(cones: Cones, friction: str) -> str:
    """Return the problem class of blocks with a law of friction."""
    blocks = cones._blocks
    return "linear" if blocks.is_free else "lcp" if blocks.is_bounded_rows else friction


def convert_keys(key: Any, k: int) -> np.ndarray:
    """Convert keys to a checked array (k,) of uint64."""
    get_shape("key", key)
    check_unmasked("key", key)
    array = np.asarray(key)
    if array.shape != (k,) or array.dtype.kind not in "ui":
        raise InputError(
            f"key has shape {array.shape} and dtype {array.dtype}; ({k},) integers are needed"
        )
    if array.dtype.kind == "i" and array.size and array.min() < 0:
        i = int(array.argmin())
        raise InputError(f"key has {array[i]} at [{i}]; integers from 0 to 2**64 - 1 are needed")
    return mark_read_only(array.astype(np.uint64))


def check_rhs(b: FloatArray) -> None:
    """Raise InputError unless b [m/s] is finite and in range, and max |b_i| is 0 or at least MIN_MAGNITUDE."""
    if not is_rhs_valid(b):
        check_finite_and_in_range("b [m/s]", b, "m/s")
        max_abs = np.abs(b).max()
        raise InputError(
            f"the largest entry of b [m/s] is {max_abs:g}; 0 or at least {MIN_MAGNITUDE:g} is needed: change a unit"
        )


for _name in ("b", "cones", "generalized", "compliance", "key", "names", "angular"):
    setattr(ProblemData, _name, late_field(_name))  # Importers postpone these fields.
ProblemData.__init__.__qualname__ = (
    "Problem.__init__"  # Makes a TypeError name the class that users call.
)


def check_problem(problem: Any) -> None:
    """Raise InputError unless `problem` is a `Problem`."""
    if not isinstance(problem, ProblemData):
        advice = "make one with Problem.lcp(A, b, lower, upper), linear, contact, from_rows or from_jacobian"
        if isinstance(getattr(problem, "problem", None), ProblemData):
            # The object is a case, or the result of reading a file.
            advice = "give its .problem"
        elif callable(getattr(problem, "get_world", None)):
            advice = "give one of its worlds, batch[i]"
        elif callable(getattr(problem, "velocity_after", None)):
            # The object is a `RowBuilder`, which is not imported here.
            advice = "give the result of its .problem()"
        raise InputError(
            f"problem is a {type(problem).__name__}; a lavender.Problem is needed: {advice}"
        )


def check_matrix(matrix: Any, m: int, copy: bool) -> Any:
    """Convert A to a read-only dense (m, m) array or canonical CSR matrix of float64, with finite entries only."""
    if not issparse(matrix):
        return as_array("A", matrix, (m, m), unit="1/kg", copy=copy)
    if matrix.shape != (m, m):
        raise InputError(f"A has shape {matrix.shape}; ({m}, {m}) is needed, as b has {m} rows")
    return as_csr(
        "A",
        matrix,
        copy=copy,
        unit="1/kg",
        too_many="; give J and M^-1 instead (Problem.from_rows)",
    )
