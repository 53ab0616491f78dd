"""An elimination order by approximate minimum degree, on a quotient graph.

    pivot p:  L_p = union of the neighbours of p and of L_e for its adjacent elements e, without p                (1)
    i in L_p: d_i <= |L_p \\ i| + neighbours outside L_p + sum over other elements e adjacent to i of |L_e \\ L_p|  (2)

An eliminated vertex becomes an element. Its list L_p replaces the lists of the elements that it absorbs, so that the graph
never grows (Amestoy, Davis, Duff 1996, without their merging of vertices: vertices with one pattern are one weighted vertex
here). Vertices with very many neighbours are ordered last, and the degrees of the others do not count them.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t


cdef enum:
    VERTEX = 0
    ELEMENT = 1
    GONE = 2


cdef struct quotient_t:
    int32_t n
    int32_t free                # first unused entry of `list`
    int32_t* list               # lists of the neighbours of vertices (adjacent elements first) and of elements
    int32_t* at                 # (n) first entry of each list
    int32_t* length             # (n) length of each list
    int32_t* elements           # (n) number of elements at the beginning of a vertex's list
    int32_t* kind               # (n)
    int32_t* degree             # (n) bound (2) of a vertex's degree; for an element, the weight of its list
    int32_t* head               # (weight + 1) first vertex of each degree
    int32_t* next               # (n) next vertex of the same degree
    int32_t* before             # (n) previous vertex of the same degree, or -1
    int32_t* pivot_of           # (n) last pivot whose list contains the vertex
    int64_t* outside            # (n) weight of an element outside the pivot's list, plus `stamp`


cdef inline void remove_degree(quotient_t* g, int32_t i) noexcept nogil:
    """Remove vertex i from the list of its degree."""
    if g.next[i] >= 0:
        g.before[g.next[i]] = g.before[i]
    if g.before[i] >= 0:
        g.next[g.before[i]] = g.next[i]
    else:
        g.head[g.degree[i]] = g.next[i]


cdef inline void insert_degree(quotient_t* g, int32_t i) noexcept nogil:
    """Insert vertex i into the list of its degree."""
    cdef int32_t d = g.degree[i]
    g.before[i] = -1
    g.next[i] = g.head[d]
    if g.head[d] >= 0:
        g.before[g.head[d]] = i
    g.head[d] = i


cdef inline void compact_lists(quotient_t* g) noexcept nogil:
    """Move the lists in use to the front of `list` in their order; until a list is moved, its first entry is -1 - its owner."""
    cdef int32_t i, j, q = 0, to = 0, k
    for i in range(g.n):
        if g.kind[i] != GONE and g.length[i] > 0:
            j = g.list[g.at[i]]
            g.list[g.at[i]] = -1 - i
            g.at[i] = j                                 # j is the first entry of the list until the list is moved
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


cdef inline int32_t gather_element_neighbours(quotient_t* g, int32_t p, int32_t workspace) noexcept nogil:
    """Write the union (1) as the list of p, which becomes an element. Its weight is computed later."""
    cdef int32_t k, q, i, e, need = 0, begin
    for k in range(g.elements[p]):
        need += g.length[g.list[g.at[p] + k]]
    need += g.length[p]
    if need > g.n:
        need = g.n
    if g.free + need > workspace:
        compact_lists(g)
    begin = g.free
    for k in range(g.length[p]):
        e = g.list[g.at[p] + k]
        if k >= g.elements[p]:
            if g.kind[e] == VERTEX and g.pivot_of[e] != p:
                g.pivot_of[e] = p
                g.list[g.free] = e
                g.free += 1
            continue
        if g.kind[e] != ELEMENT:
            continue
        for q in range(g.at[e], g.at[e] + g.length[e]):
            i = g.list[q]
            if g.kind[i] == VERTEX and i != p and g.pivot_of[i] != p:
                g.pivot_of[i] = p
                g.list[g.free] = i
                g.free += 1
        g.kind[e] = GONE
    g.kind[p] = ELEMENT
    g.at[p] = begin
    g.length[p] = g.free - begin
    return g.length[p]


cdef inline int32_t initialise_quotient_graph(quotient_t* g, const int32_t* size, int32_t* integers, int32_t* last,
                                              int32_t* order) noexcept nogil:
    """Bind the integers, compute degrees, and order vertices with very many neighbours last, from order[last] on.

    Return the total weight of the other vertices.
    """
    cdef int32_t i, q, deg, total = 0, n = g.n
    cdef double many = 10.0 * sqrt(<double>n)
    g.at = integers
    g.length = integers + n + 1
    g.elements = integers + 2 * n + 1
    g.kind = integers + 3 * n + 1
    g.degree = integers + 4 * n + 1
    g.next = integers + 5 * n + 1
    g.before = integers + 6 * n + 1
    g.pivot_of = integers + 7 * n + 1
    g.free = g.at[n]
    last[0] = n
    for i in range(n):
        total += size[i]
        g.length[i] = g.at[i + 1] - g.at[i]
        g.elements[i] = 0
        g.kind[i] = VERTEX
        g.pivot_of[i] = -1
        g.outside[i] = 0
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
        insert_degree(g, i)
    return total


cdef inline void minimum_degree_order(int32_t n, const int32_t* size, int32_t workspace, int32_t* list, int32_t* integers,
                                      int64_t* outside, int32_t* head, int32_t* order) noexcept nogil:
    """Write the vertices in the order of their elimination to order (n).

    list (workspace) has the neighbours of vertex i, without itself, at list[integers[i]:integers[i + 1]]; workspace is at least
    their number plus n. size (n) > 0 are weights. integers (8 n + 1), outside (n) and head (sum of size + 1) are scratch.
    """
    cdef quotient_t g
    cdef int32_t i, j, e, p, k, q, to, first, count = 0, last, least = 0, deg, weight, total, rest, middle
    cdef int64_t stamp = 1
    g.n, g.list, g.outside, g.head = n, list, outside, head
    total = rest = initialise_quotient_graph(&g, size, integers, &last, order)
    while count < last:
        while head[least] < 0:
            least += 1
        p = head[least]
        remove_degree(&g, p)
        order[count] = p
        count += 1
        rest -= size[p]
        gather_element_neighbours(&g, p, workspace)
        first = g.at[p]
        weight = 0
        for k in range(first, first + g.length[p]):
            i = list[k]
            remove_degree(&g, i)
            weight += size[i]
            for q in range(g.at[i], g.at[i] + g.elements[i]):
                e = list[q]
                if g.kind[e] != ELEMENT:
                    continue
                if outside[e] < stamp:
                    outside[e] = stamp + g.degree[e]
                outside[e] -= size[i]
        to = first
        for k in range(first, first + g.length[p]):
            i = list[k]
            deg = 0
            j = g.at[i]
            for q in range(g.at[i], g.at[i] + g.elements[i]):
                e = list[q]
                if g.kind[e] != ELEMENT:
                    continue
                if outside[e] == stamp:
                    g.kind[e] = GONE                    # The list of e is a subset of the list of p.
                    continue
                deg += <int32_t>(outside[e] - stamp)
                list[j] = e
                j += 1
            middle = j
            for q in range(g.at[i] + g.elements[i], g.at[i] + g.length[i]):
                e = list[q]
                if g.kind[e] == VERTEX and g.pivot_of[e] != p:
                    deg += size[e]
                    list[j] = e
                    j += 1
            if deg == 0:                                # No neighbours are outside the list of p: the vertex is eliminated next.
                g.kind[i] = GONE
                order[count] = i
                count += 1
                weight -= size[i]
                rest -= size[i]
                continue
            # Insert p as the first element; the displaced entries move to the ends of the elements and of the vertices.
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
            insert_degree(&g, i)
        stamp += <int64_t>total + 1
