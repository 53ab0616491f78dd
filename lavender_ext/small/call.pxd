"""Solver of small problems: `derive_small_problem` once, then `solve_small` from any start, on a copy for each thread."""
from libc.stdint cimport int32_t

from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.small.task cimport small_rules_t, task_t


cdef bint can_use_small_call(const blocks_t* p) noexcept nogil
cdef bint are_all_rows_bounded(const blocks_t* p) noexcept nogil
cdef bint derive_small_problem(task_t* j, workspace_t* workspace) noexcept nogil
cdef void judge_task(task_t* j, double* scratch) noexcept nogil
cdef void judge_task_within_bounds(task_t* j, double* scratch) noexcept nogil
cdef int32_t solve_small(task_t* j, const small_rules_t* rules, workspace_t* workspaces) except -1 nogil
