"""Islands under friction, one after the other in one room: each cut out of A, swept, and where that is slow by Newton's method.

Island i of n, E0_i its error of doing nothing, has met its share where

    E_i <= tol sqrt((E0_i^2 + E0^2 / n) / 2),   V_i <= tol V0                                              (1)

which for all of them together is tol by both measures. An island with the bytes of the one before has its answer. One
that misses its share ends the call: the caller starts again the long way.
"""
from cpython.exc cimport PyErr_CheckSignals
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t, uint64_t
from libc.stdlib cimport free, malloc
from libc.string cimport memcmp, memcpy, memset

import numpy as np

from lavender_ext.accelerate.accelerated cimport anderson_step, sweep_data_t
from lavender_ext.accelerate.mixing cimport CONTROL, MAX_MEMORY, UNDONE
from lavender_ext.core.block cimport CONE, blocks_t
from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport view_t
from lavender_ext.driver.driver cimport NEWTON, asked_t, lav_room, lav_start, lav_step, room_t, said_t
from lavender_ext.factor.tiles cimport has_wide
from lavender_ext.judge.measure cimport Judged, do_nothing, judge_into, relative_of
from lavender_ext.judge.measure import same_bits
from lavender_ext.judge.score cimport score_t
from lavender_ext.local import gauss_seidel
from lavender_ext.newton.plan cimport CERTIFICATE, MORE


cdef enum:
    MEMORY = 5                  # sweeps that are combined
    FIRST = 4                   # before the first look
    SHORT = 12                  # factorisations before sweeps have AGAIN times as many as before them; of each in the mean,
    AGAIN = 8
    STEPS = 120                 # and in all
    LISTEN = 5000000            # multiply-adds between two looks for Ctrl-C, a few milliseconds
    HOPED = 4                   # times the rounds left, that what the last one gained may promise an end in


cdef struct island_t:           # cut out of the whole; its numbers and whole numbers are one run of bytes each
    blocks_t p
    csr_t a
    double* numbers
    int32_t* marks
    int64_t n_numbers
    int64_t n_marks
    double* lam                 # (m) N s, at first where it starts: the last of the numbers compared
    double* answer              # (m)
    double* swept               # (m)
    double* w                   # (m)
    double* error               # (m)


cdef struct ask_t:
    double tol
    double e0                   # of the whole: E0 / sqrt(n),
    double v0
    int32_t most                # sweeps
    int32_t wide
    int64_t swept               # what was done in all
    int64_t undone
    int64_t factorisations
    double factored             # multiply-adds of them,
    double most_factored        # and at most
    int32_t driven              # islands that asked for factors
    int32_t longest             # sweeps and factorisations of one island


cdef struct newton_run_t:
    view_t v
    asked_t asked
    room_t room
    said_t said
    int32_t how


cdef inline void lay(island_t* s, double* numbers, int32_t* marks, int32_t m, int32_t k, int32_t nnz) noexcept nogil:
    """Places of m rows in k blocks with nnz entries."""
    s.numbers, s.marks = numbers, marks
    s.n_numbers, s.n_marks = 7 * <int64_t>m + 3 * k + nnz, 2 * k + m + 2 + nnz
    s.p.n_blocks, s.p.n_rows = k, m
    s.p.lower, s.p.upper, s.p.b, s.p.d = numbers, numbers + m, numbers + 2 * m, numbers + 3 * m
    s.p.nu, s.p.step = numbers + 4 * m, numbers + 5 * m
    s.lam = numbers + 6 * m
    s.p.mu, s.p.patch_radius, s.p.rolling = numbers + 7 * m, numbers + 7 * m + k, numbers + 7 * m + 2 * k
    s.a.data = numbers + 7 * m + 3 * k
    s.answer = numbers + s.n_numbers
    s.w, s.error, s.swept = s.answer + m, s.answer + 2 * m, s.answer + 3 * m
    s.p.ptr, s.p.kind = marks, marks + k + 1
    s.a.indptr, s.a.indices = marks + 2 * k + 1, marks + 2 * k + m + 2


cdef inline int64_t numbers_of(int64_t m, int64_t k, int64_t nnz) noexcept nogil:
    return 11 * m + 3 * k + nnz


cdef inline void cut(island_t* s, const blocks_t* p, const csr_t* a, const int32_t* block, const double* lam,
                     int32_t* place) noexcept nogil:
    """The blocks `block` of the whole; place (rows of the whole) gets the numbers that its rows have here."""
    cdef int32_t i, j, k, q, row, at = 0, n = 0
    cdef int32_t* ptr = <int32_t*>s.p.ptr
    cdef int32_t* kind = <int32_t*>s.p.kind
    cdef int32_t* indptr = <int32_t*>s.a.indptr
    cdef int32_t* indices = <int32_t*>s.a.indices
    cdef double* data = <double*>s.a.data
    s.p.law = p.law
    ptr[0] = 0
    indptr[0] = 0
    for k in range(s.p.n_blocks):
        i = block[k]
        kind[k] = p.kind[i]
        (<double*>s.p.mu)[k], (<double*>s.p.patch_radius)[k] = p.mu[i], p.patch_radius[i]
        (<double*>s.p.rolling)[k] = p.rolling[i]
        j = p.ptr[i]
        q = p.ptr[i + 1] - j
        memcpy(<double*>s.p.lower + n, p.lower + j, q * sizeof(double))
        memcpy(<double*>s.p.upper + n, p.upper + j, q * sizeof(double))
        memcpy(<double*>s.p.b + n, p.b + j, q * sizeof(double))
        memcpy(<double*>s.p.d + n, p.d + j, q * sizeof(double))
        memcpy(<double*>s.p.nu + n, p.nu + j, q * sizeof(double))
        memcpy(<double*>s.p.step + n, p.step + j, q * sizeof(double))
        memcpy(s.lam + n, lam + j, q * sizeof(double))
        for row in range(j, j + q):
            place[row] = n
            n += 1
        ptr[k + 1] = n
    n = 0
    for k in range(s.p.n_blocks):
        i = block[k]
        for row in range(p.ptr[i], p.ptr[i + 1]):
            for q in range(a.indptr[row], a.indptr[row + 1]):
                indices[at] = place[a.indices[q]]
                data[at] = a.data[q]
                at += 1
            n += 1
            indptr[n] = at


cdef inline bint same(const island_t* s, const island_t* t) noexcept nogil:
    return (s.n_numbers == t.n_numbers and s.n_marks == t.n_marks
            and memcmp(s.numbers, t.numbers, s.n_numbers * sizeof(double)) == 0
            and memcmp(s.marks, t.marks, s.n_marks * sizeof(int32_t)) == 0)


cdef inline double found_at(const island_t* s, const double* lam, double e0, double v0) noexcept nogil:
    cdef score_t found = score_t(0.0, 0.0, 0.0, 0.0, -1, 1)
    judge_into(&s.p, &s.a, NULL, False, lam, s.w, s.error, NULL, False, &found)
    return relative_of(&found, s.w, s.p.n_rows, e0, v0)


cdef inline bint promises(double before, double now, double tol, int32_t rounds) noexcept nogil:
    """Does what the last round gained bring the residual to tol in so many more?"""
    cdef double fall = now / before
    cdef int32_t _
    for _ in range(rounds):
        now *= fall
        if now <= tol:
            return True
    return False


cdef inline double sweep_on(island_t* s, sweep_data_t* c, const ask_t* o, double e0, double v0, int32_t most) noexcept nogil:
    """Sweeps of `swept` up to `most` in all, as long as they promise an end within that; its relative residual."""
    cdef double before, now = found_at(s, s.swept, e0, v0)
    cdef int32_t step = FIRST
    while now > o.tol and c.turn < most:
        before = now
        anderson_step(c, s.swept, c.turn == 0, step)
        now = found_at(s, s.swept, e0, v0)
        step = c.turn // 2 if c.turn // 2 > FIRST else FIRST
        if not promises(before, now, o.tol, HOPED * (most - c.turn) // step):
            break
    return now


cdef inline bint begin_newton(island_t* s, newton_run_t* n, room_t* r) noexcept nogil:
    """Newton's method from `answer`; is there room for it?"""
    n.v = view_t(s.p, &s.a, NULL, NULL)
    lav_room(&n.v, &n.asked, &n.room)
    if n.room.n_index > r.n_index or n.room.n_real > r.n_real:
        free(r.index)
        free(r.real)
        r.n_index, r.n_real = 2 * n.room.n_index, 2 * n.room.n_real
        r.index = <int32_t*>malloc(r.n_index * sizeof(int32_t))
        r.real = <double*>malloc(r.n_real * sizeof(double))
        if r.index == NULL or r.real == NULL:
            r.n_index = r.n_real = 0
            return False
    n.room.index, n.room.real = r.index, r.real
    n.said.factorisations = 0
    n.how = lav_start(&n.v, &n.asked, &n.room, s.answer)
    return n.how == MORE


cdef inline double step_newton(island_t* s, newton_run_t* n, double e0, double v0, int32_t steps) noexcept nogil:
    """So many factorisations, or its end; the relative residual of `answer`."""
    cdef int32_t last = n.said.factorisations + steps
    while n.said.factorisations < last and (n.how == MORE or n.how == CERTIFICATE):
        n.how = lav_step(&n.v, &n.asked, &n.room, last - n.said.factorisations, s.answer, &n.said)
    return found_at(s, s.answer, e0, v0)


cdef inline bint solve_island(island_t* s, sweep_data_t* c, ask_t* o, room_t* r) noexcept nogil:
    """From `lam` into `answer`, in turns of both; has it met its share?"""
    cdef score_t nothing = score_t(0.0, 0.0, 0.0, 0.0, -1, 1)
    cdef newton_run_t n
    cdef int32_t m = s.p.n_rows
    cdef double own, e0, v0, now
    do_nothing(&s.p, s.answer, s.w)
    judge_into(&s.p, &s.a, NULL, False, s.answer, s.w, s.error, NULL, False, &nothing)
    own = nothing.energy
    if own == 0.0 and nothing.velocity == 0.0:
        return True     # doing nothing is right
    e0, v0 = sqrt(0.5 * (own * own + o.e0 * o.e0)), o.v0
    memcpy(s.swept, s.lam, m * sizeof(double))
    c.turn = 0
    memset(c.control, 0, CONTROL * sizeof(double))
    n.said.factorisations = 0
    now = sweep_on(s, c, o, e0, v0, o.most)
    if now > o.tol:
        o.driven += 1
        if now < 1.0:
            memcpy(s.answer, s.swept, m * sizeof(double))
        # Both measures of the island's own error of doing nothing are then below tol of its share.
        now = e0 / own if e0 * nothing.velocity < v0 * own else v0 / nothing.velocity
        n.asked = asked_t(NEWTON, STEPS, 0, 0, 0, o.wide, o.tol * now)
        if not begin_newton(s, &n, r):
            return False
        now = step_newton(s, &n, e0, v0, SHORT)
        if now > o.tol:
            now = sweep_on(s, c, o, e0, v0, AGAIN * o.most)
            if now <= o.tol:
                memcpy(s.answer, s.swept, m * sizeof(double))
            else:
                now = step_newton(s, &n, e0, v0, STEPS)
    else:
        memcpy(s.answer, s.swept, m * sizeof(double))
    o.swept += c.turn
    o.undone += <int64_t>c.control[UNDONE]
    o.factorisations += n.said.factorisations
    o.factored += n.said.factorisations * (<double>m * m * m)
    if c.turn + n.said.factorisations > o.longest:
        o.longest = c.turn + n.said.factorisations
    return now <= o.tol and o.factored <= o.most_factored


cdef class Islands:
    """A problem under friction that divides; `run` only reads it.

    Parameters
    ----------
    data : Data
        What the judge reads, its error of doing nothing known.
    matrix : Data
        Of A in compressed rows.
    start : (m,) N s
        Pi(0), read-only.
    label : (k,) int32
        The island of each block, from 0 to count - 1.
    count, most : int
        Islands; sweeps of one at most.
    """

    cdef Data data, matrix
    cdef readonly bint pivots
    cdef readonly int count
    cdef readonly double most_factored
    cdef object start, label
    cdef int most

    def __init__(self, Data data, Data matrix, start, label, int count, int most):
        self.data, self.matrix, self.start, self.label = data, matrix, start, label
        self.count, self.most = count, most
        rows = np.bincount(label, np.diff(np.asarray(<int32_t[:data.blocks.n_blocks + 1]>data.blocks.ptr)))
        self.most_factored = SHORT * float(rows @ rows**2)

    def run(self, impulse, double tol, bint look, double warm, bint follow=False):
        """As `Chain.run`; counts are (longest, sweeps, undone, factorisations, islands that asked for these, islands)."""
        cdef Judged found
        if impulse is None or same_bits(impulse, self.start):
            impulse = self.start
            if self.data.start_relative <= tol:
                return Judged(self.data, self.start.copy()), None
        else:
            found = Judged(self.data, impulse.copy())
            if found.relative <= tol:
                return found, None
            if not found.relative < 1.0:
                impulse = self.start
        own = impulse.copy()
        counts = self.solve(own, tol)
        if counts is None:
            return False
        found = Judged(self.data, own)
        return (found, counts) if found.relative <= tol else False

    cdef solve(self, double[::1] own, double tol):
        cdef const int32_t[::1] label = self.label, block, first
        cdef const blocks_t* p = &self.matrix.blocks
        cdef const csr_t* a = &self.matrix.csr
        cdef int32_t i, j, q, m, k, nnz, n = self.count, most_m = 0, most_k = 0, most_nnz = 0
        cdef ask_t o = ask_t(tol, self.data.start_energy / sqrt(<double>n), self.data.start_velocity, self.most, has_wide(),
                             0, 0, 0, 0.0, self.most_factored, 0, 0)
        cdef island_t two[2]
        cdef island_t* s
        cdef sweep_data_t c
        cdef room_t r = room_t(0, 0, NULL, NULL)
        cdef uint64_t rng = 0
        cdef int64_t swept
        cdef double factored, unheard = 0.0     # multiply-adds
        cdef bint good = True
        cdef const int32_t[::1] prepared_at
        cdef const double[::1] prepared
        block = np.argsort(self.label, kind="stable").astype(np.int32)
        sizes = np.bincount(self.label, minlength=n)
        first = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
        size_array = np.zeros((n, 2), np.int32)
        cdef int32_t[:, ::1] size = size_array
        for i in range(p.n_blocks):
            size[label[i], 0] += p.ptr[i + 1] - p.ptr[i]
            size[label[i], 1] += a.indptr[p.ptr[i + 1]] - a.indptr[p.ptr[i]]
        most_m, most_nnz = size_array.max(axis=0)
        most_k = sizes.max()
        cdef int64_t each = numbers_of(most_m, most_k, most_nnz), whole = 2 * most_k + most_m + 2 + most_nnz
        cdef double[::1] numbers = np.empty(2 * each)
        cdef int32_t[::1] marks = np.empty(2 * whole, np.int32)
        cdef int32_t[::1] place = np.empty(p.n_rows, np.int32), at = np.empty(most_k + 1, np.int32)
        cdef int32_t[::1] order = np.arange(most_k, dtype=np.int32)
        cdef double[::1] work = np.empty((4 + 2 * MEMORY) * most_m), control = np.zeros(CONTROL)
        cdef double[::1] gram = np.zeros(MAX_MEMORY * MAX_MEMORY)
        memset(&c, 0, sizeof(c))
        c.order, c.work, c.control, c.gram, c.rng = &order[0], &work[0], &control[0], &gram[0], &rng
        c.memory, c.exact = MEMORY, p.law == CONE
        if c.exact:
            prepared_at, prepared = gauss_seidel.prepare(self.matrix)
            c.start, c.g = &at[0], &prepared[0]
        two[1].n_numbers = -1
        try:
            with nogil:
                for i in range(n):
                    s = &two[i % 2]
                    m, k, nnz = size[i, 0], first[i + 1] - first[i], size[i, 1]
                    lay(s, &numbers[(i % 2) * each], &marks[(i % 2) * whole], m, k, nnz)
                    cut(s, p, a, &block[first[i]], &own[0], &place[0])
                    if same(s, &two[1 - i % 2]):
                        memcpy(s.answer, two[1 - i % 2].answer, m * sizeof(double))
                    else:
                        for j in range(k if c.exact else 0):
                            at[j] = prepared_at[block[first[i] + j]]
                        c.blocks, c.csr = &s.p, &s.a
                        swept, factored = o.swept, o.factored
                        good = solve_island(s, &c, &o, &r)
                        if not good:
                            break
                        unheard += o.factored - factored + <double>nnz * (o.swept - swept)
                        if unheard > LISTEN:
                            unheard = 0.0
                            with gil:
                                PyErr_CheckSignals()
                    for j in range(k):
                        q = block[first[i] + j]
                        memcpy(&own[p.ptr[q]], s.answer + s.p.ptr[j], (p.ptr[q + 1] - p.ptr[q]) * sizeof(double))
        finally:
            free(r.index)
            free(r.real)
        return (o.longest, o.swept, o.undone, o.factorisations, o.driven, n) if good else None
