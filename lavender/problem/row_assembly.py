"""Bodies of `RowBuilder`, and the checks of the arguments of its blocks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import dist, hypot, inf
from typing import Any

import numpy as np

from lavender.base.arrays import (
    ArrayLike,
    FloatArray,
    as_array,
    as_names,
    check_float,
    check_int,
    check_nonnegative_magnitudes,
    get_shape,
)
from lavender.base.errors import InputError
from lavender.problem.rows import check_and_symmetrise_inertia
from lavender_ext.core.checks import MIN_MAGNITUDE, find_body_fault
from lavender_ext.core.row_blocks import ARGUMENTS, FAULTS, RowBlocks

#: Types of blocks; a key has the number of the type (4 bits), body a + 1 (22), body b + 1 (22), and the feature (16).
BLOCK_TYPES = tuple(ARGUMENTS)
#: Names of the arguments of each type of block in the order of `RowBlocks.add`: vectors, then numbers.
NAMES = {
    block_type: [name.rstrip("?") for name in vectors + numbers]
    for block_type, (vectors, numbers) in ARGUMENTS.items()
}
MAX_KEYED_BODIES = 2**22 - 1  # More bodies do not fit into the 22 bits of a key.
MAX_FEATURE = 2**16 - 1  # Larger features do not fit into the 16 bits of a key.
# Columns of (v_x, v_y, omega_z) in the velocities of a body in three dimensions.
PLANAR_VELOCITIES = (0, 1, 5)
# Axes of rotation, or directions of travel, which two dimensions do not have, or which have two components.
ROTATION_AXES = ("axis?", "axis_a?", "axis_b?")
#: Ranges of numbers that may not be negative.
RANGES = {name: {"low": 0.0} for name in ("length", "max_torque", "max_force", "stiffness", "damping", "mu")} | {
    "restitution": {"low": 0.0, "high": 1.0}, "restitution_threshold": {"low": 0.0},
}  # fmt: skip
#: Messages of the faults of row_blocks.pyx; `argument` is the one that a fault refers to, `given` its value.
MESSAGES = {
    "axis_given": "{argument} is {given!r:.60}; in two dimensions all rotation is about z: leave it out",
    "axis_missing": "{argument} is None; a vector ({dimensions},) in world coordinates is needed",
    "length": "{argument} has length {size:g}; a direction is needed",
    "anchor_given": "anchor is given with max_torque, which acts everywhere on the body: leave anchor out, or give "
    "max_force",
    "anchor_missing": "anchor is None; a motor with max_force needs the point at which the force acts",
    "rod": "length is {length}, and anchor_a and anchor_b are {span:g} m apart; a positive length is needed, as a rod "
    "of length 0 has no direction: give length, or use ball for two points that coincide",
    "spring": "stiffness is {stiffness:g} N/m and damping is {damping:g} N s/m; at least one must be positive, so that "
    f"dt (damping + dt stiffness) is at least {MIN_MAGNITUDE:g}",
    "motor": "max_torque is {max_torque} and max_force is {max_force}; exactly one of the two is needed: max_torque "
    "for rotation, max_force for travel",
    "limits": "lower is {lower:g} and upper is {upper:g}; lower must not exceed upper, and at least one must be "
    "finite: change one of the two",
    "ratio": "ratio is 0; a nonzero number is needed: 0 would stop a and leave b free",
    "normal": "normal has length {size:g}; a unit vector from a to b is needed",
    "tangent_given": "tangent is {tangent!r:.60}; in two dimensions it follows from the normal: leave it out",
    "parallel": "tangent is {tangent!r:.60}, which is parallel to the normal; another direction is needed, or None",
}


def name_block(key: int) -> str:
    """Return the default name of a block, such as "hinge 0 of world and body 3", from its key."""
    bodies = ((key >> shift & MAX_KEYED_BODIES) - 1 for shift in (38, 16))
    places = " and ".join("world" if body < 0 else f"body {body}" for body in bodies)
    return f"{BLOCK_TYPES[key >> 60]} {key & MAX_FEATURE} of {places}"


def _check_dimensions(position: tuple[int, ...], velocity: tuple[int, ...], inertia: tuple[int, ...]) -> None:
    """Check the shape of `position`; name it if the shapes of the other arguments belong to another dimension."""
    order = "the order is inv_mass, inv_inertia, velocity, dt, position"
    if len(position) == 2 and velocity == (position[0], {3: 2, 6: 3}.get(position[1])):
        raise InputError(
            f"position [m] has shape {position} and velocity {velocity}, so the two seem to be swapped: {order}"
        )
    if len(position) != 2 or position[1] not in (2, 3):
        raise InputError(
            f"position [m] has shape {position}; (n, 2) is needed in two dimensions, (n, 3) in three"
        )
    n = position[0]
    if position[1] == 3 and velocity == (n, 3) and len(inertia) < 2:
        raise InputError(
            f"position [m] has shape {position}, three dimensions, but velocity has shape {velocity} and inv_inertia "
            f"{inertia}, two dimensions: position ({n}, 2) is needed, without the angle; in three dimensions velocity "
            f"({n}, 6) and inv_inertia ({n}, 3, 3)"
        )


def _as_inverses(name: str, value: ArrayLike, n: int, unit: str) -> FloatArray:
    """Convert inverse masses or inertias (n,); the error for infinity names the value of a body that does not move."""
    array = as_array(name, value, (n,), finite=False, unit=unit)
    infinite = np.flatnonzero(np.isposinf(array))
    if len(infinite):
        raise InputError(
            f"{name} [{unit}] of body {infinite[0]} is inf, and a finite number is needed; it is 0 for a body that "
            "impulses do not move"
        )
    check_nonnegative_magnitudes(name, array, unit)
    return array


class RowAssembly:
    """Bodies and blocks of a step; `RowBuilder` describes the arguments.

    `lavender_ext/core/row_blocks.pyx` checks the usual types of arguments and makes the rows. The methods of this class
    convert other types, and word the messages.
    """

    def __init__(
        self,
        inv_mass: ArrayLike,
        inv_inertia: ArrayLike,
        velocity: ArrayLike,
        dt: float,
        position: ArrayLike,
        *,
        baumgarte: float = 0.2,
        slop: float = 0.0,
    ) -> None:
        shape = get_shape("position", position)
        _check_dimensions(shape, get_shape("velocity", velocity), get_shape("inv_inertia", inv_inertia))
        n, self._dimensions = shape[0], shape[1]
        if n > MAX_KEYED_BODIES:
            raise InputError(f"position has {n} bodies; at most {MAX_KEYED_BODIES} are needed for keys")
        self._position = np.zeros((n, 3))
        self._position[:, : shape[1]] = as_array("position", position, (n, shape[1]), unit="m")
        self._inv_mass = _as_inverses("inv_mass", inv_mass, n, "1/kg")
        if self._is_planar:
            self._inv_inertia = np.zeros((n, 3, 3))
            self._inv_inertia[:, 2, 2] = _as_inverses("inv_inertia", inv_inertia, n, "1/(kg m^2)")
            self._velocity = np.zeros((n, 6))
            self._velocity[:, PLANAR_VELOCITIES] = as_array("velocity", velocity, (n, 3), unit="m/s, rad/s")
        else:
            tensors = as_array("inv_inertia", inv_inertia, (n, 3, 3), unit="1/(kg m^2)")
            none, empty = np.zeros((0, 2), np.int32), np.zeros((0, 3))
            if find_body_fault(self._inv_mass, tensors, none, none, empty, empty, True)[0]:
                tensors = check_and_symmetrise_inertia("inv_inertia", tensors)
            self._inv_inertia = tensors
            self._velocity = as_array("velocity", velocity, (n, 6), unit="m/s, rad/s")
        self._dt = check_float("dt", dt, above=0.0)
        self._baumgarte = check_float("baumgarte", baumgarte, low=0.0, high=1.0)
        self._slop = check_float("slop", slop, low=0.0)
        self._blocks = RowBlocks(
            self._position, self._velocity, self._dimensions, self._dt, self._baumgarte, self._slop
        )
        self._names: dict[int, str] = {}  # Names of blocks that were given, by key.

    # -- arguments -----------------------------------------------------------------------------------------------

    @property
    def _is_planar(self) -> bool:
        return self._dimensions == 2

    def _check_pair(self, a: int | None, b: int | None) -> tuple[int, int]:
        """Return the numbers of two different bodies, at most one of them the static world (-1)."""
        found, n = [], len(self._position)
        for name, body in (("a", a), ("b", b)):
            try:
                found.append(-1 if body is None else check_int(name, body, -1, n - 1))
            except InputError:
                raise InputError(
                    f"{name} is {body!r:.60}; the number of one of the {n} bodies is needed, counted from 0, or -1 or "
                    "None for the static world"
                ) from None
        if found[0] == found[1]:
            same = "the static world" if found[0] < 0 else f"body {found[0]}"
            raise InputError(f"a and b are both {same}; two bodies are needed, at most one of them static")
        return found[0], found[1]

    def _convert_values(self, block_type: str, values: Iterable[Any]) -> tuple[Any, ...]:
        """Return the arguments of one block as lists and floats; raise InputError if one has a wrong type or range."""
        vectors, numbers = ARGUMENTS[block_type]
        converted: list[Any] = []
        for i, (argument, value) in enumerate(zip(vectors + numbers, values, strict=True)):
            name = argument.rstrip("?")
            is_vector, width = self._get_width(block_type, i)
            if value is None and name != argument:
                converted.append(None)
            elif argument in ROTATION_AXES and self._is_planar and get_shape(name, value) != (2,):
                raise InputError(MESSAGES["axis_given"].format(argument=name, given=value))
            elif is_vector:
                if width == self._dimensions and name != "angle_error" and get_shape(name, value) == ():
                    raise InputError(f"{name} is {value!r:.60}; a vector ({width},) is needed")
                unit = "m" if name.startswith(("anchor", "point")) else ""
                converted.append(as_array(name, value, (width,), unit=unit).tolist())
            elif isinstance(value, (float, np.floating)) and value == {"lower": -inf, "upper": inf}.get(name):
                converted.append(float(value))
            else:
                converted.append(check_float(name, value, **RANGES.get(name, {})))
        return tuple(converted)

    def _get_width(self, block_type: str, i: int) -> tuple[bool, int]:
        """Return whether argument i of a type of block is a vector, and its length."""
        vectors, _ = ARGUMENTS[block_type]
        if i < len(vectors) and vectors[i] == "angle_error":
            return not self._is_planar, 3
        return i < len(vectors), self._dimensions

    def _describe_fault(self, block_type: str, values: Sequence[Any]) -> str:
        """Return the message of the last fault of `_blocks`; `values` are the converted arguments of the block."""
        x, i = dict(zip(NAMES[block_type], values, strict=True)), self._blocks.argument
        more = {"argument": NAMES[block_type][i], "given": values[i], "dimensions": self._dimensions}
        if isinstance(values[i], list):
            more["size"] = hypot(*values[i])
        if block_type == "distance":
            more["span"] = dist(x["anchor_a"], x["anchor_b"])
        return MESSAGES[FAULTS[self._blocks.fault]].format(**x, **more)

    def _check_feature(self, block_type: str, pair: tuple[int, int], feature: int | None) -> int:
        """Return the feature of a new block."""
        key = BLOCK_TYPES.index(block_type) << 60 | pair[0] + 1 << 38 | pair[1] + 1 << 16
        if feature is None:
            number: int = self._blocks.next_feature.get(key, 0)
            if number > MAX_FEATURE:
                raise InputError(
                    f"feature is None; after {number} blocks of one pair of bodies it must be given"
                )
        else:
            number = check_int("feature", feature, high=MAX_FEATURE)
        if key | number in self._blocks.keys:
            bodies = " and ".join("world" if body < 0 else f"body {body}" for body in pair)
            raise InputError(
                f"feature is {number}, which another {block_type} of {bodies} already has; a number that no "
                f"other {block_type} of them has is needed"
            )
        return number

    # -- blocks --------------------------------------------------------------------------------------------------

    def _add(
        self, block_type: str, a: int | None, b: int | None, feature: int | None, name: str, *values: Any
    ) -> int:
        """Add a block and return its key; `values` are its ARGUMENTS."""
        if not isinstance(name, str):
            raise InputError(f"name is {name!r:.60}; a text is needed")
        number = BLOCK_TYPES.index(block_type)
        key: int | None = self._blocks.add(number, a, b, feature, values)
        if key is None:  # An argument is invalid, or needs a conversion.
            pair, values = self._check_pair(a, b), self._convert_values(block_type, values)
            key = self._blocks.add(number, *pair, self._check_feature(block_type, pair, feature), values)
            if key is None:
                raise InputError(self._describe_fault(block_type, values))
        if name:
            self._names[key] = name
        return key

    def _add_many(
        self, block_type: str, bodies: ArrayLike, feature: ArrayLike | None, names: Any, values: Iterable[Any]
    ) -> np.ndarray:
        """Add n blocks and return their keys (n,); `values` are arrays of their ARGUMENTS."""
        pairs = as_array("bodies", bodies, (None, 2), dtype=np.int32)
        n = len(pairs)
        numbers = None if feature is None else as_array("feature", feature, (n,), dtype=np.int32)
        labels = None if names is None else as_names("names", names, n)
        arrays = [
            None if value is None else self._as_values(block_type, k, value, n)
            for k, value in enumerate(values)
        ]
        keys = np.empty(n, np.uint64)
        i = self._blocks.add_many(BLOCK_TYPES.index(block_type), pairs, numbers, tuple(arrays), keys)
        if i >= 0:
            try:
                pair = self._check_pair(*pairs[i].tolist())
                single: list[Any] = [x if x is None else x[i].tolist() for x in arrays]
                if self._is_planar and block_type in ("weld", "slider"):
                    single[-1] = single[-1][2]  # The angle of the orientation error.
                single = list(self._convert_values(block_type, single))
                self._check_feature(block_type, pair, None if numbers is None else int(numbers[i]))
            except InputError as error:
                raise InputError(f"{block_type} {i}: {error}") from None
            if FAULTS[self._blocks.fault] != "conversion":
                raise InputError(f"{block_type} {i}: {self._describe_fault(block_type, single)}")
            raise InputError(
                f"{block_type} {i}: an earlier one of the same bodies has its feature, or they are more than "
                f"{MAX_FEATURE + 1}; different features up to {MAX_FEATURE} are needed"
            )
        if labels is not None:
            self._names.update(zip(keys.tolist(), labels, strict=True))
        return keys

    def _as_values(self, block_type: str, k: int, value: ArrayLike, n: int) -> FloatArray:
        """Convert argument k of n blocks to an array; one vector or number is repeated."""
        name, (is_vector, width) = NAMES[block_type][k], self._get_width(block_type, k)
        if not is_vector:
            array = as_array(name, value, (n,), finite=name not in ("lower", "upper"))
            return array if width == self._dimensions else np.outer(array, (0.0, 0.0, 1.0))
        shape = get_shape(name, value)
        if shape == () and name != "angle_error":
            raise InputError(f"{name} is {value!r:.60}; vectors ({n}, {width}) are needed, or one vector")
        if shape in ((), (width,)):
            return np.tile(as_array(name, value, (width,)), (n, 1))
        return as_array(name, value, (n, width))
