"""Islands taken apart and solved in one compiled call: each is laid out as a problem of its own, and goes the way of one.

    blocks of an island, stably sorted by its label, renumbered; so are their rows, bodies, columns of A or velocities  (1)
    share of the tolerance:  tol_i = min(tol E0 / (sqrt(islands) E0_i), tol V0 / V0_i)                              (2)

What is derived of a block alone (d, nu, step, couplings, M^-1 J^T, entries of A, rows of M's factor) is copied from the
whole, to the bit what the island alone would derive. Then as with few rows (`chain.pyx`, `many.pyx`): a start that is a
solution is the result; else pivots where A is symmetric and each row has constant bounds, sweeps with looks at what
they promise elsewhere (`looks.pyx`), Newton's method over J and M. What does not end below (2) on the judge's own
measure is left to the caller. An island whose numbers and start are those of one before, to the bit, has its answer.
"""
from libc.stdint cimport int32_t, uint64_t
from libc.stdlib cimport free
from libc.string cimport memcmp, memcpy

import numpy as np

from lavender_ext.core.block cimport blocks_t
from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.problem cimport Data
from lavender_ext.few.island cimport asked_t, solve_island, solve_trees
from lavender_ext.few.layout cimport (BODIES, GENERAL, MATRIX, count_bodies, count_entries, fill_blocks, fill_bodies,
                                      fill_csr, fill_trees, hashed, island_t, plan_t, point, sizes, spread, view_t)
from lavender_ext.few.many cimport Gate, space_t


cdef class Islands:
    """The islands of a problem that are chosen, laid out one after the other; `run` solves them.

    Parameters
    ----------
    data : Data
        What the judge reads, prepared, its error of doing nothing known.
    matrix : Data or None
        A in compressed rows of a problem given by bodies, where pivots are asked for.
    label : (k,) int32
        Island of each block, numbered from 0.
    wanted : (count,) int32
        Other than 0: it is to be solved here.
    start : (m,) N s
        Where they stand.
    prepared : (start (k,), numbers) or None
        Of `gauss_seidel.prepare`, where blocks are solved exactly.
    """

    cdef Data data, matrix
    cdef object keep
    cdef island_t* at
    cdef plan_t plan
    cdef int32_t* begun         # (k) places of their prepared numbers
    cdef int32_t* table         # places of islands by their bytes
    cdef double* numbers
    cdef int32_t* marks
    cdef const double* prepared
    cdef double[::1] lam        # (m) by island
    cdef int32_t kind
    cdef bint also
    cdef space_t room
    cdef readonly int count, n_blocks
    cdef int next, mask

    def __init__(self, Data data, Data matrix, const int32_t[::1] label, const int32_t[::1] wanted,
                 const double[::1] start, prepared):
        cdef int32_t k = data.blocks.n_blocks, m = data.blocks.n_rows, n, i, count, size = 1
        cdef ssize_t n_numbers = 0, n_marks = 0
        cdef island_t* s
        cdef double[::1] numbers, g
        cdef int32_t[::1] marks, places
        cdef int32_t* w
        count = self.count = <int>wanted.shape[0]
        self.n_blocks = k
        self.data, self.matrix = data, matrix
        self.kind = GENERAL if data.is_general else BODIES if data.factored else MATRIX
        self.also = matrix is not None and self.kind == BODIES
        n = data.general.n if data.is_general else data.rows.n_bodies if data.factored else 0
        while size < 2 * count:
            size *= 2
        numbers = np.zeros((count + 1) * sizeof(island_t) // 8 + 1)
        marks = np.empty(2 * k + 2 * m + 3 * n + count + 8, np.int32)
        places = np.full(size, -1, np.int32)
        self.keep = [numbers, marks, places]
        self.at = <island_t*>&numbers[0]
        w = &marks[0]
        self.begun = w
        self.plan.order = w + k
        self.plan.rows = w + 2 * k
        self.plan.place = w + 2 * k + m
        self.plan.number = w + 2 * k + 2 * m
        self.plan.of = self.plan.number + n
        self.plan.moving = self.plan.of + n
        self.plan.first = self.plan.moving + n
        self.table = &places[0]
        self.mask = size - 1
        self.lam = np.empty(3 * m + 2)                  # w and e of the judge behind the last
        with nogil:
            self.divide(&label[0], n)
            for i in range(count):
                s = &self.at[i]
                s.end = LEFT
                s.twin = -1
                s.chosen = wanted[i] != 0
                if s.chosen:
                    sizes(s, self.kind, self.also)
                    s.numbers = n_numbers
                    s.marks = n_marks
                    n_numbers += s.n_numbers
                    n_marks += s.n_marks
        numbers = np.empty(n_numbers + 1)
        marks = np.zeros(n_marks + 2, np.int32)
        self.keep += [numbers, marks]
        self.numbers = &numbers[0]
        self.marks = &marks[0]
        if prepared is not None:
            places, g = prepared
            self.prepared = &g[0]
            self.keep += [g]
            for i in range(k):
                self.begun[i] = places[self.plan.order[i]]
        with nogil:
            for i in range(count):
                if self.at[i].chosen:
                    self.copy(i, &start[0])

    cdef const csr_t* entries(self) noexcept nogil:
        """Of A, where it is copied."""
        if self.kind == MATRIX:
            return &self.data.csr
        return &self.matrix.csr if self.also else NULL

    cdef void divide(self, const int32_t* label, int32_t n) noexcept nogil:
        """(1), and what each island holds; n bodies or velocities in all."""
        cdef const blocks_t* p = &self.data.blocks
        cdef plan_t* w = &self.plan
        cdef island_t* s
        cdef int32_t i, j = 0, h = 0
        for i in range(p.n_blocks):
            self.at[label[i]].n_blocks += 1
        for i in range(self.count):
            self.at[i].first = j
            j += self.at[i].n_blocks
            self.at[i].n_blocks = 0
        for i in range(n):
            w.of[i] = -1
        for i in range(p.n_blocks):                     # a stable counting sort
            s = &self.at[label[i]]
            w.order[s.first + s.n_blocks] = i
            s.n_blocks += 1
            for j in range(p.ptr[i], p.ptr[i + 1]):
                w.place[j] = s.n_rows
                s.n_rows += 1
            count_entries(p, self.entries(), &self.data.general if self.kind == GENERAL else NULL, i, label[i], s, w)
            if self.kind == BODIES:
                count_bodies(p, &self.data.rows, i, label[i], s, w)
        if self.kind == GENERAL:
            spread(&self.data.general, w)
        for i in range(n):
            if w.of[i] >= 0:
                s = &self.at[w.of[i]]
                w.number[i] = s.n_moving
                s.n_moving += 1
                if self.kind == GENERAL:
                    s.n_lower += self.data.general.lptr[i + 1] - self.data.general.lptr[i]
        j = 0
        for i in range(self.count):
            w.first[i] = j
            j += self.at[i].n_moving
            self.at[i].row = h
            h += self.at[i].n_rows
        for i in range(n):
            if w.of[i] >= 0:
                w.moving[w.first[w.of[i]] + w.number[i]] = i
        for i in range(p.n_blocks):
            for j in range(p.ptr[i], p.ptr[i + 1]):
                w.rows[self.at[label[i]].row + w.place[j]] = j

    cdef void copy(self, int32_t i, const double* start) noexcept nogil:
        """Island i into its own arrays."""
        cdef const blocks_t* p = &self.data.blocks
        cdef const csr_t* a = self.entries()
        cdef island_t* s = &self.at[i]
        cdef int32_t* moving = self.plan.moving + self.plan.first[i]
        cdef view_t v
        point(s, self.kind, self.also, p.law, self.numbers + s.numbers, self.marks + s.marks, &v)
        fill_blocks(p, &self.matrix.blocks if self.also else NULL, start, s, self.plan.order, &v)
        if a != NULL:
            fill_csr(p, a, s, self.plan.order, self.plan.place, &v)
        if self.kind == BODIES:
            fill_bodies(p, &self.data.rows, s, self.plan.order, self.plan.number, moving, &v)
        elif self.kind == GENERAL:
            fill_trees(p, &self.data.general, s, self.plan.order, self.plan.number, moving, &v)

    def __dealloc__(self):
        free(self.room.numbers)
        free(self.room.marks)

    cdef int32_t same(self, int32_t i) noexcept nogil:
        """An island before i whose bytes are the same, -1 where there is none, and i is then known."""
        cdef island_t* s = &self.at[i]
        cdef island_t* o
        cdef uint64_t h = hashed(self.numbers + s.numbers, s.n_numbers, <uint64_t>s.n_rows)
        h = hashed(self.marks + s.marks, s.n_marks // 2, h)
        cdef int32_t slot = <int32_t>(h & <uint64_t>self.mask)
        while self.table[slot] >= 0:
            o = &self.at[self.table[slot]]
            if o.n_numbers == s.n_numbers and o.n_marks == s.n_marks and o.n_rows == s.n_rows \
                    and o.n_joints == s.n_joints and o.n_moving == s.n_moving and o.n_entries == s.n_entries \
                    and memcmp(self.marks + o.marks, self.marks + s.marks, s.n_marks * sizeof(int32_t)) == 0 \
                    and memcmp(self.numbers + o.numbers, self.numbers + s.numbers,
                               s.n_numbers * sizeof(double)) == 0:
                return self.table[slot]
            slot = (slot + 1) & self.mask
        self.table[slot] = i
        return -1

    def run(self, asked, Gate gate, double most, double limit, double[::1] impulse):
        """Solve from where the last call ended, as long as that takes at a guess at most `limit` [ns]; is there more?

        `asked` as `asked_t`; of what is solved, and of what came nearer, the impulse goes into `impulse` (m,).
        """
        cdef asked_t k
        cdef island_t* s
        cdef island_t* o
        cdef view_t v
        cdef double spent = 0.0
        cdef double* lam = &self.lam[0]
        cdef int32_t j
        cdef const int32_t* begun = NULL
        (k.tol, k.energy, k.velocity, k.warm, k.n, k.pivots, k.linear, k.symmetric, k.sweeps, k.exact, k.few, k.narrow,
         k.band, k.at_once, k.work, k.row, k.look, k.each, k.hope, k.believed) = asked
        with nogil:
            while self.next < self.count and spent < limit:
                s = &self.at[self.next]
                if s.chosen:
                    s.twin = self.same(self.next)
                    if s.twin >= 0:
                        o = &self.at[s.twin]
                        s.end = o.end
                        s.relative = o.relative
                        memcpy(s.counts, o.counts, sizeof(s.counts))
                        memcpy(lam + s.row, lam + o.row, s.n_rows * sizeof(double))
                        spent += 1e3
                    else:
                        point(s, self.kind, self.also, self.data.blocks.law, self.numbers + s.numbers,
                              self.marks + s.marks, &v)
                        if self.prepared != NULL:
                            begun = self.begun + s.first
                        if self.kind == GENERAL:
                            spent += solve_trees(s, &v, &k, begun, self.prepared, &gate.at, most, &self.room,
                                                 lam + s.row)
                        else:
                            spent += solve_island(s, &v, self.kind, &k, begun, self.prepared, &self.room,
                                                  lam + s.row)
                    for j in range(s.row, s.row + s.n_rows):
                        impulse[self.plan.rows[j]] = lam[j]
                self.next += 1
        return self.next < self.count

    def report(self):
        """(count, 9) int32: how each island ended, its counts (6), rows, 1 where it is the copy of another's."""
        cdef int32_t i, j
        found = np.zeros((self.count, 9), np.int32)
        cdef int32_t[:, ::1] out = found
        for i in range(self.count):
            out[i, 0] = self.at[i].end
            for j in range(6):
                out[i, 1 + j] = self.at[i].counts[j]
            out[i, 7] = self.at[i].n_rows
            out[i, 8] = self.at[i].twin >= 0
        return found
