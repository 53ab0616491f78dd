"""A method as three functions on plain structs: room, start, step. Nothing here needs Python, allocates, or looks at a clock.

    view_t v          a problem: its blocks with d and nu, and one of A, bodies, J and M
    options_t o       which method, to what tolerance, with how much work
    room_t r          the caller's arrays
    lav_room(&v, &o, &r)            -> r.n_index, r.n_real as a first guess; 0: the method does not take this problem
    lav_start(&v, &o, &r, lambda)   -> MORE | ROOM (r.n_index, r.n_real say how much; give it, start again) | an end
    lav_step(&v, &o, &r, work, lambda, &s) -> MORE | REACHED | FLOOR | STUCK | CERTIFICATE | SPENT, lambda the best so far

Work is counted in factorisations, so that the caller can look at a clock between two steps; a step may do one or two more
than it was asked for. What a method keeps stands in r, which may not move between start and the last step, as little as the
arrays of v.

| method | over A | over bodies | over J and M |
|---|---|---|---|
| NEWTON | bounded rows, cones, Coulomb's law; dense | the same, of up to 1,500 bodies | the same, islands |

After CERTIFICATE `options_t.proven` = 1 ends it; without, the next step goes on.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.view cimport view_t


cdef enum:                      # methods
    NEWTON = 0

cdef enum:                      # outcomes; the first six are those of newton/plan.pxd
    ROOM = 6
    UNFIT = 7


cdef struct options_t:
    int32_t method
    int32_t budget              # factorisations
    int32_t proven              # the direction of a CERTIFICATE is a proof
    int32_t stop                # end with what is there
    int32_t wide                # four lanes are one instruction: the same bits, sooner
    double tol                  # relative residual


cdef struct room_t:
    int64_t n_index
    int64_t n_real
    int32_t* index
    double* real


cdef struct said_t:
    int32_t factorisations
    double relative             # residual of lambda
    const double* direction     # (m) N s of a CERTIFICATE, or NULL


cdef public int32_t lav_room(const view_t* v, const options_t* o, room_t* r) noexcept nogil
cdef public int32_t lav_start(const view_t* v, const options_t* o, room_t* r, const double* lam) noexcept nogil
cdef public int32_t lav_step(const view_t* v, const options_t* o, const room_t* r, int32_t work, double* lam,
                             said_t* said) noexcept nogil
