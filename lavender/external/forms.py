"""Three forms of a problem as a convex program (`as_qp.QP`).

Impulse form, lambda = sigma S x, S = D^-1/2 (with `unit_diagonal`, else one number for all rows):

    P = S A S,  q = -S b / sigma,  bounds of lambda;  friction  |x_t| <= a x_n,  a = mu S_n / S_t

Velocity form, from `Problem.velocity_form` (K, theta, g; y = M^1/2 times the change of velocity), S = D^-1/2:

    min 1/2 |y|^2 + 1/2 |p|^2 - (K~^T r).(y, p) + (u - l).t,   K~ = [K, theta^1/2],  w = K~ (y, p) - g

    free row                w = 0                          r = 0
    only a lower bound      w >= 0                         r = l
    both bounds             w + t >= 0, t >= 0             r = l, the multiplier does not exceed u - l
    only an upper bound     -w >= 0                        r = u
    disk and spin           w_n - a_s t >= a |w_t|,  t >= |w_s|;  a second disk likewise, t >= a_r |w_r|

with lambda = sigma S (r + T zeta), and the rows A = -T^T K~ (without the columns of t). The unknowns are the velocities
y, one p for each soft row, and t; J J^T is never formed.

Program form, of a quadratic program (`Problem.from_qp`): the user's own P, q, A, G and bounds. S is one number for all
variables and another for all rows, the geometric mean of r^-1/2, with r_i the largest entry of row i of (5) of
`problem/program.py`; sigma is the root mean square of r^-1/2 times the violation of the rows of (5) at zero. All three
are rounded to powers of PROGRAM_UNIT, so that a backend receives the user's numbers in every bit if they are near 1.
Backends equilibrate rows and columns themselves: with a second equilibration here, piqp 0.7 reported that a feasible
public program is infeasible.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_choice
from lavender.base.errors import CapabilityError
from lavender.base.lazy_import import sparse as sp
from lavender.external.as_qp import QP, FrictionComponent, IntpArray, ScaledProblem, is_singular
from lavender.problem import Problem

PROGRAM_FORMS = ("impulse", "velocity", "program", "auto")
# Backends treat larger numbers as infinite, or fail.
# [-] A row with a larger scaled |b| is assumed to stay at its bound and is removed. Active rows have a scaled b near
# 1, and a b of 10^k costs a backend k digits. If the assumption fails, the backend is called once more with all rows.
MAX_SCALED_RHS = 1e2
# [-] Value of MAX_SCALED_RHS for programs with a singular P. It is larger, because |x| often exceeds the active bounds.
MAX_SCALED_SINGULAR_RHS = 1e6
# At and above this mass ratio, the velocity form is more accurate at all sizes.
VELOCITY_FORM_MASS_RATIO = 1e3
# With more rows, only the numbers of rows and of velocities show whether A is singular.
MAX_PIVOT_ROWS = 1000
PROGRAM_UNIT = 16.0  # Power of two, larger than the differences of scale that matter to a backend.
Entries = list[tuple[int, float]]  # (column, value) of each entry of a row of a matrix.


def choose_program_form(problem: Problem, form: str, definite: bool = False) -> str:
    """Choose the form of the program: "impulse", "velocity" or "program".

    Parameters
    ----------
    problem : Problem
    form : {"impulse", "velocity", "program", "auto"}
        "auto" chooses the program form for a quadratic program (`Problem.from_qp`), and else the velocity form

        - for bodies or J and M if `definite` is set,
        - for bodies if m exceeds its number of unknowns, without those of soft rows, or if the mass ratio is at least
          VELOCITY_FORM_MASS_RATIO,
        - for J and M if A is singular.
    definite : bool
        Whether the backend needs a positive definite P.

    Raises
    ------
    InputError
        The form is unknown.
    CapabilityError
        The problem does not have this form.
    """
    form, rows = check_choice("form", form, PROGRAM_FORMS), problem.rows
    if form == "program" and problem.qp is None:
        raise CapabilityError("form='program' needs a quadratic program (Problem.from_qp)")
    if form in ("impulse", "velocity") and problem.has_singular_program:
        raise CapabilityError(f"form={form!r} needs a positive definite P; P of this program is singular")
    if form == "velocity" and problem.matrix is not None:
        raise CapabilityError(
            "form='velocity' needs a problem with bodies (Problem.from_rows, without ellipses) or J and M "
            "(Problem.from_jacobian); this one is a matrix"
        )
    if form != "auto":
        return form
    if problem.qp is not None:
        return "program"
    if rows is None:
        is_singular = problem.generalized is not None and (definite or _has_singular_delassus(problem))
        return "velocity" if is_singular else "impulse"
    moving = rows.inv_mass[rows.inv_mass > 0.0]
    ratio = moving.max() / moving.min() if len(moving) else 1.0
    n_slacks = np.count_nonzero(np.isfinite(problem.cones.lower) & np.isfinite(problem.cones.upper))
    is_smaller = problem.m > 6 * rows.n_bodies + n_slacks
    return "velocity" if definite or is_smaller or ratio >= VELOCITY_FORM_MASS_RATIO else "impulse"


def _has_singular_delassus(problem: Problem) -> bool:
    """Return whether A of a problem with J and M is singular."""
    assert problem.generalized is not None
    if np.count_nonzero(problem.compliance == 0.0) > problem.generalized.nv:
        return True
    if problem.m > MAX_PIVOT_ROWS:
        return False
    root = 1.0 / np.sqrt(problem.d)
    return is_singular(root[:, None] * problem.dense() * root)


def build_program(problem: Problem, form: str, *, fix_far_rows: bool = False, **options: Any) -> QP:
    """Build the program in the given form.

    Parameters
    ----------
    problem : Problem
    form : {"impulse", "velocity", "program"}
    fix_far_rows : bool
        Whether to remove rows that b pushes far into a bound (MAX_SCALED_RHS).
    **options
        Options of `build_impulse_form`.
    """
    threshold = MAX_SCALED_SINGULAR_RHS if problem.has_singular_program else MAX_SCALED_RHS
    scaled = ScaledProblem.from_problem(problem, threshold if fix_far_rows else np.inf)
    build: Any = {
        "impulse": _build_impulse_form,
        "velocity": _build_velocity_form,
        "program": _build_program_form,
    }
    qp: QP = build[form](scaled, **options)
    if len(qp.b) or (qp.lb is not None and qp.ub is not None and np.isfinite([qp.lb, qp.ub]).any()):
        return qp
    # Many backends need a row or a bound, and qpsolvers passes programs without them to LSQR: add 0 x <= 1.
    values, bounds = qp.recovery[:, : qp.n], sp.csr_matrix((len(qp.root), 1 + qp.n))
    recovery, row = sp.csr_matrix(sp.hstack([values, bounds])), sp.csc_matrix((1, qp.n))
    return replace(qp, A=row, b=np.ones(1), n_nonneg=1, lb=None, ub=None, recovery=recovery)


def _build_impulse_form(scaled: ScaledProblem, unit_diagonal: bool = True) -> QP:
    """Build the impulse form: min 1/2 l.A l - b.l over the bounds or friction cones of a symmetric problem.

    Parameters
    ----------
    scaled : ScaledProblem
    unit_diagonal : bool
        Whether to scale by D^-1/2. If false, all rows are scaled by one number, so that P is a multiple of A.
    """
    problem, unknown, sigma, k = scaled.problem, scaled.unknown_rows, scaled.sigma, len(scaled.unknown_rows)
    if not unit_diagonal and k:
        scaled.root[:] = np.exp(np.mean(np.log(scaled.root)))
    c, root, a = problem.cones, scaled.root, problem.csr
    p = _mirror_lower_triangle(a[unknown][:, unknown], root)
    q = -root * (problem.b - (a @ scaled.fixed if scaled.fixed.any() else 0.0))[unknown] / sigma
    lb, ub = c.lower[unknown] / (root * sigma), c.upper[unknown] / (root * sigma)
    components = scaled.list_friction_components()
    linear: list[Entries] = []
    conic: list[Entries] = []
    for n, tangents, ratios in components:
        # A pair gives s = a x_n - x_t >= 0 and s = a x_n + x_t >= 0, a disk gives s = (a x_n, x_t) in a second-order
        # cone.
        a_n = ratios[0]
        if len(tangents) == 1:
            linear += [[(n, -a_n), (tangents[0], sign)] for sign in (1.0, -1.0)]
        else:
            conic += [[(n, -a_n)], *([(t, -a_n / a_t)] for t, a_t in zip(tangents, ratios, strict=True))]
    matrix = _build_matrix(linear + conic, k).tocsc()
    r = matrix.shape[0]
    return QP(
        **vars(scaled),
        form="impulse",
        P=p,
        q=q,
        A=matrix,
        b=np.zeros(r),
        n_zero=0,
        n_nonneg=len(linear),
        soc=_list_cone_sizes(components),
        lb=None if c.is_free else lb,
        ub=None if c.is_free else ub,
        recovery=sp.csr_matrix(sp.eye_array(k, k + r + k)),
        shift=np.zeros(k),
    )


def _build_velocity_form(scaled: ScaledProblem) -> QP:
    """Build the mass-scaled velocity form of a problem with bodies or J and M."""
    problem, unknown, root, sigma = scaled.problem, scaled.unknown_rows, scaled.root, scaled.sigma
    form, c, k = problem.velocity_form(), problem.cones, len(unknown)
    # Form K~ = [K, theta^1/2].
    jac, theta = sp.csr_matrix(form.jacobian), form.theta[unknown]
    soft = np.flatnonzero(theta > 0.0)
    root_theta = sp.csr_matrix((np.sqrt(theta[soft]), (soft, np.arange(len(soft)))), shape=(k, len(soft)))
    velocity_map = sp.csr_matrix(sp.hstack([jac[unknown], root_theta]))
    ny = velocity_map.shape[1]
    g = form.rhs[unknown] / sigma
    # Classify bounded rows as free, with a lower bound, with both bounds, or with an upper bound.
    low, high = c.lower[unknown] / (root * sigma), c.upper[unknown] / (root * sigma)
    components = scaled.list_friction_components()
    is_bounded = np.ones(k, bool)
    is_bounded[[i for n, tangents, _ in components for i in (n, *tangents)]] = False
    has_low, has_high = is_bounded & np.isfinite(low), is_bounded & np.isfinite(high)
    free, upper = np.flatnonzero(is_bounded & ~has_low & ~has_high), np.flatnonzero(has_high & ~has_low)
    both = np.flatnonzero(has_low & has_high)
    shift = np.where(has_low, low, np.where(has_high, high, 0.0))
    t_of_row = dict(zip(both.tolist(), range(ny, ny + len(both)), strict=True))
    rows, n_friction = _list_velocity_rows(components, free, np.flatnonzero(has_low), upper, ny, t_of_row)
    n, r = ny + len(both) + n_friction, len(rows)
    # Form the rows A = -T^T K~, and append the columns of t.
    transposed = _build_matrix([multipliers for multipliers, _ in rows], k)
    velocities = -(transposed @ velocity_map)
    velocities.resize(r, n)
    q = np.zeros(n)
    known = np.zeros(ny)
    known[: jac.shape[1]] = jac.T @ (scaled.fixed / (form.scale * sigma))
    q[:ny] = -(velocity_map.T @ shift) - known
    q[ny : ny + len(both)] = high[both] - low[both]
    velocity_map.resize(k, n)
    is_slack = np.arange(n) >= ny
    return QP(
        **vars(scaled),
        form="velocity",
        P=sp.csc_matrix(sp.diags_array(np.where(is_slack, 0.0, 1.0))),
        q=q,
        A=sp.csc_matrix(velocities + _build_matrix([slacks for _, slacks in rows], n)),
        b=-(transposed @ g),
        n_zero=len(free),
        n_nonneg=r - len(free) - sum(_list_cone_sizes(components)),
        soc=_list_cone_sizes(components),
        lb=np.where(is_slack, 0.0, -np.inf) if n > ny else None,
        ub=np.full(n, np.inf) if n > ny else None,
        recovery=sp.csr_matrix(sp.hstack([sp.csr_matrix((k, n)), transposed.T, sp.csr_matrix((k, n))])),
        shift=shift,
        slack_map=velocity_map,
        slack_rhs=g,
    )


def _list_velocity_rows(
    components: list[FrictionComponent],
    free: IntpArray,
    lower: IntpArray,
    upper: IntpArray,
    ny: int,
    t_of_row: dict[int, int],
) -> tuple[list[tuple[Entries, Entries]], int]:
    """List the rows of the velocity form: entries of a column of T, and of the unknowns t, for each row of A.

    Parameters
    ----------
    components : list of FrictionComponent
    free, lower, upper : (k,) int
        Rows without friction that are free, have a lower bound, or have only an upper bound.
    ny : int
        Number of velocities, which the unknowns t follow.
    t_of_row : dict
        Unknown t of each row with both bounds.

    Returns
    -------
    rows, n_friction : list of (entries, entries), int
        The rows, and the number of unknowns t of friction, which follow those of `t_of_row`.
    """
    rows: list[tuple[Entries, Entries]] = [([(i, -1.0)], []) for i in free.tolist()]
    rows += [([(i, 1.0)], [(t_of_row[i], -1.0)] if i in t_of_row else []) for i in lower.tolist()]
    rows += [([(i, -1.0)], []) for i in upper.tolist()]
    first = ny + len(t_of_row)
    new, t_of_normal = itertools.count(first), dict[int, Entries]()
    # A friction component of one row has t >= |w_t|.
    for normal, tangents, ratios in components:
        if len(tangents) == 1:
            t = next(new)
            t_of_normal.setdefault(normal, []).append((t, ratios[0]))
            rows += [([(tangents[0], sign)], [(t, -1.0)]) for sign in (-1.0, 1.0)]
    # The second disk of a contact has t >= |w|.
    disks = [x for x in components if len(x[1]) > 1]
    t_of_disk: dict[int, int] = {}
    for k, (one, two) in enumerate(itertools.pairwise(disks), 1):
        if one[0] == two[0]:
            t_of_disk[k] = next(new)
            t_of_normal.setdefault(two[0], []).append((t_of_disk[k], 1.0))
    # Normals without a disk have w_n >= sum of a t; disks are second-order cones.
    has_disk = {disk[0] for disk in disks}
    rows += [([(normal, 1.0)], entries) for normal, entries in t_of_normal.items() if normal not in has_disk]
    for k, (normal, tangents, ratios) in enumerate(disks):
        is_second = k in t_of_disk
        rows.append(
            ([], [(t_of_disk[k], -1.0)]) if is_second else ([(normal, 1.0)], t_of_normal.get(normal, []))
        )
        rows += [([(tangent, ratio)], []) for tangent, ratio in zip(tangents, ratios, strict=True)]
    return rows, next(new) - first


def _build_program_form(scaled: ScaledProblem) -> QP:
    """Build the program form of a quadratic program."""
    qp, unknown = scaled.problem.qp, scaled.unknown_rows
    n, m = len(qp.q), len(qp.target)
    # With a singular P, the first impulses are the variables.
    offset = n if qp.is_singular else 0
    variables = unknown[unknown < n] if offset else np.arange(n)
    n_x, k = len(variables), len(unknown)
    n_shared = n_x if offset else 0
    rows = unknown[n_shared:] - offset
    # Scale by the largest entries of the rows of (5) and their violations at x = 0.
    sizes = np.zeros(n + m)
    for matrix, row_first in ((qp.generalized.mass, 0), (qp.generalized.jac, n)):
        row_of_entry = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
        for first, index in ((row_first, row_of_entry), (0, matrix.indices)):
            np.maximum.at(sizes, first + index, np.abs(matrix.data))
    violation = np.concatenate([np.abs(qp.q), np.maximum(qp.target, 0.0)])
    violation[n : n + qp.free] = np.abs(qp.target[: qp.free])
    parts = variables, n + rows
    roots = [1.0 / np.sqrt(sizes[part]) for part in parts]
    squares = [(root * violation[part]) ** 2 for root, part in zip(roots, parts, strict=True)]
    sigma = _round_unit(np.sqrt(np.mean(np.concatenate(squares))))
    unit, row_unit = (_round_unit(np.exp(np.mean(np.log(root)))) if len(root) else 1.0 for root in roots)
    # Classify the rows of `problem/program.py` (2): A, fixed variables, G, lower and upper bounds.
    none = np.zeros(0, np.intp)
    fixed, lower, upper = (none if at is None else at for at in (qp.fixed, qp.lower, qp.upper))
    n_a, n_g = qp.free - len(fixed), m - qp.free - len(lower) - len(upper)
    kind = np.repeat(range(5), [n_a, len(fixed), n_g, len(lower), len(upper)])[rows]
    variable = np.concatenate([np.zeros(n_a, int), fixed, np.zeros(n_g, int), lower, upper])[rows]
    index_of = np.zeros(n, int)
    index_of[variables] = np.arange(n_x)
    at, sign = index_of[variable], np.array([-1.0, -1.0, 1.0, -1.0, 1.0])[kind]
    is_general = (kind == 0) | (kind == 2)
    general = np.flatnonzero(is_general)
    r = len(general)
    root = np.where(is_general, row_unit, 1.0 / unit)
    jac, hessian = qp.generalized.jac, qp.generalized.mass
    if len(rows) < m or n_x < n:
        jac, hessian = jac[rows][:, variables], hessian[variables][:, variables]
    entries = jac.data * np.repeat(root * unit, np.diff(jac.indptr))
    jac = sp.csr_matrix((entries, jac.indices, jac.indptr), jac.shape)
    target = root * qp.target[rows] / sigma
    lb, ub = np.full(n_x, -np.inf), np.full(n_x, np.inf)
    is_lower, is_fixed, is_upper = (kind == 1) | (kind == 3), kind == 1, kind == 4
    lb[at[is_lower]] = target[is_lower]
    ub[at[is_fixed]] = target[is_fixed]
    ub[at[is_upper]] = -target[is_upper]
    # The multipliers of rows, then of bounds, in the order of the rows of the problem.
    column = np.where(is_general, np.cumsum(is_general) - 1, r + at) + n_x
    columns = np.concatenate([np.arange(n_shared), column])
    recovery = (np.concatenate([np.ones(n_shared), sign]), columns, np.arange(k + 1))
    has_bounds = r < len(rows)
    fields = vars(scaled) | {"root": np.concatenate([np.full(n_shared, unit), root]), "sigma": sigma}
    flip, matrix = -sign[general], jac[general] if has_bounds else jac.copy()
    matrix.data *= np.repeat(flip, np.diff(matrix.indptr))
    return QP(
        **fields,
        form="program",
        P=sp.csc_matrix(hessian * unit**2),
        q=qp.q[variables] * unit / sigma,
        A=sp.csc_matrix(matrix),
        b=flip * target[general],
        n_zero=int(np.count_nonzero(kind == 0)),
        n_nonneg=int(np.count_nonzero(kind == 2)),
        soc=(),
        lb=lb if has_bounds else None,
        ub=ub if has_bounds else None,
        recovery=sp.csr_matrix(recovery, (k, n_x + r + n_x)),
        shift=np.zeros(k),
        slack_map=None if offset else jac,
        slack_rhs=None if offset else target,
        variable_unit=unit,
    )


def _round_unit(x: float) -> float:
    """Round a positive number to a power of PROGRAM_UNIT; return 1 for 0."""
    return float(PROGRAM_UNIT ** np.round(np.log(x) / np.log(PROGRAM_UNIT))) if x > 0.0 else 1.0


def _list_cone_sizes(components: list[FrictionComponent]) -> tuple[int, ...]:
    """Return the size of the second-order cone of each component of several rows."""
    return tuple(1 + len(tangents) for _, tangents, _ in components if len(tangents) > 1)


def _mirror_lower_triangle(matrix: sp.csr_array, root: FloatArray) -> sp.csc_matrix:
    """Return diag(root) A diag(root) from the lower triangle of A, with both triangles equal in every bit."""
    entries = matrix.tocoo()
    is_lower = entries.row >= entries.col
    i, j = entries.row[is_lower], entries.col[is_lower]
    value, off = entries.data[is_lower] * (root[i] * root[j]), i > j
    data = np.concatenate([value, value[off]])
    return sp.csc_matrix((data, (np.concatenate([i, j[off]]), np.concatenate([j, i[off]]))), matrix.shape)


def _build_matrix(rows: list[Entries], columns: int) -> sp.csr_matrix:
    """Build a sparse matrix from the entries of its rows."""
    entries = [entry for row in rows for entry in row]
    ptr = np.cumsum([0, *map(len, rows)])
    data, index = np.array([x for _, x in entries], float), np.array([i for i, _ in entries], int)
    return sp.csr_matrix((data, index, ptr), (len(rows), columns))
