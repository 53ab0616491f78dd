"""Structs of a problem for kernels: its blocks, and one of A, bodies, J and M.

The products are in `csr.pxd`, `rows.pxd` and `generalized.pxd`.
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport blocks_t


cdef struct csr_t:
    const int32_t* indptr       # (m + 1)
    const int32_t* indices      # (nnz)
    const double* data          # (nnz) 1/kg


cdef struct rows_t:
    int32_t n_bodies            # n
    int32_t n_joints            # kj: the first kj blocks are joints, the others contacts
    int32_t n_contacts          # c
    const double* jac           # (mj, 12) rows of a joint: linear and angular on a, then on b
    const double* minv_jac      # (mj, 12) M^-1 J^T, same layout
    const int32_t* joint_body   # (kj, 2)
    const double* normal        # (c, 3) unit, from a to b
    const double* tangent       # (c, 3) unit, normal to `normal`; t2 = n x t1
    const double* arm_a         # (c, 3) m, contact point minus centre of a
    const double* arm_b         # (c, 3) m
    const int32_t* contact_body  # (c, 2)
    const double* coupling      # (c, 5) 1/kg: A_t1n, A_t2n, A_sn (for a box A_t2t1), A_st1, A_st2 without compliance
    const double* inv_inertia_arm   # (contact rows, 6) 1/(kg m): I^-1 (arm x axis), change of -omega_a and omega_b per impulse
    const double* inv_mass      # (n) 1/kg
    const double* inv_inertia   # (n, 9) 1/(kg m^2), world
    const double* compliance    # (m) 1/kg


cdef struct generalized_t:
    int32_t n                   # number of velocities, nv
    int32_t m                   # number of rows
    const int32_t* jptr         # (m + 1) row pointers of J
    const int32_t* jidx         # columns, ascending
    const double* jval
    const int32_t* lptr         # (n + 1) row pointers of L, without its diagonal
    const int32_t* lidx         # columns, ascending
    const double* lval
    const int32_t* parent       # (n) last column of the row of L, -1 at a root
    const double* inv_pivot     # (n) 1 / D
    const double* root          # (n) D^-1/2
    const int32_t* mptr         # (n + 1) row pointers of the lower triangle of M, diagonal last
    const int32_t* midx         # columns, ascending
    const double* mval
    double condition            # `estimate_condition` of M, 0 if unknown
    const double* compliance    # (m) 1/kg, >= 0
    int32_t n_panels
    const int32_t* prow         # (n_panels + 1) first row of each panel
    const int32_t* pcol         # (n_panels + 1) first index of each panel in `cols`
    const int32_t* pval         # (n_panels + 1) first index of each panel in `y`
    const int32_t* cols         # columns of each panel, ascending
    const double* y             # values of Y, panel by panel
    const int32_t* home         # (k) panel of each block


cdef struct view_t:
    blocks_t p
    const csr_t* a              # Exactly one of a, r and g is not NULL.
    const rows_t* r
    const generalized_t* g      # with panels


cdef inline const int32_t* get_block_bodies(const rows_t* r, int32_t i) noexcept nogil:
    """Return the two bodies of block i."""
    return r.joint_body + 2 * i if i < r.n_joints else r.contact_body + 2 * (i - r.n_joints)


cdef inline int32_t get_moving_body(const rows_t* r, int32_t i, int32_t side) noexcept nogil:
    """Return the body on one side (0 or 1) of block i, -1 if it is static or its inverse mass and inertia are 0."""
    cdef int32_t k, body = get_block_bodies(r, i)[side]
    if body < 0 or r.inv_mass[body] != 0.0:
        return body
    for k in range(9):
        if r.inv_inertia[9 * body + k] != 0.0:
            return body
    return -1
