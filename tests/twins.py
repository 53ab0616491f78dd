"""The judge and a sweep written densely, for every kind of block: they share nothing with what they check."""

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


def root_of(rising, low, high):
    """Where a function that only rises passes zero, by bisection."""
    for _ in range(110):
        mid = 0.5 * (low + high)
        low, high = (low, mid) if rising(mid) > 0.0 else (mid, high)
    return 0.5 * (low + high)


def nearest(y, parts):
    """Projection on |y_g| <= a_g y_n for all parts g: the slope of the distance rises with the normal part."""
    size = np.array([np.linalg.norm(y[rows]) for rows, _ in parts])
    a = np.array([bound for _, bound in parts])
    out = y.copy()
    slope = lambda s: s - y[0] - np.sum(a * np.maximum(0.0, size - a * s))  # noqa: E731
    out[0] = root_of(slope, 0.0, np.abs(y).sum() * (1.0 + a.sum()) + 1.0) if slope(0.0) < 0.0 else 0.0
    for (rows, bound), length in zip(parts, size, strict=True):
        if length > bound * out[0]:
            out[rows] = y[rows] * (bound * out[0] / length)
    return out


def nearest_round(y, a, groups):
    """Projection on sum (|y_g| / a_g)^2 <= y_n^2 by bisection on the multiplier, in long double."""
    y, size = np.asarray(y, np.longdouble), np.array([np.linalg.norm(y[g]) for g in groups], np.longdouble)
    if np.sum((size / a) ** 2) <= y[0] ** 2 and y[0] >= 0:
        return y.astype(float)
    if y[0] + np.sqrt(np.sum((a * size) ** 2)) <= 0:
        return np.zeros(len(y))
    low = max(np.longdouble(0), np.max((y[0] + a * size) / (1 + a * a)))
    s = root_of(
        lambda s: 1 - np.sum((a * size / ((1 + a * a) * s - y[0])) ** 2), low, low + np.abs(y).sum() * 1e3 + 1
    )
    out = y.copy()
    out[0] = s
    for g, share in zip(groups, a * a * s / ((1 + a * a) * s - y[0]), strict=True):
        out[g] = y[g] * share
    return out.astype(float)


def errors(problem, lam, w, d):
    """e (m,): lambda less its projection, by the law; all in the rows where ellipses are disks."""
    c, e = problem.cones, np.zeros(problem.m)
    for i in range(c.n_blocks):
        s = slice(c.ptr[i], c.ptr[i + 1])
        x, y, root = lam[s], lam[s] - w[s] / d[s], np.sqrt(d[s])
        if c.kind[i] == lv.ROW:
            e[s] = x - np.clip(y, c.lower[s], c.upper[s])
        elif c.kind[i] == lv.ROUND:
            groups = groups_of(c, i)[1:]
            tilt = np.array([c.mu[i] * root[g[0]] / root[0] for g in groups])
            e[s] = x - nearest_round(root * y, tilt, groups) / root
        elif problem.friction == "cone":
            parts = [(rows, bound * root[rows[0]] / root[0]) for rows, bound in parts_of(c, i)]
            e[s] = x - nearest(root * y, parts) / root
        else:
            y[0] = max(0.0, y[0])
            for rows, bound in parts_of(c, i):
                most, size = bound * max(0.0, x[0]), np.linalg.norm(y[rows])
                y[rows] *= min(1.0, most / size) if size > 0.0 else 1.0
            e[s] = x - y
    return e


def angular_weight(problem):
    """1/m_a + 1/m_b on joint rows without linear entries, NaN elsewhere; of rows over bodies alone."""
    rows, out = problem.rows, np.full(problem.m, np.nan)
    if rows is not None:
        body = np.repeat(rows.joint_body, np.diff(rows.joint_ptr), axis=0)
        inv = np.append(rows.inv_mass, 0.0)  # body -1 reads the last entry
        angular = ~rows.jac[:, [0, 1, 2, 6, 7, 8]].any(axis=1)
        out[: len(body)][angular] = (inv[body[:, 0]] + inv[body[:, 1]])[angular]
    return out


def judged(problem, lam):
    """(e, E, V, the rows of which V is the speed) by the formulas."""
    c, s = problem.cones, stretch(problem.cones)
    a = s[:, None] * problem.dense() * s
    d = diagonal(a, c, problem.operator != "matrix")
    e, given = errors(problem, lam / s, a @ (lam / s) - s * problem.b, d), angular_weight(problem)
    nu = np.where(np.isnan(given), d, given)
    speeds = [(0.0, [-1])]
    for i in range(c.n_blocks):
        j, turns = c.ptr[i], c.kind[i] in (lv.CONTACT_SPIN, lv.CONTACT_ROLLING)
        for rows in groups_of(c, i):
            if turns and rows[0] > c.n_tangents[i]:  # what spins and what rolls counts as the normal
                nu[j + np.array(rows)] = d[j]
            weight = np.sqrt(nu[j + rows[0]] * d[j + rows[0]])
            speeds.append((weight * np.linalg.norm(e[j + np.array(rows)]), [j + q for q in rows]))
    return s * e, np.sqrt(np.sum(d * e * e)), *max(speeds)


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
