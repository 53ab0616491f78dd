"""The operator H over the rows of A, dense or in compressed rows (`coupled.pxd`): choice of the form, memory, values.

`analyse_row_system` needs the elements and the pattern of A, `form_row_system` its values, and `form_generalized_matrix`
forms a dense H from J and M instead. Factors of a sparse matrix without symmetry may lose pivots, and hosts without another
factorisation then use a dense H (`start_newton_over_rows`).
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

from lavender_ext.core.arena cimport arena_t, take_doubles, take_integers
from lavender_ext.core.block_types cimport CONE, COULOMB, blocks_t, has_friction
from lavender_ext.core.deadline cimport deadline_t, has_passed
from lavender_ext.core.view cimport csr_t, generalized_t, view_t
from lavender_ext.factor.linear cimport NO_FACTOR, analyse_dense, analyse_rows, bind_rows_values
from lavender_ext.factor.tiles cimport combine_rows
from lavender_ext.newton.coupled cimport (copy_coupled_entries, coupled_t, list_coupled_rows, list_neighbours, merge_graphs,
                                          transpose_graph)
from lavender_ext.newton.elements cimport elements_t
from lavender_ext.newton.run cimport newton_t
from lavender_ext.newton.scaling cimport form_scaled_matrix, scaled_t
from lavender_ext.newton.system cimport DENSE, SPARSE
from lavender_ext.velocity_newton.flow cimport combined_product_cost


cdef enum:
    ANY_FORM = -1
    MAX_ALWAYS_DENSE_ROWS = 150     # Up to this many rows, a dense factor is faster than a sparse factor.
    MAX_DENSE_ROWS = 6000       # A matrix with more rows is not stored as a full matrix; at this size one takes 288 MB.


cdef inline bint is_dense_faster(double entries, double rows, bint cones) noexcept nogil:
    """Return whether a dense factor is faster, if the fraction of nonzeros of A is above 0.4 for the cone law, else 0.25.

    A full block of s^1/2 m rows has the fraction s, and a multiply-add of a dense factor costs a quarter of a sparse one. The
    fraction is smaller for bounded rows, because dense factors contain only the free rows, and for Coulomb's law, because
    supernodal factors of its asymmetric matrices may lose pivots.
    """
    return entries > (0.4 if cones else 0.25) * rows * rows


cdef inline bint has_dense_rows(double entries, double rows, bint cones) noexcept nogil:
    """Return whether H is stored as a full matrix."""
    return rows <= MAX_ALWAYS_DENSE_ROWS or is_dense_faster(entries, rows, cones) and rows <= MAX_DENSE_ROWS


cdef inline int32_t list_unfixed_entries(const scaled_t* s, int32_t rows, const csr_t* a, int32_t* place, csr_t* h) noexcept nogil:
    """Write the columns or the data of the rows that are not fixed, unless they are NULL; return the number of entries.

    place (rows) receives the index of each row among them, -1 of a fixed one.
    """
    cdef int32_t i, j, q, count = 0
    for j in range(rows):
        place[j] = -1
    for i in range(s.e.m):
        place[s.keep[i]] = i
    for i in range(s.e.m):
        if h.indptr != NULL:
            (<int32_t*>h.indptr)[i] = count
        for q in range(a.indptr[s.keep[i]], a.indptr[s.keep[i] + 1]):
            j = place[a.indices[q]]
            if j < 0:
                continue
            if h.indices != NULL:
                (<int32_t*>h.indices)[count] = j
            if h.data != NULL:
                (<double*>h.data)[count] = s.scale[i] * a.data[q] * s.scale[j]
            count += 1
    if h.indptr != NULL:
        (<int32_t*>h.indptr)[s.e.m] = count
    return count


cdef inline bint list_coupled_graph(const elements_t* e, const csr_t* h, coupled_t* c, int64_t capacity,
                                    arena_t* arena) noexcept nogil:
    """Take and list the graph of the elements that H couples in either direction; return False without the integers."""
    cdef int32_t n = e.n, count, i, j
    cdef int32_t* element = take_integers(arena, e.m)
    cdef int32_t* mark = take_integers(arena, n)
    cdef int32_t* ptr = take_integers(arena, n + 2)
    cdef int32_t* to = take_integers(arena, n + 2)
    cdef int32_t* near
    cdef int32_t* other
    c.to = take_integers(arena, n + 1)
    if arena.n_index > capacity:
        return False
    for i in range(n):
        for j in range(e.ptr[i], e.ptr[i + 1]):
            element[j] = i
    count = list_neighbours(e, h, element, mark, ptr, NULL)
    near, other = take_integers(arena, count), take_integers(arena, count)
    if arena.n_index > capacity:
        return False
    list_neighbours(e, h, element, mark, ptr, near)
    transpose_graph(n, ptr, near, to, other)
    transpose_graph(n, to, other, ptr, near)            # Neighbours now ascend.
    c.other = take_integers(arena, merge_graphs(n, ptr, near, to, other, c.to, NULL))
    if arena.n_index > capacity:
        return False
    merge_graphs(n, ptr, near, to, other, c.to, c.other)
    return True


cdef inline int32_t analyse_row_system(newton_t* n, const csr_t* a, int32_t form, int64_t capacity, arena_t* arena) noexcept nogil:
    """Set the form of H, the faster one if `form` is ANY_FORM, and analyse a sparse one.

    Return 1; 0 if more than `capacity` integers are needed, at least arena.n_index; -1 if the factor is too large.
    """
    cdef scaled_t* s = &n.sc
    cdef coupled_t* c = &n.s.coupled
    cdef csr_t h = csr_t(NULL, NULL, NULL)
    cdef int32_t rows = n.problem.p.n_rows, m = s.e.m, count
    cdef int32_t* place
    n.s.form = DENSE
    if form == DENSE or form == ANY_FORM and m <= MAX_ALWAYS_DENSE_ROWS or m == 0:
        return 1
    place = take_integers(arena, rows)
    if arena.n_index > capacity:
        return 0
    count = list_unfixed_entries(s, rows, a, place, &h)
    if form == ANY_FORM and has_dense_rows(count, m, s.e.n < m and n.problem.p.law == CONE):
        return 1
    n.s.form = SPARSE
    n.s.a.indptr, n.s.a.indices = take_integers(arena, m + 1), take_integers(arena, count)
    n.s.a.data = NULL
    if arena.n_index > capacity:
        return 0
    list_unfixed_entries(s, rows, a, place, &n.s.a)
    if not list_coupled_graph(&s.e, &n.s.a, c, capacity, arena):
        return 0
    c.indptr, c.diagonal = take_integers(arena, m + 1), take_integers(arena, m)
    if arena.n_index > capacity:
        return 0
    count = list_coupled_rows(c, &s.e, NULL)
    c.indices = take_integers(arena, count)
    n.linear.rows.tptr, n.linear.rows.tind = take_integers(arena, m + 2), take_integers(arena, count)
    if arena.n_index > capacity:
        return 0
    list_coupled_rows(c, &s.e, c.indices)
    return analyse_rows(&n.linear, m, c.indptr, c.indices, capacity, arena)


cdef inline void bind_row_values(newton_t* n, int64_t m, bint dense, arena_t* a) noexcept nogil:
    """Take H of m rows, and the matrix with its factor."""
    if dense:
        n.s.h, n.linear.matrix = take_doubles(a, m * m), take_doubles(a, m * m)
        n.linear.lower = n.s.multiplied = take_doubles(a, m * m)        # L L^T, or L H
    else:
        n.s.a.data, n.s.y = take_doubles(a, n.s.a.indptr[m]), take_doubles(a, m)
        n.s.coupled.h = take_doubles(a, n.s.coupled.indptr[m])
        bind_rows_values(&n.linear, n.s.coupled.indptr[m], a)


cdef inline void form_row_system(newton_t* n, const csr_t* a, int32_t wide) noexcept nogil:
    """Form H and set whether it is symmetric; a dense H that is formed may stay."""
    n.linear.wide, n.linear.factored = wide, NO_FACTOR
    if n.s.form == DENSE:
        analyse_dense(&n.linear, n.sc.e.m)
        if not (n.keeps_matrix and n.has_matrix):
            n.s.symmetric = form_scaled_matrix(&n.sc, a, n.problem.p.n_rows, n.linear.swap, <double*>n.s.h)
        n.has_matrix = True
        return
    # A pivot of up to 1e-13 of its diagonal entry is lost.
    n.linear.rows.factor.wide, n.linear.tiny, n.linear.shift = wide, 1e-13, 0.0
    list_unfixed_entries(&n.sc, n.problem.p.n_rows, a, n.linear.swap, &n.s.a)
    n.s.symmetric = copy_coupled_entries(&n.s.coupled, n.sc.e.m, &n.s.a, n.linear.swap)


# -- J and M -----------------------------------------------------------------------------------------------------------


cdef inline bint has_row_with_two_bounds(const blocks_t* p, const generalized_t* g) noexcept nogil:
    """Return whether a row has two finite bounds that differ, and a compliance below 0.005 d.

    With more compliance, as joint friction of MuJoCo has (from 0.01 d on), a solve over velocities takes half of the time over
    rows. With 0.001 d it takes up to 13 times as long.
    """
    cdef int32_t k
    for k in range(p.n_rows):
        if p.lower[k] > -1.0 / 0.0 and p.upper[k] < 1.0 / 0.0 and p.lower[k] < p.upper[k] and g.compliance[k] < 0.005 * p.d[k]:
            return True
    return False


cdef inline bint are_generalized_rows_faster(const view_t* v) noexcept nogil:
    """Return whether J and M are solved over a dense H: under Coulomb's law, or without friction if a row has two bounds.

    The exception are rows that far outnumber velocities. A step over velocities forms K^T V K from its panels and factors one
    matrix for each island, here of equal sizes. Rows with two bounds change their state in nearly every such step: 13 of 36
    random problems stalled.
    """
    cdef const generalized_t* g = v.g
    cdef double m = v.p.n_rows, n = min(g.n, g.pcol[g.n_panels]), islands = 1 if v.p.islands == NULL else v.p.islands.n, work, nc
    cdef int32_t b
    if m * (m + g.n) > 1e9 or (v.p.law != COULOMB if has_friction(&v.p) else not has_row_with_two_bounds(&v.p, g)):
        return False
    work = n * n * n / (3.0 * islands * islands)
    for b in range(g.n_panels):
        nc = g.pcol[b + 1] - g.pcol[b]
        work += (g.prow[b + 1] - g.prow[b]) * nc * nc
    # Steps over velocities are 3 to 10 times as many under Coulomb's law. On random problems of 3 to 900 rows, steps over rows
    # take less time up to 3 times the work, and more time from 4 on.
    return m * m * m / 3.0 <= 3.0 * work


cdef inline bint form_generalized_matrix(newton_t* n, int32_t wide, double* transpose, int32_t* at,
                                         deadline_t* deadline) noexcept nogil:
    """Form a dense H with its compliance from Y = J L^-T of M = L D L^T, unless a formed H may stay.

    Return False if the deadline has passed before the end. Up to three doubles after H are lost. transpose (nv, m + 4) and
    at (nv) are scratch. The rows of Y D^-1/2 are multiplied by the columns of its transpose.
    """
    cdef const scaled_t* s = &n.sc
    cdef const generalized_t* g = n.problem.g
    cdef int32_t b, i, j, c, nc, _pass, m = s.e.m, rows = (m + 3) & ~3
    cdef const double* y
    cdef double* h = <double*>n.s.h
    cdef double* line = transpose + <int64_t>g.n * rows
    analyse_dense(&n.linear, m)
    n.s.symmetric, n.linear.wide, n.linear.factored = 1, wide, NO_FACTOR
    if n.keeps_matrix and n.has_matrix:
        memset(<double*>s.e.theta, 0, m * sizeof(double))
        return True
    n.has_matrix = False
    memset(transpose, 0, <int64_t>g.n * rows * sizeof(double))
    for _pass in range(2):
        for i in range(s.e.n):
            b = g.home[s.block[i]]
            nc = g.pcol[b + 1] - g.pcol[b]
            for c in range(nc):
                at[c] = g.cols[g.pcol[b] + c] * rows
            for j in range(s.e.ptr[i], s.e.ptr[i + 1]):
                y = g.y + g.pval[b] + <int64_t>(s.keep[j] - g.prow[b]) * nc
                for c in range(nc):
                    line[c] = y[c] * s.scale[j]
                    if _pass == 0:
                        transpose[at[c] + j] = line[c]
                if _pass == 1:
                    combine_rows(wide, rows, nc, transpose, at, line, h + <int64_t>j * m)
                    if has_passed(deadline, combined_product_cost() * nc * rows):
                        return False
    for i in range(m):
        for j in range(i):
            h[<int64_t>j * m + i] = h[<int64_t>i * m + j]
        h[<int64_t>i * (m + 1)] += s.e.theta[i]
    memset(<double*>s.e.theta, 0, m * sizeof(double))
    n.has_matrix = True
    return True
