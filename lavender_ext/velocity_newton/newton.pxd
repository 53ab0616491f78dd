"""Newton's method over the velocities of generalised coordinates, island by island, of which few rows form A (`normal.pxd`).

With y = D^1/2 L (v - v*), whitened, s = Y y - b, and the answer lambda(s) of softened blocks (`flow.pxd`):

    G(y) = y - Y^T lambda(s),    N = I + Y^T V Y,    N p = -G,    y <- y + t p                            (1)
    theta' = theta + rho,        z = (rho c - s) / theta'                                                 (2)
    s_n <- s_n + phi                                                                                      (3)

Without Coulomb friction G is the gradient of a convex function with kinks in its second derivative, N is symmetric,
and t is where the derivative along p vanishes (Todorov 2014; Castro et al. 2022): it ends in a few steps. rho (2)
is nothing where the problem's own theta is no less than 1e-6 d, 1e-3 d on contacts, where kinks are sharp; below, and
between tangents that differ, it is a proximal term about the centre c, which follows lambda (Rockafellar 1976), and the
limit is the problem given. It begins the larger the further steps lead astray: 1e-4 d where nothing rubs, 3e-3 d
under the cone law, 3e-2 d under Coulomb's.

Coulomb's law has no such function. Newton's method goes on from the convex relaxation's answer with the derivative
that lacks symmetry, as long as |G| falls; where it does not, normals are lowered by phi = sum of a_g |w_g| over parts (3)
and the convex problem is solved again (De Saxce, Feng 1998; Cadoux 2009).

The test of the end is the judge's, on lambda itself: w = Y (Y^T lambda) - b + theta lambda, error e of every block.
N and its factor serve the next step where no block has changed its V, and the first after the centre has moved: lambda
leaps there, along the law that it has settled on, and so does V.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport length
from lavender_ext.core.dot cimport dot
from lavender_ext.core.method cimport BROKEN, LOST, MORE, REACHED, STUCK
from lavender_ext.core.block_types cimport CONE, COULOMB, blocks_t, is_rows, get_friction_components, friction_components_t
from lavender_ext.core.start cimport is_zero_impulse, zero_impulse
from lavender_ext.core.view cimport generalized_t
from lavender_ext.velocity_newton.flow cimport (NOWHERE, blank, block_end, block_from, descent_t, flow_t, gather, keep,
                                            measure, renew, respond_all, row_end, row_from, wait_t)
from lavender_ext.velocity_newton.normal cimport factor, form, is_held, newton_step
from lavender_ext.velocity_newton.soft cimport least_softness


cdef enum:                      # a round of Coulomb friction
    BEGINS = 0
    RELAXED = 1                 # descends under the cone law
    OWN = 2                     # under its own

cdef enum:
    IDLE_STEPS = 30             # steps without a better iterate after which an island is stuck
    LINE_STEPS = 24             # evaluations of one line search
    RENEW = 16                  # steps after which s is formed anew
    UNSEEN = 8                  # steps after which errors are looked at however large |G| is,
    FAR = 100                   # and before that where it is at most so many times their limit
    ROUNDS = 12                 # of Coulomb friction: what these leave is not for this method


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
    cdef const int32_t* own = f.own
    cdef const double* y = f.y
    cdef const double* grad = f.grad
    cdef const double* step = f.step
    cdef const double* p = f.q if f.formed else f.step
    for a in range(f.n_own):
        c = own[a]
        py += p[c] * y[c]
        pp += p[c] * step[c]
        pg += step[c] * grad[c]
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


cdef inline void one_theta(double* theta, int32_t first, int32_t end) noexcept nogil:
    # the largest of rows [first, end) on all of them
    cdef double big = 0.0
    cdef int32_t k
    for k in range(first, end):
        if theta[k] > big:
            big = theta[k]
    for k in range(first, end):
        theta[k] = big


cdef inline void soften(const flow_t* f, int32_t island, double share) noexcept nogil:
    """theta' of (2): rho is `share` d on rows with less than `least_softness` of their own.

    Rows of one part get the largest.
    """
    cdef int32_t a, i, j, k, g, end, last
    cdef friction_components_t q
    cdef const double* compliance = f.g.compliance
    cdef const double* d = f.p.d
    cdef double* theta = f.theta
    cdef double* rho = f.rho
    cdef double* soft = f.soft
    cdef double x, low
    for a in range(f.iptr[island], f.iptr[island + 1]):
        last = block_end(f, a)
        for i in range(block_from(f, a), last):
            j = f.p.ptr[i]
            end = f.p.ptr[i + 1]
            low = least_softness(&f.p, i)
            if share < low:
                low = share
            for k in range(j, end):
                x = compliance[k]
                if not x >= low * d[k]:
                    x += share * d[k]
                theta[k] = x
            if not is_rows(&f.p, i):
                get_friction_components(&f.p, i, &q)
                for g in range(q.n):
                    if q.size[g] > 1:
                        one_theta(theta, j + q.first[g], j + q.first[g] + q.size[g])
            for k in range(j, end):
                rho[k] = theta[k] - compliance[k]
                soft[k] = 1.0 / theta[k]
                f.root[k] = sqrt(theta[k])


cdef inline bint is_rigid(const flow_t* f, int32_t island) noexcept nogil:
    """Is there any proximal term that matters?"""
    cdef int32_t a, k
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(row_from(f, a), row_end(f, a)):
            if f.rho[k] > 1e-13 * f.theta[k]:
                return True
    return False


cdef inline double pull(const flow_t* f, int32_t island) noexcept nogil:
    """Energy error that the proximal terms leave, rho (lambda - c); that of G grows with the rows of a velocity."""
    cdef int32_t a, k
    cdef double x, out = 0.0
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(row_from(f, a), row_end(f, a)):
            x = f.rho[k] * (f.lam[k] - f.center[k])
            out += x * x / f.p.d[k]
    return sqrt(out)


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


cdef inline void begin_descent(flow_t* f, int32_t island, int32_t law, double least) noexcept nogil:
    """Newton steps under a law from y, s still to be formed; `best` has that error, or none has."""
    cdef descent_t* x = &f.descent
    f.p.law = law
    x.idle = x.n = x.known = x.moved = 0
    x.fresh = x.stale = 1
    x.share = f.share
    x.least = least
    x.lowest = 1.0 / 0.0
    x.last_center = x.sizes[0] = x.sizes[1] = x.sizes[2] = -1.0
    soften(f, island, x.share)
    renew(f, island)


cdef inline double weigh(flow_t* f, int32_t island, bint moves, double* energy) noexcept nogil:
    """How many times over its limits the error of lambda is, with u of `gather`; kept where that is the least."""
    cdef descent_t* x = &f.descent
    cdef double velocity, over
    energy[0] = measure(f, island, f.lam, moves, &velocity)
    over = excess(f, energy[0], velocity)
    if over < x.lowest:
        x.idle = x.idle if over > 0.9 * x.lowest else 0
        x.lowest = over
    if over < x.least:
        x.least = over
        keep(f, island, f.lam, f.best)
    return over


cdef inline int32_t given_up(flow_t* f, int32_t island, bint moves, bint far, double goal, int32_t end) noexcept nogil:
    """How it ended, at an iterate that nobody has looked at where it is far."""
    cdef double energy
    return REACHED if far and weigh(f, island, moves, &energy) <= goal else end


cdef inline double gradient(flow_t* f) noexcept nogil:
    """|G|, with G in `grad`; where A is formed h, and its size."""
    cdef int32_t a, c
    cdef double size = 0.0
    cdef const int32_t* own = f.own
    cdef const double* y = f.y
    cdef const double* u = f.u
    cdef double* grad = f.grad
    if f.formed:
        for a in range(f.n_own):
            c = own[a]
            grad[c] = (f.s[c] + f.p.b[c]) - u[c]
            size += (y[c] - f.lam[c]) * grad[c]
    else:
        for a in range(f.n_own):
            c = own[a]
            grad[c] = y[c] - u[c]
            size += grad[c] * grad[c]
    return sqrt(size) if size > 0.0 else size * 0.0     # of h, rounding may leave less than 0; NaN stays


cdef inline int32_t descend(flow_t* f, int32_t island, double goal) noexcept nogil:
    """Newton steps until the error is `goal` times its limits, or nothing moves; MORE: call again to go on.

    The iterate with the least error stands in `best`; `share` of d is the softness of rows without one, lowered where the
    centre's progress is slow. Idle is what does not lower the least error of this descent: the first step of one often
    leaves a larger one than it began with. First iterates that are far from G = 0 are only looked at where steps end there.
    """
    cdef descent_t* x = &f.descent
    cdef int32_t a, c
    cdef bint square = f.p.law == COULOMB, rigid, moves, far
    cdef double energy = 0.0, t, size, bound, over
    rigid = is_rigid(f, island)
    while True:
        if not x.known:
            respond_all(f, island, f.s, f.lam)
        x.known = 0
        moves = gather(f, island, f.lam, f.u)
        size = gradient(f)
        far = not (rigid or square) and x.n < UNSEEN and size > FAR * f.energy_limit
        if not far or f.steps <= 0:
            over = weigh(f, island, moves, &energy)
            if over != over:
                return LOST
            if over <= goal and not far:                # far: as where nobody asked
                return REACHED
        if f.steps <= 0:
            x.known = 1                                 # N, s and lambda stay as they are
            return MORE
        x.idle += 1
        x.n += 1
        if x.idle > IDLE_STEPS:
            return STUCK
        if rigid and (size <= 0.1 * energy and size <= 0.1 * pull(f, island) or size == 0.0):
            # The softened problem is solved as well as it needs to be: its centre moves.
            follow(f, island)
            x.moved = 1
            if x.last_center >= 0.0 and energy > 0.3 * x.last_center and x.share > 1e-9:
                x.share = 0.1 * x.share
                soften(f, island, x.share)
                x.stale = 1
            x.last_center = energy
            f.steps -= 1
            x.sizes[0] = x.sizes[1] = x.sizes[2] = -1.0
            continue
        f.steps -= 1
        if x.stale or not (x.moved or is_held(f, island)):
            form(f, island, square)
            if not factor(f, island, square):
                return given_up(f, island, moves, far, goal, BROKEN)
        x.stale = x.moved = 0
        newton_step(f, island, square)
        if square:
            bound = size
            for a in range(3):
                if x.sizes[a] > bound:
                    bound = x.sizes[a]
            x.sizes[x.n % 3] = size
            t = backtrack(f, island, bound)
        else:
            t = search(f, island)
        if t == 0.0:
            if x.fresh:
                return given_up(f, island, moves, far, goal, STUCK)
            x.fresh = x.stale = 1                       # s anew, once: rounding may be in the way
            renew(f, island)
            continue
        for a in range(f.n_own):
            c = f.own[a]
            f.y[c] += t * f.step[c]
        f.still = False
        x.fresh = x.n % RENEW == 0
        if x.fresh:
            renew(f, island)
        else:
            arrive(f)                                   # both ended where they looked last
            x.known = 1


cdef inline double slip(const flow_t* f, int32_t i) noexcept nogil:
    """phi of (3) from w of block i, whose normal it leaves out."""
    cdef int32_t g
    cdef double out = 0.0
    cdef friction_components_t q
    get_friction_components(&f.p, i, &q)
    for g in range(q.n):
        out += q.friction_coefficient[g] * length(f.w + f.p.ptr[i] + q.first[g], q.size[g])
    return out


cdef inline void lower_normals(const flow_t* f, int32_t island, const double* lam) noexcept nogil:
    """phi of what lam leaves; it must be 0 before."""
    cdef int32_t a, i
    cdef double velocity
    measure(f, island, lam, gather(f, island, lam, f.u), &velocity)
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for i in range(block_from(f, a), block_end(f, a)):
            if not is_rows(&f.p, i) and f.p.ptr[i + 1] - f.p.ptr[i] > 1:
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
    for a in range(f.n_own):
        c = f.own[a]
        f.y[c] = lam[c] if f.formed else f.u[c]


cdef inline bint offer(flow_t* f, int32_t island, const double* lam, bint moves) noexcept nogil:
    """Keep lam in `first_best` where its error under the problem's own law is less than is kept; phi must be 0.

    With u of `gather`, which says whether it moves. Is the error less than the least?
    """
    cdef double energy, velocity, over
    f.p.law = f.law
    energy = measure(f, island, lam, moves, &velocity)
    over = excess(f, energy, velocity)
    if over < f.wait.kept:
        f.wait.kept = over
        keep(f, island, lam, f.first_best)
    if over < f.wait.least:
        f.wait.least = over
        return True
    return False


cdef inline int32_t with_coulomb(flow_t* f, int32_t island, double* impulse) noexcept nogil:
    """Rounds of Newton's method on Coulomb's law, each from the answer of a convex problem, on from where they wait.

    What a descent that waits began with, phi or the impulse, stands `aside`: the best so far is in its place.
    """
    cdef wait_t* x = &f.wait
    cdef int32_t n
    cdef double least
    if x.at == RELAXED:
        keep(f, island, f.aside, f.phi)
    elif x.at == OWN:
        keep(f, island, f.aside, impulse)
    while x.rounds < ROUNDS:
        least = x.least
        if x.at == BEGINS:
            f.rounds += 1
            x.at = RELAXED if x.rounds > 0 or x.cold else OWN
            if x.at == OWN:
                restart(f, island, impulse)
            begin_descent(f, island, CONE if x.at == RELAXED else COULOMB, 1.0 / 0.0)
        f.p.law = CONE if x.at == RELAXED else COULOMB
        n = descend(f, island, 0.1 * least if x.at == RELAXED and least > 1e2 else 1.0)
        if x.at == RELAXED:
            if n == LOST or n == BROKEN:
                return n
            if n == MORE:
                keep(f, island, f.phi, f.aside)
            keep(f, island, f.best, impulse)
            level(f, island)
            offer(f, island, impulse, gather(f, island, impulse, f.u))
        else:
            if n == MORE:
                keep(f, island, impulse, f.aside)
            if n != LOST and offer(f, island, f.best, gather(f, island, f.best, f.u)):
                keep(f, island, f.best, impulse)
        if x.least <= 1.0:
            return REACHED
        if n == MORE:
            x.least = least                             # as if nobody had looked
            return MORE
        if x.at == OWN:
            lower_normals(f, island, impulse)
            x.rounds += 1
        restart(f, island, impulse)
        x.at = OWN if x.at == RELAXED else BEGINS
        if x.at == OWN:
            begin_descent(f, island, COULOMB, 1.0 / 0.0)
    return STUCK


cdef inline void set_limits(flow_t* f, int32_t island) noexcept nogil:
    """Largest errors with which an island's relative residual is at most tol; 0 if each row is compared with its own terms."""
    cdef const double* own
    cdef double energy = f.reference_energy, velocity = f.reference_velocity
    if f.p.islands != NULL:
        own = f.p.islands.reference + 2 * f.p.islands.label[block_from(f, f.iptr[island])]
        energy, velocity = max(own[0], 0.0), max(own[1], 0.0)
    f.energy_limit, f.velocity_limit = f.tol * energy, f.tol * velocity


cdef inline void enter(flow_t* f, int32_t island) noexcept nogil:
    """What y counts, velocities or rows, of which no column of A is known."""
    cdef int32_t a, k
    set_limits(f, island)
    f.formed = f.few[island]
    f.own, f.n_own = f.icols + f.cptr[island], f.cptr[island + 1] - f.cptr[island]
    if not f.formed:
        return
    f.own, f.n_own, f.rows = f.listed, 0, f.n_own       # rows: of Y^T
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(row_from(f, a), row_end(f, a)):
            f.listed[f.n_own] = k
            f.n_own += 1
    k, f.rows = f.rows, f.n_own + 3 & ~3
    f.a = f.across + k * f.rows
    f.home[0] = NOWHERE


cdef inline bint is_settled(flow_t* f, int32_t island, double* impulse) noexcept nogil:
    """Whether no row of the island acts; the zero impulse, which solves it, is then its impulse."""
    cdef int32_t a, k
    if f.p.islands == NULL or f.p.islands.reference[2 * f.p.islands.label[block_from(f, f.iptr[island])]] >= 0.0:
        return False
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(row_from(f, a), row_end(f, a)):
            impulse[k] = zero_impulse(&f.p, k)
    return True


cdef inline int32_t solve_island(flow_t* f, int32_t island, double* impulse) noexcept nogil:
    """One island from `impulse`, or from where it waits, into it; how it ended."""
    cdef int32_t end
    cdef bint waits = f.wait.island == island
    f.island = island
    if not waits:
        enter(f, island)
        if is_settled(f, island, impulse):
            return REACHED
        restart(f, island, impulse)
        level(f, island)
        f.wait.at, f.wait.rounds = BEGINS, 0
        f.wait.least = f.wait.kept = 1.0 / 0.0
        if not offer(f, island, impulse, not f.still):
            return LOST
        if f.wait.least <= 1.0:
            return REACHED
    if f.law == COULOMB:
        end = with_coulomb(f, island, impulse)
        keep(f, island, f.first_best, impulse)
    else:
        if not waits:
            begin_descent(f, island, f.law, f.wait.least)
        end = descend(f, island, 1.0)
        keep(f, island, f.best, impulse)
    f.wait.island = island if end == MORE else -1
    return end


cdef inline int32_t descend_all(flow_t* f, double* impulse) noexcept nogil:
    """All islands from `impulse` (m), or from the one that waits on, into it: REACHED, or how the worst of them ended."""
    cdef int32_t i, end, first = f.wait.island
    if first < 0:
        first = 0
        f.wait.worst, f.wait.cold = REACHED, f.law == COULOMB and is_zero_impulse(&f.p, impulse)
    for i in range(first, f.n_islands):
        end = solve_island(f, i, impulse)
        if end == MORE:                                # N is of this one
            return MORE
        if end > f.wait.worst:
            f.wait.worst = end
    return f.wait.worst
