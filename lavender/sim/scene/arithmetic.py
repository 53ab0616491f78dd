"""Arithmetic of a scene's numbers, in an order that is written here: every machine builds a scene from the same bits.

NumPy's sine and cosine, a matrix product and LAPACK's inverse differ in the last bit between processors, libraries and
versions, and after some hundred steps of a chaotic scene in every bit. Here are only + - * / and square roots of
IEEE 754, and whole numbers.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError

#: Numbers of sine_cosine are whole multiples of 2^-BITS.
BITS = 256
#: Largest angle [rad]; as many bits of PI go into telling its turns.
LARGEST = 2.0**64

#: pi 2^BITS.
PI = 0x3243F6A8885A308D313198A2E03707344A4093822299F31D0082EFA98EC4E6C89


def sine_cosine(angle: float) -> tuple[float, float]:
    """Sine and cosine of an angle [rad], each rounded once: Taylor's series in whole multiples of 2^-256."""
    angle = float(angle)
    if not abs(angle) < LARGEST:
        raise InputError(f"an angle is {angle:g} rad; less than {LARGEST:g} is needed")
    if abs(angle) < 2.0**-27:  # what follows, angle^3 / 6 and angle^2 / 2, is less than half of the last bit
        return angle, 1.0
    over, under = angle.as_integer_ratio()
    x = (over << BITS) // under
    quarter, x = divmod(2 * x + PI // 2, PI)  # now 2 (x + pi / 4), in [0, pi)
    x = (x - PI // 2) // 2
    square, one = (x * x) >> BITS, 1 << BITS
    sine, cosine, a, b = x, one, x, one
    for k in range(1, 64):  # the last term is below (pi / 4)^127 / 127! < 2^-700
        b = -((b * square) >> BITS) // ((2 * k - 1) * 2 * k)
        a = -((a * square) >> BITS) // (2 * k * (2 * k + 1))
        sine, cosine = sine + a, cosine + b
    for _ in range(quarter % 4):
        sine, cosine = cosine, -sine
    return sine / one, cosine / one  # a quotient of whole numbers is rounded to nearest


def norm(x: FloatArray) -> float:
    """Euclidean norm of a short vector (n,): squares added in order."""
    total = 0.0
    for value in x.tolist():
        total += value * value
    return sqrt(total)


def turned(r: FloatArray, x: FloatArray) -> FloatArray:
    """R x of a matrix (3, 3) and a vector (3,)."""
    a, b, c = x[0] * r[:, 0], x[1] * r[:, 1], x[2] * r[:, 2]
    return (a + b) + c


def turned_back(r: FloatArray, x: FloatArray) -> FloatArray:
    """R^T x of a matrix (3, 3) and a vector (3,)."""
    return turned(r.T, x)


def inverse(x: FloatArray) -> FloatArray | None:
    """Inverse (3, 3) of a symmetric positive definite matrix by X = L D L^T; None where a pivot is not positive."""
    (a, _, _), (b, d, _), (c, e, f) = x.tolist()
    if not a > 0.0:
        return None
    l10, l20 = b / a, c / a
    pivot, left = d - l10 * b, e - l20 * b
    if not pivot > 0.0:
        return None
    l21 = left / pivot
    last = (f - l20 * c) - l21 * left
    if not last > 0.0:
        return None
    # L^-1 below its diagonal of ones
    m10, m20, m21 = -l10, l10 * l21 - l20, -l21
    i22 = 1.0 / last
    i21 = m21 / last
    i20 = m20 / last
    i11 = 1.0 / pivot + m21 * i21
    i10 = m10 / pivot + m21 * i20
    i00 = (1.0 / a + m10 * (m10 / pivot)) + m20 * i20
    return np.array([[i00, i10, i20], [i10, i11, i21], [i20, i21, i22]]) + 0.0


def frame_quaternion(r: FloatArray) -> FloatArray:
    """Unit quaternion (4,) w x y z with w >= 0 of a rotation matrix (3, 3).

    Rows of 4 q q^T, of which the one with the largest diagonal loses no digits (Shepperd 1978).
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
    q = q / norm(q)
    return q if q[0] >= 0.0 else -q
