"""Reproducible arithmetic for the numbers of a scene: every machine builds a scene with the same bits.

NumPy's sine and cosine, matrix products and LAPACK's inverse differ in the last bit between processors, libraries and
versions; after some hundred steps of a chaotic scene every bit differs. These functions use only + - * / and square
roots of IEEE 754 in a fixed order, and integers.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError

#: `compute_sine_and_cosine` computes in integer multiples of 2^-FIXED_POINT_BITS.
FIXED_POINT_BITS = 256
#: [rad] Angles of this size or larger are rejected: reducing one to a quarter turn uses 64 of the bits of PI.
MAX_ANGLE = 2.0**64

#: pi 2^FIXED_POINT_BITS.
PI = 0x3243F6A8885A308D313198A2E03707344A4093822299F31D0082EFA98EC4E6C89


def compute_sine_and_cosine(angle: float) -> tuple[float, float]:
    """Return sine and cosine of an angle [rad], each rounded once: Taylor series in integer multiples of 2^-256."""
    angle = float(angle)
    if not abs(angle) < MAX_ANGLE:
        raise InputError(f"an angle is {angle:g} rad; less than {MAX_ANGLE:g} is needed")
    # Rounded to nearest, sin x is x and cos x is 1: the next terms are below half a bit.
    if abs(angle) < 2.0**-27:
        return angle, 1.0
    numerator, denominator = angle.as_integer_ratio()
    x = (numerator << FIXED_POINT_BITS) // denominator
    quarter, x = divmod(2 * x + PI // 2, PI)  # The new x is 2 (x + pi / 4), in [0, pi).
    x = (x - PI // 2) // 2
    square = (x * x) >> FIXED_POINT_BITS
    one = 1 << FIXED_POINT_BITS
    sine, cosine, a, b = x, one, x, one
    for k in range(1, 64):  # The last term is below (pi / 4)^127 / 127! < 2^-700.
        b = -((b * square) >> FIXED_POINT_BITS) // ((2 * k - 1) * 2 * k)
        a = -((a * square) >> FIXED_POINT_BITS) // (2 * k * (2 * k + 1))
        sine, cosine = sine + a, cosine + b
    for _ in range(quarter % 4):
        sine, cosine = cosine, -sine
    return sine / one, cosine / one  # A quotient of integers is rounded to nearest.


def compute_norm(x: FloatArray) -> float:
    """Return the Euclidean norm of a short vector (n,); squares are added in order."""
    total = 0.0
    for value in x.tolist():
        total += value * value
    return sqrt(total)


def rotate_vector(r: FloatArray, x: FloatArray) -> FloatArray:
    """Return R x for a matrix (3, 3) and a vector (3,)."""
    a, b, c = x[0] * r[:, 0], x[1] * r[:, 1], x[2] * r[:, 2]
    return (a + b) + c


def invert_definite_3x3(x: FloatArray) -> FloatArray:
    """Return the inverse (3, 3) of a symmetric positive definite X = L D L^T."""
    (a, _, _), (b, d, _), (c, e, f) = x.tolist()
    l10, l20 = b / a, c / a
    pivot, reduced = d - l10 * b, e - l20 * b
    l21 = reduced / pivot
    last = (f - l20 * c) - l21 * reduced
    # Entries of L^-1 below its unit diagonal.
    m10 = -l10
    m20 = l10 * l21 - l20
    m21 = -l21
    i22 = 1.0 / last
    i21 = m21 / last
    i20 = m20 / last
    i11 = 1.0 / pivot + m21 * i21
    i10 = m10 / pivot + m21 * i20
    i00 = (1.0 / a + m10 * (m10 / pivot)) + m20 * i20
    return np.array([[i00, i10, i20], [i10, i11, i21], [i20, i21, i22]]) + 0.0


def convert_frame_to_quaternion(r: FloatArray) -> FloatArray:
    """Return the unit quaternion (4,) w x y z with w >= 0 of a rotation matrix (3, 3).

    It is computed from the row of 4 q q^T with the largest diagonal entry, which avoids cancellation (Shepperd 1978).
    """
    (a, b, c), (d, e, f), (g, h, i) = r.tolist()
    rows = (
        ((1.0 + a) + (e + i), h - f, c - g, d - b),
        (h - f, (1.0 + a) - (e + i), b + d, c + g),
        (c - g, b + d, (1.0 - a) + (e - i), f + h),
        (d - b, c + g, f + h, (1.0 - a) - (e - i)),
    )
    best = max(range(4), key=lambda k: rows[k][k])
    q = np.array(rows[best])
    q = q / compute_norm(q)
    return q if q[0] >= 0.0 else -q
