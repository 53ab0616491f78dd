"""A sweep written densely, for every kind of block: it shares nothing with what it checks."""

import numpy as np

import lavender as lv


def parts_of(cones, i):
    """(rows within a contact, bound over lambda_n) of what it bounds together, behind its normal."""
    size, mu, nt = int(np.diff(cones.ptr)[i]), cones.coefficients[i].max(), int(cones.n_tangents[i])
    if cones.kind[i] == lv.CONTACT_BOX:
        return [([1], cones.coefficients[i][0]), ([2], cones.coefficients[i][1])]
    rolls = cones.kind[i] == lv.CONTACT_ROLLING
    found = [(list(range(1, 1 + nt)), mu)] if nt else []
    if cones.kind[i] == lv.CONTACT_SPIN or (rolls and size == 6):
        found.append(([1 + nt], mu * cones.patch_radius[i]))
    return [*found, ([size - 2, size - 1], cones.rolling[i])] if rolls else found


def groups_of(cones, i):
    """Rows within a block that share a diagonal entry and a speed."""
    size = int(np.diff(cones.ptr)[i])
    if cones.kind[i] == lv.ROW:
        return [[q] for q in range(size)]
    if cones.kind[i] == lv.ROUND:
        return [[0], [1, 2], *([[3], [4, 5]] if size == 6 else [[q] for q in range(3, size)])]
    return [[0], *(rows for rows, _ in parts_of(cones, i))]


def stretch(cones):
    """(m,) mu_i over the larger of the two on the tangents of ellipses, else 1: rows so long have disks for them."""
    s = np.ones(cones.n_rows)
    for i in np.flatnonzero(cones.kind == lv.CONTACT_ELLIPSE):
        s[cones.ptr[i] + 1 : cones.ptr[i + 1]] = cones.coefficients[i] / cones.coefficients[i].max()
    return s


def diagonal(a, cones, factored):
    """d: A_ii or what stands in for it, the mean where rows share it."""
    big = np.abs(a).max(axis=1, initial=0.0)
    diag = np.diag(a).copy()
    d = np.where(diag > (0.0 if factored else 1e-10 * big), diag, 0.0 if factored else big)
    positive = d[d > 0]
    d[d <= 0] = positive.mean() if len(positive) else 1.0
    for i in range(cones.n_blocks):
        for rows in groups_of(cones, i):
            d[cones.ptr[i] + np.array(rows)] = d[cones.ptr[i] + np.array(rows)].mean()
    return d


def sweep(problem, a, lam, blocks):
    """One sweep over blocks under Coulomb's law, in place."""
    c, s = problem.cones, stretch(problem.cones)
    a, b, given = s[:, None] * a * s, s * problem.b, lam
    lam, d = given / s, diagonal(a, c, problem.operator != "matrix")
    for i in blocks:
        j, end = c.ptr[i], c.ptr[i + 1]
        if c.kind[i] == lv.ROW:
            for q in range(j, end):
                lam[q] = np.clip(lam[q] - (a[q] @ lam - b[q]) / d[q], c.lower[q], c.upper[q])
            continue
        lam[j] = max(0.0, lam[j] - (a[j] @ lam - b[j]) / d[j])
        for rows, bound in parts_of(c, i):
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
