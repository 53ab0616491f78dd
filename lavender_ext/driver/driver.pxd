"""The methods with the interface of `core/method.pxd`, and the three functions that call the method for a problem's form.

| method | over A | over bodies | over J and M |
|---|---|---|---|
| NEWTON | every law; dense factors | every law; sparse supernodes | every law; islands one by one |
"""
from libc.stdint cimport int32_t

from lavender_ext.core.method cimport grow_t, info_t, options_t, workspace_t
from lavender_ext.core.view cimport view_t


cdef enum:                      # methods
    NEWTON = 0


cdef public int32_t lav_workspace_size(const view_t* v, const options_t* o, workspace_t* r) noexcept nogil
cdef public int32_t lav_analyse(const view_t* v, const options_t* o, workspace_t* r, workspace_t* memory,
                                grow_t grow) noexcept nogil
cdef public int32_t lav_start(const view_t* v, const options_t* o, workspace_t* r, const double* lam, workspace_t* memory,
                              grow_t grow) noexcept nogil
cdef public int32_t lav_step(const view_t* v, const options_t* o, const workspace_t* r, int32_t work, double* lam,
                             info_t* info) noexcept nogil
