"""MuJoCo's impedance model, which Genesis, MJX and MuJoCo Warp share: reference and compliance of constraint rows.

With the impedance d(r) of a row at the gap r, a time constant t [s] and a damping ratio c,

    B = 2 / (d_width t)        K = 1 / (d_width t c)^2         a_ref = -B (J v - surface) - K d r               (1)
    R = (1 - d) / d weight                                                                                      (2)

and in the direct format K = -solref[0] / d_width^2, B = -solref[1] / d_width. A friction row has K = 0. Compliances of
a contact with weight w of its normal and coefficients mu are, with the ratio i of the impedances,

    elliptic    R_0 = (1 - d) / d w,    R_1 = R_0 / i,    R_j = R_1 (mu_0 / mu_{j-1})^2
    pyramidal   R of each edge = 2 mu_0^2 / i (1 - d) / d w (1 + mu_0^2)                                         (3)

Source: MuJoCo's documentation, "Computation", and its function mj_makeImpedance.
"""

from __future__ import annotations

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.io.step_record import ConstraintBlock, Softness

MIN_IMPEDANCE, MAX_IMPEDANCE = 1e-4, 0.9999  # MuJoCo's limits of solimp [-].
SMALLEST = 1e-15  # MuJoCo's mjMINVAL.


def limit_solimp(solimp: FloatArray) -> FloatArray:
    """Return solimp (5,) within MuJoCo's limits."""
    d0, d1, width, middle, power = map(float, solimp)
    low, high = MIN_IMPEDANCE, MAX_IMPEDANCE
    return np.array(
        [np.clip(d0, low, high), np.clip(d1, low, high), max(0.0, width),
         np.clip(middle, low, high), max(1.0, power)]
    )  # fmt: skip


def compute_impedance(solimp: FloatArray, gap: float) -> float:
    """Return the impedance d [-] at a gap [m, rad]."""
    d0, d1, width, middle, power = map(float, limit_solimp(solimp))
    if d0 == d1 or width <= SMALLEST:
        return 0.5 * (d0 + d1)
    x = min(abs(gap) / width, 1.0)
    if power == 1.0 or x in (0.0, 1.0):
        y = x
    elif x <= middle:
        y = x**power / middle ** (power - 1.0)
    else:
        y = 1.0 - (1.0 - x) ** power / (1.0 - middle) ** (power - 1.0)
    return d0 + y * (d1 - d0)


def compute_rate_and_stiffness(
    solref: FloatArray, solimp: FloatArray, shortest_time: float, impedance: float | None = None
) -> tuple[float, float]:
    """Return B [1/s] and K [1/s^2] of a row with a position, equation (1).

    With the impedance d of an implicit row and the step h, half of `shortest_time`, the shortest time is the one for
    which h^2 K d is 1.
    """
    first, second = map(float, solref)
    if (first > 0.0) != (second > 0.0):
        first, second = 0.02, 1.0  # MuJoCo replaces mixed formats by its default.
    width = float(limit_solimp(solimp)[1])
    if first > 0.0:
        if impedance is not None:
            shortest_time *= 0.5 * float(np.sqrt(impedance)) / max(SMALLEST, width * second)
        first = max(first, shortest_time)
        stiffness = 1.0 / max(SMALLEST, (width * first * second) ** 2)
        return 2.0 / max(SMALLEST, width * first), stiffness
    return -second / max(SMALLEST, width), -first / max(SMALLEST, width * width)


def measure_gap(block: ConstraintBlock) -> float:
    """Return the gap [m, rad] that determines the impedance of a block."""
    if block.role == "friction":
        return 0.0
    if block.role == "equality":
        return float(np.linalg.norm(block.gap))
    return float(block.gap[0]) if len(block.gap) else 0.0


def compute_reference(
    block: ConstraintBlock,
    reference: Softness,
    compliance: Softness,
    count: int,
    is_implicit: bool = False,
) -> tuple[FloatArray, FloatArray]:
    """Return B [1/s] and K d [1/s^2] (count,) of the rows of a block with a solref and a solimp, equation (1).

    An integrator that is implicit in the rows (MuJoCo's "discrete") has a shortest time for limits and normals only.
    """
    solimp, shortest = compliance.solimp, reference.shortest_time
    impedance = compute_impedance(solimp, measure_gap(block))
    of_normal, of_others = shortest, 0.0 if is_implicit else shortest
    is_one_sided = block.role in ("contact", "limit")
    if is_implicit and not is_one_sided:
        of_normal = 0.0
    rate, stiffness = compute_rate_and_stiffness(
        reference.solref, solimp, of_normal, impedance if is_implicit and is_one_sided else None
    )
    rates, springs = np.full(count, rate), np.full(count, stiffness * impedance)
    if block.role == "friction":
        springs[:] = 0.0
    if block.role == "contact":
        springs[1:] = 0.0
        has_own = reference.solref_friction.any()
        if (has_own or is_implicit) and block.cone == "ellipse":
            solref = reference.solref_friction if has_own else reference.solref
            rates[1:] = compute_rate_and_stiffness(solref, solimp, of_others)[0]
    return rates, springs


def compute_compliance(
    block: ConstraintBlock, softness: Softness, weight: FloatArray, friction: FloatArray, cone: str
) -> FloatArray:
    """Return the compliance R [1/kg] of the rows of a block, or of the edges of its pyramid, equations (2), (3)."""
    d = compute_impedance(softness.solimp, measure_gap(block))
    ratio = (1.0 - d) / d
    if not cone:
        return np.maximum(SMALLEST, ratio * weight)
    impratio = max(SMALLEST, softness.impratio)
    if cone == "pyramid":
        edge = max(SMALLEST, ratio * float(weight[0]) * (1.0 + friction[0] ** 2))
        return np.full(2 * len(friction), 2.0 * friction[0] ** 2 / impratio * edge)
    normal = max(SMALLEST, ratio * float(weight[0]))
    tangents = normal / impratio * (friction[0] / friction) ** 2
    return np.append(normal, tangents)
