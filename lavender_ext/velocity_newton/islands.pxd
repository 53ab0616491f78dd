"""Islands of Newton's method over generalised velocities, and the binding of its arrays to the caller's workspace.

The islands are those of the problem (`core/islands.pxd`), listed as panels and columns. The velocities of one island do not
move the rows of another.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

from lavender_ext.core.arena cimport arena_t, take_doubles, take_integers
from lavender_ext.core.order cimport sort_blocks_by_level
from lavender_ext.core.block_types cimport CONE, COULOMB, blocks_t, has_friction
from lavender_ext.core.view cimport generalized_t
from lavender_ext.velocity_newton.flow cimport flow_t, end_row_of_run, first_row_of_run
from lavender_ext.velocity_newton.normal cimport STRIP_ROWS
from lavender_ext.velocity_newton.sparse cimport count_mass_factor_work, find_pattern, pattern_index_size
from lavender_ext.velocity_newton.soft cimport has_bounded_rows_only


cdef enum:
    ASSEMBLY_WEIGHT = 5         # One multiply-add of forming N counts as this many of its factorisation.


cdef struct requirements_t:     # sizes of the workspace, and the work of a factorisation
    int32_t island_columns      # columns of the largest island
    int32_t panel_columns       # columns of the widest panel, rounded up to a multiple of four
    int32_t panel_values        # rows x columns of the largest panel, with columns rounded up
    int32_t rows                # number of rows of the largest island that is solved over rows, plus 3 for padding
    int32_t exceeds_pattern     # L has more entries than the given workspace; repeat with more
    double values               # values of the largest N of an island; its factor has as many
    double row_matrix_values    # values of A and Y^T of the largest island that is solved over rows
    double work                 # multiply-adds of forming N and of its factorisations, all islands
    double unused_entries       # upper bound of the entries of L of islands over rows, which are not factored


cdef inline void index_panels(flow_t* f, requirements_t* need) noexcept nogil:
    """Write the first block of each panel to `pblock`, and the offset of each block's V to `vptr`.

    `need` receives the largest number of columns and values of a panel.
    """
    cdef int32_t b, i = 0, size, nc, at = 0
    cdef const int32_t* ptr = f.p.ptr
    cdef int32_t* pblock = <int32_t*>f.pblock
    cdef int32_t* vptr = <int32_t*>f.vptr
    cdef const generalized_t* g = f.g
    need.panel_columns = need.panel_values = 0
    for b in range(g.n_panels):
        while ptr[i] < g.prow[b]:
            i += 1
        pblock[b] = i
        nc = g.pcol[b + 1] - g.pcol[b] + 3 & ~3
        need.panel_columns = max(need.panel_columns, nc)
        need.panel_values = max(need.panel_values, (g.prow[b + 1] - g.prow[b]) * nc)
    pblock[g.n_panels] = f.p.n_blocks
    for i in range(f.p.n_blocks):
        vptr[i] = at
        size = ptr[i + 1] - ptr[i]
        at += size if has_bounded_rows_only(&f.p, i) else size * size
    vptr[f.p.n_blocks] = at


cdef inline void list_islands(flow_t* f, int32_t* label, int32_t* number, requirements_t* need) noexcept nogil:
    """Number the islands in the order of their first panel, and list their panels and columns.

    label (n_panels) and number (k) are scratch.
    """
    cdef int32_t b, q, i, n = 1, panels = f.g.n_panels
    cdef const generalized_t* g = f.g
    cdef const int32_t* cols = g.cols
    cdef int32_t* iptr = <int32_t*>f.iptr
    cdef int32_t* run = <int32_t*>f.run
    cdef int32_t* cptr = <int32_t*>f.cptr
    cdef int32_t* icols = <int32_t*>f.icols
    cdef int32_t* local = <int32_t*>f.local
    # Label each panel with the island of its first block. Panels without columns may leave out islands.
    if f.p.islands != NULL:
        n = 0
        memset(number, 255, f.p.islands.n * sizeof(int32_t))        # -1
    for b in range(panels):
        label[b] = 0
        if f.p.islands != NULL:
            i = f.p.islands.label[f.pblock[b]]
            if number[i] < 0:
                number[i] = n
                n += 1
            label[b] = number[i]
    f.n_islands = n
    # List the runs of consecutive panels of each island.
    for i in range(n + 1):
        iptr[i] = 0
    for b in range(panels):
        if b == 0 or label[b] != label[b - 1]:
            iptr[label[b] + 1] += 1
    for i in range(n):
        iptr[i + 1] += iptr[i]
    for b in range(panels):
        i = label[b]
        if b == 0 or i != label[b - 1]:
            run[2 * iptr[i]] = b
            iptr[i] += 1
        run[2 * iptr[i] - 1] = b + 1
    for i in range(n, 0, -1):
        iptr[i] = iptr[i - 1]
    iptr[0] = 0
    # List the columns of each island in ascending order, and number them within it.
    for i in range(g.n):
        local[i] = -1
    for b in range(panels):
        for q in range(g.pcol[b], g.pcol[b + 1]):
            local[cols[q]] = label[b]
    sort_blocks_by_level(g.n, local, n, cptr, icols)
    need.island_columns = 0
    for b in range(n):
        need.island_columns = max(need.island_columns, cptr[b + 1] - cptr[b])
        for i in range(cptr[b], cptr[b + 1]):
            local[icols[i]] = i - cptr[b]


cdef inline bint choose_row_form(const flow_t* f, int32_t island, requirements_t* need) noexcept nogil:
    """Return whether a step over the rows of A takes less work than a step over velocities, and add work and sizes of the choice.

    The work is the number of multiply-adds of a step if three steps are made and half of the rows are free. The factor of
    N = M + J^T D J is not included. The constants were fitted to dense rows and to trees.
    """
    cdef int32_t a, b
    cdef bint applies
    cdef double rows = 0.0, values = 0.0, normal = 0.0, added = 0.0, formed, size = f.cptr[island + 1] - f.cptr[island], v, nc
    for a in range(f.iptr[island], f.iptr[island + 1]):
        rows += end_row_of_run(f, a) - first_row_of_run(f, a)
        for b in range(f.run[2 * a], f.run[2 * a + 1]):
            v = f.g.pval[b + 1] - f.g.pval[b]
            nc = f.g.pcol[b + 1] - f.g.pcol[b]
            values += v
            added += ASSEMBLY_WEIGHT * 0.5 * v * nc
            normal += nc * (28.0 + 2.0 * nc + 0.5 * v)
    formed = rows * (values / 6.0 + (rows + rows * rows / 24.0 if f.bounded_rows_only else 3.0 * rows + rows * rows / 6.0))
    applies = f.bounded_rows_only or (f.law != COULOMB and rows <= size)    # `pivots` has `size` entries.
    if not applies or formed > normal or rows * (rows + size) > 1e9:
        need.work += added
        return False
    need.work += formed
    need.unused_entries += 0.5 * size * size
    rows += 3.0
    need.values = max(need.values, rows * rows)
    need.row_matrix_values = max(need.row_matrix_values, rows * (rows + size))
    need.rows = max(need.rows, <int32_t>rows)
    return True


cdef struct structure_t:        # memory of `find_islands_and_factor_patterns`
    int32_t* label              # (n_panels) scratch
    int32_t* number             # (k) scratch
    int32_t* over_rows          # (n_panels)
    int32_t* pattern            # `pattern_index_size` of sparse.pxd


cdef inline void bind_structure(flow_t* f, const blocks_t* p, const generalized_t* g, int32_t per, structure_t* s,
                                arena_t* a) noexcept nogil:
    """Take the integers of islands, blocks and rows, and of a pattern with `per` entries in each row of L."""
    cdef int64_t n = g.n, panels = g.n_panels, m = p.n_rows
    f.linear.swap = take_integers(a, n)
    s.label, s.number = take_integers(a, panels), take_integers(a, p.n_blocks)
    f.iptr, f.cptr, f.run, f.pblock = (take_integers(a, panels + 1), take_integers(a, panels + 1), take_integers(a, 2 * panels),
                                       take_integers(a, panels + 1))
    f.icols, f.local, f.vptr = take_integers(a, n), take_integers(a, n), take_integers(a, p.n_blocks + 1)
    f.row_list, f.places, f.columns = take_integers(a, m), take_integers(a, m), take_integers(a, m)
    f.picked_columns, f.panel_of_column = take_integers(a, m), take_integers(a, m)
    f.transpose_offset = take_integers(a, g.pcol[panels])
    f.over_rows = s.over_rows = take_integers(a, panels)
    s.pattern = take_integers(a, pattern_index_size(n, g.pcol[panels], per))


cdef inline void find_islands_and_factor_patterns(flow_t* f, const blocks_t* p, const generalized_t* g, int32_t per,
                                                  structure_t* memory, requirements_t* need) noexcept nogil:
    """List the islands of a problem and find the pattern of L of each, in the memory of `bind_structure`."""
    cdef int32_t i, size
    cdef double values
    cdef const int32_t* lptr
    f.p = p[0]
    f.keeps_matrix = f.has_matrix = False
    f.law = p.law if has_friction(p) else CONE          # Without friction, the laws do not differ.
    f.p.law = f.law
    f.softness = 1e-4 if not has_friction(p) else (3e-2 if f.law == COULOMB else 3e-3)
    f.g = g
    index_panels(f, need)
    list_islands(f, memory.label, memory.number, need)
    f.paused.island = -1
    f.bounded_rows_only = True
    for i in range(p.n_blocks):
        if not has_bounded_rows_only(p, i):
            f.bounded_rows_only = False
            break
    f.sparse = False
    need.values = need.work = need.row_matrix_values = need.unused_entries = 0.0
    need.exceeds_pattern = need.rows = 0
    for i in range(f.n_islands):
        memory.over_rows[i] = choose_row_form(f, i, need)
        f.sparse = f.sparse or not memory.over_rows[i]
    if not f.sparse:
        return
    need.exceeds_pattern = find_pattern(g, f.n_islands, f.iptr, f.run, f.cptr, f.local, per, memory.pattern) < 0
    f.lptr, f.lidx = memory.pattern, memory.pattern + f.cptr[f.n_islands] + 1
    for i in range(0 if need.exceeds_pattern else f.n_islands):
        if memory.over_rows[i]:
            continue
        size = f.cptr[i + 1] - f.cptr[i]
        lptr = f.lptr + f.cptr[i]
        values = lptr[size] - lptr[0] + size
        if f.law == COULOMB:                            # Under Coulomb's law, N is not symmetric and is stored as a full matrix.
            values = <double>size * size
            need.work += values * size / 3.0
        elif size > 0:
            need.work += count_mass_factor_work(size, lptr, f.lidx)
        need.values = max(need.values, values)


cdef inline void bind_iterate(flow_t* f, const requirements_t* need, arena_t* a) noexcept nogil:
    """Take the arrays of the iterate, of V and of N."""
    cdef int64_t m = f.p.n_rows, n = max(<int64_t>f.g.n, m), nv = f.vptr[f.p.n_blocks]
    cdef int64_t size = max(need.island_columns, need.rows), values = <int64_t>need.values
    f.y, f.u, f.grad, f.step = take_doubles(a, n), take_doubles(a, n), take_doubles(a, n), take_doubles(a, n)
    f.theta, f.rho, f.s, f.q = take_doubles(a, m), take_doubles(a, m), take_doubles(a, m), take_doubles(a, m)
    f.phi, f.center, f.lam, f.trial = take_doubles(a, m), take_doubles(a, m), take_doubles(a, m), take_doubles(a, m)
    f.best, f.start, f.w, f.e = take_doubles(a, m), take_doubles(a, m), take_doubles(a, m), take_doubles(a, m)
    f.inv_theta, f.sqrt_theta = take_doubles(a, m), take_doubles(a, m)
    f.v, f.factored_v = take_doubles(a, nv), take_doubles(a, nv)
    f.normal, f.factor = take_doubles(a, values), take_doubles(a, values)
    f.linear.scale, f.local_rhs, f.weighted_y = take_doubles(a, size), take_doubles(a, size), take_doubles(a, need.panel_values)
    f.used_y, f.strip = take_doubles(a, need.panel_values), take_doubles(a, STRIP_ROWS * need.panel_columns)
    f.sum, f.y_transpose = take_doubles(a, 2 * need.rows), take_doubles(a, <int64_t>need.row_matrix_values)
    f.a = NULL
