"""A sweep written densely, for every kind of block: it shares nothing with what it checks."""

import judge_twin
import numpy as np


def sweep(problem, twin, lam, blocks):
    """One sweep over blocks under Coulomb's law, in place; A, d and bounds are those of the judge's twin."""
    c, s, (a, b, d) = problem.cones, twin.stretch, (x.astype(float) for x in (twin.A, twin.b, twin.d))
    given, lam = lam, lam / s
    for i in blocks:
        j, end = c.ptr[i], c.ptr[i + 1]
        if c.kind[i] == judge_twin.ROW:
            for q in range(j, end):
                lam[q] = np.clip(lam[q] - (a[q] @ lam - b[q]) / d[q], c.lower[q], c.upper[q])
            continue
        lam[j] = max(0.0, lam[j] - (a[j] @ lam - b[j]) / d[j])
        for rows, bound in twin.parts(i):
            t = j + np.array(rows)
            block = a[np.ix_(t, t)]
            y = lam[t] - (a[t] @ lam - b[t]) / np.linalg.eigvalsh(0.5 * (block + block.T)).max()
            size = np.linalg.norm(y)
            lam[t] = y if size <= bound * lam[j] else y * (bound * lam[j] / size)
    given[:] = s * lam


def block_diagonal(system, values):
    """The small matrices of the elements of Newton's method as one block diagonal matrix."""
    sc = system.solve
    out = np.zeros((sc.m, sc.m))
    for i, q in enumerate(sc.wptr[:-1]):
        j, end = sc.ptr[i], sc.ptr[i + 1]
        out[j:end, j:end] = values[q : sc.wptr[i + 1]].reshape(end - j, end - j)
    return out
