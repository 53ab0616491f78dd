"""An order of elimination by approximate minimum degree, on a quotient graph.

    pivot p:  L_p = union of the neighbours of p and of L_e for the elements e beside it, without p        (1)
    i in L_p: d_i <= |L_p \\ i| + neighbours outside L_p + sum over other elements e beside i of |L_e \\ L_p|  (2)

An eliminated vertex stands on as an element, whose list L_p takes the place of those of the elements it came from, so
that the graph never grows (Amestoy, Davis, Duff 1996, without their merging of vertices: those with one pattern are one
vertex of a weight here). Vertices with very many neighbours come last, unseen by the others.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t


cdef enum:
    VERTEX = 0
    ELEMENT = 1
    GONE = 2


cdef struct quotient_t:
    int32_t n
    int32_t free                # end of what `list` holds
    int32_t* list               # lists of vertices (elements first) and of elements
    int32_t* at                 # (n) where a list begins
    int32_t* length             # (n)
    int32_t* elements           # (n) how many of a vertex's list are elements
    int32_t* kind               # (n)
    int32_t* degree             # (n) a vertex's bound (2); the weight of an element's list
    int32_t* head               # (weight + 1) vertices of a degree,
    int32_t* next               # (n) the next one of the same,
    int32_t* before             # (n) and the one before, -1
    int32_t* seen               # (n) the pivot whose list a vertex is in
    int64_t* left               # (n) weight of an element outside the list, above `stamp`


cdef inline void unlink(quotient_t* g, int32_t i) noexcept nogil:
    if g.next[i] >= 0:
        g.before[g.next[i]] = g.before[i]
    if g.before[i] >= 0:
        g.next[g.before[i]] = g.next[i]
    else:
        g.head[g.degree[i]] = g.next[i]


cdef inline void link(quotient_t* g, int32_t i) noexcept nogil:
    cdef int32_t d = g.degree[i]
    g.before[i] = -1
    g.next[i] = g.head[d]
    if g.head[d] >= 0:
        g.before[g.head[d]] = i
    g.head[d] = i


cdef inline void compact(quotient_t* g) noexcept nogil:
    # Live lists to the front, in the order in which they stand: each is known by its first entry, -1 - its owner.
    cdef int32_t i, j, q = 0, to = 0, k
    for i in range(g.n):
        if g.kind[i] != GONE and g.length[i] > 0:
            j = g.list[g.at[i]]
            g.list[g.at[i]] = -1 - i
            g.at[i] = j                                 # its first entry, meanwhile
    while q < g.free:
        if g.list[q] >= 0:
            q += 1
            continue
        i = -1 - g.list[q]
        g.list[to] = g.at[i]
        g.at[i] = to
        for k in range(1, g.length[i]):
            g.list[to + k] = g.list[q + k]
        to += g.length[i]
        q += g.length[i]
    g.free = to


cdef inline int32_t gather(quotient_t* g, int32_t p, int32_t workspace) noexcept nogil:
    """(1) as the list of p, which is an element from now on; its weight is not known yet."""
    cdef int32_t k, q, i, e, need = 0, begin
    for k in range(g.elements[p]):
        need += g.length[g.list[g.at[p] + k]]
    need += g.length[p]
    if need > g.n:
        need = g.n
    if g.free + need > workspace:
        compact(g)
    begin = g.free
    for k in range(g.length[p]):
        e = g.list[g.at[p] + k]
        if k >= g.elements[p]:
            if g.kind[e] == VERTEX and g.seen[e] != p:
                g.seen[e] = p
                g.list[g.free] = e
                g.free += 1
            continue
        if g.kind[e] != ELEMENT:
            continue
        for q in range(g.at[e], g.at[e] + g.length[e]):
            i = g.list[q]
            if g.kind[i] == VERTEX and i != p and g.seen[i] != p:
                g.seen[i] = p
                g.list[g.free] = i
                g.free += 1
        g.kind[e] = GONE
    g.kind[p] = ELEMENT
    g.at[p] = begin
    g.length[p] = g.free - begin
    return g.length[p]


cdef inline int32_t begin_graph(quotient_t* g, const int32_t* size, int32_t* whole, int32_t* last, int32_t* order) noexcept nogil:
    """Degrees of all vertices but those of very many neighbours, from order[last] on; the weight of the others."""
    cdef int32_t i, q, deg, total = 0, n = g.n
    cdef double many = 10.0 * sqrt(<double>n)
    g.at = whole
    g.length = whole + n + 1
    g.elements = whole + 2 * n + 1
    g.kind = whole + 3 * n + 1
    g.degree = whole + 4 * n + 1
    g.next = whole + 5 * n + 1
    g.before = whole + 6 * n + 1
    g.seen = whole + 7 * n + 1
    g.free = g.at[n]
    last[0] = n
    for i in range(n):
        total += size[i]
        g.length[i] = g.at[i + 1] - g.at[i]
        g.elements[i] = 0
        g.kind[i] = VERTEX
        g.seen[i] = -1
        g.left[i] = 0
    for i in range(total + 1):
        g.head[i] = -1
    for i in range(n - 1, -1, -1):
        if g.length[i] > many and g.length[i] > 16:
            last[0] -= 1
            order[last[0]] = i
            total -= size[i]
            g.kind[i] = GONE
    for i in range(n - 1, -1, -1):
        if g.kind[i] != VERTEX:
            continue
        deg = 0
        for q in range(g.at[i], g.at[i] + g.length[i]):
            if g.kind[g.list[q]] == VERTEX:
                deg += size[g.list[q]]
        g.degree[i] = deg
        link(g, i)
    return total


cdef inline void degree_order(int32_t n, const int32_t* size, int32_t workspace, int32_t* list, int32_t* whole, int64_t* left,
                              int32_t* head, int32_t* order) noexcept nogil:
    """order (n): the vertex eliminated first, second, ...

    list (workspace): the neighbours of each, without itself, at list[whole[i]:whole[i + 1]]; workspace is their number and n or
    more. size (n) > 0 is the weight of each. whole (8 n + 1), left (n), head (sum of size + 1) are scratch.
    """
    cdef quotient_t g
    cdef int32_t i, j, e, p, k, q, to, first, count = 0, last, least = 0, deg, weight, total, rest, middle
    cdef int64_t stamp = 1
    g.n, g.list, g.left, g.head = n, list, left, head
    total = rest = begin_graph(&g, size, whole, &last, order)
    while count < last:
        while head[least] < 0:
            least += 1
        p = head[least]
        unlink(&g, p)
        order[count] = p
        count += 1
        rest -= size[p]
        gather(&g, p, workspace)
        first = g.at[p]
        weight = 0
        for k in range(first, first + g.length[p]):
            i = list[k]
            unlink(&g, i)
            weight += size[i]
            for q in range(g.at[i], g.at[i] + g.elements[i]):
                e = list[q]
                if g.kind[e] != ELEMENT:
                    continue
                if left[e] < stamp:
                    left[e] = stamp + g.degree[e]
                left[e] -= size[i]
        to = first
        for k in range(first, first + g.length[p]):
            i = list[k]
            deg = 0
            j = g.at[i]
            for q in range(g.at[i], g.at[i] + g.elements[i]):
                e = list[q]
                if g.kind[e] != ELEMENT:
                    continue
                if left[e] == stamp:
                    g.kind[e] = GONE                    # all of it is in the list of p
                    continue
                deg += <int32_t>(left[e] - stamp)
                list[j] = e
                j += 1
            middle = j
            for q in range(g.at[i] + g.elements[i], g.at[i] + g.length[i]):
                e = list[q]
                if g.kind[e] == VERTEX and g.seen[e] != p:
                    deg += size[e]
                    list[j] = e
                    j += 1
            if deg == 0:                                # nothing but p's list beside it: it comes right after p
                g.kind[i] = GONE
                order[count] = i
                count += 1
                weight -= size[i]
                rest -= size[i]
                continue
            # p first; what stood in its places goes to the ends of the elements and of the vertices.
            list[j] = list[middle]
            list[middle] = list[g.at[i]]
            list[g.at[i]] = p
            g.elements[i] = middle - g.at[i] + 1
            g.length[i] = j - g.at[i] + 1
            if deg < g.degree[i]:
                g.degree[i] = deg
            list[to] = i
            to += 1
        g.length[p] = to - first
        g.free = to
        g.degree[p] = weight
        if to == first:
            g.kind[p] = GONE
        for k in range(first, to):
            i = list[k]
            deg = g.degree[i] + weight - size[i]
            if deg > rest - size[i]:
                deg = rest - size[i]
            g.degree[i] = deg
            if deg < least:
                least = deg
            link(&g, i)
        stamp += <int64_t>total + 1
