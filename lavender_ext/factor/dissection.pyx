"""Nested dissection of a graph by the levels of a breadth-first search: the separators are eliminated last.

    part -> (A, B, S):  S those of a middle level that touch the next, A what comes before, B what comes after     (1)

A level separates what comes before it from what comes after (George, Liu 1981, chapter 8). On grids of bodies the fill grows
more slowly than by least degree, and separators make wide panels. The order depends on the graph alone.
"""
from libc.stdint cimport int32_t

import numpy as np


cdef struct search_t:
    const int32_t* ptr          # (n + 1) neighbours of each vertex
    const int32_t* near
    int32_t* part               # (n) number of the part that a vertex is in
    int32_t* level              # (n) of the last search
    int32_t* queue              # (n)


cdef int32_t levels(const search_t* g, int32_t start, int32_t part, int32_t mark, int32_t* reached) noexcept nogil:
    """Levels of a search from `start` within its part, whose vertices it renames to `mark`; how many there are."""
    cdef int32_t head = 0, tail = 1, v, w, q
    g.queue[0] = start
    g.level[start] = 0
    g.part[start] = mark
    while head < tail:
        v = g.queue[head]
        head += 1
        for q in range(g.ptr[v], g.ptr[v + 1]):
            w = g.near[q]
            if g.part[w] == part:
                g.part[w] = mark
                g.level[w] = g.level[v] + 1
                g.queue[tail] = w
                tail += 1
    reached[0] = tail
    return g.level[g.queue[tail - 1]] + 1


cdef public void lav_dissection(int32_t n, const int32_t* ptr, const int32_t* near, int32_t leaf, int32_t* part,
                                int32_t* level, int32_t* queue, int32_t* stack, int32_t* order) noexcept nogil:
    """order (n): the vertex eliminated first, second, ...; part, level, queue (n), stack (2 n + 2) are scratch.

    Parts of at most `leaf` vertices stay in the order of a search.
    """
    cdef search_t g
    cdef int32_t i, q, v, top = 1, begin, end, count, reached, deep, cut, size, best, before, a, b, s, number = 1
    cdef bint touches
    g.ptr, g.near, g.part, g.level, g.queue = ptr, near, part, level, queue
    for i in range(n):
        order[i] = i
        part[i] = 0
    stack[0] = 0
    stack[1] = n
    while top > 0:
        top -= 1
        begin = stack[2 * top]
        end = stack[2 * top + 1]
        count = end - begin
        if count <= 1:
            continue
        # From the end of a first search: a long way from one side to the other.
        levels(&g, order[begin], part[order[begin]], number, &reached)
        deep = levels(&g, queue[reached - 1], number, number + 1, &reached)
        number += 2
        if reached < count:                             # not connected: what was reached, then the rest
            b = begin + reached
            for i in range(begin, end):
                v = order[i]
                if part[v] != number - 1:
                    level[b - begin] = v                # scratch: levels are not needed any more
                    b += 1
            for i in range(reached):
                order[begin + i] = queue[i]
            for i in range(begin + reached, end):
                order[i] = level[i - begin]
            stack[2 * top] = begin
            stack[2 * top + 1] = begin + reached
            stack[2 * top + 2] = begin + reached
            stack[2 * top + 3] = end
            top += 2
            continue
        if count <= leaf or deep < 3:
            for i in range(count):
                order[begin + i] = queue[i]
            continue
        # (1): the smallest level that leaves a third or more on either side, else the middle one.
        cut = level[queue[count // 2]]
        cut = 1 if cut == 0 else deep - 2 if cut == deep - 1 else cut
        best = count
        i = before = 0
        while i < count:
            size = 0
            s = level[queue[i]]
            while i < count and level[queue[i]] == s:
                size += 1
                i += 1
            if 0 < s < deep - 1 and 3 * before >= count and 3 * (count - before - size) >= count and size < best:
                best = size
                cut = s
            before += size
        a = begin
        s = end
        for i in range(count):
            v = queue[i]
            if level[v] > cut:
                continue
            touches = False
            if level[v] == cut:
                for q in range(ptr[v], ptr[v + 1]):
                    if part[near[q]] == number - 1 and level[near[q]] == cut + 1:
                        touches = True
                        break
            if touches:
                s -= 1
                order[s] = v
            else:
                order[a] = v
                a += 1
        b = a
        for i in range(count):
            v = queue[i]
            if level[v] > cut:
                order[b] = v
                b += 1
        for i in range(s, end):
            part[order[i]] = -1
        for i in range(a, s):
            part[order[i]] = number
        number += 1
        stack[2 * top] = begin
        stack[2 * top + 1] = a
        stack[2 * top + 2] = a
        stack[2 * top + 3] = s
        top += 2


def dissection(const int32_t[::1] ptr, const int32_t[::1] near, int leaf):
    """(n,) vertices in their order of elimination; near[ptr[i]:ptr[i + 1]] are the neighbours of i, without i."""
    cdef int32_t n = <int32_t>ptr.shape[0] - 1
    out = np.empty(n, np.int32)
    cdef int32_t[::1] order = out, part = np.empty(n + 1, np.int32), level = np.empty(n + 1, np.int32)
    cdef int32_t[::1] queue = np.empty(n + 1, np.int32), stack = np.empty(2 * n + 4, np.int32)
    cdef const int32_t* entries = &near[0] if near.shape[0] else NULL
    if n:
        with nogil:
            lav_dissection(n, &ptr[0], entries, leaf, &part[0], &level[0], &queue[0], &stack[0], &order[0])
    return out
