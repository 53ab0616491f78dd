"""Declarations of `solve.pyx`: Newton's method over rows and bodies as workspace, start and step (`core/method.pxd`)."""
from libc.stdint cimport int32_t

from lavender_ext.core.method cimport options_t, workspace_t, info_t
from lavender_ext.core.view cimport view_t


cdef int32_t rows_workspace_size(const view_t* v, const options_t* o, workspace_t* r) noexcept nogil
cdef void keep_row_matrix(workspace_t* r) noexcept nogil
cdef int32_t start_newton_over_rows(const view_t* v, const options_t* o, workspace_t* r, const double* lam) noexcept nogil
cdef int32_t bodies_workspace_size(const view_t* v, const options_t* o, workspace_t* r) noexcept nogil
cdef int32_t start_newton_over_bodies(const view_t* v, const options_t* o, workspace_t* r, const double* lam) noexcept nogil
cdef int32_t step_newton_system(const view_t* v, const options_t* o, const workspace_t* r, int32_t work, double* lam,
                         info_t* info) noexcept nogil
