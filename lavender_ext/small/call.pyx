"""Problems of few rows by bodies or by A, and islands of few rows: check the start, solve and judge in one call.

    bounded rows   the factor of A, linear or boxed, one shift where it is singular, refinement (pivot/direct.pyx);
                   where exchanges are stuck Lemke's path, if asked for                      (pivot/lemke.pyx)
    friction       accelerated sweeps and Newton's method in turns                                 (friction.pxd)

Under friction a part is the whole, or each island in turn, cut out of A or of the bodies and solved to its own relative residual
(judge/score.pxd). An island with the bytes of the one before has the same answer. If the result does not end below tol on the
judge's own measure, the call returns none and the caller starts the general solver.
"""
from cpython.exc cimport PyErr_CheckSignals
from libc.math cimport INFINITY
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcmp, memcpy, memset

import numpy as np

from lavender_ext.core.arrays cimport doubles
from lavender_ext.core.csr cimport scan_entries
from lavender_ext.core.order cimport sort_by_level
from lavender_ext.core.parts cimport CONE, CONTACT_ROLLING, FRICTIONS, ROUND, blocks_t, frictions_of, is_rows, lay_frictions
from lavender_ext.core.problem cimport Data
from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.view cimport bodies_of, csr_t, rows_t
from lavender_ext.factor.tiles cimport has_wide
from lavender_ext.small.call cimport COUNTS, ENDED, FAILED, KEPT, Rules, few_rules_t, few_t, rooms_t
from lavender_ext.small.friction cimport ask_t, part_t, solve_part, work_of
from lavender_ext.small.limits cimport is_linear
from lavender_ext.small.workspace cimport has_workspace_size, leave
from lavender_ext.judge.measure cimport set_zero_impulse, floor_of, judge_view, judged_from, relative_of, scratch_of
from lavender_ext.judge.score cimport new_score
from lavender_ext.local.gauss_seidel cimport prepare_blocks, prepared_sizes
from lavender_ext.pivot.direct cimport (HALVED, direct_begin, direct_begin_passes, direct_factor, direct_first,
                                        direct_index, direct_lay, direct_linear, direct_pass, direct_real, direct_t, is_end)
from lavender_ext.pivot.lemke cimport RAY, lemke_begin, lemke_index, lemke_lay, lemke_real, lemke_run, lemke_t
from lavender_ext.pivot.principal cimport INDEFINITE, SMALL, SOLVED

cdef object new = np.empty


cdef enum:
    SWEEPS = 2                  # that guess the free rows
    ROUNDS = 32                 # of exchanges
    PATH = 8                    # pivots of Lemke's for each row
    ROUND_ROW = 50              # ns of a round for each row, beside its factor
    FEW = 12                    # rows of an island that has all of its sweeps before its factors
    LISTEN = 5000000            # multiply-adds between two checks for Ctrl-C, a few milliseconds


cdef bint are_bounded(const blocks_t* p) noexcept nogil:
    """Does nothing bound a row but its own two numbers?"""
    cdef int32_t i
    for i in range(p.n_blocks):
        if not is_rows(p, i) and p.ptr[i + 1] - p.ptr[i] > 1:
            return False
    return True


cdef bint lay_few(few_t* s, workspace_t* workspace) noexcept nogil:
    """What the call needs beside both views and the error of doing nothing; in `workspace`, where it stays."""
    cdef const blocks_t* p = &s.v.p
    cdef int32_t band[2]
    cdef int64_t n
    s.pivots, s.linear, s.at, s.prepared = are_bounded(p), is_linear(p), NULL, NULL
    s.split = s.v.r.n_joints if s.v.r != NULL else 0
    if not has_workspace_size(workspace, p.n_blocks + 1 + p.n_rows, 0):
        return False
    if s.pivots:
        s.symmetric = scan_entries(s.over.a, s.over.p.d, p.n_rows, workspace.index, band) <= 1e-14
        s.band = max(band[0], band[1]) if s.symmetric else p.n_rows - 1
    elif p.law == CONE or s.v.a != NULL:                # within a contact of a matrix that was given, units may be unlike
        n = <int64_t>prepared_sizes(p, workspace.index) + 1
        if not has_workspace_size(workspace, 0, n):
            return False
        memset(workspace.real, 0, n * sizeof(double))
        prepare_blocks(&s.over, workspace.index, workspace.real)
        s.at, s.prepared = workspace.index, workspace.real
    return True


cdef bint has_call(const blocks_t* p) noexcept nogil:
    """Do these calls solve every block? Neither round cones nor what rolls."""
    cdef int32_t i
    for i in range(p.n_blocks):
        if p.kind[i] == ROUND or p.kind[i] == CONTACT_ROLLING:
            return False
    return True


cdef void judge_few(few_t* s, const double* lam, double* both, double* scratch) noexcept nogil:
    """w and e into both (2 m); scratch as `judge_view`."""
    cdef int32_t m = s.v.p.n_rows
    s.score = new_score()
    judge_view(&s.v, lam, both, both + m, scratch, True, &s.score)
    s.floor = floor_of(&s.score, s.begin[0], s.begin[1])
    s.relative = relative_of(&s.score, both, m, s.begin[0], s.begin[1])


cdef bint begin_few(few_t* s, const few_rules_t* rules, double* own, bint cold, double tol, double* both,
                    double* scratch) noexcept nogil:
    """`own` (m) [N s] where it is started from, from doing nothing if `cold`; is that a solution, and judged?

    Asked where another method comes next. It is no start where its residual is above that of doing nothing, or for pivots above
    `warm`. scratch: m numbers and as `judge_view`.
    """
    cdef int32_t m = s.v.p.n_rows
    cdef double before = s.begin[2]
    set_zero_impulse(&s.v.p, scratch, both)
    if cold:
        memcpy(own, scratch, m * sizeof(double))
    if not rules.follows:
        return False
    cold = memcmp(own, scratch, m * sizeof(double)) == 0
    if not cold or before <= tol:
        judge_few(s, own, both, scratch + m)
        before = before if cold else s.relative
    if before <= tol:
        return True
    if not before <= (rules.warm if s.pivots else 1.0):
        memcpy(own, scratch, m * sizeof(double))
    return False


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


cdef inline int32_t followed(direct_t* t, double tol, double* most, workspace_t* workspace) noexcept nogil:
    """Where exchanges are stuck: Lemke's paths, and exchanges at their end.

    Pivots of the paths, -1 where they do not end below tol.
    """
    cdef lemke_t l
    cdef double each = 2.0 * <double>t.s.n ** 2
    cdef int32_t last = PATH * t.s.n if most[0] > PATH * t.s.n * each else <int32_t>(most[0] / each)
    if not has_workspace_size(workspace, lemke_index(t.s.p), lemke_real(t.s.p)):
        return -1
    lemke_lay(&l, t, workspace.real, workspace.index)
    lemke_begin(&l)
    while lemke_run(&l, last - l.pivots) == RAY:
        pass
    if last < PATH * t.s.n:
        most[0] -= l.pivots * each
    return l.pivots if t.relative <= tol else -1


cdef bint pivot_few(const few_t* s, double* own, double tol, bint follows, double* most, rooms_t* rooms,
                    int32_t* counts) noexcept nogil:
    """Linear or boxed; counts are (rounds and pivots of Lemke's path, whether swept, refinements, factorisations, pivots, shifts,
    rank of a singular linear system or 0, pivots of Lemke's path).

    What pivots find is good where it is below tol, not to rounding alone, with Lemke's path where exchanges are stuck, if another
    method follows.
    """
    cdef direct_t t
    cdef int32_t path = 0, m = s.v.p.n_rows
    cdef double each = ROUND_ROW * m + 0.1 * m * (s.band + 1.0) ** 2
    cdef bint ended
    if not has_workspace_size(&rooms.work, direct_index(&s.v), direct_real(&s.v, s.band)):
        return False
    t.e0, t.v0, t.least = s.begin[0], s.begin[1], 1e-13
    t.linear, t.symmetric = s.linear, s.symmetric
    direct_lay(&t, &s.v, s.over.a, &s.over.p, s.band, NULL, 1e-13, rooms.work.real, rooms.work.index)
    ended = pivot(&t, own, tol, follows, most[0] / each)
    most[0] -= t.s.n_rounds * each
    if not ended and most[0] > 0.0:
        path = followed(&t, tol, most, &rooms.more) if follows and not t.linear and not t.solved else -1
    if not ended:
        ended = (path >= 0 and t.relative <= tol) or (not most[0] > 0.0 and t.relative < INFINITY)
    if ended:
        memcpy(own, t.best, t.s.n * sizeof(double))
    path = max(path, 0)
    counts[0], counts[1], counts[2], counts[3] = t.s.n_rounds + path, t.swept != 0, t.refined, t.s.factorisations
    counts[4], counts[5], counts[6], counts[7] = t.s.exchanged, t.shifts, t.rank, path
    return ended


cdef inline void counted(const ask_t* o, int32_t parts, int32_t* counts) noexcept nogil:
    """(longest of a part, sweeps, undone, factorisations, parts that asked for these, parts)"""
    counts[0], counts[1], counts[2] = o.longest, <int32_t>o.swept, <int32_t>o.undone
    counts[3], counts[4], counts[5] = <int32_t>o.factorisations, o.driven, parts


cdef bint sweep_few(const few_t* s, double* own, double tol, int32_t swept, double* most, rooms_t* rooms,
                    int32_t* counts) noexcept nogil:
    """Contacts, as one part; counts as `counted`. swept: at most, before its factors."""
    cdef int32_t m = s.v.p.n_rows, n = s.over.r.n_bodies if s.over.r != NULL else 0
    cdef part_t part
    cdef ask_t o = ask_t(tol, swept, swept, has_wide(), 0, 0, 0, 0.0, most[0], 0, 0)
    cdef bint good
    if not has_workspace_size(&rooms.work, s.v.p.n_blocks, work_of(m, n) + m):
        return False
    part.v, part.lam, part.answer, part.split = s.over, own, rooms.work.real, s.split
    part.at, part.prepared, part.nothing = s.at, s.prepared, s.begin[2]
    part.e0, part.v0 = s.begin[0], s.begin[1]
    good = solve_part(&part, &o, &rooms.more, rooms.work.real + m, rooms.work.index)
    memcpy(own, part.answer, m * sizeof(double))
    most[0] = o.left
    counted(&o, 1, counts)
    return good or not o.left > 0.0


cdef int32_t run_few(few_t* s, const few_rules_t* rules, double* own, bint cold, double tol, double most, double* both,
                     rooms_t* rooms, int32_t* counts) noexcept nogil:
    """From `own` (m) [N s], from doing nothing if `cold`, into it, judged: how it ended (`FAILED` ...)."""
    cdef int64_t m = s.v.p.n_rows, scratch = m + scratch_of(&s.v)
    memset(counts, 0, COUNTS * sizeof(int32_t))
    if not has_workspace_size(&rooms.work, 0, scratch):
        return FAILED
    if begin_few(s, rules, own, cold, tol, both, rooms.work.real):
        return KEPT
    if not (pivot_few(s, own, tol, rules.follows, &most, rooms, counts) if s.pivots
            else sweep_few(s, own, tol, rules.swept, &most, rooms, counts)):
        return FAILED
    if not has_workspace_size(&rooms.work, 0, scratch):
        return FAILED
    judge_few(s, own, both, rooms.work.real)
    return ENDED if s.pivots or s.relative <= tol or not most > 0.0 else FAILED


cdef class Rules:
    """What the calls of few rows are asked for: `few_rules_t`."""

    def __init__(self, int rows, int swept, double warm, bint pivots, bint follows):
        self.at.rows, self.at.swept, self.at.warm, self.at.pivots, self.at.follows = rows, swept, warm, pivots, follows


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
    p.n_blocks, p.n_rows, p.islands = k, m, NULL
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


cdef inline int32_t number_bodies(const rows_t* r, const int32_t* block, int32_t k, int32_t* number, int32_t* body) noexcept nogil:
    """Those of k blocks, in the order in which they come, into `body`, their places there into `number`; how many."""
    cdef const int32_t* two
    cdef int32_t i, side, n = 0
    for i in range(k):
        two = bodies_of(r, block[i])
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
        j, two, pair = p.ptr[i], bodies_of(r, i), <int32_t*>bodies_of(y, k)
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


cdef class Small:
    """A problem of few rows, its error of doing nothing known to `data`; `run` only reads it.

    Parameters
    ----------
    data : Data
        What the judge reads.
    over : Data
        What is solved: of bounded rows A in compressed rows.
    """

    cdef readonly Data data
    cdef readonly int count                             # of islands
    cdef Data over
    cdef few_t at
    cdef workspace_t workspace

    def __init__(self, Data data, Data over):
        self.data, self.over, self.count = data, over, 1
        self.at.v, self.at.over = data.view(), over.view()
        self.at.begin[0], self.at.begin[1], self.at.begin[2] = data.reference_energy, data.reference_velocity, data.relative_at_zero
        if not lay_few(&self.at, &self.workspace):
            raise MemoryError(f"{data.blocks.n_rows} rows")

    def __dealloc__(self):
        leave(&self.workspace)

    def run(self, impulse, double tol, Rules rules, double most=INFINITY):
        """From `impulse` (m,) [N s], or from doing nothing where it is None: (what the judge finds, what was done).

        The judge finds None where it does not end below tol. What was done is None where `impulse` is the solution. most: counted
        cost [ns] where what was found by then is the result.
        """
        cdef few_t s = self.at
        cdef rooms_t rooms
        cdef int32_t counts[COUNTS]
        cdef Py_ssize_t m = s.v.p.n_rows
        cdef double[::1] own = new(m), both = new(2 * m + 1)
        cdef int32_t code
        memset(&rooms, 0, sizeof(rooms))
        if impulse is not None:
            memcpy(&own[0], doubles(impulse, m), m * sizeof(double))
        try:
            code = self.end(&s, &rules.at, &own[0], impulse is None, tol, most, &both[0], &rooms, counts)
        finally:
            leave(&rooms.work)
            leave(&rooms.more)
        found = judged_from(self.data, own.base, both.base, &s.score, s.relative, s.floor) if code != FAILED else None
        return found, None if code == KEPT else tuple([counts[i] for i in range(COUNTS)])

    cdef int32_t end(self, few_t* s, const few_rules_t* rules, double* own, bint cold, double tol, double most, double* both,
                     rooms_t* rooms, int32_t* counts) except -1:
        """As `run_few`."""
        with nogil:
            return run_few(s, rules, own, cold, tol, most, both, rooms, counts)


cdef class Islands(Small):
    """Islands under friction.

    Parameters
    ----------
    label : (k,) int32
        The island of each block, from 0 to count - 1.
    count : int
        More than one.
    """

    cdef object block, size

    def __init__(self, Data data, Data over, const int32_t[::1] label, int count):
        Small.__init__(self, data, over)
        self.count = count
        cdef const int32_t* ptr = over.blocks.ptr
        cdef int32_t i, k = over.blocks.n_blocks, rows, joints = over.rows.n_joints if over.factored else 0
        self.size, self.block = np.zeros((self.count, SIZES), np.int32), np.empty(k, np.int32)
        cdef int32_t[:, ::1] size = self.size
        cdef int32_t[::1] block = self.block, first = np.empty(self.count + 1, np.int32)
        for i in range(k):
            rows = ptr[i + 1] - ptr[i]
            size[label[i], 0] += rows
            size[label[i], 1] += 1
            if not over.factored:
                size[label[i], 2] += over.csr.indptr[ptr[i + 1]] - over.csr.indptr[ptr[i]]
            if i < joints:
                size[label[i], 3] += rows
                size[label[i], 4] += 1
        sort_by_level(k, &label[0], count, &first[0], &block[0])

    cdef int32_t end(self, few_t* s, const few_rules_t* rules, double* own, bint cold, double tol, double most, double* both,
                     rooms_t* rooms, int32_t* counts) except -1:
        cdef int64_t m = s.v.p.n_rows, scratch = m + scratch_of(&s.v)
        cdef ask_t o = ask_t(tol, rules.swept, rules.swept, has_wide(), 0, 0, 0, 0.0, most, 0, 0)
        cdef bint good
        if not has_workspace_size(&rooms.work, 0, scratch):
            raise MemoryError(f"{m} rows")
        if begin_few(s, rules, own, cold, tol, both, rooms.work.real):
            return KEPT
        good = self.islands(own, &o, &rooms.more)
        memset(counts, 0, COUNTS * sizeof(int32_t))
        counted(&o, self.count, counts)
        if not good:
            return FAILED
        judge_few(s, own, both, rooms.work.real)
        return ENDED if s.relative <= tol or not o.left > 0.0 else FAILED

    cdef bint islands(self, double* own, ask_t* o, workspace_t* r) except -1:
        """Each after the other from `own` (m) [N s], into it."""
        cdef const blocks_t* p = &self.over.blocks
        cdef const rows_t* rows = &self.over.rows
        cdef bint over_bodies = self.over.factored
        cdef const int32_t[::1] block = self.block
        cdef const int32_t[:, ::1] size = self.size     # SIZES of each
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
        two[1].n_numbers = -1
        with nogil:
            for i in range(self.count):
                x, last = &two[i % 2], &two[1 - i % 2]
                m, k = size[i, 0], size[i, 1]
                if over_bodies:
                    n = number_bodies(rows, &block[first], k, &number[0], &body[0])
                lay(x, &numbers[(i % 2) * each], &marks[(i % 2) * whole], &size[i, 0], n)
                cut(x, p, &block[first], own, &place[0])
                if over_bodies:
                    cut_rows(x, p, rows, &block[first], &number[0], &body[0])
                else:
                    cut_matrix(x, p, &self.over.csr, &block[first], &place[0])
                if same(x, last):
                    memcpy(x.s.answer, last.s.answer, m * sizeof(double))
                else:
                    x.s.split, x.s.at, x.s.prepared, x.s.nothing = size[i, 4], NULL, NULL, -1.0
                    if p.law == CONE:
                        for j in range(k):
                            at[j] = self.at.at[block[first + j]]
                        x.s.at, x.s.prepared = &at[0], self.at.prepared
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
