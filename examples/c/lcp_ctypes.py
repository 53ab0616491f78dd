"""Solve an LCP by the C library through ctypes, in the folder of liblavender.so.

Build a shared library for it: cmake -DBUILD_SHARED_LIBS=ON, or cc -shared -fPIC -DLAV_SHARED.
"""

import ctypes as ct

import numpy as np

COUNTS = "form law n_blocks n_rows n_entries n_bodies n_joints n_velocities n_mass_entries"
POINTERS = (
    "block_ptr kind lower upper mu patch_radius b target velocity compliance impulse key order "
    "index_ptr index value"
)


class Problem(ct.Structure):
    """The first fields of `lav_problem`, with memory for the others."""

    _fields_ = (
        ("size", ct.c_uint32),
        *((name, ct.c_int32) for name in COUNTS.split()),
        *((name, ct.c_void_p) for name in POINTERS.split()),
        ("rest", ct.c_byte * 128),
    )


def solve(matrix, b, lower):
    """Return the impulse (m,) [N s] of an LCP by the method `direct`."""
    lav = ct.CDLL("./liblavender.so")
    q = Problem()
    options = (ct.c_byte * 64)()
    budget = (ct.c_byte * 64)()
    result = (ct.c_int32 * 18)(72)
    assert lav.lav_self_test() == lav.lav_default_problem(1, ct.byref(q)) == 0  # LAV_MATRIX
    assert lav.lav_default_options(10, options) == lav.lav_default_budget(budget) == 0  # LAV_DIRECT
    m = len(b)
    impulse = np.zeros(len(b))
    q.n_blocks = m
    q.n_rows = m
    q.n_entries = m * m
    q.value, q.b, q.lower = matrix.ctypes.data, b.ctypes.data, lower.ctypes.data
    memory = (ct.c_double * 4096)()
    size = ct.c_uint64(8 * 4096)
    solver = ct.c_void_p()
    assert lav.lav_open(memory, size, ct.byref(q), options, ct.byref(solver)) == 0
    assert lav.lav_set(solver, ct.byref(q)) == lav.lav_run(solver, budget, result) == 0
    assert lav.lav_impulse(solver, ct.c_void_p(impulse.ctypes.data), m) == 0
    return impulse


if __name__ == "__main__":
    A = np.array([[2.0, 1.0], [1.0, 2.0]])  # 1/kg
    print(solve(A, np.array([1.0, -1.0]), np.zeros(2)))  # [0.5 0. ] N s
