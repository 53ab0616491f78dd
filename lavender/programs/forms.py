"""Forms of a problem as a convex program (`convex.ConvexProgram`), and the impulses of its answers.

Impulse form, with the impulses of the unknown rows as variables:

    P = A,  q = -b,  bounds of lambda;  friction  |x_t| <= mu x_n

Velocity form, from `Problem.velocity_form` (K, theta, g; y = M^1/2 times the change of velocity), S = D^-1/2:

    min 1/2 |y|^2 + 1/2 |p|^2 - (K~^T r).(y, p) + (u - l).t,   K~ = [K, theta^1/2],  w = K~ (y, p) - g

    free row                w = 0                          r = 0
    only a lower bound      w >= 0                         r = l
    both bounds             w + t >= 0, t >= 0             r = l, the multiplier does not exceed u - l
    only an upper bound     -w >= 0                        r = u
    disk and spin           w_n - a_s t >= a |w_t|,  t >= |w_s|;  a second disk likewise, t >= a_r |w_r|

with lambda = S (r + T zeta) and the multipliers zeta of the rows. The unknowns are the velocities y, one p for each
soft row, and t; J J^T is never formed.

Program form, of a quadratic program (`Problem.from_qp`): P, q and the rows of the program itself.

Rows with a known impulse are removed: lower = upper, friction with mu = 0, rows of A that are zero.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_choice
from lavender.base.errors import CapabilityError
from lavender.base.lazy_import import sparse as sp
from lavender.problem import Problem
from lavender.problem.program import IntpArray, QuadraticProgram
from lavender.programs.convex import ConvexProgram

PROGRAM_FORMS = ("impulse", "velocity", "program", "auto")
# At and above this mass ratio, the velocity form is more accurate at all sizes.
VELOCITY_FORM_MASS_RATIO = 1e3
# With more rows, only the numbers of rows and of velocities show whether A is singular.
MAX_PIVOT_ROWS = 1000
# [-] A counts as singular if a squared pivot of its Cholesky factor is at most this multiple of the diagonal.
MAX_SINGULAR_DELASSUS_PIVOT = 1e-10
Entries = list[tuple[int, float]]  # (column, value) of each entry of a row of a matrix.
#: A friction component in scaled unknowns, |x_t / a_t| <= x_n: the row of x_n, the rows of x_t, and a_t of each.
FrictionComponent = tuple[int, tuple[int, ...], tuple[float, ...]]


@dataclass(frozen=True, eq=False)
class Form:
    """A problem as a convex program, and the conversion of its answers to impulses."""

    name: str  # {"impulse", "velocity", "program"}
    problem: Problem
    program: ConvexProgram
    unknown_rows: (
        IntpArray  # (k,) int: rows of the problem with impulses that the program determines.
    )
    fixed: FloatArray  # [N s] (m,): known impulses of the other rows; 0 for unknown rows.
    recovery: sp.csr_matrix | None = None  # (k, r) or None: S T of the velocity form.
    shift: FloatArray | None = None  # (k,) or None: S r of the velocity form.
    is_definite: bool = False  # Whether P is known to be positive definite.

    def recover_impulse(self, x: FloatArray, lam: FloatArray) -> FloatArray:
        """Compute the impulses (m,) [N s] of a point, clipped to constant bounds."""
        cones = self.problem.cones
        return np.clip(self._combine(x, lam, 1.0), cones.lower, cones.upper)

    def list_certificates(self, x: FloatArray, lam: FloatArray) -> list[FloatArray]:
        """Return directions (m,) of impulses that may prove that no solution exists."""
        y = self._combine(x, lam, 0.0)
        # Remove rounding errors outside of the recession cone of the bounds.
        c = self.problem.cones
        low = np.where(np.isfinite(c.lower), 0.0, -np.inf)
        high = np.where(np.isfinite(c.upper), 0.0, np.inf)
        y = np.clip(y, low, high)
        size = np.abs(y).max(initial=0.0)
        return [y / size] if 0.0 < size < np.inf else []

    def _combine(self, x: FloatArray, lam: FloatArray, weight: float) -> FloatArray:
        """Return x or S T lambda on the unknown rows, with the given weight of S r and of known impulses (m,)."""
        out = weight * self.fixed
        if self.recovery is None or self.shift is None:
            out[self.unknown_rows] = x
        else:
            out[self.unknown_rows] = weight * self.shift + self.recovery @ lam
        return out

    def make_start(self, impulse: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return (x, lambda) of a start (m,) [N s]; None in the velocity form."""
        program = self.program
        if self.recovery is not None or program.cones:
            return None
        # Values and multipliers of bounds are complementary: both follow from the sum of value and slope.
        x = impulse[self.unknown_rows]
        lam = np.zeros(len(program.t))
        slope = (self.problem.csr @ impulse - self.problem.b)[self.unknown_rows]
        diagonal = self.problem.d[self.unknown_rows]
        at = np.flatnonzero(program.variable >= 0)
        sign = program.J[2][program.J[0][at]]
        variable = program.variable[at]
        is_active = sign * (x - slope / diagonal)[variable] <= program.t[at]
        lam[at] = np.where(is_active, np.maximum(sign * slope[variable], 0.0), 0.0)
        x = x.copy()
        x[variable[is_active]] = (sign * program.t[at])[is_active]
        return (x, lam) if np.isfinite(x).all() and np.isfinite(lam).all() else None

    def recover_bound_multiplier(
        self, x: FloatArray, lam: FloatArray, impulse: FloatArray
    ) -> FloatArray:
        """Return the multipliers z (m,) [m/s] of the bounds of the impulses, with A lambda - b + z = 0.

        In the impulse form, they are the backend's own; in other forms and on rows that were removed, z = -w.
        """
        z: FloatArray = -self.problem.slack(impulse)
        if self.name == "impulse":
            bounds = np.flatnonzero(self.program.variable >= 0)
            own = np.zeros(len(x))
            sign = self.program.J[2][self.program.J[0][bounds]]
            np.add.at(own, self.program.variable[bounds], -sign * lam[bounds])
            z[self.unknown_rows] = own
        return z


def choose_program_form(problem: Problem, form: str, definite: bool = False) -> str:
    """Choose the form of the program: "impulse", "velocity" or "program".

    Parameters
    ----------
    problem : Problem
    form : {"impulse", "velocity", "program", "auto"}
        "auto" chooses the program form for a quadratic program (`Problem.from_qp`), and else the velocity form

        - for bodies or J and M if `definite` is set,
        - for bodies if m exceeds their number of unknowns or the mass ratio is at least VELOCITY_FORM_MASS_RATIO,
        - for J and M if A is singular.
    definite : bool
        Whether the backend needs a positive definite P.
    """
    form = check_choice("form", form, PROGRAM_FORMS)
    rows = problem.rows
    if form == "program" and problem.qp is None:
        raise CapabilityError("form='program' needs a quadratic program (Problem.from_qp)")
    if form in ("impulse", "velocity") and problem.has_singular_program:
        raise CapabilityError(
            f"form={form!r} needs a positive definite P; P of this program is singular"
        )
    if form == "velocity" and problem.matrix is not None:
        raise CapabilityError(
            "form='velocity' needs bodies without ellipses, or J and M; this is a matrix"
        )
    if form != "auto":
        return form
    if problem.qp is not None:
        return "program"
    if rows is None:
        if problem.generalized is None:
            return "impulse"
        if definite or np.count_nonzero(problem.compliance == 0.0) > problem.generalized.nv:
            return "velocity"
        if problem.m > MAX_PIVOT_ROWS:
            return "impulse"
        root = 1.0 / np.sqrt(problem.d)
        try:
            pivots = np.square(
                np.linalg.cholesky(root[:, None] * problem.dense() * root).diagonal()
            )
        except np.linalg.LinAlgError:
            return "velocity"
        return "velocity" if (pivots <= MAX_SINGULAR_DELASSUS_PIVOT).any() else "impulse"
    moving = rows.inv_mass[rows.inv_mass > 0.0]
    ratio = moving.max() / moving.min() if len(moving) else 1.0
    n_slacks = np.count_nonzero(np.isfinite(problem.cones.lower) & np.isfinite(problem.cones.upper))
    is_smaller = problem.m > 6 * rows.n_bodies + n_slacks
    return "velocity" if definite or is_smaller or ratio >= VELOCITY_FORM_MASS_RATIO else "impulse"


def build_form(problem: Problem, form: str) -> Form:
    """Build a form of the problem: "impulse", "velocity" or "program"."""
    if form == "program":
        qp: QuadraticProgram = problem.qp
        return Form(
            name="program",
            problem=problem,
            program=get_program(qp),
            unknown_rows=np.arange(problem.m),
            fixed=np.zeros(problem.m),
            is_definite=not qp.is_singular,
        )
    c = problem.cones
    known = (c.lower == c.upper) & np.isfinite(c.lower)
    fixed = np.where(known, c.lower, 0.0)
    size = np.diff(c.ptr)
    has_own_bound = np.repeat(~c.is_contact | (size == 1), size)
    for i in np.asarray(problem.metric.empty, int):
        # The row of A is zero, so w = -b, and the sign of b determines the bound. If that bound is infinite, no
        # solution exists, which the validation of the input reports.
        if has_own_bound[i]:
            bound = c.upper[i] if problem.b[i] > 0.0 else c.lower[i] if problem.b[i] < 0.0 else 0.0
            known[i] = True
            fixed[i] = np.clip(bound if np.isfinite(bound) else 0.0, c.lower[i], c.upper[i])
    known[c.friction_rows] = c.friction_coefficient[c.friction_rows] == 0.0
    build = _build_impulse_form if form == "impulse" else _build_velocity_form
    return build(problem, np.flatnonzero(~known), fixed)


def get_program(qp: QuadraticProgram) -> ConvexProgram:
    """Return the convex program of a quadratic program, which is stored with it."""
    program: ConvexProgram | None = qp.__dict__.get("_convex_program")
    if program is None:
        definite = not qp.is_singular
        program = ConvexProgram(
            qp.hessian, qp.q, qp.jacobian, qp.target, qp.free, qp.variable, definite=definite
        )
        program.__dict__.update(scales=qp.scales, components=qp.components)
        qp.__dict__["_convex_program"] = program
    return program


def _list_friction_components(
    problem: Problem, unknown: IntpArray, root: FloatArray
) -> list[FrictionComponent]:
    """Return the friction components with indices of unknown rows, in unknowns scaled by S (k,)."""
    c = problem.cones
    index_of = np.full(problem.m, -1)
    index_of[unknown] = np.arange(len(unknown))
    components: list[FrictionComponent] = []
    for block, rows in c.friction_components():
        normal = int(index_of[c.ptr[block]])
        tangents = index_of[list(rows)]
        if tangents[0] >= 0:
            ratios = c.friction_coefficient[list(rows)] * root[normal] / root[tangents]
            components.append((normal, tuple(tangents.tolist()), tuple(ratios.tolist())))
    return components


def _build_impulse_form(problem: Problem, unknown: IntpArray, fixed: FloatArray) -> Form:
    """Build the impulse form: min 1/2 l.A l - b.l over the bounds or friction cones of a symmetric problem."""
    c = problem.cones
    k = len(unknown)
    a = problem.csr
    # Both triangles are made from the lower one, equal in every bit.
    low, off = sp.tril(a[unknown][:, unknown], 0, "coo"), sp.tril(a[unknown][:, unknown], -1, "coo")
    places = np.concatenate([low.row, off.col]), np.concatenate([low.col, off.row])
    hessian = sp.csr_matrix((np.concatenate([low.data, off.data]), places), (k, k))
    q = -(problem.b - (a @ fixed if fixed.any() else 0.0))[unknown]
    root = np.ones(k)
    components = _list_friction_components(problem, unknown, root)
    linear: list[Entries] = []
    conic: list[Entries] = []
    for n, tangents, ratios in components:
        # A pair gives a x_n - x_t >= 0 and a x_n + x_t >= 0, a disk gives (a x_n, x_t) in a second-order cone.
        a_n = ratios[0]
        if len(tangents) == 1:
            linear += [[(n, a_n), (tangents[0], sign)] for sign in (-1.0, 1.0)]
        else:
            conic += [
                [(n, a_n)],
                *([(t, a_n / a_t)] for t, a_t in zip(tangents, ratios, strict=True)),
            ]
    lower, upper = c.lower[unknown], c.upper[unknown]
    low, high = np.flatnonzero(np.isfinite(lower)), np.flatnonzero(np.isfinite(upper))
    bounds = [[(int(i), 1.0)] for i in low] + [[(int(i), -1.0)] for i in high]
    rows = _build_matrix(linear + bounds + conic, k)
    none = np.full(len(linear), -1), np.full(len(conic), -1)
    program = ConvexProgram(
        P=_get_arrays(hessian),
        q=q,
        J=_get_arrays(rows),
        t=np.concatenate([np.zeros(len(linear)), lower[low], -upper[high], np.zeros(len(conic))]),
        free=0,
        variable=np.concatenate([none[0], low, high, none[1]]).astype(np.int32),
        cones=_list_cone_sizes(components),
    )
    return Form(name="impulse", problem=problem, program=program, unknown_rows=unknown, fixed=fixed)


def _build_velocity_form(problem: Problem, unknown: IntpArray, fixed: FloatArray) -> Form:
    """Build the mass-scaled velocity form of a problem with bodies or J and M."""
    form = problem.velocity_form()
    c = problem.cones
    k = len(unknown)
    root = 1.0 / np.sqrt(problem.d[unknown])
    # Form K~ = [K, theta^1/2].
    jac = sp.csr_matrix(form.jacobian)
    theta = form.theta[unknown]
    soft = np.flatnonzero(theta > 0.0)
    root_theta = sp.csr_matrix(
        (np.sqrt(theta[soft]), (soft, np.arange(len(soft)))), shape=(k, len(soft))
    )
    velocity_map = sp.csr_matrix(sp.hstack([jac[unknown], root_theta]))
    ny = velocity_map.shape[1]
    g = form.rhs[unknown]
    # Classify bounded rows as free, with a lower bound, with both bounds, or with an upper bound.
    low, high = c.lower[unknown] / root, c.upper[unknown] / root
    components = _list_friction_components(problem, unknown, root)
    is_bounded = np.ones(k, bool)
    is_bounded[[i for n, tangents, _ in components for i in (n, *tangents)]] = False
    has_low, has_high = is_bounded & np.isfinite(low), is_bounded & np.isfinite(high)
    free = np.flatnonzero(is_bounded & ~has_low & ~has_high)
    upper = np.flatnonzero(has_high & ~has_low)
    both = np.flatnonzero(has_low & has_high)
    shift = np.where(has_low, low, np.where(has_high, high, 0.0))
    t_of_row = dict(zip(both.tolist(), range(ny, ny + len(both)), strict=True))
    rows, n_friction = _list_velocity_rows(
        components, free, np.flatnonzero(has_low), upper, ny, t_of_row
    )
    n = ny + len(both) + n_friction
    r = len(rows)
    # Form the rows T^T K~ with the columns of t, and insert the rows t >= 0 before the cones.
    transposed = _build_matrix([multipliers for multipliers, _ in rows], k)
    velocities = transposed @ velocity_map
    velocities.resize(r, n)
    velocities = sp.csr_matrix(velocities - _build_matrix([slacks for _, slacks in rows], n))
    slack_rows = _build_matrix([[(i, 1.0)] for i in range(ny, n)], n)
    sizes = _list_cone_sizes(components)
    first = r - sum(sizes)
    n_slack = n - ny
    order = np.concatenate([np.arange(first), r + np.arange(n_slack), np.arange(first, r)]).astype(
        int
    )
    matrix = sp.csr_matrix(sp.vstack([velocities, slack_rows]))[order]
    q = np.zeros(n)
    known = np.zeros(ny)
    known[: jac.shape[1]] = jac.T @ (fixed / form.scale)
    q[:ny] = -(velocity_map.T @ shift) - known
    q[ny : ny + len(both)] = high[both] - low[both]
    is_velocity = np.arange(n) < ny
    variable = np.concatenate([np.full(r, -1), np.arange(ny, n)])[order].astype(np.int32)
    program = ConvexProgram(
        P=_get_arrays(sp.csr_matrix(sp.diags_array(np.where(is_velocity, 1.0, 0.0)))),
        q=q,
        J=_get_arrays(matrix),
        t=np.concatenate([transposed @ g, np.zeros(n_slack)])[order],
        free=len(free),
        variable=variable,
        cones=sizes,
    )
    recovery = sp.vstack([transposed, sp.csr_matrix((n_slack, k))]).tocsr()[order].T
    return Form(
        name="velocity",
        problem=problem,
        program=program,
        unknown_rows=unknown,
        fixed=fixed,
        recovery=sp.csr_matrix(sp.diags_array(root) @ recovery),
        shift=root * shift,
        is_definite=not n_slack,
    )


def _get_arrays(matrix: sp.csr_matrix) -> tuple[Any, Any, Any]:
    """Return (indptr, indices, data) of a matrix in compressed rows, with indices of 32 bits."""
    matrix.sort_indices()
    return (
        matrix.indptr.astype(np.int32),
        matrix.indices.astype(np.int32),
        matrix.data.astype(float),
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

    The rows `free`, `lower` and `upper` have no friction; `t_of_row` has the unknown t of each row with both bounds.
    Unknowns t follow `ny` velocities. The second result is the number of unknowns t of friction, which follow these.
    """
    rows: list[tuple[Entries, Entries]] = [([(i, -1.0)], []) for i in free.tolist()]
    rows += [([(i, 1.0)], [(t_of_row[i], -1.0)] if i in t_of_row else []) for i in lower.tolist()]
    rows += [([(i, -1.0)], []) for i in upper.tolist()]
    first = ny + len(t_of_row)
    new = itertools.count(first)
    t_of_normal = dict[int, Entries]()
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
    rows += [
        ([(normal, 1.0)], entries)
        for normal, entries in t_of_normal.items()
        if normal not in has_disk
    ]
    for k, (normal, tangents, ratios) in enumerate(disks):
        is_second = k in t_of_disk
        rows.append(
            ([], [(t_of_disk[k], -1.0)])
            if is_second
            else ([(normal, 1.0)], t_of_normal.get(normal, []))
        )
        rows += [([(tangent, ratio)], []) for tangent, ratio in zip(tangents, ratios, strict=True)]
    return rows, next(new) - first


def _list_cone_sizes(components: list[FrictionComponent]) -> tuple[int, ...]:
    """Return the size of the second-order cone of each component of several rows."""
    return tuple(1 + len(tangents) for _, tangents, _ in components if len(tangents) > 1)


def _build_matrix(rows: list[Entries], columns: int) -> sp.csr_matrix:
    """Build a sparse matrix from the entries of its rows."""
    entries = [entry for row in rows for entry in row]
    ptr = np.cumsum([0, *map(len, rows)])
    data, index = np.array([x for _, x in entries], float), np.array([i for i, _ in entries], int)
    return sp.csr_matrix((data, index, ptr), (len(rows), columns))
