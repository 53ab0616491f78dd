"""The linear system of a step of one island (`newton.pxd`): N = I + Y^T V Y, or over few rows a part of A = Y Y^T.

N has the pattern of L; in COULOMB_STAGE it is a full matrix, since it is not symmetric. `form_normal_matrix` forms it and
`factor_normal_matrix` factors it. A lost pivot ends a descent (`descend_island`): in COULOMB_STAGE a new round begins, else the
island ends with BROKEN, and `_run_over_velocities` of lavender/solvers/newton.py continues over bodies or the rows of A.

If an island has few rows, its steps are taken over these: y = Y^T mu and p = Y^T pi. A column of A is formed when its row first
becomes free (V != 0). By the matrix inversion lemma, with a the free rows, if all rows are bounded rows:

    h = A (mu - lambda) = s + b - A lambda,    S = Theta_a + A_aa,    z = S^-1 h_a                        (1)
    pi = lambda - mu + E_a z,    q = A pi = A E_a z - h,    q_a = -Theta_a z                              (2)

and with contacts, whose blocks of V may be full, with a the rows of the blocks of V that are not 0:

    (I + A_aa V_aa) t = h_a,    x = V_aa t,    pi = lambda - mu + E_a x,    q = A E_a x - h,    q_a = -t      (3)
"""
from libc.stdint cimport int32_t
from libc.string cimport memcpy, memset

from lavender_ext.core.deadline cimport entry_cost, has_passed
from lavender_ext.core.dot cimport dot
from lavender_ext.factor.linear cimport (CHOLESKY, LU, TREE, analyse_dense, factor_linear_system_matrix,
                                         solve_linear_system, linear_t)
from lavender_ext.factor.tiles cimport combine_rows, gemm_subtract_nt
from lavender_ext.velocity_newton.flow cimport end_block_of_run, first_block_of_run, form_column_of_a, flow_t, multiply_y
from lavender_ext.velocity_newton.soft cimport has_bounded_rows_only


cdef enum:
    STRIP_ROWS = 6              # rows of Y^T (V Y) of a panel that are computed together


cdef inline void append_weighted_row(const flow_t* f, const double* y, double v, int32_t nc, int32_t n) noexcept nogil:
    """Write row n of `weighted_y`, -v y padded with 0, and of `used_y`, y."""
    cdef int32_t k, stride = nc + 3 & ~3
    cdef double* out = f.weighted_y + <ssize_t>n * stride
    cdef double* used = f.used_y + <ssize_t>n * nc
    for k in range(nc):
        out[k] = -v * y[k]
        used[k] = y[k]
    for k in range(nc, stride):
        out[k] = 0.0


cdef inline int32_t append_weighted_block(const flow_t* f, const double* v, int32_t i, int32_t nc, const double* y,
                                          int32_t n) noexcept nogil:
    """Append the rows of -V Y of block i, padded with 0 to a multiple of four columns, to the n rows of `weighted_y`.

    Rows of V that are 0 are omitted. `used_y` receives the row of Y for each row. v has the block's V, y its rows of Y.
    Returns the new number of rows.
    """
    cdef int32_t size = f.p.ptr[i + 1] - f.p.ptr[i], r, c, k, first
    cdef double* out
    if has_bounded_rows_only(&f.p, i):
        for r in range(size):
            if v[r] != 0.0:
                append_weighted_row(f, y + <ssize_t>r * nc, v[r], nc, n)
                n += 1
        return n
    for r in range(size):
        first = 0
        while first < size and v[first] == 0.0:
            first += 1
        if first < size:
            append_weighted_row(f, y + <ssize_t>r * nc, v[r], nc, n)
            out = f.weighted_y + <ssize_t>n * (nc + 3 & ~3)
            for c in range(first, size):
                if c != r and v[c] != 0.0:
                    for k in range(nc):
                        out[k] -= v[c] * y[<ssize_t>c * nc + k]
            n += 1
        v += size
    return n


cdef inline bint multiply_strip(const flow_t* f, int32_t n, int32_t nc, int32_t first, int32_t end) noexcept nogil:
    """Compute rows [first, first + STRIP_ROWS) of Y^T (V Y), columns before `end`, from n appended rows into `strip`.

    Return False, without a result, if the deadline has passed.
    """
    cdef int32_t stride = nc + 3 & ~3
    # A multiply-add of a strip takes 0.15 ns: "velocities" of the rates.
    if f.deadline != NULL and has_passed(f.deadline, STRIP_ROWS * end * (entry_cost() + 0.15 * n)):
        return False
    memset(f.strip, 0, STRIP_ROWS * stride * sizeof(double))
    gemm_subtract_nt(f.wide, end + 3 & ~3, min(STRIP_ROWS, nc - first), n, f.weighted_y, stride, f.used_y + first, nc, f.strip,
                     stride)
    return True


cdef inline void add_panel_to_sparse_matrix(const flow_t* f, int32_t panel, int32_t n, int32_t size) noexcept nogil:
    """Add Y^T (V Y) of one panel to N in the pattern of L; after the deadline, a part of it."""
    cdef int32_t nc = f.g.pcol[panel + 1] - f.g.pcol[panel], a, b, at, i, k
    cdef int32_t c0 = f.cptr[f.island]
    cdef const int32_t* cols = f.g.cols + f.g.pcol[panel]
    cdef const int32_t* local = f.local
    cdef const int32_t* lptr = f.lptr + c0
    cdef const int32_t* theirs
    cdef const double* line
    cdef double* val = f.normal - lptr[0]
    cdef double* diag = f.normal + (lptr[size] - lptr[0])
    cdef double* to
    for a in range(nc):
        if a % STRIP_ROWS == 0 and not multiply_strip(f, n, nc, a, min(a + STRIP_ROWS, nc)):
            return
        line = f.strip + a % STRIP_ROWS * (nc + 3 & ~3)
        k = local[cols[a]]
        to = val + lptr[k]
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
    """Add Y^T (V Y) of one panel to the full matrix N; after the deadline, a part of it.

    Its first row is that of the last velocity: if leaves are eliminated before their ancestors, most entries of L and U are 0.
    """
    cdef int32_t nc = f.g.pcol[panel + 1] - f.g.pcol[panel], a, b
    cdef const int32_t* cols = f.g.cols + f.g.pcol[panel]
    cdef const int32_t* local = f.local
    cdef const double* line
    cdef double* row
    for a in range(nc):
        if a % STRIP_ROWS == 0 and not multiply_strip(f, n, nc, a, nc):
            return
        line = f.strip + a % STRIP_ROWS * (nc + 3 & ~3)
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


cdef inline void store_v(const flow_t* f, int32_t island, bint as_change) noexcept nogil:
    """Store V in `factored_v`, or its difference from the V there."""
    cdef int32_t a, k, end
    for a in range(f.iptr[island], f.iptr[island + 1]):
        end = f.vptr[end_block_of_run(f, a)]
        for k in range(f.vptr[first_block_of_run(f, a)], end):
            f.factored_v[k] = f.v[k] - f.factored_v[k] if as_change else f.v[k]


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


cdef inline void form_normal_matrix(flow_t* f, int32_t island, bint square, bint updates) noexcept nogil:
    """Form N with the present V, or the matrix over rows; `updates`: add Y^T dV Y of the change of V to the last N."""
    cdef int32_t a, b, i, n, nc, size = f.cptr[island + 1] - f.cptr[island], end, last
    cdef const double* y
    cdef const double* v = f.v
    if f.is_over_rows:
        store_v(f, island, False)
        form_row_matrix(f)
        return
    if updates:
        store_v(f, island, True)
        v = f.factored_v
    else:                                               # N = I
        n = 0 if square else f.lptr[f.cptr[island + 1]] - f.lptr[f.cptr[island]]
        memset(f.normal, 0, (<ssize_t>size * size if square else n + size) * sizeof(double))
        for a in range(size):
            f.normal[n + <ssize_t>a * (size + 1 if square else 1)] = 1.0
    for a in range(f.iptr[island], f.iptr[island + 1]):
        end = f.run[2 * a + 1]
        for b in range(f.run[2 * a], end):
            nc = f.g.pcol[b + 1] - f.g.pcol[b]
            y = f.g.y + f.g.pval[b]
            n = 0
            last = f.pblock[b + 1]
            for i in range(f.pblock[b], last):
                n = append_weighted_block(f, v + f.vptr[i], i, nc, y + <ssize_t>(f.p.ptr[i] - f.g.prow[b]) * nc, n)
            if n > 0 and square:
                add_panel_to_dense_matrix(f, b, n, size)
            elif n > 0:
                add_panel_to_sparse_matrix(f, b, n, size)
            if f.deadline != NULL and f.deadline.passed:
                return                                  # `factor_normal_matrix` ends the step.
    store_v(f, island, False)


cdef inline bint factor_normal_matrix(flow_t* f, int32_t island, bint square) noexcept nogil:
    """Factor N, or the matrix over rows; return whether no pivot was lost."""
    cdef int32_t a, size = f.cptr[island + 1] - f.cptr[island], values
    cdef const int32_t* lptr = f.lptr + f.cptr[island]
    cdef linear_t* n = &f.linear
    if f.deadline != NULL and f.deadline.passed:
        return False
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
        n.kind, n.n, n.lptr, n.lidx = TREE, size, lptr, f.lidx         # L^T D L of entries left of the diagonal, and this
        n.matrix, n.diagonal = f.factor - lptr[0], f.factor + values
        for a in range(size):
            n.scale[a] = n.diagonal[a]
    n.deadline = f.deadline
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
