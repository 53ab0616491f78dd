"""Vectors of three numbers in plain Python, for small counts of rows: NumPy calls would take longer."""

from __future__ import annotations

from math import hypot
from typing import Any

from lavender.base.errors import InputError
from lavender_ext.core.checks import MIN_MAGNITUDE

Vector = tuple[float, float, float]

X_AXIS, Y_AXIS, Z_AXIS = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
ZERO = (0.0, 0.0, 0.0)


def dot(x: Any, y: Any) -> float:
    """Return the scalar product."""
    return float(x[0] * y[0] + x[1] * y[1] + x[2] * y[2])


def cross(x: Vector, y: Vector) -> Vector:
    """Return the vector product."""
    return x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]


def subtract(x: Vector, y: Vector) -> Vector:
    """Return x - y."""
    return x[0] - y[0], x[1] - y[1], x[2] - y[2]


def scale(factor: float, x: Vector) -> Vector:
    """Return the factor times x."""
    return factor * x[0], factor * x[1], factor * x[2]


def normalise(name: str, x: Vector) -> Vector:
    """Return a vector divided by its length; raise InputError if that is 0."""
    size = hypot(*x)
    if size < MIN_MAGNITUDE:
        raise InputError(f"{name} has length {size:g}; a direction is needed")
    return x[0] / size, x[1] / size, x[2] / size


def complete_orthonormal_frame(axis: Vector) -> list[Vector]:
    """Return two unit vectors that form a right-handed frame with a unit vector: side, axis x side."""
    smallest = min(range(3), key=lambda i: abs(axis[i]))
    side = normalise("axis", cross(axis, (X_AXIS, Y_AXIS, Z_AXIS)[smallest]))
    return [side, cross(axis, side)]
