"""Solutions of small problems beyond float64: in long double, or in rational numbers.

The conditions that hold at a solution (free, at a bound, open, sticking, sliding) are read off a float64 solution;
their equations are solved in wider numbers and every condition is then checked. Where one is broken, conditions are
read anew off what was found. Rational numbers are exact where cones are polyhedral (rows, contacts of at most one
tangent); where a disk slides a square root stands in the equations, and they hold to 2^-EXACT_BITS of their size.
Those of a quadratic program, from its arrays as given, are measured in float64.
"""

from fractions import Fraction
from math import isqrt

import numpy as np
from judge_twin import norm, project_cone

import lavender as lv
from lavender.problem.cones import ROW

HAS_WIDE = np.finfo(np.longdouble).eps < 1e-18
ROUNDS = 6  # of reading the conditions anew
EXACT_BITS = 240


class Wide:
    """Long double: conditions to a few of its last places."""

    equal, close = 1e-17, 1e-16  # of sizes: what equations and inequalities may miss; its last place is 1e-19
    steps = 6  # of a float64 Newton step each

    number = staticmethod(np.longdouble)
    sqrt = staticmethod(np.sqrt)

    @staticmethod
    def array(x):
        return np.asarray(x).astype(np.longdouble)

    @staticmethod
    def solve(slope, f):
        return np.linalg.lstsq(slope.astype(float), f.astype(float), rcond=1e-13)[0]

    @staticmethod
    def rounded(x):
        return x


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


class Exact:
    """Fractions in object arrays."""

    equal, close = Fraction(1, 2**200), Fraction(1, 2**200)
    # of Newton, from 1e-16: one where equations are linear, four double the figures up to EXACT_BITS
    steps = 5

    @staticmethod
    def number(x):
        return Fraction(float(x)) if np.isfinite(x) else float(x)

    @staticmethod
    def array(x):
        x = np.asarray(x)
        out = np.empty(x.shape, object)
        out.flat = [Fraction(float(v)) for v in x.flat]
        return out

    @staticmethod
    def sqrt(x):
        """Down to 2^-EXACT_BITS of itself."""
        x = Fraction(x)
        if x <= 0:
            return Fraction(0)
        shift = max(0, 2 * EXACT_BITS - x.numerator.bit_length() + x.denominator.bit_length())
        shift += shift % 2
        return Fraction(isqrt((x.numerator << shift) // x.denominator), 1 << (shift // 2))

    @staticmethod
    def solve(slope, f):
        """A solution of slope x = f by elimination; entries without a pivot are 0."""
        m = len(f)
        t = [[*slope[i], f[i]] for i in range(m)]
        pivots = eliminate(t, m)
        x = np.array([Fraction(0)] * m, object)
        for r, column in reversed(list(enumerate(pivots))):
            x[column] = (t[r][-1] - sum(t[r][k] * x[k] for k in pivots[r + 1 :])) / t[r][column]
        return x

    @staticmethod
    def rounded(x):
        """To 2^-EXACT_BITS of the largest: Newton's next step needs no more, and fractions stay short."""
        size = max((abs(v) for v in x), default=Fraction(0))
        if size == 0:
            return x
        grid = Fraction(2) ** (EXACT_BITS + 30 - size.numerator.bit_length() + size.denominator.bit_length())
        return np.array([Fraction(round(v * grid)) / grid for v in x], object)


def matrix_in(problem, numbers):
    """A (m, m) and its kinetic part, or None, of the numbers as they are stored."""
    if problem.operator == "matrix":
        a = numbers.array(problem.dense())
        return (a + a.T) / numbers.number(2.0), None
    jac = numbers.array(problem.jacobian.toarray())
    if problem.generalized is not None:
        moving = jac @ inverse_times(numbers.array(problem.generalized.mass.toarray()), jac.T)
    else:
        moving = jac @ numbers.array(problem.rows.inverse_mass_matrix().toarray()) @ jac.T
    theta = numbers.array(problem.compliance)
    a = moving.copy()
    a[np.arange(problem.m), np.arange(problem.m)] += theta
    return a, moving


def inverse_times(m, x):
    """M^-1 x, M positive definite, by elimination in its own kind of numbers."""
    m, x = m.copy(), x.copy()
    for k in range(len(m)):
        for i in range(k + 1, len(m)):
            f = m[i, k] / m[k, k]
            m[i] = m[i] - f * m[k]
            x[i] = x[i] - f * x[k]
    for k in reversed(range(len(m))):
        x[k] = (x[k] - m[k, k + 1 :] @ x[k + 1 :]) / m[k, k]
    return x


def curved(problem):
    """Whether a square root stands in the conditions: two rows bounded by their norm."""
    return any(len(rows) > 1 for i in contacts(problem) for rows, _ in parts(problem.cones, i))


def contacts(problem):
    """Blocks with friction or rows that turn."""
    c = problem.cones
    return np.flatnonzero((c.kind != ROW) & (np.diff(c.ptr) > 1))


def parts(c, i, number=float):
    """(rows, most of their norm over the normal impulse) of all that a contact bounds by itself."""
    mu, first = number(c.mu[i]), c.ptr[i] + 1
    found = [(np.arange(first, first + c.n_together[i]), mu)] if c.n_together[i] else []
    if c.separate_rows[i] >= 0:  # spin, or the other side of a box
        found.append((c.separate_rows[i : i + 1], mu * number(c.patch_radius[i])))
    if c.rolling_rows[i] >= 0:
        found.append((c.rolling_rows[i] + np.arange(2), number(c.rolling[i])))
    return found


def solution_in(problem, a, b, numbers):
    """(lambda, w) of the problem with matrix a and right-hand side b; None where no conditions were found to hold."""
    plain = lv.Problem(b.astype(float), problem.cones, a.astype(float), friction=problem.friction)
    rough = lv.solve(plain, "auto", tol=1e-15)
    if not rough.residual.relative <= max(1e-12, 2 * rough.residual.roundoff_floor):
        return None
    x, d = numbers.array(rough.impulse), numbers.array(plain.d)
    modes = conditions(problem, x, a @ x - b, d, numbers)
    for _ in range(ROUNDS):
        for _ in range(numbers.steps):
            f, slope, _ = equations(problem, modes, a, x, a @ x - b, numbers)
            x = x - numbers.solve(slope, f)
            if not curved(problem) and numbers is Exact:
                break  # linear: done
            x = numbers.rounded(x)
        w = a @ x - b
        if holds(problem, modes, a, b, x, w, numbers):
            return x, w
        found = conditions(problem, x, w, d, numbers)
        if found == modes:
            return None
        modes = found
    return None


def conditions(problem, x, w, d, numbers):
    """For every row None (free) or the bound it lies on; of a contact "open" or, for each part, whether it slides."""
    c, modes = problem.cones, dict.fromkeys(range(problem.m))
    z = x - w / d
    for k, low, high in bounded(problem):
        modes[k] = low if z[k] < low else high if z[k] > high else None
    for i in contacts(problem):
        j = c.ptr[i]
        # A share of the rim decides: on it, what is left of w moves the projection's argument outwards.
        rim = x[j] * numbers.number(1 + 1e-12)
        slides = tuple(
            bool(norm(z[rows], numbers.sqrt) > reach * rim)
            for rows, reach in parts(problem.cones, i, numbers.number)
        )
        modes[j] = "open" if z[j] <= 0 and x[j] <= 0 else slides
    return modes


def bounded(problem):
    """(row, lower, upper) of every row with constant bounds."""
    c = problem.cones
    for i in range(c.n_blocks):
        if c.kind[i] == ROW:
            yield from ((k, c.lower[k], c.upper[k]) for k in range(c.ptr[i], c.ptr[i + 1]))
        elif c.ptr[i + 1] == c.ptr[i] + 1:
            yield c.ptr[i], 0.0, np.inf


def equations(problem, modes, a, x, w, numbers):
    """The conditions as f(x) = 0 (m,), their slope (m, m), and which of them are of impulses, not of slacks (m,)."""
    c = problem.cones
    f, slope, impulse = w.copy(), a.copy(), np.zeros(problem.m, bool)
    one, none = numbers.number(1.0), numbers.number(0.0)

    def given(k, value):
        f[k], slope[k], impulse[k] = x[k] - value, none, True
        slope[k, k] = one

    for k, _, _ in bounded(problem):
        if modes[k] is not None:
            given(k, numbers.number(modes[k]))
    for i in contacts(problem):
        j = c.ptr[i]
        if modes[j] == "open":
            for k in range(j, c.ptr[i + 1]):
                given(k, none)
            continue
        for (rows, reach), slides in zip(parts(problem.cones, i, numbers.number), modes[j], strict=True):
            if not slides:
                continue
            size = norm(w[rows], numbers.sqrt)
            u = w[rows] / size if size > 0 else 0 * w[rows]
            along = u @ a[rows]
            f[j] -= reach * size
            slope[j] = slope[j] - reach * along
            for k, uk in zip(rows, u, strict=True):
                given(k, -reach * x[j] * uk)
                slope[k, j] += reach * uk
                if size > 0 and len(rows) > 1:
                    slope[k] = slope[k] + reach * x[j] / size * (a[k] - uk * along)
    return f, slope, impulse


def holds(problem, modes, a, b, x, w, numbers):
    """Every condition, to shares of the size of what is summed in it."""
    c = problem.cones
    size = max(np.abs(a) @ np.abs(x) + np.abs(b), default=numbers.number(0.0))
    most = max(np.abs(x), default=numbers.number(0.0))
    slow, small = numbers.close * size, numbers.close * most
    f, _, impulse = equations(problem, modes, a, x, w, numbers)
    # A diagonal entry carries an impulse into a slack: the larger of both is what rounding leaves.
    for k in range(problem.m):
        if abs(f[k]) > numbers.equal * (most if impulse[k] else size):
            return False
    for k, low, high in bounded(problem):
        if x[k] - low < -small or x[k] - high > small:
            return False
        if low < high and ((modes[k] == low and w[k] < -slow) or (modes[k] == high and w[k] > slow)):
            return False
    for i in contacts(problem):
        j, lift = c.ptr[i], 0 * x[0]
        for rows, reach in parts(problem.cones, i, numbers.number):
            if norm(x[rows], numbers.sqrt) > reach * x[j] + small:
                return False
            lift += reach * norm(w[rows], numbers.sqrt)
        if x[j] < -small or w[j] < lift - slow:
            return False
    return True


def shift_in(problem, a, y, numbers):
    """d (y - Pi(y - w / d)) (m,), what a witness y moves targets by: the judge's projection, written apart."""
    d, c, y = numbers.array(problem.d), problem.cones, numbers.array(y)
    z = y - (a @ y - numbers.array(problem.b)) / d
    p = z.copy()
    for k, low, high in bounded(problem):
        p[k] = numbers.number(low) if z[k] < low else numbers.number(high) if z[k] > high else z[k]
    for i in contacts(problem):
        j, end = c.ptr[i], c.ptr[i + 1]
        bounds = [(rows - j, reach) for rows, reach in parts(problem.cones, i, numbers.number)]
        p[j:end] = project_cone(z[j:end], d[j:end], bounds, numbers.sqrt)
    return d * (y - p)


OF_PROGRAM = ("P", "q", "G", "h", "A", "b", "lb", "ub")


def of_program(qp, answer):
    """(primal, dual, gap) of min 1/2 x.P x + q.x, G x <= h, A x = b, lb <= x <= ub, from the arrays as given."""
    x, force = answer.x, qp["P"] @ answer.x + qp["q"]
    short, wrong, value = [0.0], [0.0], x @ force
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
    x, px, y = answer.x, qp["P"] @ answer.x, [np.zeros(0)]
    dense = {k: np.zeros((0, len(x))) if qp[k] is None else np.asarray(qp[k]) for k in ("G", "A")}
    rows = [(dense["A"], qp["b"], answer.y), (dense["G"], qp["h"], answer.z)]
    short, size, force, forces = [0.0], [1e-300], px + qp["q"], [np.abs(px).max(), np.abs(qp["q"]).max()]
    value, terms = x @ (px + qp["q"]), np.abs(x) @ (np.abs(px) + np.abs(qp["q"]))
    for (matrix, side, y), is_equation in zip(rows, (True, False), strict=True):
        if side is None:
            continue
        on = np.isfinite(side)
        along = matrix[on] @ x - side[on]
        short.extend(np.abs(along) if is_equation else along)
        size.extend(np.abs(side[on]))
        size.extend(np.abs(matrix[on] @ x))
        pull = matrix.T @ y
        force, value = force + pull, value + side[on] @ y[on]
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
    return max(short) / max(size), np.abs(force).max() / max(*forces, tiny), gap, objective / max(terms, tiny)
