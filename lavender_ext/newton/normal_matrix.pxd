"""Form N = I + K^T V K block by block, for runs of elements between the same two bodies."""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.factor.factors cimport block_matrix_t
from lavender_ext.newton.elements cimport elements_t


cdef inline void add_transposed_product(double* out, const double* left, const double* right, int32_t nr,
                             const int32_t s) noexcept nogil:
    """Add left^T right to out, of nr rows with stride 2 s, s columns each."""
    cdef int32_t i, j, r
    cdef double x
    cdef double row[6]
    for i in range(s):
        for j in range(s):
            row[j] = out[i * s + j]
        for r in range(nr):
            x = left[r * 2 * s + i]
            for j in range(s):
                row[j] += x * right[r * 2 * s + j]
        for j in range(s):
            out[i * s + j] = row[j]


cdef inline void multiply_by_small_matrix(const double* v, const double* rows, double* t, int32_t nr,
                                          const int32_t s) noexcept nogil:
    """Compute t = V rows (nr, 2 s)."""
    cdef int32_t r, k, c
    cdef double x
    cdef double row[12]
    for r in range(nr):
        x = v[r * nr]
        for c in range(2 * s):
            row[c] = x * rows[c]
        for k in range(1, nr):
            x = v[r * nr + k]
            for c in range(2 * s):
                row[c] += x * rows[k * 2 * s + c]
        for c in range(2 * s):
            t[r * 2 * s + c] = row[c]


cdef inline void form_normal_matrix_of_width(const elements_t* e, const double* v, const block_matrix_t* f, int32_t lu,
                              const int32_t s) noexcept nogil:
    """Form N for a constant number of columns s."""
    cdef int32_t h, i, j, r, c, nr, first, second, n_blocks = f.nptr[f.n], n_done
    cdef int64_t b = s * s, q
    cdef double t[216]                                  # V K of up to 18 rows between two bodies (18, 2 s)
    cdef const double *pr
    cdef const int32_t *slot
    for q in range(n_blocks * b):
        f.nval[q] = 0.0
    if lu:
        for q in range(n_blocks * b):
            f.mval[q] = 0.0
    for i in range(f.n):
        q = (f.nptr[i + 1] - 1) * b
        for c in range(s):
            f.nval[q + c * s + c] = 1.0
            if lu:
                f.mval[q + c * s + c] = 1.0
    for h in range(e.n_groups):
        i = e.group[h]
        first = e.node[2 * i]
        second = e.node[2 * i + 1]
        slot = e.slot + 3 * i
        if first < 0:
            continue
        while i < e.group[h + 1]:
            j = e.ptr[i]
            pr = e.panel + <int64_t>j * 2 * s
            n_done = 0
            while i < e.group[h + 1] and n_done <= 12:
                nr = e.ptr[i + 1] - e.ptr[i]
                if nr == 1:
                    multiply_by_small_matrix(v + e.wptr[i], pr + n_done * 2 * s, t + n_done * 2 * s, 1, s)
                elif nr == 3:
                    multiply_by_small_matrix(v + e.wptr[i], pr + n_done * 2 * s, t + n_done * 2 * s, 3, s)
                else:
                    multiply_by_small_matrix(v + e.wptr[i], pr + n_done * 2 * s, t + n_done * 2 * s, nr, s)
                n_done += nr
                i += 1
            add_transposed_product(f.nval + slot[0] * b, pr, t, n_done, s)
            if second >= 0:
                add_transposed_product(f.nval + slot[1] * b, pr + s, t + s, n_done, s)
                add_transposed_product(f.nval + slot[2] * b, pr, t + s, n_done, s)
                if lu:
                    # Block (second, first) of K^T V K, transposed: (V K_first)^T K_second.
                    add_transposed_product(f.mval + slot[2] * b, t, pr + s, n_done, s)
    if lu:
        # The upper copy of a diagonal block is its transpose.
        for i in range(f.n):
            q = (f.nptr[i + 1] - 1) * b
            for r in range(s):
                for c in range(s):
                    f.mval[q + c * s + r] = f.nval[q + r * s + c]


cdef inline void form_normal_matrix(const elements_t* e, const double* v, const block_matrix_t* f, int32_t lu) noexcept nogil:
    """Form N of elements.pxd (2) in the blocks of `f`; with `lu` also its upper blocks."""
    if f.s == 1:
        form_normal_matrix_of_width(e, v, f, lu, 1)
    elif f.s == 3:
        form_normal_matrix_of_width(e, v, f, lu, 3)
    elif f.s == 6:
        form_normal_matrix_of_width(e, v, f, lu, 6)
    else:
        form_normal_matrix_of_width(e, v, f, lu, f.s)
