"""Newton's method over the velocities of generalised coordinates, island by island; A is never formed.

With y = D^1/2 L (v - v*), whitened, s = Y y - b, and the answer lambda(s) of softened blocks (`soft.pxd`):

    G(y) = y - Y^T lambda(s),    N = I + Y^T V Y,    N p = -G,    y <- y + t p                            (1)
    theta' = theta + rho,        z = (rho c - s) / theta'                                                 (2)
    s_n <- s_n + phi                                                                                      (3)

Without Coulomb friction G is the gradient of a convex function with kinks in its second derivative, N is symmetric,
and t is where the derivative along p vanishes (Todorov 2014; Castro et al. 2022): it ends in a few steps. rho (2)
is nothing where the problem's own theta is no less than 1e-6 d, 1e-3 d on contacts, where kinks are sharp; below, and
between tangents that differ, it is a proximal term about the centre c, which follows lambda (Rockafellar 1976), and the
limit is the problem given. It begins the larger the further steps lead astray: 1e-4 d where nothing rubs, 1e-3 d
under the cone law, 3e-2 d under Coulomb's (docs/auto.md).

Coulomb's law has no such function. Newton's method goes on from the convex relaxation's answer with the derivative
that lacks symmetry, as long as |G| falls; where it does not, normals are lowered by phi = mu |w_t| + mu r |w_s| (3)
and the convex problem is solved again (De Saxce, Feng 1998; Cadoux 2009).

The test of the end is the judge's, on lambda itself: w = Y (Y^T lambda) - b + theta lambda, error e of every block.
N is kept between steps; where few blocks have changed their V only those change it.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t
from libc.string cimport memcpy

from lavender_ext.core.block cimport (CONE, COULOMB, CONTACT_SPIN, ROW, block_error, blocks_t, n_tangents,
                                      row_error)
from lavender_ext.core.generalized cimport dot, generalized_t, ldl_solve, panel_push, panel_times
from lavender_ext.core.problem cimport Data
from lavender_ext.factor.dense_lu cimport lu_factor, lu_solve
from lavender_ext.generalized.dense cimport ltdl_factor, ltdl_solve
from lavender_ext.generalized.sparse cimport is_worth, sparse_factor
from lavender_ext.generalized.soft cimport INSIDE, OFF, SLIDES, cone_map, coulomb_map, size_of
from lavender_ext.judge.score cimport nothing, tally_block, tally_row, tally_t


cdef enum:
    DONE = 0                    # the test at tol was met
    SPENT = 1                   # the steps asked for are done
    STUCK = 2                   # nothing moves any more
    FAILED = 3                  # a factorisation failed
    LOST = 4                    # numbers are no longer finite

cdef enum:
    IDLE_STEPS = 30             # steps without a better iterate after which an island is stuck
    LINE_STEPS = 24             # evaluations of one line search
    RENEW = 16                  # steps after which s and N are formed anew
    ROUNDS = 60                 # rounds of Coulomb friction


cdef struct wait_t:             # a descent whose steps were used up, to go on with
    int32_t island              # -1: none waits
    int32_t worst               # end of the islands before it
    int32_t cold                # those after it begin from nothing
    int32_t law                 # that it is under
    int32_t rounds              # of Coulomb friction before this one
    int32_t idle
    int32_t n                   # steps of it
    int32_t fresh               # s was formed anew, not moved
    int32_t stale               # N is to be formed anew
    double share                # of d
    double kept                 # error of the island's best, which a cut may have found,
    double least                # of the best that one run knows of,
    double found                # of the descent's as its caller keeps it,
    double lowest               # and of its own steps
    double last_center
    double sizes[3]             # |G| of the last steps


cdef struct flow_t:
    blocks_t p                  # a copy: its law is that of the convex problem while one is solved
    const generalized_t* g
    int32_t law                 # of the problem
    double share                # of d, that rho is at first
    int32_t n_islands
    const int32_t* iptr         # (n_islands + 1) runs of panels of each island in `run`
    const int32_t* run          # (2 runs) first panel and the one past the last; runs <= n_panels
    const int32_t* cptr         # (n_islands + 1) columns of each island in `icols`
    const int32_t* icols        # (<= n) ascending in each
    const int32_t* local        # (n) number of a column in its island
    const int32_t* lptr         # (n + 1) rows of the islands' L, one after the other; NULL: all dense
    const int32_t* lidx         # columns in their island, ascending
    int32_t thin                # the present island's N and L are kept where L has entries (`sparse.pxd`)
    const int32_t* pblock       # (n_panels + 1) first block of each panel
    const int32_t* vptr         # (k + 1) V of each block: its diagonal for ROW, else square
    int32_t island              # the present one
    int32_t still               # its y is 0
    double* theta               # (m) theta', > 0
    double* soft                # (m) 1 / theta'
    double* rho                 # (m) >= 0
    double* y                   # (n)
    double* u                   # (n) Y^T lambda
    double* grad                # (n) G
    double* step                # (n) p
    double* s                   # (m) Y y - b + phi
    double* q                   # (m) Y p
    double* phi                 # (m)
    double* center              # (m)
    double* lam                 # (m)
    double* trial               # (m)
    double* best                # (m) of one descent
    double* first_best          # (m) of one island, under the problem's own law
    double* aside               # (m) what a descent that waits began with: phi, under Coulomb's law the impulse
    double* w                   # (m)
    double* e                   # (m)
    double* v                   # V at s
    double* held                # V inside `normal`
    double* normal              # N of the present island, lower triangle by rows; or L's entries; or whole: Coulomb
    double* factor              # its factor
    double* inv                 # (s) 1 / D
    double* turned              # (rows of a panel, columns) changes of V times Y
    double* line                # (columns)
    double* local_rhs           # (s)
    int32_t* swap               # (s)
    double energy_limit         # sqrt J of one island
    double velocity_limit       # m/s
    int32_t steps               # Newton steps left
    int32_t factorisations
    int32_t updates             # of N by changed blocks alone
    int32_t rounds              # of Coulomb friction
    int32_t evaluations         # of lambda(s) along a line
    wait_t wait


# -- rows and blocks of a run of panels ------------------------------------------------------------------


cdef inline int32_t row_from(const flow_t* f, int32_t a) noexcept nogil:
    return f.g.prow[f.run[2 * a]]


cdef inline int32_t row_end(const flow_t* f, int32_t a) noexcept nogil:
    return f.g.prow[f.run[2 * a + 1]]


cdef inline int32_t block_from(const flow_t* f, int32_t a) noexcept nogil:
    return f.pblock[f.run[2 * a]]


cdef inline int32_t block_end(const flow_t* f, int32_t a) noexcept nogil:
    return f.pblock[f.run[2 * a + 1]]


# -- lambda(s) and V -------------------------------------------------------------------------------------


cdef inline void respond(const flow_t* f, int32_t first, int32_t last, const double* s, double* lam,
                         double* v) noexcept nogil:
    """lambda and V of blocks [first, last)."""
    cdef int32_t i, j, end, k, nt, spin, at
    # Hoisted: what is stored to might be any of them, for all a compiler knows.
    cdef const int32_t* ptr = f.p.ptr
    cdef const int32_t* kind = f.p.kind
    cdef const int32_t* vptr = f.vptr
    cdef const double* lower = f.p.lower
    cdef const double* upper = f.p.upper
    cdef const double* rho = f.rho
    cdef const double* center = f.center
    cdef const double* soft = f.soft
    cdef double z, low, high
    cdef bint cone = f.p.law == CONE
    for i in range(first, last):
        j = ptr[i]
        end = ptr[i + 1]
        at = vptr[i]
        if kind[i] == ROW:
            at -= j
            for k in range(j, end):
                z = (rho[k] * center[k] - s[k]) * soft[k]
                low = lower[k]
                high = upper[k]
                v[at + k] = soft[k] if low < z < high else 0.0
                lam[k] = low if z < low else (high if z > high else z)
            continue
        for k in range(j, end):
            lam[k] = (rho[k] * center[k] - s[k]) * soft[k]
        nt = n_tangents(kind[i], end - j)
        spin = kind[i] == CONTACT_SPIN
        if cone:
            cone_map(nt, spin, f.theta + j, f.p.mu[i], f.p.patch_radius[i], lam + j, v + at)
        else:
            coulomb_map(nt, spin, f.theta + j, f.p.mu[i], f.p.patch_radius[i], lam + j, v + at)


cdef inline void respond_all(const flow_t* f, int32_t island, const double* s, double* lam) noexcept nogil:
    cdef int32_t a
    for a in range(f.iptr[island], f.iptr[island + 1]):
        respond(f, block_from(f, a), block_end(f, a), s, lam, f.v)


cdef inline bint gather(const flow_t* f, int32_t island, const double* lam, double* x) noexcept nogil:
    """x = Y^T lam on the island's columns; whether any lam is other than 0."""
    cdef int32_t a, b, k
    cdef bint moves = False
    for a in range(f.cptr[island], f.cptr[island + 1]):
        x[f.icols[a]] = 0.0
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(row_from(f, a), row_end(f, a)):
            if lam[k] != 0.0:
                moves = True
                break
        if moves:
            for b in range(f.run[2 * a], f.run[2 * a + 1]):
                panel_push(f.g, b, lam, x)
    return moves


cdef inline void spread(const flow_t* f, int32_t island, const double* x, double* out) noexcept nogil:
    """out = Y x on the island's rows."""
    cdef int32_t a, b, end
    for a in range(f.iptr[island], f.iptr[island + 1]):
        end = f.run[2 * a + 1]
        for b in range(f.run[2 * a], end):
            panel_times(f.g, b, x, out)


cdef inline void blank(const flow_t* f, int32_t island, double* out) noexcept nogil:
    """out = 0 on the island's rows."""
    cdef int32_t a, k
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(row_from(f, a), row_end(f, a)):
            out[k] = 0.0


cdef inline void renew(const flow_t* f, int32_t island) noexcept nogil:
    """s = Y y - b + phi."""
    cdef int32_t a, k
    cdef double* s = f.s
    cdef const double* phi = f.phi
    cdef const double* b = f.p.b
    if f.still:
        blank(f, island, s)
    else:
        spread(f, island, f.y, s)
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(row_from(f, a), row_end(f, a)):
            s[k] += phi[k] - b[k]


cdef inline double measure(const flow_t* f, int32_t island, const double* lam, bint moves,
                           double* velocity) noexcept nogil:
    """Energy [sqrt J] and velocity [m/s] of the errors of lam, with u = Y^T lam, 0 unless it `moves`; NaN: not finite."""
    cdef int32_t a, i, k, end, last
    cdef const int32_t* ptr = f.p.ptr
    cdef const int32_t* kind = f.p.kind
    cdef const double* lower = f.p.lower
    cdef const double* upper = f.p.upper
    cdef const double* d = f.p.d
    cdef const double* b = f.p.b
    cdef const double* phi = f.phi
    cdef const double* compliance = f.g.compliance
    cdef double* w = f.w
    cdef tally_t t = nothing()
    if moves:
        spread(f, island, f.u, w)
    else:
        blank(f, island, w)
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(row_from(f, a), row_end(f, a)):
            w[k] += compliance[k] * lam[k] - b[k] + phi[k]
        last = block_end(f, a)
        for i in range(block_from(f, a), last):
            if kind[i] == ROW:
                end = ptr[i + 1]
                for k in range(ptr[i], end):
                    tally_row(&f.p, k, row_error(lam[k], w[k], d[k], lower[k], upper[k]), &t)
            else:
                block_error(&f.p, i, lam, w, f.e)
                tally_block(&f.p, i, f.e, &t)
    velocity[0] = sqrt(t.fast) if t.fast > 0.0 else 0.0
    return sqrt(t.energy)


# -- N -------------------------------------------------------------------------------------------------------


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


# -- along a line ----------------------------------------------------------------------------------------------


cdef inline void along(const flow_t* f, int32_t island, double t) noexcept nogil:
    """w = s + t q, with lambda there in `trial`, and V."""
    cdef int32_t a, k
    cdef double* w = f.w
    cdef const double* s = f.s
    cdef const double* q = f.q
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(row_from(f, a), row_end(f, a)):
            w[k] = s[k] + t * q[k]
    respond_all(f, island, w, f.trial)


cdef inline void arrive(flow_t* f) noexcept nogil:
    """What `along` found at its last t is where the iterate is."""
    cdef double* x = f.s
    f.s = f.w
    f.w = x
    x = f.lam
    f.lam = f.trial
    f.trial = x


cdef inline double slope(flow_t* f, int32_t island, double py, double pp, double t) noexcept nogil:
    """Derivative along p of the convex function, at y + t p; lambda there in `trial`."""
    cdef int32_t a, k
    cdef double out = py + t * pp
    f.evaluations += 1
    along(f, island, t)
    for a in range(f.iptr[island], f.iptr[island + 1]):
        k = row_from(f, a)
        out -= dot(f.q + k, f.trial + k, row_end(f, a) - k)
    return out


cdef inline double search(flow_t* f, int32_t island) noexcept nogil:
    """t where the derivative along p is at most a tenth of what it was; 0 where p is no descent."""
    cdef int32_t a, c, n
    cdef double py = 0.0, pp = 0.0, pg = 0.0, low = 0.0, high, at_low, at_high, t, x, enough
    cdef int32_t side = 0
    for a in range(f.cptr[island], f.cptr[island + 1]):
        c = f.icols[a]
        py += f.step[c] * f.y[c]
        pp += f.step[c] * f.step[c]
        pg += f.step[c] * f.grad[c]
    if not pg < 0.0:
        return 0.0
    enough = -0.1 * pg
    at_low = pg
    high = 1.0
    at_high = slope(f, island, py, pp, high)
    n = 1
    while at_high < -enough and n < LINE_STEPS // 2:        # the minimum is beyond
        low = high
        at_low = at_high
        high = 2.0 * high
        at_high = slope(f, island, py, pp, high)
        n += 1
    if fabs(at_high) <= enough or at_high < 0.0 or at_high != at_high:
        return high if at_high == at_high else 0.0
    t = high
    while n < LINE_STEPS:                                   # regula falsi with halved ends (Dowell, Jarratt 1971)
        t = low - at_low * (high - low) / (at_high - at_low)
        if not low < t < high:
            t = 0.5 * (low + high)
        x = slope(f, island, py, pp, t)
        n += 1
        if fabs(x) <= enough:
            return t
        if x < 0.0:
            low = t
            at_low = x
            if side < 0:
                at_high *= 0.5
            side = -1
        else:
            high = t
            at_high = x
            if side > 0:
                at_low *= 0.5
            side = 1
    return t


cdef inline double backtrack(flow_t* f, int32_t island, double bound) noexcept nogil:
    """t where |G| falls below the bound (Coulomb); 0 where no step tried does it."""
    cdef int32_t a, c, _n
    cdef double t = 1.0, size
    for _n in range(8):
        f.evaluations += 1
        along(f, island, t)
        gather(f, island, f.trial, f.u)
        size = 0.0
        for a in range(f.cptr[island], f.cptr[island + 1]):
            c = f.icols[a]
            size += (f.y[c] + t * f.step[c] - f.u[c]) * (f.y[c] + t * f.step[c] - f.u[c])
        if sqrt(size) <= (1.0 - 1e-4 * t) * bound:
            return t
        t *= 0.5
    return 0.0


# -- one island --------------------------------------------------------------------------------------------------


cdef inline void follow(const flow_t* f, int32_t island) noexcept nogil:
    """The centre of the proximal terms moves to lambda."""
    keep(f, island, f.lam, f.center)


cdef inline void soften(const flow_t* f, int32_t island, double share) noexcept nogil:
    """theta' of (2): rho is `share` d on rows with less than 1e-6 d of their own, 1e-3 d in contacts.

    A disk's tangents get the largest.
    """
    cdef int32_t a, i, j, k, nt, end, last
    cdef const double* compliance = f.g.compliance
    cdef const double* d = f.p.d
    cdef double* theta = f.theta
    cdef double* rho = f.rho
    cdef double* soft = f.soft
    cdef double big, x, low
    for a in range(f.iptr[island], f.iptr[island + 1]):
        last = block_end(f, a)
        for i in range(block_from(f, a), last):
            j = f.p.ptr[i]
            end = f.p.ptr[i + 1]
            low = 1e-6 if f.p.kind[i] == ROW else 1e-3
            if share < low:
                low = share
            for k in range(j, end):
                x = compliance[k]
                if not x >= low * d[k]:
                    x += share * d[k]
                theta[k] = x
            nt = 0 if f.p.kind[i] == ROW else n_tangents(f.p.kind[i], end - j)
            if nt > 1:
                big = 0.0
                for k in range(j + 1, j + 1 + nt):
                    if theta[k] > big:
                        big = theta[k]
                for k in range(j + 1, j + 1 + nt):
                    theta[k] = big
            for k in range(j, end):
                rho[k] = theta[k] - compliance[k]
                soft[k] = 1.0 / theta[k]


cdef inline bint is_rigid(const flow_t* f, int32_t island) noexcept nogil:
    """Is there any proximal term that matters?"""
    cdef int32_t a, k
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(row_from(f, a), row_end(f, a)):
            if f.rho[k] > 1e-13 * f.theta[k]:
                return True
    return False


cdef inline void keep(const flow_t* f, int32_t island, const double* lam, double* to) noexcept nogil:
    cdef int32_t a, k
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(row_from(f, a), row_end(f, a)):
            to[k] = lam[k]


cdef inline double excess(const flow_t* f, double energy, double velocity) noexcept nogil:
    """How many times over its limits an error is; at most 1 where the test is met, NaN where it is lost."""
    cdef double x = 0.0, v = 0.0
    if energy != energy or velocity != velocity:
        return energy + velocity
    if energy > 0.0:
        x = energy / f.energy_limit if f.energy_limit > 0.0 else 1.0 / 0.0
    if velocity > 0.0:
        v = velocity / f.velocity_limit if f.velocity_limit > 0.0 else 1.0 / 0.0
    return x if x > v else v


cdef inline int32_t descend(flow_t* f, int32_t island, double goal, double* share, double* least) noexcept nogil:
    """Newton steps under the law of f.p until the error is `goal` times its limits, or nothing moves.

    The iterate with the least error stands in `best`, that error in least[0]; `share` of d is the softness of rows
    without one, lowered where the centre's progress is slow. Idle is what does not lower the least error of this
    descent: the first step of one often leaves a larger one than it began with. Where the steps are used up it waits,
    and goes on from there when it is called again.
    """
    cdef int32_t a, c, idle = 0, n = 0
    cdef bint square = f.p.law == COULOMB, rigid, stale = True, fresh = True, known = False, moves
    cdef double energy, velocity, over, t, size, last_center = -1.0, bound, lowest = 1.0 / 0.0
    cdef double sizes[3]
    sizes[0] = sizes[1] = sizes[2] = -1.0
    if f.wait.island == island:                         # its N, s and lambda are as they were
        idle = f.wait.idle
        n = f.wait.n
        fresh = f.wait.fresh
        lowest = f.wait.lowest
        last_center = f.wait.last_center
        for a in range(3):
            sizes[a] = f.wait.sizes[a]
        f.wait.island = -1
        stale = f.wait.stale
        known = True
    else:
        soften(f, island, share[0])
        renew(f, island)
    rigid = is_rigid(f, island)
    while True:
        if not known:
            respond_all(f, island, f.s, f.lam)
        known = False
        moves = gather(f, island, f.lam, f.u)
        energy = measure(f, island, f.lam, moves, &velocity)
        over = excess(f, energy, velocity)
        if over != over:
            return LOST
        if over < lowest:
            idle = idle if over > 0.9 * lowest else 0
            lowest = over
        if over < least[0]:
            least[0] = over
            keep(f, island, f.lam, f.best)
        if over <= goal:
            return DONE
        if f.steps <= 0:
            f.wait.island = island
            f.wait.law = f.p.law
            f.wait.idle = idle
            f.wait.n = n
            f.wait.fresh = fresh
            f.wait.stale = stale
            f.wait.share = share[0]
            f.wait.found = least[0]
            f.wait.lowest = lowest
            f.wait.last_center = last_center
            for a in range(3):
                f.wait.sizes[a] = sizes[a]
            return SPENT
        idle += 1
        n += 1
        if idle > IDLE_STEPS:
            return STUCK
        size = 0.0
        for a in range(f.cptr[island], f.cptr[island + 1]):
            c = f.icols[a]
            f.grad[c] = f.y[c] - f.u[c]
            size += f.grad[c] * f.grad[c]
        size = sqrt(size)
        if rigid and (size <= 0.1 * energy or size == 0.0):
            # The softened problem is solved as well as it needs to be: its centre moves.
            if last_center >= 0.0 and energy > 0.3 * last_center and share[0] > 1e-9:
                share[0] = 0.1 * share[0]
                follow(f, island)
                soften(f, island, share[0])
                stale = True
            else:
                follow(f, island)
            last_center = energy
            f.steps -= 1
            sizes[0] = sizes[1] = sizes[2] = -1.0
            continue
        f.steps -= 1
        if form(f, island, stale or n % RENEW == 0, square) or stale:
            if not factor(f, island, square):
                if not stale:
                    stale = True
                    continue
                return FAILED
        stale = False
        newton_step(f, island, square)
        if square:
            bound = size
            for a in range(3):
                if sizes[a] > bound:
                    bound = sizes[a]
            sizes[n % 3] = size
            t = backtrack(f, island, bound)
        else:
            t = search(f, island)
        if t == 0.0:
            if fresh:
                return STUCK
            fresh = True                                # s anew, once: rounding may be in the way
            stale = True
            renew(f, island)
            continue
        for a in range(f.cptr[island], f.cptr[island + 1]):
            c = f.icols[a]
            f.y[c] += t * f.step[c]
        f.still = False
        if n % RENEW == 0:
            renew(f, island)
            fresh = True
        else:
            arrive(f)                                   # both ended where they looked last
            known = True
            fresh = False


cdef inline double slip(const flow_t* f, int32_t i) noexcept nogil:
    """phi of (3) from w of block i, whose normal it leaves out."""
    cdef int32_t j = f.p.ptr[i], end = f.p.ptr[i + 1], nt = n_tangents(f.p.kind[i], end - j)
    cdef double out = f.p.mu[i] * size_of(f.w + j + 1, nt)
    if f.p.kind[i] == CONTACT_SPIN:
        out += f.p.mu[i] * f.p.patch_radius[i] * fabs(f.w[end - 1])
    return out


cdef inline void lower_normals(const flow_t* f, int32_t island, const double* lam) noexcept nogil:
    """phi of what lam leaves; it must be 0 before."""
    cdef int32_t a, i
    cdef double velocity
    measure(f, island, lam, gather(f, island, lam, f.u), &velocity)
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for i in range(block_from(f, a), block_end(f, a)):
            if f.p.kind[i] != ROW and f.p.ptr[i + 1] - f.p.ptr[i] > 1:
                f.phi[f.p.ptr[i]] = slip(f, i)


cdef inline void level(const flow_t* f, int32_t island) noexcept nogil:
    """phi = 0."""
    blank(f, island, f.phi)


cdef inline void restart(flow_t* f, int32_t island, const double* lam) noexcept nogil:
    """y = Y^T lam and the centre at lam, the best until a descent finds a better."""
    cdef int32_t a, c
    keep(f, island, lam, f.lam)
    keep(f, island, lam, f.best)                        # errors that overflow are no better than infinity
    follow(f, island)
    f.still = not gather(f, island, lam, f.u)
    for a in range(f.cptr[island], f.cptr[island + 1]):
        c = f.icols[a]
        f.y[c] = f.u[c]


cdef inline bint offer(flow_t* f, int32_t island, const double* lam, double* least, double* kept) noexcept nogil:
    """Keep lam in `first_best` where its error under the problem's own law is less than is kept; phi must be 0.

    Is it less than the least?
    """
    cdef double energy, velocity, over
    f.p.law = f.law
    energy = measure(f, island, lam, gather(f, island, lam, f.u), &velocity)
    over = excess(f, energy, velocity)
    if over < kept[0]:
        kept[0] = over
        keep(f, island, lam, f.first_best)
    if over < least[0]:
        least[0] = over
        return True
    return False


cdef inline int32_t with_coulomb(flow_t* f, int32_t island, double* impulse, bint cold, double* least,
                                 double* kept) noexcept nogil:
    """Rounds of Newton's method on Coulomb's law, each from the answer of a convex problem."""
    cdef bint waits = f.wait.island == island, convex
    cdef int32_t n, rounds
    cdef double found, share
    for rounds in range(f.wait.rounds if waits else 0, ROUNDS):
        convex = f.wait.law == CONE if waits else rounds > 0 or cold
        if convex:
            f.p.law = CONE
            found = f.wait.found if waits else 1.0 / 0.0
            share = f.wait.share if waits else f.share
            if waits:
                keep(f, island, f.aside, f.phi)
            else:
                f.rounds += 1
            waits = False
            n = descend(f, island, 1e-2 * least[0] if least[0] > 1e2 else 1.0, &share, &found)
            if n == LOST or n == FAILED:
                return n
            if n == SPENT:
                f.wait.rounds = rounds
                f.wait.least = least[0]
                keep(f, island, f.phi, f.aside)
            keep(f, island, f.best, impulse)
            level(f, island)
            offer(f, island, impulse, least, kept)
            if least[0] <= 1.0:
                f.wait.island = -1
                return DONE
            if n == SPENT:
                return SPENT
        if waits:
            keep(f, island, f.aside, impulse)
        else:
            if not convex:
                f.rounds += 1
            restart(f, island, impulse)
        f.p.law = COULOMB
        found = f.wait.found if waits else 1.0 / 0.0
        share = f.wait.share if waits else f.share
        waits = False
        n = descend(f, island, 1.0, &share, &found)
        if n == SPENT:
            f.wait.rounds = rounds
            f.wait.least = least[0]
            keep(f, island, impulse, f.aside)
        if n != LOST and offer(f, island, f.best, least, kept):
            keep(f, island, f.best, impulse)
        if least[0] <= 1.0:
            f.wait.island = -1
            return DONE
        if n == SPENT:
            return SPENT
        lower_normals(f, island, impulse)
        restart(f, island, impulse)
    return STUCK


cdef inline int32_t solve_island(flow_t* f, int32_t island, double* impulse, bint cold) noexcept nogil:
    """One island from `impulse`, or from where it waits, into it; how it ended."""
    cdef int32_t end
    cdef double least = 1.0 / 0.0, kept = 1.0 / 0.0, share = f.share
    f.island = island
    f.thin = f.lptr != NULL and is_worth(f.cptr[island + 1] - f.cptr[island], f.lptr + f.cptr[island], f.lidx)
    if f.wait.island == island:
        least = f.wait.least
        kept = f.wait.kept
        share = f.wait.share
    else:
        restart(f, island, impulse)
        level(f, island)
        if not offer(f, island, impulse, &least, &kept):
            return LOST
        if least <= 1.0:
            return DONE
    if f.law == COULOMB:
        end = with_coulomb(f, island, impulse, cold, &least, &kept)
        f.wait.kept = kept
        keep(f, island, f.first_best, impulse)
    else:
        end = descend(f, island, 1.0, &share, &least)
        f.wait.least = least
        keep(f, island, f.best, impulse)
    return end


cdef int32_t descend_all(flow_t* f, double* impulse, int32_t cold) noexcept nogil


cdef class Newton:
    cdef flow_t f
    cdef Data data
    cdef list keep
    cdef readonly int largest
    cdef readonly bint fits, crowded

    cdef void aim(self, double tol, int32_t steps) noexcept
    cdef int32_t go(self, double* impulse, bint cold) noexcept nogil
