"""An elimination order by nested dissection: the vertices of two halves of a graph, then those that separate them.

A half is split again until it has at most LEAF_VERTICES vertices, which keep the order of a given rank (George 1973). The
halves of a connected graph are those below and above the median of an approximate Fiedler vector, by power iteration

    x <- (x - mean of x + D^-1 W x) / 2,   D = diag(W 1),  mean weighted by D                         (1)

from distances to a distant vertex (Pothen, Simon, Liou 1990). The vertices of the smaller border separate them. Moves of
separating vertices to one half, with their neighbours in the other half to the separator, reduce the separator (Fiduccia,
Mattheyses 1982; Ashcraft, Liu 1997).
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t


cdef enum:
    LEAF_VERTICES = 50          # With 100 or 200, piles need 1.03 to 1.1 times the multiply-adds.
    POWER_ITERATIONS = 60
    MAX_REFINEMENTS = 6         # passes of moves; most separators stay after two or three
    MAX_WORSE_VERTICES = 12     # A pass ends when the separator has this many vertices more than the smallest one.
    SEPARATOR = 2               # value of `part`; the halves are 0 and 1


cdef struct dissection_t:
    const int32_t* ptr
    const int32_t* near
    const int32_t* rank         # (n) order within leaves and separators
    int32_t* vertices           # (n) vertices, in the order of elimination where that is final
    int32_t* label              # (n) first index in `vertices` of the subgraph of each vertex
    double* x                   # (n)
    double* y                   # (n)
    int32_t* part               # (n)
    int32_t* best               # (n) `part` with the smallest separator of a pass
    int32_t* moved              # (n) whether a vertex has left the separator in this pass
    int32_t* queue              # (n)
    int32_t* separator          # (n) list of separating vertices


cdef inline int32_t absolute_difference(int32_t i, int32_t j) noexcept nogil:
    """Return |i - j|."""
    return i - j if i > j else j - i


cdef inline void sort_by_rank(const dissection_t* g, int32_t begin, int32_t end) noexcept nogil:
    """Sort vertices[begin:end] by rank."""
    cdef int32_t i, j, v
    for i in range(begin + 1, end):
        v = g.vertices[i]
        j = i - 1
        while j >= begin and g.rank[g.vertices[j]] > g.rank[v]:
            g.vertices[j + 1] = g.vertices[j]
            j -= 1
        g.vertices[j + 1] = v


cdef inline int32_t compute_distances(const dissection_t* g, int32_t start) noexcept nogil:
    """Write the distances from `start` within its subgraph to x, others to -1; return the number of vertices that are reached.

    `queue` receives these vertices, the most distant ones last.
    """
    cdef int32_t head = 0, count = 1, q, v
    g.x[start] = 0.0
    g.queue[0] = start
    while head < count:
        v = g.queue[head]
        head += 1
        for q in range(g.ptr[v], g.ptr[v + 1]):
            if g.label[g.near[q]] == g.label[start] and g.x[g.near[q]] < 0.0:
                g.x[g.near[q]] = g.x[v] + 1.0
                g.queue[count] = g.near[q]
                count += 1
    return count


cdef inline void compute_fiedler_vector(const dissection_t* g, int32_t begin, int32_t end) noexcept nogil:
    """Iterate (1) on x over the subgraph of vertices[begin:end]."""
    cdef int32_t i, q, v, k
    cdef double degree, total, mean, s, size
    for k in range(POWER_ITERATIONS):  # no-cython-lint
        mean = total = size = 0.0
        for i in range(begin, end):
            v = g.vertices[i]
            degree = s = 0.0
            for q in range(g.ptr[v], g.ptr[v + 1]):
                if g.label[g.near[q]] == begin:
                    degree += 1.0
                    s += g.x[g.near[q]]
            mean += degree * g.x[v]
            total += degree
            g.y[v] = 0.5 * (g.x[v] + s / degree)
        mean /= total                                   # The mean of D^-1 W x is the mean of x.
        for i in range(begin, end):
            v = g.vertices[i]
            g.y[v] -= mean
            size += g.y[v] * g.y[v]
        size = 1.0 / sqrt(size) if size > 0.0 else 1.0
        for i in range(begin, end):
            g.x[g.vertices[i]] = size * g.y[g.vertices[i]]


cdef inline void split_at_median(const dissection_t* g, int32_t begin, int32_t end) noexcept nogil:
    """Set `part` to 1 above the median of x, else to 0, and in the smaller border of both to SEPARATOR."""
    cdef int32_t i, q, v, k, count
    cdef int32_t border[2]
    cdef double low = g.x[g.vertices[begin]], high = low, middle = low
    for i in range(begin, end):
        low = min(low, g.x[g.vertices[i]])
        high = max(high, g.x[g.vertices[i]])
    for k in range(50):  # no-cython-lint
        middle = 0.5 * (low + high)
        count = 0
        for i in range(begin, end):
            count += g.x[g.vertices[i]] <= middle
        if 2 * count > end - begin:
            high = middle
        else:
            low = middle
    for i in range(begin, end):
        g.part[g.vertices[i]] = g.x[g.vertices[i]] > low
    border[0] = border[1] = 0
    for i in range(begin, end):
        v = g.vertices[i]
        g.best[v] = 0
        for q in range(g.ptr[v], g.ptr[v + 1]):
            if g.label[g.near[q]] == begin and g.part[g.near[q]] != g.part[v]:
                g.best[v] = 1
        border[g.part[v]] += g.best[v]
    k = 0 if border[0] <= border[1] else 1
    for i in range(begin, end):
        v = g.vertices[i]
        if g.best[v] and g.part[v] == k:
            g.part[v] = SEPARATOR


cdef inline bint refine_separator(const dissection_t* g, int32_t begin, int32_t end) noexcept nogil:
    """Do one pass of moves; return whether the separator is smaller afterwards, or equal with halves of closer sizes."""
    cdef int32_t size[3]
    cdef int32_t i, q, v, w, k, t, count = 0, pulled, gain, chosen, half, best_gain, smallest, difference, limit, unequal
    cdef bint improved = False, is_free
    size[0] = size[1] = size[2] = 0
    for i in range(begin, end):
        v = g.vertices[i]
        g.moved[v] = 0
        g.best[v] = g.part[v]
        size[g.part[v]] += 1
        if g.part[v] == SEPARATOR:
            g.separator[count] = v
            count += 1
    limit = <int32_t>(0.58 * (end - begin))             # largest number of vertices in one half
    smallest, difference = size[2], absolute_difference(size[0], size[1])
    for k in range(2 * smallest + 20):  # no-cython-lint
        chosen, half, best_gain = -1, 0, 0
        for i in range(count):
            v = g.separator[i]
            for t in range(2):
                if size[t] + 1 > limit:
                    continue
                pulled, is_free = 0, True
                for q in range(g.ptr[v], g.ptr[v + 1]):
                    w = g.near[q]
                    if g.label[w] == begin and g.part[w] == 1 - t:
                        pulled += 1
                        is_free = is_free and not g.moved[w]
                gain = 1 - pulled
                if is_free and (chosen < 0 or gain > best_gain or (gain == best_gain and size[t] < size[half])):
                    chosen, half, best_gain = i, t, gain
        if chosen < 0:
            break
        v = g.separator[chosen]
        count -= 1
        g.separator[chosen] = g.separator[count]
        g.part[v], g.moved[v] = half, 1
        size[half] += 1
        size[2] -= 1
        for q in range(g.ptr[v], g.ptr[v + 1]):
            w = g.near[q]
            if g.label[w] == begin and g.part[w] == 1 - half:
                g.part[w] = SEPARATOR
                g.separator[count] = w
                count += 1
                size[1 - half] -= 1
                size[2] += 1
        unequal = absolute_difference(size[0], size[1])
        if max(size[0], size[1]) <= limit and (size[2] < smallest or (size[2] == smallest and unequal < difference)):
            smallest, difference, improved = size[2], unequal, True
            for i in range(begin, end):
                g.best[g.vertices[i]] = g.part[g.vertices[i]]
        if size[2] > smallest + MAX_WORSE_VERTICES:
            break
    for i in range(begin, end):
        g.part[g.vertices[i]] = g.best[g.vertices[i]]
    return improved


cdef inline bint split_subgraph(const dissection_t* g, int32_t begin, int32_t end, int32_t* middle,
                                int32_t* last) noexcept nogil:
    """Sort vertices[begin:end] to the halves [begin:middle] and [middle:last] and their separator [last:end].

    Return False if a half is empty; the vertices are then not changed.
    """
    cdef int32_t i, k, v, t, reached = 0, start = g.vertices[begin]
    cdef int32_t place[3]
    for k in range(3):                                  # Find a distant vertex.  # no-cython-lint
        for i in range(begin, end):
            g.x[g.vertices[i]] = -1.0
        reached = compute_distances(g, start)
        start = g.queue[reached - 1]
    if reached < end - begin:                           # The subgraph is not connected.
        for i in range(begin, end):
            g.part[g.vertices[i]] = g.x[g.vertices[i]] < 0.0
    else:
        compute_fiedler_vector(g, begin, end)
        split_at_median(g, begin, end)
        for k in range(MAX_REFINEMENTS):  # no-cython-lint
            if not refine_separator(g, begin, end):
                break
    place[0] = place[1] = place[2] = 0
    for i in range(begin, end):
        place[g.part[g.vertices[i]]] += 1
    if place[0] == 0 or place[1] == 0:
        return False
    middle[0] = begin + place[0]
    last[0] = middle[0] + place[1]
    place[0], place[1], place[2] = begin, middle[0], last[0]
    for i in range(begin, end):
        g.queue[i - begin] = g.vertices[i]
    for i in range(end - begin):
        v = g.queue[i]
        t = g.part[v]
        g.vertices[place[t]] = v
        g.label[v] = begin if t == 0 else (middle[0] if t == 1 else -1)
        place[t] += 1
    return True


cdef inline void order_by_dissection(int32_t n, const int32_t* ptr, const int32_t* near, const int32_t* rank, int32_t* scratch,
                                     int32_t* order) noexcept nogil:
    """Write an elimination order (n) of the vertices of a graph to `order`; rank (n) orders leaves and separators.

    near[ptr[i]:ptr[i + 1]] are the neighbours of i, without i. scratch has 12 n entries, aligned to 8 bytes.
    """
    cdef dissection_t g
    cdef int32_t i, k, begin, end, middle, last, count, top = 0
    cdef int32_t* stack
    g.ptr, g.near, g.rank, g.vertices = ptr, near, rank, order
    g.x = <double*>scratch
    g.y = g.x + n
    g.label = scratch + 4 * n
    g.part, g.best, g.moved, g.queue = g.label + n, g.label + 2 * n, g.label + 3 * n, g.label + 4 * n
    g.separator = g.label + 5 * n
    stack = g.label + 6 * n                             # 2 n: beginnings and ends of the subgraphs that remain
    for i in range(n):
        g.label[i] = 0
        g.x[i] = -1.0
    begin = 0
    for i in range(n):                                  # Begin with the connected components.
        if g.x[i] >= 0.0:
            continue
        count = compute_distances(&g, i)
        for k in range(count):
            g.vertices[begin + k] = g.queue[k]
        stack[top], stack[top + 1] = begin, begin + count
        top += 2
        begin += count
    k = 0
    while k < top:
        for i in range(stack[k], stack[k + 1]):
            g.label[g.vertices[i]] = stack[k]
        k += 2
    while top > 0:
        top -= 2
        begin, end = stack[top], stack[top + 1]
        if end - begin <= LEAF_VERTICES or not split_subgraph(&g, begin, end, &middle, &last):
            sort_by_rank(&g, begin, end)
            continue
        sort_by_rank(&g, last, end)
        stack[top], stack[top + 1], stack[top + 2], stack[top + 3] = begin, middle, middle, last
        top += 4
