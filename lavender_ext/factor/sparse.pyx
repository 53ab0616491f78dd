"""A sparse matrix of any pattern and its factor by dense panels: L L^T, or L U with rows exchanged inside a panel; a full
one and its L L^T.

    A_JJ' = A_JJ - sum over K below J of L_K U_K,   P A_JJ' = L_JJ U_JJ                                    (1)
    L_J = (A_J - sum L_K U_KJ) U_JJ^-1 below,   U_J = L_JJ^-1 P (A_J - sum L_JK U_K) beside                (2)

Both on the pattern of the symmetric factor, in an order of least degree, rows of one pattern taken as one vertex. A
panel is held column by column, its own columns' rows first, then the rows below; of L U what is beside it transposed,
so that every update is C - A B^T (`tiles.pxd`). 1 / L_jj or 1 / U_jj stands on the diagonal. L U is of
D^-1/2 A D^-1/2: what rows a panel exchanges are of one size, and how small a pivot is shows.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

import numpy as np

from lavender_ext.factor.symbolic import analysed

from lavender_ext.core.csr cimport transpose_csr, scan_entries
from lavender_ext.core.view cimport csr_t
from lavender_ext.factor.blocks cimport sparse_t
from lavender_ext.factor.dense cimport cholesky_workspace_size, dense_cholesky, dense_cholesky_solve
from lavender_ext.factor.supernodal cimport begin_panels, hand_on, place_rows, sparse_solve, take_panels
from lavender_ext.factor.panels cimport LU_STRIP, cholesky_panel, lu_panel
from lavender_ext.factor.tiles cimport axpy_subtract, gemm_subtract_nt, has_wide


cdef inline int32_t lu_panel_with_rows(const sparse_t* f, int32_t width, int32_t rows, double* a, double* u, int32_t* swap,
                                       double min_pivot) noexcept nogil:
    """Factor columns a (rows, width) with L below, and u (rows - width, width), the transposed rows beside them, by (1) and (2).

    Return the number of pivots that are too small.
    """
    cdef int32_t j, j0 = 0, t, n, i, below = rows - width
    cdef int32_t lost = lu_panel(f.wide, width, rows, width, a, rows, swap, min_pivot, f.temp)
    cdef double x
    cdef double* y
    cdef double* z
    if below == 0:
        return lost
    # exchange the rows of U
    for j in range(width):
        if swap[j] != j:
            y = u + <int64_t>j * below
            z = u + <int64_t>swap[j] * below
            for i in range(below):
                x = y[i]
                y[i] = z[i]
                z[i] = x
    # solve with L
    while j0 < width:
        n = LU_STRIP if j0 + LU_STRIP <= width else width - j0
        gemm_subtract_nt(f.wide, below, n, j0, u, below, a + j0, rows, u + <int64_t>j0 * below, below)
        for j in range(j0 + 1, j0 + n):
            for t in range(j0, j):
                axpy_subtract(below, a[j + <int64_t>t * rows], u + <int64_t>t * below, u + <int64_t>j * below)
        j0 += n
    return lost


cdef inline void fill(const sparse_t* f, int32_t i, const int32_t* indptr, const int32_t* indices, const double* data,
                      const int32_t* tptr, const int32_t* tind, const double* tdata, const double* d,
                      double shift) noexcept nogil:
    """Entries of A + shift D in the columns of panel i and, of L U, beside them."""
    cdef int32_t base = f.first[i], after = f.first[i + 1], c, q, p, row
    cdef int64_t own = after - base, beside = f.rptr[i + 1] - f.rptr[i], ld = own + beside
    cdef double* v = f.val + f.at[i]
    cdef double* u = f.up + f.beside[i]
    cdef double s
    memset(v, 0, sizeof(double) * ld * own)
    if not f.lu:
        for c in range(base, after):
            row = f.order[c]
            for q in range(indptr[row], indptr[row + 1]):
                p = f.place[indices[q]]
                if p >= c:
                    v[f.rel[p]] = data[q]
            v[c - base] += shift * d[row]
            v += ld
        return
    memset(u, 0, sizeof(double) * beside * own)
    for c in range(base, after):
        row = f.order[c]
        s = f.scale[c]
        for q in range(indptr[row], indptr[row + 1]):
            p = f.place[indices[q]]
            if p >= after:
                u[f.rel[p] - own] = s * data[q] * f.scale[p]
        for q in range(tptr[row], tptr[row + 1]):
            p = f.place[tind[q]]
            if p >= base:
                v[f.rel[p]] = f.scale[p] * tdata[q] * s
        v[c - base] += shift
        v += ld
        u += beside


cdef public int32_t lav_sparse_factor(const sparse_t* f, const int32_t* indptr, const int32_t* indices,
                                      const double* data, const int32_t* tptr, const int32_t* tind, const double* tdata,
                                      const double* d, double shift, double tiny) noexcept nogil:
    """Factor A + shift D, D = diag(d) > 0; of L U with A^T beside. How many pivots were at most tiny of d."""
    cdef int32_t i, k, q, lost = 0
    for k in range(f.n):
        f.scale[k] = 1.0 / sqrt(d[f.order[k]]) if f.lu else tiny * d[f.order[k]]
    begin_panels(f)
    for i in range(f.panels):
        place_rows(f, i)
        fill(f, i, indptr, indices, data, tptr, tind, tdata, d, shift)
        take_panels(f, i, f.lu)
        k = f.first[i + 1] - f.first[i]
        q = k + f.rptr[i + 1] - f.rptr[i]
        if f.lu:
            lost += lu_panel_with_rows(f, k, q, f.val + f.at[i], f.up + f.beside[i], f.swap + f.first[i], tiny)
        else:
            lost += cholesky_panel(f.wide, k, q, f.val + f.at[i], f.scale + f.first[i])
        hand_on(f, i, f.rptr[i])
    return lost


cdef inline int64_t panel_workspace_size(const sparse_t* f) noexcept nogil:
    # for what one panel takes from another, for the rows below it, and of L U for the tops of a strip
    cdef int32_t i, j, run
    cdef int64_t most = 0, needed
    for i in range(f.panels):
        needed = <int64_t>(f.first[i + 1] - f.first[i]) * LU_STRIP if f.lu else 0
        if f.rptr[i + 1] - f.rptr[i] > needed:
            needed = f.rptr[i + 1] - f.rptr[i]
        if needed > most:
            most = needed
        run = 0
        for j in range(f.rptr[i], f.rptr[i + 1]):
            run = run + 1 if j > f.rptr[i] and f.of[f.rows[j]] == f.of[f.rows[j - 1]] else 1
            needed = <int64_t>run * (f.rptr[i + 1] - j + run - 1)
            if needed > most:
                most = needed
    return most


def bandwidth(const int32_t[::1] indptr, const int32_t[::1] indices):
    """(lower, upper) bandwidth of a canonical CSR matrix, from the ends of its rows."""
    cdef Py_ssize_t i, n = indptr.shape[0] - 1
    cdef int32_t lower = 0, upper = 0
    for i in range(n):
        if indptr[i] < indptr[i + 1]:
            lower = max(lower, <int32_t>i - indices[indptr[i]])
            upper = max(upper, indices[indptr[i + 1] - 1] - <int32_t>i)
    return lower, upper


def scan(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] data, const double[::1] d):
    """(lower bandwidth, upper bandwidth, asymmetry) of a canonical CSR matrix with the metric d (n,)."""
    cdef int32_t n = <int32_t>indptr.shape[0] - 1
    cdef int32_t band[2]
    cdef double asymmetry
    cdef csr_t a
    cdef int32_t[::1] cursor
    if n <= 0 or data.shape[0] == 0:
        return 0, 0, 0.0
    a.indptr = &indptr[0]
    a.indices = &indices[0]
    a.data = &data[0]
    cursor = np.empty(n, np.int32)
    with nogil:
        asymmetry = scan_entries(&a, &d[0], n, &cursor[0], band)
    return band[0], band[1], asymmetry


def is_mirrored(const int32_t[::1] indptr, const int32_t[::1] indices):
    """Whether the pattern of a canonical CSR matrix is symmetric."""
    cdef int32_t[::1] cursor = np.array(indptr)
    cdef int32_t i, j, q
    for i in range(indptr.shape[0] - 1):
        for q in range(indptr[i], indptr[i + 1]):
            j = indices[q]
            if cursor[j] == indptr[j + 1] or indices[cursor[j]] != i:
                return False                            # rows are gone through in order: entry i of row j is next
            cursor[j] += 1
    return True


def free_part(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] data,
              const int32_t[::1] place, int n_free):
    """(indptr, indices, data) of the rows and columns with place >= 0, numbered in order of rows."""
    cdef int32_t i, q, k = 0, n = <int32_t>indptr.shape[0] - 1
    ptr_array = np.zeros(n_free + 1, np.int32)
    cdef int32_t[::1] ptr = ptr_array, idx
    cdef double[::1] val
    for i in range(n):
        if place[i] >= 0:
            for q in range(indptr[i], indptr[i + 1]):
                k += place[indices[q]] >= 0
            ptr[place[i] + 1] = k
    idx_array, val_array = np.empty(k, np.int32), np.empty(k)
    idx, val = idx_array, val_array
    k = 0
    for i in range(n):
        if place[i] >= 0:
            for q in range(indptr[i], indptr[i + 1]):
                if place[indices[q]] >= 0:
                    idx[k] = place[indices[q]]
                    val[k] = data[q]
                    k += 1
    return ptr_array, idx_array, val_array


cdef class SparsePanels:
    """The factor of a matrix in canonical compressed rows (n, n), whose pattern is symmetric; n > 0.

    Parameters
    ----------
    indptr, indices : (n + 1,), (nnz,) int32
    lu : bool
        L U; else L L^T of a symmetric matrix, of which the entries at and after the diagonal in the order are read.
    wide : bool
        Four lanes where the machine has them: the same bits.
    like : SparsePanels, optional
        Of the same pattern, whose analysis serves again.
    """

    def __init__(self, indptr, indices, bint lu, bint wide=True, SparsePanels like=None):
        cdef int32_t n = <int32_t>len(indptr) - 1
        if n < 1:
            raise ValueError("a matrix of one row or more")
        if like is None:
            analysis = analysed(indptr, indices)
        elif like.f.n == n and like.indices.shape[0] == len(indices):
            analysis = like.keep[0].copy(), like.keep[1], like.half
        else:
            raise ValueError("panels of another matrix")
        self.indptr, self.indices = indptr, indices
        self._hold(analysis, n, lu, wide)

    cdef _hold(self, analysis, int32_t n, bint lu, bint wide):
        whole_array, places, self.half = analysis
        cdef int32_t k = <int32_t>(len(places) // 2 - 1)
        cdef int32_t[::1] whole = whole_array
        cdef int64_t[::1] places_ = places
        cdef int32_t* order = &whole[0]
        cdef int32_t* place = order + n
        cdef int32_t* of = place + n
        cdef int32_t* swap = of + n
        cdef int32_t* rel = swap + n
        cdef int32_t* first = rel + n                   # k + 1
        cdef int32_t* rptr = first + k + 1              # k + 1
        cdef int32_t* head = rptr + k + 1
        cdef int32_t* link = head + k
        cdef int32_t* next_ = link + k
        cdef int32_t* rows = next_ + k                  # the rest
        cdef int64_t* at = &places_[0]
        cdef int64_t* beside = at + k + 1
        self.work = 2.0 * self.half if lu else self.half
        self.entries = at[k] + (beside[k] if lu else 0)
        self.keep, self.numbers = (whole_array, places), None
        self.f = sparse_t(
            n, k, wide and has_wide(), lu, order, place, first, of, rptr, rows, at, beside, NULL, NULL, NULL, NULL, NULL,
            swap, rel, head, link, next_)

    @staticmethod
    cdef SparsePanels of_blocks(analysis, int32_t n, bint wide):
        """With workspace for the values of n rows, by `symbolic.block_panels`."""
        cdef SparsePanels made = SparsePanels.__new__(SparsePanels)
        made._hold((analysis[0].copy(), *analysis[1:]), n, False, wide)
        made._make_workspace()
        return made

    cdef _make_workspace(self):
        # What is counted and never factored holds no numbers.
        cdef int64_t most = panel_workspace_size(&self.f)
        cdef double[::1] numbers
        numbers = self.numbers = np.empty(self.entries + most + 2 * self.f.n + 1)
        self.f.val = &numbers[0]
        self.f.up = self.f.val + self.f.at[self.f.panels]
        self.f.temp = self.f.val + self.entries
        self.f.scale = self.f.temp + most
        self.f.y = self.f.scale + self.f.n

    def factor(self, const double[::1] data, const double[::1] d, double shift, double tiny):
        """Factor the matrix of these entries with shift D, d (n,) > 0; how many pivots are not above tiny d."""
        cdef const int32_t[::1] ptr = self.indptr, ind = self.indices
        cdef int32_t[::1] tptr, tind
        cdef double[::1] tdata
        cdef int32_t lost
        if data.shape[0] != ind.shape[0] or d.shape[0] != self.f.n:
            raise ValueError("entries of another matrix")
        if data.shape[0] == 0:
            return self.f.n
        if self.numbers is None:
            self._make_workspace()
        tptr, tind, tdata = np.empty(1, np.int32), np.empty(1, np.int32), np.empty(1)
        if self.f.lu:
            tptr = np.empty(self.f.n + 2, np.int32)
            tind, tdata = np.empty(data.shape[0], np.int32), np.empty(data.shape[0])
        with nogil:
            if self.f.lu:
                transpose_csr(self.f.n, self.f.n, &ptr[0], &ind[0], &data[0], &tptr[0], &tind[0], &tdata[0])
            lost = lav_sparse_factor(&self.f, &ptr[0], &ind[0], &data[0], &tptr[0], &tind[0], &tdata[0], &d[0], shift, tiny)
        return lost

    def solve(self, const double[::1] b):
        """(n,) of the last factor; a new array."""
        out = np.empty(self.f.n)
        cdef double[::1] x = out
        if b.shape[0] != self.f.n or self.numbers is None:
            raise ValueError("of another size, or before a factor")
        with nogil:
            sparse_solve(&self.f, &b[0], &x[0])
        return out

    @property
    def order(self):
        """(n,) row eliminated first, second, ..."""
        return self.keep[0][:self.f.n]

    def lost_rows(self):
        """Rows whose pivots the last factor did not take, in ascending order; their columns of L are 0."""
        cdef int32_t i, k
        cdef int64_t rows
        if self.numbers is None:
            raise ValueError("before a factor")
        found = []
        for i in range(self.f.panels):
            rows = self.f.first[i + 1] - self.f.first[i] + self.f.rptr[i + 1] - self.f.rptr[i]
            for k in range(self.f.first[i], self.f.first[i + 1]):
                if self.f.val[self.f.at[i] + (k - self.f.first[i]) * (rows + 1)] == 0.0:
                    found.append(self.f.order[k])
        return np.sort(np.array(found, np.intp))


cdef class FullCholesky:
    """L L^T of a full symmetric matrix (`dense.pxd`).

    Parameters
    ----------
    a : (n, n) float64
        Of which the entries at and after the diagonal are read.
    least : (n,) float64
        What each pivot must be above.
    wide : bool
        Four lanes where the machine has them: the same bits.
    """

    cdef double[::1] lower
    cdef int32_t n
    cdef readonly int lost      # pivots that were not

    def __init__(self, const double[:, ::1] a, const double[::1] least, bint wide=True):
        cdef int32_t n = <int32_t>a.shape[0]
        if n < 1 or a.shape[1] != n or least.shape[0] != n:
            raise ValueError("a square matrix of one row or more, and what each of its pivots must be above")
        self.n, self.lower = n, np.empty(cholesky_workspace_size(n))
        with nogil:
            self.lost = dense_cholesky(wide and has_wide(), n, &a[0, 0], &least[0], &self.lower[0])

    def solve(self, const double[::1] b):
        """(n,); a new array."""
        out = np.array(b)
        cdef double[::1] x = out
        if b.shape[0] != self.n:
            raise ValueError("of another size")
        with nogil:
            dense_cholesky_solve(self.n, &self.lower[0], &x[0])
        return out
