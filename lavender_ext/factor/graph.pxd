"""An elimination order of bodies, and the pattern of the matrix over them in that order.

The order is the minimum degree of the graph in which bodies with a block in common are neighbours (Tinney, Walker 1967):
eliminate a body of least degree, join its neighbours, repeat. Neighbours are bits, so joining is one pass over n / 64
words.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t


cdef inline int32_t count_bits(uint64_t x) noexcept nogil:
    x = x - ((x >> 1) & <uint64_t>0x5555555555555555)
    x = (x & <uint64_t>0x3333333333333333) + ((x >> 2) & <uint64_t>0x3333333333333333)
    x = (x + (x >> 4)) & <uint64_t>0x0F0F0F0F0F0F0F0F
    return <int32_t>((x * <uint64_t>0x0101010101010101) >> 56)


cdef inline int32_t lowest_bit(uint64_t x) noexcept nogil:
    return count_bits((x & (~x + 1)) - 1)


cdef inline void body_order(int32_t k, const int32_t* body, int32_t n, int32_t words, uint64_t* near, uint64_t* given,
                            int32_t* degree, int32_t* rank) noexcept nogil:
    """rank (n): place of each body in the elimination; near, given (n, words) hold neighbours, scratch and kept."""
    cdef int32_t i, j, p, w, q, step, best
    cdef uint64_t bits
    cdef int64_t row, other
    for row in range(<int64_t>n * words):
        near[row] = 0
    for i in range(k):
        p = body[2 * i]
        q = body[2 * i + 1]
        if p >= 0 and q >= 0:
            near[<int64_t>p * words + (q >> 6)] |= <uint64_t>1 << (q & 63)
            near[<int64_t>q * words + (p >> 6)] |= <uint64_t>1 << (p & 63)
    for i in range(n):
        rank[i] = -1
        degree[i] = 0
        for w in range(words):
            bits = near[<int64_t>i * words + w]
            given[<int64_t>i * words + w] = bits
            degree[i] += count_bits(bits)
    for step in range(n):
        p = -1
        best = n + 1
        for i in range(n):
            if rank[i] < 0 and degree[i] < best:
                best = degree[i]
                p = i
        rank[p] = step
        row = <int64_t>p * words
        for w in range(words):
            bits = near[row + w]
            while bits != 0:
                i = 64 * w + lowest_bit(bits)
                bits = bits & (bits - 1)
                other = <int64_t>i * words
                degree[i] = 0
                for j in range(words):
                    near[other + j] |= near[row + j]
                near[other + (i >> 6)] &= ~(<uint64_t>1 << (i & 63))
                near[other + (p >> 6)] &= ~(<uint64_t>1 << (p & 63))
                for j in range(words):
                    degree[i] += count_bits(near[other + j])


cdef inline void lower_pattern(int32_t k, const int32_t* body, int32_t n, int32_t words, const uint64_t* given,
                               const int32_t* rank, int32_t* at, int32_t* nptr, int32_t* nind, int32_t* node, int32_t* slot,
                               int32_t* turned) noexcept nogil:
    """Lower block rows in elimination order, and of each block its two places (larger first) and three slots."""
    cdef int32_t i, j, r, w, q, top, a, b
    cdef uint64_t bits
    for i in range(n):
        at[rank[i]] = i
    q = 0
    for r in range(n):
        nptr[r] = q
        for w in range(words):
            bits = given[<int64_t>at[r] * words + w]
            while bits != 0:
                j = rank[64 * w + lowest_bit(bits)]
                bits = bits & (bits - 1)
                if j < r:
                    top = q
                    while top > nptr[r] and nind[top - 1] > j:
                        nind[top] = nind[top - 1]
                        top -= 1
                    nind[top] = j
                    q += 1
        nind[q] = r
        q += 1
    nptr[n] = q
    for i in range(k):
        a = rank[body[2 * i]] if body[2 * i] >= 0 else -1
        b = rank[body[2 * i + 1]] if body[2 * i + 1] >= 0 else -1
        turned[i] = a < b
        if a < b:
            r = a
            a = b
            b = r
        node[2 * i] = a
        node[2 * i + 1] = b
        slot[3 * i] = slot[3 * i + 1] = slot[3 * i + 2] = 0
        if a < 0:
            continue
        slot[3 * i] = nptr[a + 1] - 1
        if b >= 0:
            slot[3 * i + 1] = nptr[b + 1] - 1
            for q in range(nptr[a], nptr[a + 1]):
                if nind[q] == b:
                    slot[3 * i + 2] = q
