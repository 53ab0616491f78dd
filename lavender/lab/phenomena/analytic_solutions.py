"""Analytic solutions of phenomena that need more than one formula."""

from __future__ import annotations

import math

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.lab.phenomena.parts import GRAVITY


def compute_period_of_pendulum(inertia: float, torque: float, angle: float) -> float:
    """Compute the period [s] of a pendulum of `inertia` [kg m^2] about its hinge, released at `angle` [rad].

    The angle is measured from the lowest position.

    From I phi'^2/2 = m g l (cos phi - cos phi0), `torque` = m g l [N m]:

        T = 4 sqrt(I/(m g l)) K(sin(phi0/2))
    """
    from scipy.special import ellipk

    return 4.0 * math.sqrt(inertia / torque) * float(ellipk(math.sin(0.5 * angle) ** 2))


def compute_period_of_free_rotation(inertia: FloatArray, omega: FloatArray) -> float:
    """Compute the period [s] after which the angular velocity of a free body repeats, in the body's axes.

    Euler's equations with energy E and momentum L have Jacobi's elliptic functions as solutions (Landau, Lifshitz,
    Mechanics, section 37); with I1 < I2 < I3, and 1 and 3 exchanged if L^2 < 2 E I2:

        T = 4 K(k) sqrt(I1 I2 I3/((I3 - I2)(L^2 - 2 E I1))),   k^2 = (I2 - I1)(2 E I3 - L^2)/((I3 - I2)(L^2 - 2 E I1))
    """
    from scipy.special import ellipk

    twice_energy, l2 = float(inertia @ omega**2), float(((inertia * omega) ** 2).sum())
    i1, i2, i3 = sorted(inertia.tolist())
    if l2 < twice_energy * i2:
        i1, i3 = i3, i1
    moment = (i3 - i2) * (l2 - twice_energy * i1)
    k2 = (i2 - i1) * (twice_energy * i3 - l2) / moment
    return 4.0 * float(ellipk(k2)) * math.sqrt(i1 * i2 * i3 / moment)


def compute_tipping_time(width: float, height: float, slope: float, angle: float) -> float:
    """Compute the time [s] in which a box on a slope tips by `angle` [rad] about its lower edge; inf if it stands.

    With r half the diagonal, beta = atan(w/h) the lean at which it balances and eps = atan(slope) - beta:

        phi'' = (3 g/(4 r)) sin(eps + phi)       so       phi'^2 = (3 g/(2 r)) (cos eps - cos(eps + phi))

    and t is the integral of d phi/phi', with phi = u^2, which removes the pole at 0.
    """
    eps = math.atan(slope) - math.atan(width / height)
    if eps <= 0.0:
        return math.inf
    r = 0.5 * math.hypot(width, height)
    points, weights = np.polynomial.legendre.leggauss(200)
    u = 0.5 * math.sqrt(angle) * (points + 1.0)
    # cos eps - cos(eps + phi), without cancellation.
    fall = 2.0 * np.sin(eps + 0.5 * u * u) * np.sin(0.5 * u * u)
    speed = np.sqrt(1.5 * GRAVITY / r * fall)
    return float(0.5 * math.sqrt(angle) * (weights * 2.0 * u / speed).sum())


def compute_pointed_arch_thrust_bounds(stones: int, lean: float, thick: float) -> tuple[float, float]:
    """Compute the smallest and the largest thrust H at the apex of a pointed arch that stands, in weights of a stone.

    Each leg consists of `stones` blocks of length 1 and thickness t = `thick` on a skewback, at a = `lean` [rad] from
    upright. Both legs meet at their upper inner edges, where the thrust H is horizontal by symmetry. A joint at
    distance D from the top carries the weight D of D blocks. The resultant must pass the joint within its thickness.
    Moments about the inner and the outer edge of the joint give

        H >= (D tan a - t)/2,        H (D cos a - t sin a) <= D (D sin a + t cos a)/2

    Below the angle of friction nothing slides: the angle between resultant and axis does not exceed the lean.
    """
    s, c = math.sin(lean), math.cos(lean)
    d = np.arange(1, stones + 1, dtype=float)
    moment, arm = d * (d * s + thick * c) / 2.0, d * c - thick * s
    largest_thrust = np.divide(moment, arm, out=np.full_like(arm, np.inf), where=arm > 0.0)
    return max(0.0, float(((d * math.tan(lean) - thick) / 2.0).max())), float(largest_thrust.min())


def compute_min_arch_thickness(stones: int, lean: float) -> float:
    """Compute the thickness [stone lengths] below which no thrust holds the pointed arch."""
    low, high = 0.0, float(stones)
    for _ in range(60):
        middle = 0.5 * (low + high)
        smallest_thrust, largest_thrust = compute_pointed_arch_thrust_bounds(stones, lean, middle)
        low, high = (low, middle) if smallest_thrust <= largest_thrust else (middle, high)
    return high
