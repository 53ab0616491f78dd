"""The tower of `lav_self_test`, made by the package: three boxes that twist as they fall."""

import numpy as np

import lavender as lv


def self_test_problem():
    side = [(-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)]
    inv_mass = [1.0 / (1.0 + 0.3 * i) for i in range(3)]
    inertia = [np.diag([(6.0 + 0.1 * k) * w for k in range(3)]) for w in inv_mass]
    velocity = [[0.01 * (k + 1) / (i + 3) for k in range(6)] for i in range(3)]
    for v in velocity:
        v[2] = -9.81 / 60.0
    rows = lv.Rows(
        inv_mass=inv_mass,
        inv_inertia=inertia,
        v_free=velocity,
        contact_body=[(c // 4 - 1, c // 4) for c in range(12)],
        normal=[(0.0, 0.0, 1.0)] * 12,
        tangent=[(0.6, 0.8, 0.0)] * 12,
        arm_a=[(0.0, 0.0, 0.0) if c < 4 else (*side[c % 4], 0.5) for c in range(12)],
        arm_b=[(*side[c % 4], -0.5) for c in range(12)],
    )
    return lv.Problem.from_rows(rows, mu=[0.1 + 0.05 * c for c in range(12)])


def hash_of(x, seed=0):
    """`lav_hash` of float64 numbers."""
    h = seed
    full = 2**64 - 1
    for bits in np.ascontiguousarray(x, np.float64).view(np.uint64).tolist():
        h = ((h ^ bits) * 0x9E3779B97F4A7C15) & full
        h ^= h >> 29
    return h ^ h >> 32


def self_test_hash():
    found = lv.solve(self_test_problem(), "sequential_impulses", tol=0, max_iter=40)
    return hash_of(found.impulse, hash_of([found.residual.relative]))
