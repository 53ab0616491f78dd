"""Assignment of the impulses of one step to the blocks of the next one by their keys, with a hash table."""
from libc.stdint cimport int32_t, int64_t, uint64_t
from libc.stdlib cimport free, malloc
from libc.string cimport memcpy, memset

from lavender_ext.core.blocks cimport Blocks
from lavender_ext.core.start cimport clip_zero_to_row_bounds


cdef enum:
    MIN_TABLE_SIZE = 16             # entries of the smallest hash table of keys


cdef inline int64_t find_table_entry(const int32_t* table, int64_t mask, const uint64_t* keys, uint64_t key) noexcept nogil:
    """Return the entry of the table (open addressing, linear probing) that holds the index of this key, or its empty entry."""
    cdef int64_t entry = <int64_t>((key * <uint64_t>0x9E3779B97F4A7C15) >> 32) & mask      # Fibonacci hashing
    while table[entry] >= 0 and keys[table[entry]] != key:
        entry = (entry + 1) & mask
    return entry


cdef bint index_keys(int32_t* table, int64_t mask, const uint64_t* keys, int32_t n) noexcept nogil:
    """Store the index of each key in an empty table, the last index of a repeated one; return whether a key is repeated."""
    cdef int32_t i
    cdef int64_t entry
    cdef bint repeated = False
    memset(table, 0xFF, (mask + 1) * sizeof(int32_t))
    for i in range(n):
        entry = find_table_entry(table, mask, keys, keys[i])
        repeated |= table[entry] >= 0
        table[entry] = i
    return repeated


def carry_impulses_by_key(Blocks old, const uint64_t[::1] old_keys, const double[::1] impulse, Blocks new,
                          const uint64_t[::1] new_keys, double[::1] start):
    """Copy impulses [N s] of old blocks into `start` at new blocks with the same key, kind and number of rows.

    Returns
    -------
    tuple of bool
        Whether a key is repeated among the new keys, and among the old ones, of which the last one is then used.
    """
    cdef int32_t i, j, n = new.at.n_blocks, n_old = old.at.n_blocks, size
    cdef int64_t mask = MIN_TABLE_SIZE - 1
    cdef bint new_repeated, old_repeated
    cdef int32_t* table
    if new_keys.shape[0] != n or old_keys.shape[0] != n_old or impulse.shape[0] != old.at.n_rows or start.shape[0] != new.at.n_rows:
        raise ValueError("a key for each block and an impulse for each row are needed")
    cdef const uint64_t* key = &new_keys[0] if n else NULL
    cdef const uint64_t* old_key = &old_keys[0] if n_old else NULL
    while mask < 2 * <int64_t>max(n, n_old):            # at most half of the entries are used
        mask = 2 * mask + 1
    table = <int32_t*>malloc((mask + 1) * sizeof(int32_t))
    if table == NULL:
        raise MemoryError(f"{mask + 1} entries of a table of keys")
    with nogil:
        new_repeated = index_keys(table, mask, key, n)
        old_repeated = index_keys(table, mask, old_key, n_old)
        for i in range(n):
            j = table[find_table_entry(table, mask, old_key, key[i])]
            size = new.at.ptr[i + 1] - new.at.ptr[i]
            if j >= 0 and old.at.kind[j] == new.at.kind[i] and old.at.ptr[j + 1] - old.at.ptr[j] == size:
                memcpy(&start[new.at.ptr[i]], &impulse[old.at.ptr[j]], size * sizeof(double))
        free(table)
    return bool(new_repeated), bool(old_repeated)


def carry_impulses_of_worlds(Blocks old, const int64_t[:, ::1] old_at, const uint64_t[::1] old_keys, const double[::1] impulse,
                             Blocks new, const int64_t[:, ::1] new_at, const uint64_t[::1] new_keys, double[::1] start):
    """Write the start of each world: the impulses [N s] of its blocks with the same key, kind and number of rows, else Pi(0).

    The columns of old_at and new_at (n, 5) are the first block of a world in `old` and `new`, its number of blocks, its first
    row in them, its first row in the impulses, and its first key.

    Returns
    -------
    tuple
        The first world that repeats a key, else -1, and whether the previous step repeats it.
    """
    cdef int64_t w, n_worlds = new_at.shape[0], size = MIN_TABLE_SIZE, mask, bad = -1
    cdef int32_t i, j, k, n, n_old, rows, first, from_
    cdef bint is_old = False
    cdef int32_t* table
    cdef const uint64_t* key
    cdef const uint64_t* old_key
    if old_at.shape[0] != n_worlds or old_at.shape[1] != 5 or new_at.shape[1] != 5:
        raise ValueError("the places of as many worlds before and now are needed")
    for w in range(n_worlds):
        if old_at[w, 4] + old_at[w, 1] > old_keys.shape[0] or new_at[w, 4] + new_at[w, 1] > new_keys.shape[0]:
            raise ValueError("a key for each block is needed")
        while size < 2 * max(old_at[w, 1], new_at[w, 1]) + 2:
            size *= 2
    table = <int32_t*>malloc(size * sizeof(int32_t))
    if table == NULL:
        raise MemoryError(f"{size} entries of a table of keys")
    with nogil:
        for w in range(n_worlds):
            n, n_old = <int32_t>new_at[w, 1], <int32_t>old_at[w, 1]
            key = &new_keys[new_at[w, 4]] if n else NULL
            old_key = &old_keys[old_at[w, 4]] if n_old else NULL
            mask = MIN_TABLE_SIZE - 1
            while mask < 2 * <int64_t>max(n, n_old):
                mask = 2 * mask + 1
            if index_keys(table, mask, key, n):
                bad = w
                break
            if index_keys(table, mask, old_key, n_old):
                bad, is_old = w, True
                break
            for i in range(n):
                k = <int32_t>new_at[w, 0] + i
                first, rows = new.at.ptr[k], new.at.ptr[k + 1] - new.at.ptr[k]
                for j in range(first, first + rows):
                    start[new_at[w, 3] + j - new_at[w, 2]] = clip_zero_to_row_bounds(&new.at, j)
                j = table[find_table_entry(table, mask, old_key, key[i])]
                if j < 0:
                    continue
                j += <int32_t>old_at[w, 0]
                from_ = old.at.ptr[j]
                if old.at.kind[j] == new.at.kind[k] and old.at.ptr[j + 1] - from_ == rows:
                    memcpy(&start[new_at[w, 3] + first - new_at[w, 2]], &impulse[old_at[w, 3] + from_ - old_at[w, 2]],
                           rows * sizeof(double))
        free(table)
    return bad, bool(is_old)
