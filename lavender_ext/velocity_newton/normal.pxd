"""The linear system of a step of one island (`newton.pxd`): N = I + Y^T V Y, or over few rows a part of A = Y Y^T.

N has the pattern of L; under Coulomb's law it is a full matrix, since it is not symmetric. `form_normal_matrix` forms it and
`factor_normal_matrix` factors it. A lost pivot ends the island with BROKEN (`descend_island`), and the host continues over
bodies or over the rows of A.

If an island has few rows, its steps are taken over these: y = Y^T mu and p = Y^T pi. A column of A is formed when its row first
becomes free (V != 0). By the matrix inversion lemma, with a the free rows, if all rows are bounded rows:

    h = A (mu - lambda) = s + b - A lambda,    S = Theta_a + A_aa,    z = S^-1 h_a                        (1)
    pi = lambda - mu + E_a z,    q = A pi = A E_a z - h,    q_a = -Theta_a z                              (2)

and with contacts, whose blocks of V may be full, with a the rows of the blocks of V that are not 0:

    (I + A_aa V_aa) t = h_a,    x = V_aa t,    pi = lambda - mu + E_a x,    q = A E_a x - h,    q_a = -t      (3)
"""
from libc.stdint cimport int32_t
from libc.string cimport memcpy

from lavender_ext.core.dot cimport dot
from lavender_ext.factor.linear cimport (CHOLESKY, LU, analyse_dense, analyse_tree, factor_linear_system_matrix,
                                         solve_linear_system, linear_t)
from lavender_ext.factor.tiles cimport combine_rows
from lavender_ext.velocity_newton.flow cimport end_block_of_run, first_block_of_run, form_column_of_a, flow_t, multiply_y
from lavender_ext.velocity_newton.soft cimport has_bounded_rows_only


cdef inline void scale_row(double* out, const double* x, double f, int32_t n) noexcept nogil:
    """Compute out = f x."""
    cdef int32_t i
    for i in range(n):
        out[i] = f * x[i]


cdef inline void add_row(double* out, const double* x, double f, int32_t n) noexcept nogil:
    """Add f x to out."""
    cdef int32_t i
    for i in range(n):
        out[i] += f * x[i]


cdef inline void scale_row_2(double* out, const double* x, const double* y, double f, double g, int32_t n) noexcept nogil:
    """Compute out = f x + g y."""
    cdef int32_t i
    for i in range(n):
        out[i] = f * x[i] + g * y[i]


cdef inline void scale_row_3(double* out, const double* x, const double* y, const double* z, double f, double g, double h,
                         int32_t n) noexcept nogil:
    """Compute out = f x + g y + h z."""
    cdef int32_t i
    for i in range(n):
        out[i] = (f * x[i] + g * y[i]) + h * z[i]


cdef inline void add_row_3(double* out, const double* x, const double* y, const double* z, double f, double g, double h,
                       int32_t n) noexcept nogil:
    """Add f x + g y + h z to out."""
    cdef int32_t i
    for i in range(n):
        out[i] += (f * x[i] + g * y[i]) + h * z[i]


cdef inline int32_t multiply_block_by_v(const flow_t* f, const double* v, int32_t i, int32_t row, int32_t nc, const double* y,
                                        int32_t n) noexcept nogil:
    """Append the non-zero rows of V Y of block i, with V in v, to the n rows of `weighted_y`; return the new number of rows.

    `row` is the block's first row within its panel. `line` receives, after its columns, the row of Y of each appended row.
    """
    cdef int32_t j = f.p.ptr[i], size = f.p.ptr[i + 1] - j, r, c
    cdef double* out
    cdef bint any_
    if has_bounded_rows_only(&f.p, i):
        for r in range(size):
            if v[r] != 0.0:
                scale_row(f.weighted_y + n * nc, y + <ssize_t>(row + r) * nc, v[r], nc)
                f.line[nc + n] = row + r
                n += 1
        return n
    for r in range(size):
        out = f.weighted_y + n * nc
        any_ = False
        for c in range(size):
            if v[r * size + c] != 0.0:
                if any_:
                    add_row(out, y + <ssize_t>(row + c) * nc, v[r * size + c], nc)
                else:
                    scale_row(out, y + <ssize_t>(row + c) * nc, v[r * size + c], nc)
                any_ = True
        if any_:
            f.line[nc + n] = row + r
            n += 1
    return n


cdef inline void weighted_row(const flow_t* f, const double* y, int32_t nc, int32_t n, int32_t a, int32_t end) noexcept nogil:
    """Compute row a of Y^T (V Y), columns before `end`, into `line`."""
    cdef int32_t r = 3
    cdef const double* t = f.weighted_y
    cdef double* line = f.line
    cdef const double* at = line + nc                   # index of the row of Y for each row of `weighted_y`
    cdef double f0 = y[<int32_t>at[0] * nc + a], f1, f2
    if n == 1:
        scale_row(line, t, f0, end)
        return
    f1 = y[<int32_t>at[1] * nc + a]
    if n == 2:
        scale_row_2(line, t, t + nc, f0, f1, end)
        return
    f2 = y[<int32_t>at[2] * nc + a]
    scale_row_3(line, t, t + nc, t + 2 * nc, f0, f1, f2, end)
    while r + 3 <= n:
        f0 = y[<int32_t>at[r] * nc + a]
        f1 = y[<int32_t>at[r + 1] * nc + a]
        f2 = y[<int32_t>at[r + 2] * nc + a]
        t = f.weighted_y + r * nc
        add_row_3(line, t, t + nc, t + 2 * nc, f0, f1, f2, end)
        r += 3
    while r < n:
        add_row(line, f.weighted_y + r * nc, y[<int32_t>at[r] * nc + a], end)
        r += 1


cdef inline void add_panel_to_sparse_matrix(const flow_t* f, int32_t panel, int32_t n, int32_t size) noexcept nogil:
    """Add Y^T (V Y) of one panel to N in the pattern of L."""
    cdef int32_t nc = f.g.pcol[panel + 1] - f.g.pcol[panel], a, b, at, i, k
    cdef int32_t c0 = f.cptr[f.island]
    cdef const int32_t* cols = f.g.cols + f.g.pcol[panel]
    cdef const int32_t* local = f.local
    cdef const int32_t* lptr = f.lptr + c0
    cdef const int32_t* theirs
    cdef const double* y = f.g.y + f.g.pval[panel]
    cdef double* line = f.line
    cdef double* val = f.normal - lptr[0]
    cdef double* diag = f.normal + (lptr[size] - lptr[0])
    cdef double* to
    for a in range(nc):
        k = local[cols[a]]
        to = val + lptr[k]
        weighted_row(f, y, nc, n, a, a + 1)
        diag[k] += line[a]
        if lptr[k + 1] - lptr[k] == a:                  # Row k has the panel's columns only.
            for b in range(a):
                to[b] += line[b]
            continue
        theirs = f.lidx + lptr[k]
        at = 0
        for b in range(a):
            i = local[cols[b]]
            while theirs[at] != i:
                at += 1
            to[at] += line[b]


cdef inline void add_panel_to_dense_matrix(const flow_t* f, int32_t panel, int32_t n, int32_t size) noexcept nogil:
    """Add Y^T (V Y) of one panel to the full matrix N.

    Its first row is that of the last velocity: if leaves are eliminated before their ancestors, most entries of L and U are 0.
    """
    cdef int32_t nc = f.g.pcol[panel + 1] - f.g.pcol[panel], a, b
    cdef const int32_t* cols = f.g.cols + f.g.pcol[panel]
    cdef const int32_t* local = f.local
    cdef const double* y = f.g.y + f.g.pval[panel]
    cdef double* line = f.line
    cdef double* row
    for a in range(nc):
        weighted_row(f, y, nc, n, a, nc)
        row = f.normal + <ssize_t>(size - 1 - local[cols[a]]) * size + size - 1
        for b in range(nc):
            row[-local[cols[b]]] += line[b]


cdef enum:                      # results of `compare_v`
    SAME_V = 0
    FEW_CHANGES = 1
    MANY_CHANGES = 2


cdef inline int32_t compare_v(const flow_t* f, int32_t island) noexcept nogil:
    """Compare V with the V with which N was formed: return SAME_V, FEW_CHANGES if fewer entries changed than are not 0."""
    cdef int32_t a, k, end, changed = 0, used = 0
    for a in range(f.iptr[island], f.iptr[island + 1]):
        end = f.vptr[end_block_of_run(f, a)]
        for k in range(f.vptr[first_block_of_run(f, a)], end):
            changed += f.v[k] != f.factored_v[k]
            used += f.v[k] != 0.0
    return SAME_V if changed == 0 else FEW_CHANGES if changed < used else MANY_CHANGES


cdef inline bint has_nonzero_v(const flow_t* f, int32_t island) noexcept nogil:
    """Return whether some entry of V is not 0, so that a step changes an impulse."""
    cdef int32_t a, k, end
    for a in range(f.iptr[island], f.iptr[island + 1]):
        end = f.vptr[end_block_of_run(f, a)]
        for k in range(f.vptr[first_block_of_run(f, a)], end):
            if f.v[k] != 0.0:
                return True
    return False


cdef inline void store_v(const flow_t* f, int32_t island) noexcept nogil:
    """Store the V with which N is formed."""
    cdef int32_t a, k, end
    for a in range(f.iptr[island], f.iptr[island + 1]):
        end = f.vptr[end_block_of_run(f, a)]
        for k in range(f.vptr[first_block_of_run(f, a)], end):
            f.factored_v[k] = f.v[k]


cdef inline void replace_stored_v_by_change(const flow_t* f, int32_t island) noexcept nogil:
    """Replace the stored V by the difference of V from it."""
    cdef int32_t a, k, end
    for a in range(f.iptr[island], f.iptr[island + 1]):
        end = f.vptr[end_block_of_run(f, a)]
        for k in range(f.vptr[first_block_of_run(f, a)], end):
            f.factored_v[k] = f.v[k] - f.factored_v[k]


# -- over rows: S of (1), or I + A V of (3) ---------------------------------------------------------------------------------


cdef inline int32_t compute_or_list_free_rows(const flow_t* f, const double* t, double* x) noexcept nogil:
    """Compute x = V t of (3); if t is NULL, list the free rows instead and write the rows of V A to x. Return their number."""
    cdef int32_t a, i, r, k, size, end, place = 0, n = 0
    cdef const double* v
    cdef bint is_free
    for a in range(f.iptr[f.island], f.iptr[f.island + 1]):
        for i in range(first_block_of_run(f, a), end_block_of_run(f, a)):
            v, end = f.factored_v + f.vptr[i], place + f.p.ptr[i + 1] - f.p.ptr[i]
            size = 1 if has_bounded_rows_only(&f.p, i) else end - place
            while place < end:
                is_free = False
                for k in range(size * size):
                    is_free |= v[k] != 0.0
                if is_free and t == NULL:
                    for r in range(size):
                        form_column_of_a(f, place + r)
                        f.places[n + r], f.columns[n + r] = place + r, (place + r) * f.rows
                    for r in range(size):
                        combine_rows(f.wide, f.rows, size, f.a, f.columns + n, v + r * size, x + <ssize_t>(n + r) * f.rows)
                elif is_free:
                    for r in range(size):
                        x[n + r] = dot(v + r * size, t + n, size)
                n += size if is_free else 0
                place += size
                v += size * size
    return n


cdef inline void form_row_matrix(flow_t* f) noexcept nogil:
    """Form S, its entries at and after the diagonal of each row, or the full matrix I + A V of (3), in `factor`."""
    cdef int32_t a, b, n = 0
    cdef const double* column
    cdef double* to = f.factor
    if not f.bounded_rows_only:
        f.n_free = n = compute_or_list_free_rows(f, NULL, f.normal)
        for a in range(n):
            for b in range(n):
                to[b] = f.normal[<ssize_t>b * f.rows + f.places[a]]     # V A transposed: both are symmetric.
            to[a] += 1.0
            to += n
        return
    for a in range(f.n_unknowns):
        if f.v[f.unknowns[a]] != 0.0:
            form_column_of_a(f, a)
            f.places[n], f.columns[n] = a, a * f.rows
            n += 1
    for a in range(n):
        column = f.a + f.columns[a]
        for b in range(a, n):
            to[b] = column[f.places[b]]
        to[a] += f.theta[f.unknowns[f.places[a]]]
        to += n
    f.n_free = n


cdef inline void solve_row_step(flow_t* f) noexcept nogil:
    """Compute pi and q of (2) or (3)."""
    cdef int32_t a, k
    cdef double* z = f.local_rhs
    cdef double* x = z
    for a in range(f.n_free):
        z[a] = f.grad[f.unknowns[f.places[a]]]
    solve_linear_system(&f.linear, z)
    if not f.bounded_rows_only:
        x = f.sum + f.rows
        compute_or_list_free_rows(f, z, x)
    combine_rows(f.wide, f.rows, f.n_free, f.a, f.columns, x, f.sum)
    for a in range(f.n_unknowns):
        k = f.unknowns[a]
        f.step[k] = f.lam[k] - f.y[k]
        f.q[k] = f.sum[a] - f.grad[k]
    for a in range(f.n_free):
        k = f.unknowns[f.places[a]]
        f.step[k] += x[a]
        f.q[k] = -f.theta[k] * z[a] if f.bounded_rows_only else -z[a]   # In (2) and (3), the other terms cancel.


# -- N -----------------------------------------------------------------------------------------------------------


cdef inline void set_identity(const flow_t* f, int32_t island, bint square) noexcept nogil:
    """Set N = I."""
    cdef int32_t a, b, n = 0, size = f.cptr[island + 1] - f.cptr[island]
    cdef double* normal = f.normal
    if square:
        for a in range(size):
            for b in range(size):
                normal[b] = 0.0
            normal[a] = 1.0
            normal += size
        return
    n = f.lptr[f.cptr[island + 1]] - f.lptr[f.cptr[island]]
    for a in range(n):
        normal[a] = 0.0
    for a in range(n, n + size):
        normal[a] = 1.0


cdef inline void form_normal_matrix(flow_t* f, int32_t island, bint square, bint updates) noexcept nogil:
    """Form N with the present V, or the matrix over rows; `updates`: add Y^T dV Y of the change of V to the last N."""
    cdef int32_t a, b, i, n, nc, size = f.cptr[island + 1] - f.cptr[island], end, last
    cdef const double* y
    cdef const double* v = f.v
    if f.is_over_rows:
        store_v(f, island)
        form_row_matrix(f)
        return
    if updates:
        replace_stored_v_by_change(f, island)
        v = f.factored_v
    else:
        set_identity(f, island, square)
    for a in range(f.iptr[island], f.iptr[island + 1]):
        end = f.run[2 * a + 1]
        for b in range(f.run[2 * a], end):
            nc = f.g.pcol[b + 1] - f.g.pcol[b]
            y = f.g.y + f.g.pval[b]
            n = 0
            last = f.pblock[b + 1]
            for i in range(f.pblock[b], last):
                n = multiply_block_by_v(f, v + f.vptr[i], i, f.p.ptr[i] - f.g.prow[b], nc, y, n)
            if n > 0 and square:
                add_panel_to_dense_matrix(f, b, n, size)
            elif n > 0:
                add_panel_to_sparse_matrix(f, b, n, size)
    store_v(f, island)


cdef inline bint factor_normal_matrix(flow_t* f, int32_t island, bint square) noexcept nogil:
    """Factor N, or the matrix over rows; return whether no pivot was lost."""
    cdef int32_t a, size = f.cptr[island + 1] - f.cptr[island], values
    cdef const int32_t* lptr = f.lptr + f.cptr[island]
    cdef linear_t* n = &f.linear
    f.factorisations += 1
    n.wide, n.shift, n.tiny, n.matrix = f.wide, 0.0, 0.0, f.factor
    n.d = NULL          # C++ converts no NULL through a temporary.
    if f.is_over_rows:
        analyse_dense(n, f.n_free)
        n.by, n.lower = CHOLESKY if f.bounded_rows_only else LU, f.normal
    elif square:
        analyse_dense(n, size)
        n.by = LU
        memcpy(f.factor, f.normal, <ssize_t>size * size * sizeof(double))
    else:
        values = lptr[size] - lptr[0]
        memcpy(f.factor, f.normal, (values + size) * sizeof(double))
        analyse_tree(n, size, lptr, f.lidx, f.factor - lptr[0], f.factor + values)
        for a in range(size):
            n.scale[a] = n.diagonal[a]
    return factor_linear_system_matrix(n) == 0


cdef inline void solve_step(flow_t* f, int32_t island, bint square) noexcept nogil:
    """Solve the island's system for the step p of (1) in newton.pxd, and compute q = Y p."""
    cdef int32_t a, c0 = f.cptr[island], size = f.cptr[island + 1] - c0
    if f.is_over_rows:
        solve_row_step(f)
        return
    if square:
        for a in range(size):
            f.local_rhs[size - 1 - a] = -f.grad[f.icols[c0 + a]]
        solve_linear_system(&f.linear, f.local_rhs)
        for a in range(size):
            f.step[f.icols[c0 + a]] = f.local_rhs[size - 1 - a]
    else:
        for a in range(size):
            f.local_rhs[a] = -f.grad[f.icols[c0 + a]]
        solve_linear_system(&f.linear, f.local_rhs)
        for a in range(size):
            f.step[f.icols[c0 + a]] = f.local_rhs[a]
    multiply_y(f, island, f.step, f.q)
