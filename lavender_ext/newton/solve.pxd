"""Newton's method over rows and bodies as room, start and step (`core/method.pxd`), compiled once, in `solve.pyx`."""
from libc.stdint cimport int32_t

from lavender_ext.core.method cimport options_t, room_t, said_t
from lavender_ext.core.view cimport view_t
from lavender_ext.newton.elements cimport elements_t


cdef int32_t rows_room(const view_t* v, const options_t* o, room_t* r) noexcept nogil
cdef int32_t rows_start(const view_t* v, const options_t* o, room_t* r, const double* lam) noexcept nogil
cdef int32_t bodies_room(const view_t* v, const options_t* o, room_t* r) noexcept nogil
cdef int32_t bodies_start(const view_t* v, const options_t* o, room_t* r, const double* lam) noexcept nogil
cdef int32_t system_step(const view_t* v, const options_t* o, const room_t* r, int32_t work, double* lam,
                         said_t* said) noexcept nogil
cdef const elements_t* elements_of(object solve) except NULL
