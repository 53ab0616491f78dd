"""Problems of J and M as jobs of a compiled loop: what one asks for, what it is solved in, what came of it."""
from libc.stdint cimport int32_t
from libc.stdlib cimport free, malloc

from lavender_ext.core.block cimport blocks_t
from lavender_ext.core.generalized cimport generalized_t
from lavender_ext.core.problem cimport made_t
from lavender_ext.judge.score cimport score_t


cdef enum:
    LEFT = 0                    # to the caller
    SOLVED = 1


cdef struct gate_t:             # what Newton's method may cost [ns] to be asked first; see `general_first`
    int32_t is_open             # whatever it costs
    double start
    double row[4]               # by law: linear, lcp, coulomb, cone
    double factor[4]
    double most
    double rigid[5]             # few rows under Coulomb's law: up to so many, a row, a multiply-add, most; d of soft ones
    double form                 # of a multiply-add of A
    double count[4]             # factorisations by law
    # Bounded rows, more than few, where A costs at least `carried` sweeps and their call to form; see `is_carried`.
    int32_t few                 # 2^31 - 1: never
    double formed               # of an entry of A
    double call
    double carried
    double swept, of_row        # of each multiply-add of a sweep, and for each row


cdef struct job_t:
    blocks_t p
    generalized_t g
    made_t made                 # of the data, or in this call; NULL between
    double begin[3]             # E0, V0, relative residual of doing nothing; E0 < 0 where not known
    int32_t law                 # as `gate_t.count`
    int32_t cold                # 1: from doing nothing, else from lam as it is
    int32_t end
    int32_t counts[5]           # steps, factorisations, updates, rounds, evaluations
    double* lam                 # (m)
    double* both                # (2 m + 1) w, e
    score_t score
    double relative, floor


cdef struct space_t:            # one after the other in the same room
    int32_t* marks
    ssize_t n_marks
    double* numbers
    ssize_t n_numbers


cdef inline int32_t with_numbers(space_t* s, ssize_t n) noexcept nogil:
    if n > s.n_numbers:
        free(s.numbers)
        s.n_numbers = 2 * n
        s.numbers = <double*>malloc(s.n_numbers * sizeof(double))
        if s.numbers == NULL:
            s.n_numbers = 0
            return 0
    return 1


cdef inline int32_t with_marks(space_t* s, ssize_t n) noexcept nogil:
    if n > s.n_marks:
        free(s.marks)
        s.n_marks = 2 * n
        s.marks = <int32_t*>malloc(s.n_marks * sizeof(int32_t))
        if s.marks == NULL:
            s.n_marks = 0
            return 0
    return 1


cdef class Gate:
    cdef gate_t at


cdef void begin(job_t* j, double* w) noexcept nogil
cdef void solve_made(job_t* j, space_t* space, const gate_t* gate, double tol, double most) noexcept nogil
cdef int32_t law_of(const blocks_t* p) noexcept nogil
