"""Parts of the conditions that hold at a solution, and residuals of quadratic programs from their arrays as given."""

import numpy as np


def eliminate(t, columns):
    """Row echelon form of lists of fractions, in place; the columns that have a pivot."""
    pivots = []
    for column in range(columns):
        row = len(pivots)
        best = max(range(row, len(t)), key=lambda i: abs(t[i][column]), default=None)
        if best is None or t[best][column] == 0:
            continue
        t[row], t[best] = t[best], t[row]
        lead = t[row]
        for i in range(row + 1, len(t)):
            if t[i][column] != 0:
                factor = t[i][column] / lead[column]
                t[i] = [p if q == 0 else p - factor * q for p, q in zip(t[i], lead, strict=True)]
        pivots.append(column)
    return pivots


def parts(c, i, number=float):
    """(rows, most of their norm over the normal impulse) of all that a contact bounds by itself."""
    mu = number(c.mu[i])
    first = c.ptr[i] + 1
    found = [(np.arange(first, first + c.n_together[i]), mu)] if c.n_together[i] else []
    if c.separate_rows[i] >= 0:  # spin, or the other side of a box
        found.append((c.separate_rows[i : i + 1], mu * number(c.patch_radius[i])))
    if c.rolling_rows[i] >= 0:
        found.append((c.rolling_rows[i] + np.arange(2), number(c.rolling[i])))
    return found


OF_PROGRAM = ("P", "q", "G", "h", "A", "b", "lb", "ub")


def of_program(qp, answer):
    """(primal, dual, gap) of min 1/2 x.P x + q.x, G x <= h, A x = b, lb <= x <= ub, from the arrays as given."""
    x = answer.x
    force = qp["P"] @ answer.x + qp["q"]
    short = [0.0]
    wrong = [0.0]
    value = x @ force
    if qp["A"] is not None:
        force = force + qp["A"].T @ answer.y
        short.append(np.abs(qp["A"] @ x - qp["b"]).max(initial=0.0))
        value += qp["b"] @ answer.y
    if qp["G"] is not None:
        force = force + qp["G"].T @ answer.z
        short.append((qp["G"] @ x - qp["h"]).max(initial=0.0))
        wrong.append(-answer.z.min(initial=0.0))
        finite = qp["h"] < np.inf
        wrong.append(np.abs(answer.z[~finite]).max(initial=0.0))
        value += qp["h"][finite] @ answer.z[finite]
    for bound, sign in (("ub", 1.0), ("lb", -1.0)):
        if qp[bound] is not None:
            short.append((sign * (x - qp[bound])).max())
            push = np.maximum(sign * answer.z_box, 0.0)
            finite = np.isfinite(qp[bound])
            wrong.append(push[~finite].max(initial=0.0))
            value += sign * qp[bound][finite] @ push[finite]
    if answer.z_box is not None:
        force = force + answer.z_box
    return max(short), max(*wrong, np.abs(force).max()), abs(value)


def relative_of_program(qp, answer):
    """(primal, dual, gap) as OSQP and Clarabel have them: over the largest of their terms, the gap over |objective|.

    And |objective| over the sum of its terms' sizes, which says how far they cancel.
    """
    x = answer.x
    px = qp["P"] @ answer.x
    y = [np.zeros(0)]
    dense = {k: np.zeros((0, len(x))) if qp[k] is None else np.asarray(qp[k]) for k in ("G", "A")}
    rows = [(dense["A"], qp["b"], answer.y), (dense["G"], qp["h"], answer.z)]
    short = [0.0]
    size = [1e-300]
    force = px + qp["q"]
    forces = [np.abs(px).max(), np.abs(qp["q"]).max()]
    value = x @ (px + qp["q"])
    terms = np.abs(x) @ (np.abs(px) + np.abs(qp["q"]))
    for (matrix, side, y), is_equation in zip(rows, (True, False), strict=True):
        if side is None:
            continue
        on = np.isfinite(side)
        along = matrix[on] @ x - side[on]
        short.extend(np.abs(along) if is_equation else along)
        size.extend(np.abs(side[on]))
        size.extend(np.abs(matrix[on] @ x))
        pull = matrix.T @ y
        force = force + pull
        value = value + side[on] @ y[on]
        terms += np.abs(side[on]) @ np.abs(y[on])
        forces.append(np.abs(pull).max())
    if answer.z_box is not None:
        force = force + answer.z_box
        forces.append(np.abs(answer.z_box).max())
        size.append(np.abs(x).max())
        for bound, sign in (("ub", 1.0), ("lb", -1.0)):
            if qp[bound] is not None:
                on = np.isfinite(qp[bound])
                push = np.maximum(sign * answer.z_box[on], 0.0)
                short.extend(sign * (x[on] - qp[bound][on]))
                value += sign * qp[bound][on] @ push
                terms += np.abs(qp[bound][on]) @ push
    objective = abs(0.5 * x @ px + qp["q"] @ x)
    tiny = 1e-300
    gap = abs(value) / max(objective, tiny) if value else 0.0
    return (
        max(short) / max(size),
        np.abs(force).max() / max(*forces, tiny),
        gap,
        objective / max(terms, tiny),
    )
