"""Addresses of the arrays of one MjData and its model."""
from libc.stdint cimport int32_t, int64_t

ctypedef const double* doubles
ctypedef const int32_t* ints
ctypedef const char* bytes_


ctypedef struct step_t:
    # Arrays of mjData that do not move, then arrays of the last forward pass, in the order of `ARRAYS` of mujoco_step.pyx.
    doubles qvel, qacc, qacc_smooth, qfrc_smooth, qfrc_constraint, M, cdof, cvel
    doubles efc_J, efc_D, efc_R, efc_aref, efc_force, efc_vel, efc_b, efc_frictionloss
    ints efc_type, efc_id, efc_J_rownnz, efc_J_rowadr, efc_J_colind
    # Members of the first contact, and the number of bytes between two contacts.
    bytes_ dim, geom, friction, efc_address
    Py_ssize_t stride
    # mjData.nefc, ncon, nJ, parena (bytes of the arena in use) and efm_active; mjOption.jacobian and noslip_iterations;
    # mjModel.flg_surfacevel.
    int64_t m, contacts, jac_entries, arena, is_discrete, jacobian, noslip_iterations, has_moving_surfaces
    double dt                                           # [s] mjOption.timestep
    # Arrays of mjModel, and the numbers of velocities, entries of M and bodies.
    ints M_rowadr, M_rownnz, M_colind, dof_bodyid, body_parentid
    int32_t n, mass_entries, bodies


cdef class Step:
    cdef step_t at
    cdef readonly object model, cache                   # of the caller; the model is kept alive
    cdef readonly bint is_sparse                        # whether efc_J is in compressed rows
    cdef int32_t[5] object_counts                       # equalities, velocities, tendons, joints, tendons
    cdef object find_sparse, offsets, arrays
    cdef int64_t known_jacobian
    cdef bytes_ data_address, model_address

    cdef bint has_valid_counts(self) noexcept
    cdef bint has_rows(self) noexcept
    cdef void read_memory(self) noexcept
    cdef void read_attributes(self, data) except *
