"""Problems of few rows by bodies or by A, and islands of few rows: check the start, solve and judge in one call.

    bounded rows   the factor of A, linear or boxed, one shift where it is singular, refinement (pivot/direct.pyx);
                   where exchanges are stuck Lemke's path, if asked for                      (pivot/lemke.pyx)
    friction       accelerated sweeps and Newton's method in turns                                 (friction.pxd)

Under friction a part is the whole, or each island in its turn, cut out of A or of the bodies. Part i of n, E0_i its error of doing
nothing, has met its share where

    E_i <= tol sqrt((E0_i^2 + E0^2 / n) / 2),   V_i <= tol V0                                              (1)

which for all of them together is tol by both measures. An island with the bytes of the one before has its answer. What
does not end below tol on the judge's own measure is nobody's result: the caller starts again the long way.
"""
from cpython.exc cimport PyErr_CheckSignals
from libc.math cimport INFINITY, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.stdlib cimport free
from libc.string cimport memcmp, memcpy

import numpy as np

from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.parts cimport CONE, FRICTIONS, blocks_t, frictions_of, lay_frictions
from lavender_ext.core.problem cimport Data, Room, room_for
from lavender_ext.core.rows cimport rows_t
from lavender_ext.core.view cimport view_t
from lavender_ext.core.method cimport room_t
from lavender_ext.factor.tiles cimport has_wide
from lavender_ext.small.friction cimport ask_t, part_t, solve_part, work_of
from lavender_ext.judge.measure cimport Judged
from lavender_ext.judge.measure import same_bits
from lavender_ext.local import gauss_seidel
from lavender_ext.pivot.direct cimport (HALVED, direct_begin, direct_begin_passes, direct_factor, direct_first,
                                        direct_index, direct_lay, direct_linear, direct_pass, direct_real, direct_t, is_end)
from lavender_ext.pivot.lemke cimport RAY, lemke_begin, lemke_index, lemke_lay, lemke_real, lemke_run, lemke_t
from lavender_ext.pivot.principal cimport INDEFINITE, SMALL, SOLVED


cdef enum:
    SWEEPS = 2                  # that guess the free rows
    ROUNDS = 32                 # of exchanges
    PATH = 8                    # pivots of Lemke's for each row
    ROUND_ROW = 50              # ns of a round for each row, beside its factor
    FEW = 12                    # rows of an island that has all of its sweeps before its factors
    LISTEN = 5000000            # multiply-adds between two checks for Ctrl-C, a few milliseconds


cdef class Small:
    """One problem, its error of doing nothing known to `data`; `run` only reads it.

    Parameters
    ----------
    data : Data
        What the judge reads.
    start : (m,) N s
        Pi(0), read-only.
    matrix : Data
        What is solved: of bounded rows and islands A in compressed rows.
    """

    cdef readonly Data data
    cdef readonly object start
    cdef readonly bint pivots
    cdef Data matrix

    def __init__(self, Data data, start, Data matrix):
        self.data, self.start, self.matrix = data, start, matrix

    def run(self, impulse, double tol, bint follows, double warm, double most=INFINITY):
        """From `impulse` (m,) [N s], or from `start` where it is None: (what the judge finds, what was done).

        follows: another method comes next. Is `impulse` a solution? It is no start where its residual is above that of doing
        nothing, or for pivots above `warm`. And what pivots find is good where it is below tol, not to rounding alone,
        with Lemke's path where exchanges are stuck. The judge finds None where it does not end below tol. What was done is
        None where `impulse` is the solution. most: counted cost [ns] where what was found by then is the result.
        """
        cdef Judged found
        cdef double before = self.data.start_relative
        if follows:
            if impulse is None or same_bits(impulse, self.start):
                impulse = None
                if before <= tol:
                    return Judged(self.data, self.start.copy()), None
            else:
                found = Judged(self.data, impulse.copy())
                before = found.relative
                if before <= tol:
                    return found, None
            if not before <= (warm if self.pivots else 1.0):
                impulse = None
        own = (self.start if impulse is None else impulse).copy()
        good, counts = self.solve(own, tol, follows, &most)
        found = Judged(self.data, own) if good else None
        good = good and (self.pivots or found.relative <= tol or not most > 0.0)
        return found if good else None, counts

    cdef solve(self, own, double tol, bint follow, double* most):
        """`own` (m,) N s in place: is it good, and counts. What it cost is taken off `most`, which ends it at 0 or below."""


cdef inline bint met(const direct_t* t, double tol, bint enough) noexcept nogil:
    # Below tol and to rounding; where bounded rows are exchanged to the end and that is `enough`, below tol alone.
    return t.relative <= tol and (is_end(t) or (enough and t.solved and not t.linear))


cdef inline bint pivot(direct_t* t, const double* start, double tol, bint enough, double most) noexcept nogil:
    """Into `best`; did it end below tol? Passes end where one does not halve the residual, or is stuck.

    No more rounds than `most`, which ends it.
    """
    cdef int32_t code
    direct_begin(t, start)
    if t.linear:
        code = direct_factor(t)
        if code == INDEFINITE:
            return False
        if code == SOLVED:
            code = direct_linear(t)
    else:
        code = direct_first(t, SWEEPS, ROUNDS if most > ROUNDS else <int32_t>max(most, 0.0))
    if t.symmetric and (code == SMALL or (t.linear and not is_end(t))):
        direct_begin_passes(t, 0)
        code = HALVED
        while code == HALVED and t.s.n_rounds < most:
            code = direct_pass(t, ROUNDS if most - t.s.n_rounds > ROUNDS else <int32_t>(most - t.s.n_rounds))
            if not t.relative < INFINITY:
                return False
    return met(t, tol, enough)


cdef class Bounded(Small):
    """Linear or boxed; counts are (rounds, whether swept, refinements, factorisations, pivots, shifts, rank of a singular
    linear system or 0, pivots of Lemke's path).

    Parameters
    ----------
    band, linear, symmetric : int, bool, bool
        Half bandwidth of A, m - 1 where it is not symmetric; whether every row is free.
    """

    cdef int band
    cdef bint linear, symmetric

    def __init__(self, Data data, start, Data matrix, int band, bint linear, bint symmetric):
        Small.__init__(self, data, start, matrix)
        self.band, self.linear, self.symmetric, self.pivots = band, linear, symmetric, True

    cdef solve(self, own, double tol, bint follow, double* most):
        cdef double[::1] start = own
        cdef view_t v = self.data.view()
        cdef int64_t n = direct_real(&v, self.band)
        cdef Room room = room_for(n * sizeof(double) + direct_index(&v) * sizeof(int32_t))
        cdef double* real = <double*>room.at
        cdef direct_t t
        cdef int32_t path = 0
        cdef double each = ROUND_ROW * self.data.blocks.n_rows + 0.1 * self.data.blocks.n_rows * (self.band + 1.0) ** 2
        cdef bint ended
        t.e0, t.v0, t.least = self.data.start_energy, self.data.start_velocity, 1e-13
        t.linear, t.symmetric = self.linear, self.symmetric
        with nogil:
            direct_lay(&t, &v, &self.matrix.csr, &self.matrix.blocks, self.band, NULL, 1e-13, real,
                       <int32_t*>(real + n))
            ended = pivot(&t, &start[0], tol, follow, most[0] / each)
        most[0] -= t.s.n_rounds * each
        if not ended and most[0] > 0.0:
            path = self.followed(&t, own, tol, most) if follow and not t.linear and not t.solved else -1
        if not ended:
            ended = (path >= 0 and t.relative <= tol) or (not most[0] > 0.0 and t.relative < INFINITY)
        if ended:
            memcpy(&start[0], t.best, t.s.n * sizeof(double))
        return ended, (t.s.n_rounds, bool(t.swept), t.refined, t.s.factorisations, t.s.exchanged, t.shifts, t.rank,
                       max(path, 0))

    cdef int followed(self, direct_t* t, own, double tol, double* most) except -2:
        """Where exchanges are stuck: Lemke's paths, and exchanges at their end.

        Pivots of the paths, -1 where they do not end below tol.
        """
        cdef lemke_t l
        cdef double each = 2.0 * <double>t.s.n ** 2
        cdef int32_t last = PATH * t.s.n if most[0] > PATH * t.s.n * each else <int32_t>(most[0] / each)
        cdef int64_t n = lemke_real(t.s.p)
        cdef Room room = room_for(n * sizeof(double) + lemke_index(t.s.p) * sizeof(int32_t))
        cdef double* real = <double*>room.at
        with nogil:
            lemke_lay(&l, t, real, <int32_t*>(real + n))
            lemke_begin(&l)
            while lemke_run(&l, last - l.pivots) == RAY:
                pass
        if last < PATH * t.s.n:
            most[0] -= l.pivots * each
        return l.pivots if t.relative <= tol else -1


cdef enum:                      # numbers of an island's
    OF_ROW = 7                  # rows: lower, upper, b, d, nu, step, where it starts
    OF_JOINT = 24               # rows of joints: J, M^-1 J^T
    OF_TURN = 6                 # rows of contacts: swing
    OF_CONTACT = 17             # contacts: normal, tangent, arm_a, arm_b, coupling
    OF_BODY = 10                # bodies: 1/m, I^-1
    SIZES = 5


cdef struct island_t:           # cut out of A or of the bodies; its numbers and whole numbers are one run of bytes each
    part_t s
    csr_t a
    rows_t r
    double* numbers
    int32_t* marks
    int64_t n_numbers
    int64_t n_marks


cdef inline double* after(double** at, int64_t n) noexcept nogil:
    """The next n of them."""
    cdef double* x = at[0]
    at[0] = x + n
    return x


cdef inline void lay(island_t* x, double* numbers, int32_t* marks, const int32_t* size, int32_t n) noexcept nogil:
    """Places of an island of so many (SIZES) rows, blocks, entries, rows of joints and joints on n bodies, and of its answer.

    n < 0: over A, without joints.
    """
    cdef blocks_t* p = &x.s.v.p
    cdef rows_t* r = &x.r
    cdef int32_t m = size[0], k = size[1], nnz = size[2], mj = size[3], c = k - size[4]
    x.numbers, x.marks = numbers, marks
    p.n_blocks, p.n_rows = k, m
    p.lower, p.upper, p.b = after(&numbers, m), after(&numbers, m), after(&numbers, m)
    p.d, p.nu, p.step, x.s.lam = after(&numbers, m), after(&numbers, m), after(&numbers, m), after(&numbers, m)
    lay_frictions(p, after(&numbers, FRICTIONS * k), k)
    p.ptr, p.kind = marks, marks + k + 1
    marks += 2 * k + 1
    x.s.v.a = x.s.v.r = x.s.v.g = NULL
    if n < 0:
        x.a.data, x.a.indptr, x.a.indices = after(&numbers, nnz), marks, marks + m + 1
        marks += m + 1 + nnz
        x.s.v.a = &x.a
    else:
        r.n_bodies, r.n_joints, r.n_contacts = n, size[4], c
        r.jac, r.minv_jac = after(&numbers, 12 * mj), after(&numbers, 12 * mj)
        r.normal, r.tangent = after(&numbers, 3 * c), after(&numbers, 3 * c)
        r.arm_a, r.arm_b, r.coupling = after(&numbers, 3 * c), after(&numbers, 3 * c), after(&numbers, 5 * c)
        r.swing, r.compliance = after(&numbers, OF_TURN * (m - mj)), after(&numbers, m)
        r.inv_mass, r.inv_inertia = after(&numbers, n), after(&numbers, 9 * n)
        r.joint_body, r.contact_body = marks, marks + 2 * size[4]
        marks += 2 * k
        x.s.v.r = r
    x.n_numbers, x.n_marks = numbers - x.numbers, marks - x.marks
    x.s.answer = numbers


cdef inline void cut(island_t* x, const blocks_t* p, const int32_t* block, const double* lam, int32_t* place) noexcept nogil:
    """The blocks `block` of the whole; place (rows of the whole) gets the numbers that its rows have here."""
    cdef const double* of_row[OF_ROW]
    cdef const double* of_block[FRICTIONS]
    cdef blocks_t* own = &x.s.v.p
    cdef int32_t i, j, k, q, row, n = 0
    cdef int32_t* ptr = <int32_t*>own.ptr
    of_row[0], of_row[1], of_row[2], of_row[3], of_row[4], of_row[5] = p.lower, p.upper, p.b, p.d, p.nu, p.step
    of_row[6] = lam
    frictions_of(p, of_block)
    own.law = p.law
    ptr[0] = 0
    for k in range(own.n_blocks):
        i = block[k]
        (<int32_t*>own.kind)[k] = p.kind[i]
        for q in range(FRICTIONS):
            x.numbers[OF_ROW * own.n_rows + q * own.n_blocks + k] = of_block[q][i]
        j = p.ptr[i]
        for q in range(OF_ROW):
            memcpy(x.numbers + q * own.n_rows + n, of_row[q] + j, (p.ptr[i + 1] - j) * sizeof(double))
        for row in range(j, p.ptr[i + 1]):
            place[row] = n
            n += 1
        ptr[k + 1] = n


cdef inline void cut_matrix(island_t* x, const blocks_t* p, const csr_t* a, const int32_t* block,
                            const int32_t* place) noexcept nogil:
    """Their entries of A."""
    cdef int32_t i, k, q, row, at = 0, n = 0
    cdef int32_t* indptr = <int32_t*>x.a.indptr
    indptr[0] = 0
    for k in range(x.s.v.p.n_blocks):
        i = block[k]
        for row in range(p.ptr[i], p.ptr[i + 1]):
            for q in range(a.indptr[row], a.indptr[row + 1]):
                (<int32_t*>x.a.indices)[at] = place[a.indices[q]]
                (<double*>x.a.data)[at] = a.data[q]
                at += 1
            n += 1
            indptr[n] = at


cdef inline const int32_t* bodies_at(const rows_t* r, int32_t i) noexcept nogil:
    """The two of block i."""
    return r.joint_body + 2 * i if i < r.n_joints else r.contact_body + 2 * (i - r.n_joints)


cdef inline int32_t number_bodies(const rows_t* r, const int32_t* block, int32_t k, int32_t* number, int32_t* body) noexcept nogil:
    """Those of k blocks, in the order in which they come, into `body`, their places there into `number`; how many."""
    cdef const int32_t* two
    cdef int32_t i, side, n = 0
    for i in range(k):
        two = bodies_at(r, block[i])
        for side in range(2):
            if two[side] >= 0 and number[two[side]] < 0:
                number[two[side]] = n
                body[n] = two[side]
                n += 1
    return n


cdef inline void pick(const double* to, int64_t n, const double* x, int64_t i) noexcept nogil:
    """n numbers of the i-th."""
    memcpy(<void*>to, x + n * i, n * sizeof(double))


cdef inline void cut_rows(island_t* x, const blocks_t* p, const rows_t* r, const int32_t* block, const int32_t* number,
                          const int32_t* body) noexcept nogil:
    """Their joints, contacts and bodies."""
    cdef const blocks_t* own = &x.s.v.p
    cdef const rows_t* y = &x.r
    cdef const int32_t* two
    cdef int32_t i, j, k, m, c, n, first = own.ptr[y.n_joints]
    cdef int32_t* pair
    for k in range(own.n_blocks):
        i, m, n = block[k], own.ptr[k], own.ptr[k + 1] - own.ptr[k]
        j, two, pair = p.ptr[i], bodies_at(r, i), <int32_t*>bodies_at(y, k)
        for c in range(2):
            pair[c] = number[two[c]] if two[c] >= 0 else -1
        memcpy(<void*>(y.compliance + m), r.compliance + j, n * sizeof(double))
        if k < y.n_joints:
            memcpy(<void*>(y.jac + 12 * m), r.jac + 12 * j, 12 * n * sizeof(double))
            memcpy(<void*>(y.minv_jac + 12 * m), r.minv_jac + 12 * j, 12 * n * sizeof(double))
            continue
        memcpy(<void*>(y.swing + OF_TURN * (m - first)), r.swing + OF_TURN * (j - p.ptr[r.n_joints]),
               OF_TURN * n * sizeof(double))
        c, i = k - y.n_joints, i - r.n_joints
        pick(y.normal + 3 * c, 3, r.normal, i)
        pick(y.tangent + 3 * c, 3, r.tangent, i)
        pick(y.arm_a + 3 * c, 3, r.arm_a, i)
        pick(y.arm_b + 3 * c, 3, r.arm_b, i)
        pick(y.coupling + 5 * c, 5, r.coupling, i)
    for k in range(y.n_bodies):
        pick(y.inv_mass + k, 1, r.inv_mass, body[k])
        pick(y.inv_inertia + 9 * k, 9, r.inv_inertia, body[k])


cdef inline bint same(const island_t* x, const island_t* y) noexcept nogil:
    return (x.n_numbers == y.n_numbers and x.n_marks == y.n_marks
            and memcmp(x.numbers, y.numbers, x.n_numbers * sizeof(double)) == 0
            and memcmp(x.marks, y.marks, x.n_marks * sizeof(int32_t)) == 0)


cdef inline int32_t swept_before(const blocks_t* p, int32_t most) noexcept nogil:
    """Sweeps of an island before its factors: of many rows these pay sooner, and at once under the cone's law."""
    if p.n_rows <= FEW:
        return most
    return 0 if p.law == CONE else most * FEW // p.n_rows


cdef class Friction(Small):
    """Contacts; counts are (longest of a part, sweeps, undone, factorisations, parts that asked for these, parts).

    Parameters
    ----------
    split, most : int
        Blocks before it are swept before the others: joints, contacts; sweeps of one part at most, before its factors.
    label : (k,) int32, or None
        The island of each block, from 0 to count - 1.
    count : int
        Islands; 1 is the whole.
    """

    cdef readonly int count
    cdef object block, size, at, prepared
    cdef int split, most

    def __init__(self, Data data, start, Data matrix, int split, int most, label=None, int count=1):
        Small.__init__(self, data, start, matrix)
        self.split, self.most, self.count = split, most, count
        # Within a contact of a matrix that was given, units may be unlike.
        if matrix.blocks.law == CONE or not (data.factored or data.is_general):
            self.at, self.prepared = gauss_seidel.prepare(matrix)
        if count > 1:
            self.find_sizes(label)

    cdef int find_sizes(self, const int32_t[::1] label) except -1:
        """What each island has, and blocks by their islands."""
        cdef Data of = self.matrix
        cdef const int32_t* ptr = of.blocks.ptr
        cdef int32_t i, k = of.blocks.n_blocks, rows, joints = of.rows.n_joints if of.factored else 0, at = 0
        self.size, self.block = np.zeros((self.count, SIZES), np.int32), np.empty(k, np.int32)
        cdef int32_t[:, ::1] size = self.size
        cdef int32_t[::1] block = self.block, first = np.empty(self.count, np.int32)
        for i in range(k):
            rows = ptr[i + 1] - ptr[i]
            size[label[i], 0] += rows
            size[label[i], 1] += 1
            if not of.factored:
                size[label[i], 2] += of.csr.indptr[ptr[i + 1]] - of.csr.indptr[ptr[i]]
            if i < joints:
                size[label[i], 3] += rows
                size[label[i], 4] += 1
        for i in range(self.count):
            first[i] = at
            at += size[i, 1]
        for i in range(k):
            block[first[label[i]]] = i
            first[label[i]] += 1
        return 0

    cdef solve(self, own, double tol, bint follow, double* most):
        cdef ask_t o = ask_t(tol, self.data.start_energy / sqrt(<double>self.count), self.data.start_velocity, self.most,
                             self.most, has_wide(), 0, 0, 0, 0.0, most[0], 0, 0)
        cdef room_t r = room_t(0, 0, NULL, NULL, 0, 0, 0, 0.0)
        try:
            good = self.whole(own, &o, &r) if self.count == 1 else self.islands(own, &o, &r)
        finally:
            free(r.index)
            free(r.real)
        most[0] = o.left
        done = o.longest, o.swept, o.undone, o.factorisations, o.driven, self.count
        return good or (self.count == 1 and not o.left > 0.0), done

    cdef bint whole(self, double[::1] own, ask_t* o, room_t* r) except -1:
        cdef part_t s
        cdef const blocks_t* p = &self.matrix.blocks
        cdef int32_t m = p.n_rows, n = 0 if self.matrix.csr.indptr != NULL else self.matrix.rows.n_bodies
        cdef Room room = room_for((work_of(m, n) + m) * sizeof(double) + p.n_blocks * sizeof(int32_t))
        cdef double* x = <double*>room.at
        cdef const int32_t[::1] at
        cdef const double[::1] prepared
        cdef bint good
        s.v = self.matrix.view()
        s.lam, s.answer, s.split = &own[0], x, self.split
        s.at, s.prepared, s.nothing = NULL, NULL, self.data.start_relative
        if self.prepared is not None:
            at, prepared = self.at, self.prepared
            s.at, s.prepared = &at[0], &prepared[0]
        with nogil:
            good = solve_part(&s, o, r, x + m, <int32_t*>(x + m + work_of(m, n)))
        memcpy(&own[0], s.answer, m * sizeof(double))
        return good

    cdef bint islands(self, double[::1] own, ask_t* o, room_t* r) except -1:
        cdef const blocks_t* p = &self.matrix.blocks
        cdef const rows_t* rows = &self.matrix.rows
        cdef bint over_bodies = self.matrix.factored
        cdef const int32_t[::1] block = self.block, prepared_at
        cdef const int32_t[:, ::1] size = self.size     # SIZES of each
        cdef const double[::1] prepared
        cdef int32_t n_bodies = rows.n_bodies if over_bodies else 0
        cdef int32_t[::1] place = np.empty(p.n_rows, np.int32), at, order, marks, number, body
        cdef double[::1] numbers, work
        cdef int32_t i, j, q, m, k, n = -1, first = 0
        cdef int64_t swept, read, unheard = 0
        cdef double factored
        cdef island_t two[2]
        cdef island_t* x
        cdef island_t* last
        cdef bint good = True
        m, k, q, _, _ = self.size.max(axis=0)
        cdef int64_t each = (OF_ROW + 1) * <int64_t>m + FRICTIONS * k + q, whole = 4 * k + m + 2 + q
        if over_bodies:
            n = min(2 * k, n_bodies)
            each += (OF_JOINT + OF_TURN + 1) * <int64_t>m + OF_CONTACT * k + OF_BODY * n
        numbers, marks, work = np.empty(2 * each), np.empty(2 * whole, np.int32), np.empty(work_of(m, max(n, 0)))
        at, order = np.empty(k + 1, np.int32), np.empty(k, np.int32)
        number, body = np.full(n_bodies + 1, -1, np.int32), np.empty(n + 2, np.int32)
        if self.prepared is not None:
            prepared_at, prepared = self.at, self.prepared
        two[1].n_numbers = -1
        with nogil:
            for i in range(self.count):
                x, last = &two[i % 2], &two[1 - i % 2]
                m, k = size[i, 0], size[i, 1]
                if over_bodies:
                    n = number_bodies(rows, &block[first], k, &number[0], &body[0])
                lay(x, &numbers[(i % 2) * each], &marks[(i % 2) * whole], &size[i, 0], n)
                cut(x, p, &block[first], &own[0], &place[0])
                if over_bodies:
                    cut_rows(x, p, rows, &block[first], &number[0], &body[0])
                else:
                    cut_matrix(x, p, &self.matrix.csr, &block[first], &place[0])
                if same(x, last):
                    memcpy(x.s.answer, last.s.answer, m * sizeof(double))
                else:
                    x.s.split, x.s.at, x.s.prepared, x.s.nothing = size[i, 4], NULL, NULL, -1.0
                    if p.law == CONE:
                        for j in range(k):
                            at[j] = prepared_at[block[first + j]]
                        x.s.at, x.s.prepared = &at[0], &prepared[0]
                    o.first = swept_before(&x.s.v.p, o.most)
                    swept, factored = o.swept, o.factored
                    good = solve_part(&x.s, o, r, &work[0], &order[0])
                    if not good:
                        break
                    read = OF_JOINT * m if over_bodies else size[i, 2]
                    unheard += <int64_t>(o.factored - factored) + read * (o.swept - swept)
                    if unheard > LISTEN:
                        unheard = 0
                        with gil:
                            PyErr_CheckSignals()
                for j in range(k):
                    q = block[first + j]
                    memcpy(&own[p.ptr[q]], x.s.answer + x.s.v.p.ptr[j], (p.ptr[q + 1] - p.ptr[q]) * sizeof(double))
                first += k
        return good
