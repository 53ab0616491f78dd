"""N = I + Y^T V Y of one island, by what changed of V, and its factor: dense, in the pattern of L, or whole (`newton.pxd`)."""
from libc.stdint cimport int32_t
from libc.string cimport memcpy

from lavender_ext.core.block cimport ROW
from lavender_ext.core.generalized cimport ldl_solve
from lavender_ext.factor.dense_lu cimport lu_factor, lu_solve
from lavender_ext.generalized.dense cimport ltdl_factor, ltdl_solve
from lavender_ext.generalized.flow cimport flow_t, spread
from lavender_ext.generalized.sparse cimport sparse_factor


cdef inline void scale_row(double* out, const double* x, double f, int32_t n) noexcept nogil:
    cdef int32_t i
    for i in range(n):
        out[i] = f * x[i]


cdef inline void add_row(double* out, const double* x, double f, int32_t n) noexcept nogil:
    cdef int32_t i
    for i in range(n):
        out[i] += f * x[i]


cdef inline void scale_2(double* out, const double* x, const double* y, double f, double g, int32_t n) noexcept nogil:
    cdef int32_t i
    for i in range(n):
        out[i] = f * x[i] + g * y[i]


cdef inline void scale_3(double* out, const double* x, const double* y, const double* z, double f, double g, double h,
                         int32_t n) noexcept nogil:
    cdef int32_t i
    for i in range(n):
        out[i] = (f * x[i] + g * y[i]) + h * z[i]


cdef inline void add_3(double* out, const double* x, const double* y, const double* z, double f, double g, double h,
                       int32_t n) noexcept nogil:
    cdef int32_t i
    for i in range(n):
        out[i] += (f * x[i] + g * y[i]) + h * z[i]


cdef inline int32_t turn_block(const flow_t* f, int32_t i, int32_t row, int32_t nc, const double* y, bint whole,
                               int32_t n) noexcept nogil:
    """Rows n ... of `turned` = (V - held) Y of block i, of which `row` is the first in its panel; one past the last.

    `line`, behind the columns, holds which rows of Y they belong to. `whole`: nothing is held.
    """
    cdef int32_t j = f.p.ptr[i], size = f.p.ptr[i + 1] - j, r, c
    cdef const double* v = f.v + f.vptr[i]
    cdef double* held = f.held + f.vptr[i]
    cdef double* out
    cdef double x
    cdef bint any_
    if f.p.kind[i] == ROW:
        for r in range(size):
            x = v[r] if whole else v[r] - held[r]
            held[r] = v[r]
            if x != 0.0:
                out = f.turned + n * nc
                scale_row(out, y + <ssize_t>(row + r) * nc, x, nc)
                f.line[nc + n] = row + r
                n += 1
        return n
    for r in range(size):
        out = f.turned + n * nc
        any_ = False
        for c in range(size):
            x = v[r * size + c] if whole else v[r * size + c] - held[r * size + c]
            if x != 0.0:
                if any_:
                    add_row(out, y + <ssize_t>(row + c) * nc, x, nc)
                else:
                    scale_row(out, y + <ssize_t>(row + c) * nc, x, nc)
                any_ = True
        if any_:
            f.line[nc + n] = row + r
            n += 1
    for r in range(size * size):
        held[r] = v[r]
    return n


cdef inline void add_thin(const flow_t* f, int32_t panel, int32_t n, int32_t size) noexcept nogil:
    """N += Y^T turned of one panel, into the pattern of L."""
    cdef int32_t nc = f.g.pcol[panel + 1] - f.g.pcol[panel], a, b, r, at, i, k, count
    cdef int32_t c0 = f.cptr[f.island]
    cdef const int32_t* cols = f.g.cols + f.g.pcol[panel]
    cdef const int32_t* local = f.local
    cdef const int32_t* lptr = f.lptr + c0
    cdef const int32_t* theirs
    cdef const double* y = f.g.y + f.g.pval[panel]
    cdef const double* t = f.turned
    cdef double* line = f.line
    cdef double* val = f.normal - lptr[0]
    cdef double* diag = f.normal + (lptr[size] - lptr[0])
    cdef double* to
    for a in range(nc):
        k = local[cols[a]]
        to = val + lptr[k]
        count = lptr[k + 1] - lptr[k]
        if count == a:                                  # the same columns: into their place at once
            for r in range(n):
                at = <int32_t>line[nc + r] * nc + a
                add_row(to, t + r * nc, y[at], a)
                diag[k] += y[at] * t[r * nc + a]
            continue
        scale_row(line, t, y[<int32_t>line[nc] * nc + a], a + 1)
        for r in range(1, n):
            add_row(line, t + r * nc, y[<int32_t>line[nc + r] * nc + a], a + 1)
        diag[k] += line[a]
        theirs = f.lidx + lptr[k]
        at = 0
        for b in range(a):
            i = local[cols[b]]
            while theirs[at] != i:
                at += 1
            to[at] += line[b]


cdef inline void add_panel(const flow_t* f, int32_t panel, int32_t n, int32_t size, bint square) noexcept nogil:
    """N += Y^T turned of one panel: its lower triangle, or all of it."""
    cdef int32_t nc = f.g.pcol[panel + 1] - f.g.pcol[panel], a, b, r, end
    cdef const int32_t* cols = f.g.cols + f.g.pcol[panel]
    cdef const double* y = f.g.y + f.g.pval[panel]
    cdef const double* t = f.turned
    cdef const double* y0
    cdef double* line = f.line
    cdef double* row
    cdef double f0, f1, f2
    cdef const int32_t* local = f.local
    cdef int32_t at
    if f.thin and not square:
        add_thin(f, panel, n, size)
        return
    if n == 1:
        y0 = y + <int32_t>line[nc] * nc
        for a in range(nc):
            end = nc if square else a + 1
            f0 = y0[a]
            row = f.normal + <ssize_t>local[cols[a]] * size
            for b in range(end):
                at = local[cols[b]]
                row[at] += f0 * t[b]
        return
    for a in range(nc):
        end = nc if square else a + 1
        r = 0
        f0 = y[<int32_t>line[nc] * nc + a]
        if n == 2:
            f1 = y[<int32_t>line[nc + 1] * nc + a]
            scale_2(line, t, t + nc, f0, f1, end)
            r = 2
        else:
            f1 = y[<int32_t>line[nc + 1] * nc + a]
            f2 = y[<int32_t>line[nc + 2] * nc + a]
            scale_3(line, t, t + nc, t + 2 * nc, f0, f1, f2, end)
            r = 3
        while r + 3 <= n:
            f0 = y[<int32_t>line[nc + r] * nc + a]
            f1 = y[<int32_t>line[nc + r + 1] * nc + a]
            f2 = y[<int32_t>line[nc + r + 2] * nc + a]
            y0 = t + r * nc
            add_3(line, y0, y0 + nc, y0 + 2 * nc, f0, f1, f2, end)
            r += 3
        while r < n:
            f0 = y[<int32_t>line[nc + r] * nc + a]
            y0 = t + r * nc
            add_row(line, y0, f0, end)
            r += 1
        row = f.normal + <ssize_t>local[cols[a]] * size
        for b in range(end):
            at = local[cols[b]]
            row[at] += line[b]


cdef inline bint is_other(const flow_t* f, int32_t i) noexcept nogil:
    cdef int32_t k
    for k in range(f.vptr[i], f.vptr[i + 1]):
        if f.v[k] != f.held[k]:
            return True
    return False


cdef inline bint has_any(const flow_t* f, int32_t i) noexcept nogil:
    cdef int32_t k
    for k in range(f.vptr[i], f.vptr[i + 1]):
        if f.v[k] != 0.0:
            return True
    return False


cdef inline void changed(const flow_t* f, int32_t island, double* other, double* all_) noexcept nogil:
    """What it costs to form N by the blocks whose V is another than held, and anew."""
    cdef int32_t a, b, i, nc, last, end
    cdef double cost
    other[0] = 0.0
    all_[0] = 0.0
    for a in range(f.iptr[island], f.iptr[island + 1]):
        end = f.run[2 * a + 1]
        for b in range(f.run[2 * a], end):
            nc = f.g.pcol[b + 1] - f.g.pcol[b]
            last = f.pblock[b + 1]
            for i in range(f.pblock[b], last):
                cost = <double>nc * nc * (f.p.ptr[i + 1] - f.p.ptr[i])
                if has_any(f, i):
                    all_[0] += cost
                if is_other(f, i):
                    other[0] += cost


cdef inline int32_t form(flow_t* f, int32_t island, bint anew, bint square) noexcept nogil:
    """N of the present V, by what changed where that is less; 0 where nothing changed, 1 where it did."""
    cdef int32_t a, b, i, n, nc, size = f.cptr[island + 1] - f.cptr[island], end, last
    cdef double other, all_
    cdef double* normal = f.normal
    cdef const double* y
    if not anew:
        changed(f, island, &other, &all_)
        if other == 0.0:
            return 0
        anew = other >= all_
    if anew and f.thin and not square:
        n = f.lptr[f.cptr[island + 1]] - f.lptr[f.cptr[island]]
        for a in range(n):
            normal[a] = 0.0
        for a in range(n, n + size):
            normal[a] = 1.0
    elif anew:
        for a in range(size):
            for b in range(size if square else a + 1):
                normal[b] = 0.0
            normal[a] = 1.0
            normal += size
    if not anew:
        f.updates += 1
    for a in range(f.iptr[island], f.iptr[island + 1]):
        end = f.run[2 * a + 1]
        for b in range(f.run[2 * a], end):
            nc = f.g.pcol[b + 1] - f.g.pcol[b]
            y = f.g.y + f.g.pval[b]
            n = 0
            last = f.pblock[b + 1]
            for i in range(f.pblock[b], last):
                if anew or is_other(f, i):
                    n = turn_block(f, i, f.p.ptr[i] - f.g.prow[b], nc, y, anew, n)
            if n > 0:
                add_panel(f, b, n, size, square)
    return 1


cdef inline int32_t factor(flow_t* f, int32_t island, bint square) noexcept nogil:
    cdef int32_t a, size = f.cptr[island + 1] - f.cptr[island]
    cdef double* to = f.factor
    cdef const double* normal = f.normal
    cdef const int32_t* lptr = f.lptr + f.cptr[island]
    f.factorisations += 1
    if f.thin and not square:
        memcpy(to, normal, (lptr[size] - lptr[0] + size) * sizeof(double))
        return sparse_factor(size, lptr, f.lidx, to, f.inv)
    for a in range(size):
        memcpy(to, normal, (size if square else a + 1) * sizeof(double))
        to += size
        normal += size
    return lu_factor(size, f.factor, f.swap) if square else ltdl_factor(size, f.factor, f.inv, f.swap)


cdef inline void newton_step(const flow_t* f, int32_t island, bint square) noexcept nogil:
    """p of (1) and q = Y p."""
    cdef int32_t a, c0 = f.cptr[island], size = f.cptr[island + 1] - c0
    for a in range(size):
        f.local_rhs[a] = -f.grad[f.icols[c0 + a]]
    if square:
        lu_solve(size, f.factor, f.swap, f.local_rhs)
    elif f.thin:
        ldl_solve(size, f.lptr + c0, f.lidx, f.factor - f.lptr[c0], f.inv, f.local_rhs)
    else:
        ltdl_solve(size, f.factor, f.inv, f.local_rhs)
    for a in range(size):
        f.step[f.icols[c0 + a]] = f.local_rhs[a]
    spread(f, island, f.step, f.q)
