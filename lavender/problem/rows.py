"""Rows of rigid bodies: J and M^-1 with six velocities for each body, in the memory layout that sweeps read."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from lavender.base.arrays import (
    ArrayLike,
    FloatArray,
    IntArray,
    are_equal,
    as_array,
    check_nonnegative_magnitudes,
    get_common_precision,
    get_shape,
    mark_read_only,
)
from lavender.base.errors import InputError
from lavender.base.lazy_import import sparse as sp
from lavender.problem.cones import Cones
from lavender_ext.core import checks

# [-] Unit vectors with errors of length or orthogonality, and inertias with a relative asymmetry, up to this are not
# corrected; rounding in float64 causes less.
MAX_UNCORRECTED_ERROR = 1e-9
# [-] Larger errors of unit vectors and inertias are rejected; float32 with several rotations causes less.
MAX_CORRECTED_ERROR = 1e-5
UNITS = {
    "inv_mass": "1/kg",
    "inv_inertia": "1/(kg m^2)",
    "v_free": "m/s, rad/s",
    "jac": "-",
    "normal": "-",
    "tangent": "-",
    "arm_a": "m",
    "arm_b": "m",
}


@dataclass(frozen=True, eq=False, init=False)
class Rows:
    """Bodies, joints and contacts of one step: J and M^-1, from which A is not formed.

    Bodies are numbered 0 to n - 1; -1 is the static world. The blocks of the problem are the kj joints,
    followed by the c contacts. A contact between bodies a and b has the normal n from a to b, the tangents t1 and
    t2 = n x t1, and arms from the bodies' centres to the contact point. Its rows are

        n.u, t1.u, t2.u             u = v_b + omega_b x arm_b - v_a - omega_a x arm_a     [m/s]
        n.(omega_b - omega_a)       spin, if declared                                     [rad/s]
        t.(omega_b - omega_a)       rolling, if declared                                  [rad/s]

    A positive impulse along n pushes b away from a.

    Parameters
    ----------
    inv_mass : array-like (n,), 1/kg
        0: a kinematic body, which has the velocity `v_free` with any impulses.
    inv_inertia : array-like (n, 3, 3), 1/(kg m^2)
        In world axes, symmetric, positive semidefinite.
    v_free : array-like (n, 6), m/s and rad/s
        v*: linear and angular velocity at the end of the step without constraint impulses, gravity included.
    jac : array-like (mj, 12), optional
        Jacobian rows of the joints: linear and angular columns of body a, then of body b.
    joint_ptr : array-like (kj + 1,) of int, optional
        First row of each joint, followed by mj.
    joint_body : array-like (kj, 2) of int, optional
        Bodies a and b of each joint.
    normal : array-like (c, 3), optional
        Unit vectors from a to b.
    tangent : array-like (c, 3), optional
        Unit vectors t1, orthogonal to the normal; also needed without friction.
    arm_a, arm_b : array-like (c, 3), m, optional
        Contact point minus the centre of a, and of b, in world axes.
    contact_body : array-like (c, 2) of int, optional
        Bodies a and b of each contact.
    copy : bool, default True
        Whether to copy the arrays. If false, arrays are used without a copy if their type fits; they are then shared
        with the caller and marked read-only, and inertias are not symmetrised.

    An empty list means no joints, contacts or bodies. float32 arrays are converted to float64. Normals and tangents
    that differ from orthogonal unit vectors by up to 1e-5 are corrected, and so are inertias that are asymmetric by as
    much. If all arrays of numbers are float32, the `precision` of the rows and of their problems is "float32".

    Raises
    ------
    InputError
        The shapes disagree; a body does not exist; a body is joined to itself, or a contact has two static bodies; an
        inverse mass is negative; an inertia is not positive semidefinite; a normal or tangent is not a unit vector; a
        tangent is not orthogonal to its normal.

    Examples
    --------
    A stack of three boxes of 1 kg and 1 m on the ground, with four contacts under each, in a step of 1/60 s:

    >>> import numpy as np
    >>> import lavender as lv
    >>> dt = 1 / 60
    >>> corners = np.array([(x, y, 0.0) for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    >>> rows = lv.Rows(
    ...     inv_mass=np.ones(3),
    ...     inv_inertia=np.tile(6.0 * np.eye(3), (3, 1, 1)),  # a cube's moment is m / 6
    ...     v_free=np.tile([0.0, 0.0, -9.81 * dt, 0.0, 0.0, 0.0], (3, 1)),
    ...     contact_body=np.repeat([(-1, 0), (0, 1), (1, 2)], 4, axis=0),  # a below, b above; -1 is the ground
    ...     normal=np.tile([0.0, 0.0, 1.0], (12, 1)),
    ...     tangent=np.tile([1.0, 0.0, 0.0], (12, 1)),
    ...     arm_a=np.tile(corners + (0, 0, 0.5), (3, 1)),
    ...     arm_b=np.tile(corners - (0, 0, 0.5), (3, 1)),
    ... )
    >>> problem = lv.Problem.from_rows(rows, mu=0.5)
    >>> solution = lv.solve(problem, tol=1e-9)
    >>> force = solution.impulse.reshape(3, 4, 3) / dt  # N: box, corner, (n, t1, t2)
    >>> force[:, :, 0].sum(axis=1).round(2).tolist()  # the ground carries three boxes, the middle one two
    [29.43, 19.62, 9.81]
    >>> bool(abs(problem.velocity(solution.impulse)).max() < 1e-8)  # m/s: all boxes are at rest
    True
    """

    inv_mass: FloatArray
    inv_inertia: FloatArray
    v_free: FloatArray
    jac: FloatArray
    joint_ptr: IntArray
    joint_body: IntArray
    normal: FloatArray
    tangent: FloatArray
    arm_a: FloatArray
    arm_b: FloatArray
    contact_body: IntArray
    copy: bool = field(repr=False)
    # Default, not a field; instances made from float32 arrays set an attribute of this name.
    precision = "float64"

    def __init__(
        self,
        inv_mass: ArrayLike,
        inv_inertia: ArrayLike,
        v_free: ArrayLike,
        jac: ArrayLike = (),
        joint_ptr: ArrayLike = (0,),
        joint_body: ArrayLike = (),
        normal: ArrayLike = (),
        tangent: ArrayLike = (),
        arm_a: ArrayLike = (),
        arm_b: ArrayLike = (),
        contact_body: ArrayLike = (),
        copy: bool = True,
    ) -> None:
        masses, normals = get_shape("inv_mass", inv_mass), get_shape("normal", normal)
        n = masses[0] if len(masses) == 1 else None
        c = normals[0] if normals else None
        ptr = as_array("joint_ptr", joint_ptr, (None,), dtype=np.int32, copy=copy)
        if not checks.are_pointers_valid(ptr, 1):
            raise InputError(
                f"joint_ptr is {ptr.tolist()!s:.60}; it must start with 0 and increase"
            )
        rows, joints = get_shape("jac", jac), get_shape("joint_body", joint_body)
        are_tables = all(len(shape) == 2 or shape == (0,) for shape in (rows, joints))
        if are_tables and (rows[0], joints[0]) != (ptr[-1], len(ptr) - 1):
            raise InputError(
                f"jac has {rows[0]} joint rows, joint_body has {joints[0]} joints, and joint_ptr is "
                f"{ptr.tolist()!s:.60}, default [0]; the first row of each joint, then the number of rows is needed"
            )
        numbers: dict[str, tuple[Any, tuple[int | None, ...]]] = {
            "inv_mass": (inv_mass, (n,)),
            "inv_inertia": (inv_inertia, (n, 3, 3)),
            "v_free": (v_free, (n, 6)),
            "jac": (jac, (int(ptr[-1]), 12)),
            "normal": (normal, (c, 3)),
            "tangent": (tangent, (c, 3)),
            "arm_a": (arm_a, (c, 3)),
            "arm_b": (arm_b, (c, 3)),
        }
        values: dict[str, Any] = {
            name: as_array(name, value, shape, copy=copy, unit=UNITS[name])
            for name, (value, shape) in numbers.items()
        }
        if (
            get_common_precision(*(numbers[name][0] for name, x in values.items() if x.size))
            == "float32"
        ):
            values["precision"] = "float32"
        values["joint_ptr"] = ptr
        for name, body, k in (
            ("joint_body", joint_body, len(ptr) - 1),
            ("contact_body", contact_body, c),
        ):
            values[name] = as_array(name, body, (k, 2), dtype=np.int32, copy=copy)
        # `copy=False` applies to this call only, not to later `replace` calls.
        self.__dict__.update(values, copy=True)
        fault, index = checks.find_body_fault(
            self.inv_mass,
            self.inv_inertia,
            self.joint_body,
            self.contact_body,
            self.normal,
            self.tangent,
            copy,
        )
        if fault:
            self._correct_rounding_or_raise(fault, index, copy)

    def _correct_rounding_or_raise(self, fault: str, index: int, copy: bool) -> None:
        """Correct inertias and frames that float32 has rounded; raise InputError for other faults."""
        name, _, kind = fault.rpartition("_")
        if kind == "body":
            name = fault
            n = len(self.inv_mass)
            body = getattr(self, name).reshape(-1)[index]
            raise InputError(f"{name} names body {body}; there are {n} bodies, and -1 is static")
        if kind == "pair":
            body = getattr(self, f"{name}_body")[index, 0]
            if body >= 0:
                raise InputError(
                    f"{name}_body[{index}] is [{body}, {body}]; two different bodies are needed, or -1 for a static one"
                )
            raise InputError(
                f"{name}_body[{index}] is [-1, -1], two static bodies; a moving one is needed"
            )
        check_nonnegative_magnitudes("inv_mass", self.inv_mass, UNITS["inv_mass"])
        largest = np.abs(self.inv_inertia).max(axis=(1, 2), initial=0.0)
        check_nonnegative_magnitudes("largest entry of inv_inertia", largest, UNITS["inv_inertia"])
        if copy:
            object.__setattr__(
                self, "inv_inertia", check_and_symmetrise_inertia("inv_inertia", self.inv_inertia)
            )
        if not self.n_contacts:
            return
        normal, tangent = self.normal.copy(), self.tangent.copy()
        i, error = checks.correct_frames(normal, tangent, MAX_UNCORRECTED_ERROR)
        if error > MAX_CORRECTED_ERROR:
            raise InputError(
                f"contact {i}: normal {self.normal[i]} and tangent {self.tangent[i]} must be orthogonal unit vectors; "
                f"they are off by {error:.2g}, and up to {MAX_CORRECTED_ERROR:g} (float32 leaves 1e-7) is corrected"
            )
        if error > MAX_UNCORRECTED_ERROR:
            object.__setattr__(self, "normal", mark_read_only(normal))
            object.__setattr__(self, "tangent", mark_read_only(tangent))

    @property
    def n_bodies(self) -> int:
        """Number of moving bodies, n."""
        return len(self.inv_mass)

    @property
    def n_joints(self) -> int:
        """Number of joints, kj; the joints are the first blocks."""
        return len(self.joint_body)

    @property
    def n_contacts(self) -> int:
        """Number of contacts, c; the contacts are the blocks after the joints."""
        return len(self.contact_body)

    @property
    def block_bodies(self) -> IntArray:
        """Bodies of each block (k, 2), joints first; -1 is static."""
        if self.n_joints == 0:
            return self.contact_body
        return np.concatenate([self.joint_body, self.contact_body])

    @property
    def moving_block_bodies(self) -> IntArray:
        """`block_bodies` with -1 for bodies that cannot move: their inverse mass and inertia are 0."""
        bodies = self.block_bodies
        if not self.inv_mass.all():
            moves = np.append((self.inv_mass != 0.0) | self.inv_inertia.any(axis=(1, 2)), False)
            bodies = np.where(moves[bodies], bodies, np.int32(-1))
        return mark_read_only(bodies)

    def jacobian(self, cones: Cones) -> sp.csr_array:
        """Compute J as a CSR matrix (m, 6 n); columns 6 i to 6 i + 5 are body i, linear then angular."""
        is_valid = isinstance(cones, Cones) and cones.n_blocks == self.n_joints + self.n_contacts
        if not is_valid or cones.ptr[self.n_joints] != len(self.jac):
            raise InputError(
                f"cones is {cones!r:.60}; the Cones of {self.n_joints} joints and {self.n_contacts} contacts are needed"
            )
        tangents = cones.n_tangents[self.n_joints :]
        first = cones.ptr[self.n_joints : -1]
        m = cones.n_rows
        dense = np.zeros((m, 12))
        body = np.empty((m, 2), np.int64)
        mj = len(self.jac)
        dense[:mj] = self.jac
        body[:mj] = np.repeat(self.joint_body, np.diff(self.joint_ptr), axis=0)
        body[mj:] = np.repeat(self.contact_body, np.diff(cones.ptr[self.n_joints :]), axis=0)
        # Fill normal and tangent rows.
        t2 = np.cross(self.normal, self.tangent)
        for axis, row in ((self.normal, 0), (self.tangent, 1), (t2, 2)):
            contacts = np.flatnonzero(tangents >= row)
            with np.errstate(
                over="ignore", invalid="ignore"
            ):  # Products with very large arms may overflow.
                angular_a = np.cross(self.arm_a[contacts], axis[contacts])
                angular_b = np.cross(self.arm_b[contacts], axis[contacts])
            dense[first[contacts] + row] = np.hstack(
                [-axis[contacts], -angular_a, axis[contacts], angular_b]
            )
        # Fill spin and rolling rows.
        spin, rolling = cones.spin_rows[self.n_joints :], cones.rolling_rows[self.n_joints :]
        for axis, rows in (
            (self.normal, spin),
            (self.tangent, rolling),
            (t2, rolling + (rolling >= 0)),
        ):
            contacts = np.flatnonzero(rows >= 0)
            dense[rows[contacts]] = 0.0
            dense[rows[contacts], 3:6] = -axis[contacts]
            dense[rows[contacts], 9:12] = axis[contacts]
        # Keep the nonzero entries in columns of moving bodies.
        is_stored = np.repeat(body >= 0, 6, axis=1) & (dense != 0.0)
        columns = (6 * body[:, [0, 1], None] + np.arange(6)).reshape(m, 12)
        indptr = np.concatenate([[0], np.cumsum(is_stored.sum(axis=1))])
        jac = sp.csr_array(
            (dense[is_stored], columns[is_stored], indptr), shape=(m, 6 * self.n_bodies)
        )
        jac.sort_indices()
        return jac

    def inverse_mass_matrix(self) -> sp.csr_array:
        """Compute M^-1 as a CSR matrix (6 n, 6 n)."""
        n = self.n_bodies
        diagonal = np.repeat(np.arange(n) * 6, 3) + np.tile(np.arange(3), n)
        block = np.repeat(np.arange(n) * 6 + 3, 9)
        i = np.concatenate([diagonal, block + np.tile(np.repeat(np.arange(3), 3), n)])
        j = np.concatenate([diagonal, block + np.tile(np.arange(3), 3 * n)])
        x = np.concatenate([np.repeat(self.inv_mass, 3), self.inv_inertia.ravel()])
        return sp.csr_array((x, (i, j)), shape=(6 * n, 6 * n))

    def __repr__(self) -> str:
        return (
            f"<Rows of {self.n_bodies} bodies, {self.n_joints} joints with {len(self.jac)} rows, "
            f"{self.n_contacts} contacts>"
        )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Rows):
            return NotImplemented
        return all(
            are_equal(getattr(self, f.name), getattr(other, f.name))
            for f in fields(self)
            if f.name != "copy"
        )

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[Any, ...]:
        # Copies and pickles are built by the constructor, which marks their arrays read-only.
        return type(self), tuple(f.name != "copy" and getattr(self, f.name) for f in fields(self))


def check_and_symmetrise_inertia(name: str, tensors: FloatArray) -> FloatArray:
    """Return inverse inertias (n, 3, 3), made symmetric positive semidefinite after rounding to float32."""
    size = np.abs(tensors).max(axis=(1, 2))
    skew = np.abs(tensors - tensors.transpose(0, 2, 1)).max(axis=(1, 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = np.where(size[:, None, None] > 0.0, tensors / size[:, None, None], 0.0)
    min_eigenvalue = np.linalg.eigvalsh(scaled)[:, 0]
    for is_bad, requirement in (
        (skew > MAX_CORRECTED_ERROR * size, "symmetric"),
        (min_eigenvalue < -MAX_CORRECTED_ERROR, "positive semidefinite"),
    ):
        if is_bad.any():
            i = int(np.argmax(is_bad))
            raise InputError(
                f"{name}[{i}] is not {requirement}: {tensors[i].tolist()}; an inverse inertia, world axes, is needed"
            )
    is_corrected = (skew > MAX_UNCORRECTED_ERROR * size) | (min_eigenvalue < -MAX_UNCORRECTED_ERROR)
    if not is_corrected.any():
        return tensors
    value, axes = np.linalg.eigh(0.5 * (scaled + scaled.transpose(0, 2, 1)))
    new = size[:, None, None] * (
        (axes * np.maximum(value, 0.0)[:, None, :]) @ axes.transpose(0, 2, 1)
    )
    return mark_read_only(
        np.where(is_corrected[:, None, None], 0.5 * (new + new.transpose(0, 2, 1)), tensors)
    )
