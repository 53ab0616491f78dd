"""Factorisation of a matrix N of n x n blocks, each (s, s), with a symmetric block pattern: N = L L^T, or L U by panels.

The analysis orders nothing: block rows are eliminated as they stand (`graph.pxd` has an order). Its supernodes are those of
`symbolic.pxd`, of whole blocks. `block_matrix_t` contains N; `factor_blocks` copies it into the panels of `supernodal.pxd`.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

from lavender_ext.factor.supernodal cimport (begin_supernodes, factor_supernode, panel_width, rows_below, set_local_rows,
                                             supernodal_scratch_size, supernodal_t)
from lavender_ext.factor.symbolic cimport column_pattern, find_supernodes, list_supernode_rows


cdef struct block_matrix_t:
    int32_t n                   # block rows
    int32_t s                   # rows of a block, 1 to 6
    const int32_t* nptr         # (n + 1) blocks of row k of N, columns <= k, the diagonal last
    const int32_t* nind
    double* nval                # lower blocks of N, row-major
    double* mval                # upper blocks of N, transposed; L U only
    const int64_t* lower_offset     # of each block in the factor's `values`
    const int64_t* upper_offset     # of the mirror of each block: in `values` if both are in one supernode, else in `upper`
    supernodal_t factor


cdef inline int64_t block_pattern_index_size(int64_t n, int64_t s, int64_t blocks, int64_t below) noexcept nogil:
    """Return the number of int32 that `analyse_blocks` needs, for blocks of N and `below` off-diagonal blocks of L."""
    return 2 * (2 * blocks + 2 * (n + 1)) + n * s + 5 * (n + 1) + below + 1 + s * below + 1


cdef inline double analyse_blocks(block_matrix_t* f, int32_t n, int32_t s, const int32_t* nptr, const int32_t* nind,
                                  const int32_t* parent, const int32_t* lptr, int32_t* index) noexcept nogil:
    """Set the pattern of f in index (`block_pattern_index_size`, a multiple of 8 bytes); return the multiply-adds of L L^T.

    nptr and nind are the blocks of N, parent (n) is the elimination tree and lptr (n + 1) the columns of L of `block_tree`.
    """
    cdef int32_t blocks = nptr[n], i, j, k, q, count
    cdef int64_t place, ld
    cdef double work
    cdef supernodal_t* p = &f.factor
    cdef int64_t* lower_offset = <int64_t*>index
    cdef int64_t* upper_offset = lower_offset + blocks
    cdef int64_t* value_offset = upper_offset + blocks
    cdef int64_t* panel_upper_offset = value_offset + n + 1
    cdef int32_t* supernode_of = <int32_t*>(panel_upper_offset + n + 1)
    cdef int32_t* first = supernode_of + n * s
    cdef int32_t* row_ptr = first + n + 1
    cdef int32_t* group = row_ptr + n + 1
    cdef int32_t* starts = group + n + 1
    cdef int32_t* mark = starts + n + 1
    cdef int32_t* lind = mark + n + 1
    cdef int32_t* row_indices = lind + lptr[n] + 1
    column_pattern(n, nptr, nind, parent, mark, lptr, starts, lind)
    count = find_supernodes(n, lptr, lind, NULL, group)
    for i in range(n + 1):
        starts[i] = i * s
    work = list_supernode_rows(count, starts, lptr, lind, group, first, supernode_of, row_ptr, row_indices, value_offset,
                               panel_upper_offset)
    p.n, p.supernodes = n * s, count
    p.order = NULL
    p.position = NULL
    p.first, p.supernode_of, p.row_ptr, p.row_indices = first, supernode_of, row_ptr, row_indices
    p.value_offset, p.upper_offset = value_offset, panel_upper_offset
    f.n, f.s, f.nptr, f.nind, f.lower_offset, f.upper_offset = n, s, nptr, nind, lower_offset, upper_offset
    # places of the blocks of N
    for k in range(n):
        for q in range(nptr[k], nptr[k + 1]):
            j = nind[q] * s
            i = supernode_of[j]
            ld = panel_width(p, i) + rows_below(p, i)
            if k * s < first[i + 1]:                    # both blocks are in the diagonal block of the supernode
                lower_offset[q] = value_offset[i] + (k * s - first[i]) + (j - first[i]) * ld
                upper_offset[q] = value_offset[i] + (j - first[i]) + (k * s - first[i]) * ld
                continue
            place = row_ptr[i]
            while row_indices[place] != k * s:
                place += 1
            place -= row_ptr[i]
            lower_offset[q] = value_offset[i] + panel_width(p, i) + place + (j - first[i]) * ld
            upper_offset[q] = panel_upper_offset[i] + place + (j - first[i]) * <int64_t>rows_below(p, i)
    return work


cdef inline int64_t block_factor_index_size(int64_t n, int64_t s) noexcept nogil:
    """Return the number of int32 that `bind_block_factor` assigns."""
    return 2 * n * s + 3 * n


cdef inline int64_t block_factor_size(const block_matrix_t* f, bint lu) noexcept nogil:
    """Return the number of doubles that `bind_block_factor` assigns; `lu`: the matrix may be factored as L U."""
    cdef const supernodal_t* p = &f.factor
    cdef int64_t values = <int64_t>f.nptr[f.n] * f.s * f.s + p.value_offset[p.supernodes]
    if lu:
        values += <int64_t>f.nptr[f.n] * f.s * f.s + p.upper_offset[p.supernodes]
    return values + supernodal_scratch_size(p, lu)


cdef inline void bind_block_factor(block_matrix_t* f, bint lu, bint wide, int32_t* index, double* real) noexcept nogil:
    """Bind the values of N and of its factor, after `analyse_blocks`; neither array needs initial values."""
    cdef supernodal_t* p = &f.factor
    cdef int64_t values = <int64_t>f.nptr[f.n] * f.s * f.s
    p.wide = wide
    p.swap, p.local_row, p.head = index, index + p.n, index + 2 * p.n
    p.link, p.next_row = p.head + f.n, p.head + 2 * f.n
    f.nval = real
    real += values
    f.mval = real
    real += values if lu else 0
    p.values = real
    real += p.value_offset[p.supernodes]
    p.upper = real
    real += p.upper_offset[p.supernodes] if lu else 0
    p.scratch = real


cdef inline void fill_panels(const block_matrix_t* f, int32_t lu) noexcept nogil:
    """Copy the blocks of N to the panels of its factor, and zeros elsewhere."""
    cdef const supernodal_t* p = &f.factor
    cdef int32_t k, q, r, c, i, s = f.s
    cdef int64_t ld, b = s * s
    cdef double* y
    cdef const double* x
    memset(p.values, 0, sizeof(double) * p.value_offset[p.supernodes])
    if lu:
        memset(p.upper, 0, sizeof(double) * p.upper_offset[p.supernodes])
    for k in range(f.n):
        for q in range(f.nptr[k], f.nptr[k + 1]):
            i = p.supernode_of[s * f.nind[q]]
            ld = panel_width(p, i) + rows_below(p, i)
            y = p.values + f.lower_offset[q]
            x = f.nval + q * b
            for c in range(s):
                for r in range(s):
                    y[r + c * ld] = x[r * s + c]
            if not lu or f.nind[q] == k:
                continue
            x = f.mval + q * b
            if k * s < p.first[i + 1]:
                y = p.values + f.upper_offset[q]
                for c in range(s):
                    for r in range(s):
                        y[c + r * ld] = x[r * s + c]
            else:
                y = p.upper + f.upper_offset[q]
                ld = rows_below(p, i)
                for c in range(s):
                    for r in range(s):
                        y[r + c * ld] = x[r * s + c]


cdef inline int32_t factor_blocks(const block_matrix_t* f, int32_t lu) noexcept nogil:
    """Factor N = L L^T, or L U with row exchanges inside panels; return the number of pivots lost to rounding."""
    cdef const supernodal_t* p = &f.factor
    cdef int32_t i, lost = 0
    begin_supernodes(p)
    fill_panels(f, lu)
    for i in range(p.supernodes):
        set_local_rows(p, i)
        lost += factor_supernode(p, i, lu, NULL, 0.0)
    return lost
