"""Solve one step whose ingredients come from two records: the masses of one engine, the softness of the other, ...

With the sources of all ingredients chosen, the step is equation (1) of `lavender.io.step_record`. References and
compliances of the rows are computed from the softness of one source, from the inverse masses of the source of the
masses, from the coefficients and cone of the source of the friction, and at the positions of the source of the rows.
With the rates B, the springs K d, and the gaps r of the rows,

    target = J v + h a_ref      a_ref = -B (J v - surface) - K d r                                                (1)

An engine that integrates the springs of the rows implicitly (MuJoCo's "discrete") replaces, with D_ii the diagonal,

    B by (B + h K d) phi,   K d by K d phi,   R by R phi rho,   phi = 1 / (1 + h B + h^2 K d)                      (2)
    rho = sum_i J_i^2 / D_ii(M + H)  /  sum_i J_i^2 / D_ii(M)     of the first row of a contact

A pyramid has the edges n +- mu_j t_j of the rows n and t_j; an elliptic cone has the rows n and mu_j / mu_1 t_j, so
that it is round.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.causes.matching import Pairing
from lavender.io.impedance import compute_compliance, compute_reference
from lavender.io.step_record import (
    ConstraintBlock,
    Softness,
    StepRecord,
    add_forces,
    add_matrix,
)
from lavender.io.stiff_rows import raise_compliance
from lavender.problem import Problem
from lavender.problem.cones import Cones
from lavender.solving.solve import solve

#: Ingredient -> its parts. The parts of an ingredient are exchanged separately after the ingredients.
INGREDIENTS = {
    "mass": ("mass",),
    "force": ("force",),
    "integrator": ("damping", "actuators", "method"),
    "rows": ("rows",),
    "softness": ("reference", "compliance"),
    "friction": ("shape", "coefficient", "law"),
}
PARTS = tuple(part for parts in INGREDIENTS.values() for part in parts)
TOL = 1e-12  # [-] Relative residual to which each mixture is solved.
SOLVERS = ("newton", "auto")  # The second one solves if the first one does not converge.
MAX_RESIDUAL = 1e-9  # [-] A mixture with a larger residual than this and its floor is not solved.
# [-] The same with raised compliances: these change velocities by 1e-8 of themselves.
MAX_RAISED_RESIDUAL = 1e-6
# [-] The first three rows of a contact are the velocity of one point in three directions. An entry below this part of
# its column is rounding.
ROUNDING = 64.0 * np.finfo(float).eps


@dataclass(frozen=True, eq=False)
class Mixture:
    """Result of a mixture."""

    velocity: FloatArray  # (nv,) m/s, rad/s after the step.
    relative: float  # Relative residual of the solution [-].
    is_solved: bool
    is_raised: bool = False  # Whether compliances near zero were raised.


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows of one block in the constraint problem."""

    jacobian: FloatArray
    target: FloatArray
    compliance: FloatArray
    kind: str  # "contact", "limit", "equality", "friction" or "bounds".
    mu: FloatArray
    cone: str = ""
    loss: float = 0.0
    bounds: FloatArray | None = None  # (2, k) N, N m
    own_cones: Cones | None = None


def solve_mixture(
    sources: Mapping[str, StepRecord], pairing: Pairing, velocity: FloatArray | None = None
) -> Mixture:
    """Return the exact velocity after the step whose parts come from the records of `sources`.

    Parameters
    ----------
    sources : dict
        Record of each of `PARTS`.
    pairing : Pairing
        Partners of the blocks of the records.
    velocity : (nv,), optional
        Velocity before the step. Default: the one of the source of the rows.
    """
    step = assemble(sources, pairing, velocity)
    if step.problem is None:
        return Mixture(step.free, 0.0, True)
    best, problem = None, step.problem
    # Rows that hardly move anything, as of a wheel's contact under its axle, have a compliance near 0 beside their own
    # numbers: they are solved as `from_mujoco` gives them.
    raised = raise_compliance(problem)
    if raised is not None:
        problem = replace(problem, compliance=raised)
    for solver in SOLVERS:
        solution = solve(problem, solver, tol=TOL)
        if best is None or solution.residual.relative < best.residual.relative:
            best = solution
        if best.residual.relative <= MAX_RESIDUAL:
            break
    assert best is not None
    relative = best.residual.relative
    is_raised = raised is not None
    limit = MAX_RAISED_RESIDUAL if is_raised else MAX_RESIDUAL
    is_solved = relative <= max(limit, best.residual.roundoff_floor)
    return Mixture(step.velocity_of(best.impulse), relative, is_solved, is_raised)


@dataclass(frozen=True, eq=False)
class StepProblem:
    """The constraint problem of a step, and the integrator that moves bodies by its impulses."""

    problem: Problem | None  # None without rows.
    jacobian: FloatArray  # (m, nv): rows of the problem.
    matrix: FloatArray  # (nv, nv): M + H.
    free: FloatArray  # (nv,) m/s, rad/s: velocity after the step without constraints.

    def velocity_of(self, impulse: FloatArray) -> FloatArray:
        """Return the velocity after the step (nv,) [m/s, rad/s] for impulses (m,) [N s] of the problem's rows."""
        return self.free + np.linalg.solve(self.matrix, self.jacobian.T @ impulse)


def assemble(
    sources: Mapping[str, StepRecord], pairing: Pairing, velocity: FloatArray | None = None,
    blocks: list[tuple[StepRecord, int]] | None = None,
) -> StepProblem:  # fmt: skip
    """Return the problem of a step; the parameters are those of `solve_mixture`.

    `blocks` are the (record, index) of its blocks in their order; default: those of the sources.
    """
    base = sources["rows"]
    before = base.velocity if velocity is None else velocity
    dt, mass = base.dt, sources["mass"].mass
    terms = [sources[x] for x in ("mass", "force", "damping", "actuators", "method")]
    added, smooth = add_matrix(*terms), add_forces(*terms)
    in_problem = sources["method"].in_problem
    metric = mass + added if in_problem else mass
    inverse = np.asarray(np.linalg.inv(metric), float)
    free = before + dt * inverse @ smooth
    after = before + dt * np.linalg.solve(mass + added, smooth)
    if sources["method"].velocity_change is not None:
        after = after + sources["method"].velocity_change
    rows = [
        part
        for record, i in (_iterate_blocks(sources, pairing) if blocks is None else blocks)
        for part in [_make_rows(record, i, sources, pairing, before, added, inverse)]
        if part is not None
    ]
    if not rows:
        return StepProblem(None, np.zeros((0, len(before))), mass + added, after)
    jacobian = np.vstack([x.jacobian for x in rows])
    problem = Problem.from_jacobian(
        jacobian, metric, free, target=np.concatenate([x.target for x in rows]),
        cones=Cones._concatenate([_make_cones(x, dt) for x in rows]),
        compliance=np.concatenate([x.compliance for x in rows]),
        friction=_choose_law(sources, rows),
    )  # fmt: skip
    return StepProblem(problem, jacobian, mass + added, after)


def _choose_law(sources: Mapping[str, StepRecord], rows: list[_Rows]) -> str:
    """Return the law: Coulomb's is defined for contacts of up to two tangents."""
    law = sources["law"].law
    is_wide = any(x.kind == "contact" and len(x.jacobian) > 3 and x.own_cones is None for x in rows)
    return "cone" if is_wide else law


def _iterate_blocks(
    sources: Mapping[str, StepRecord], pairing: Pairing
) -> list[tuple[StepRecord, int]]:
    """Return (record, index) of the blocks of a mixture.

    A joint has dry friction if the source of the coefficients has it; other blocks belong to the source of the rows.
    """
    base, loss = sources["rows"], sources["coefficient"]
    chosen = [(base, i) for i, x in enumerate(base.blocks) if x.role != "friction"]
    for i, block in enumerate(loss.blocks):
        if block.role == "friction":
            partner = i if loss is base else pairing.partners[pairing.side_of(loss)][i]
            chosen.append((loss, i) if partner < 0 else (base, partner))
    return chosen


def _make_rows(
    record: StepRecord, i: int, sources: Mapping[str, StepRecord], pairing: Pairing,
    before: FloatArray, added: FloatArray, inverse: FloatArray,
) -> _Rows | None:  # fmt: skip
    """Return the rows of a block with its settings from the sources."""
    block = record.blocks[i]
    dt, mass = record.dt, sources["mass"].mass
    jac, cone, mu = block.jacobian, "", np.zeros(0)
    loss = pairing.find(sources["coefficient"], record, i) or block
    if block.role == "contact":
        shape = pairing.find(sources["shape"], record, i) or block
        wide = block if len(block.jacobian) >= shape.condim else shape
        jac = np.vstack([block.jacobian, wide.jacobian[len(block.jacobian) :]])[: shape.condim]
        mu = np.append(loss.friction, shape.friction[len(loss.friction) :])[: shape.condim - 1]
        cone = shape.cone
        if shape.condim == 1 or not cone or mu[0] <= 0.0:
            jac, cone, mu = jac[:1], "", np.zeros(0)
        jac = _drop_rounding(jac)
    k = len(jac)
    shaped = replace(block, cone=cone, condim=k) if block.role == "contact" else block
    gap = np.zeros(k)
    gap[: len(block.gap)] = block.gap[:k]
    surface = np.zeros(k)
    if block.surface_velocity is not None:
        known = min(k, len(block.surface_velocity))
        surface[:known] = block.surface_velocity[:known]
    reference = pairing.find_softness(sources["reference"], record, i) or block.softness
    softness = pairing.find_softness(sources["compliance"], record, i) or block.softness
    has_implicit_rows = sources["method"].implicit_rows
    rates, springs = _find_rates(shaped, reference, softness, k, gap, dt, has_implicit_rows)
    weight = _find_weight(record, i, sources["mass"], pairing)
    edges = make_edges(cone, mu, k)
    compliance = _find_compliance(shaped, softness, weight, mu, cone, edges, jac, inverse)
    if cone == "pyramid" and reference.rule == "impedance":
        springs[1:] = springs[0]  # Each edge has the spring of the normal.
    phi = np.ones(k)
    is_implicit = has_implicit_rows and softness.rule != "rigid"
    if is_implicit:
        rows = edges @ jac
        diagonal, whole = np.diag(mass), np.diag(mass + added)
        size = rows**2 @ (1.0 / diagonal)
        weighted = rows**2 @ (1.0 / whole) / np.where(size > 0.0, size, 1.0)
        weighted = np.where(size > 0.0, weighted, 1.0)
        phi = 1.0 / (1.0 + dt * rates + dt**2 * springs)
        if block.role == "contact":
            compliance = compliance * phi[0] * weighted[0]
        else:
            compliance = compliance * phi * weighted
        if reference.rule != "rigid":
            rates = (rates + dt * springs) * phi
            springs = springs * phi
    own = jac @ before
    target = own - dt * (rates * (own - surface) + springs * gap)
    if block.bias is not None and reference.rule != "rigid":
        known = min(k, len(block.bias))
        target[:known] += dt * phi[:known] * block.bias[:known]
    # No impulse satisfies a rigid row that moves nothing, so that its reference has no meaning.
    is_fixed = (compliance == 0.0) & ~(edges @ jac).any(axis=1)
    kind = block.role if block.role != "contact" or k > 1 else "limit"
    if cone == "pyramid":
        kind = "limit"
    return _Rows(
        edges @ jac,
        np.where(is_fixed, 0.0, edges @ target),
        compliance,
        kind,
        mu,
        cone,
        loss.loss,
        block.bounds,
        block.own_cones,
    )


def _drop_rounding(jac: FloatArray) -> FloatArray:
    """Return the rows of a contact without entries of its normal and tangents that are rounding."""
    point = jac[:3]
    size = np.linalg.norm(point, axis=0)
    if len(point) == 3 and (found := (point != 0.0) & (np.abs(point) <= ROUNDING * size)).any():
        jac = jac.copy()
        jac[:3][found] = 0.0
    return jac


def make_edges(cone: str, mu: FloatArray, k: int) -> FloatArray:
    """Return the rows of the problem as combinations of the k rows of a block."""
    if not cone:
        return np.eye(k)
    if cone == "pyramid":
        edges = np.zeros((2 * len(mu), k))
        edges[:, 0] = 1.0
        for j, coefficient in enumerate(mu):
            edges[2 * j, j + 1] = coefficient
            edges[2 * j + 1, j + 1] = -coefficient
        return edges
    if cone in ("box", "own"):
        return np.eye(k)
    return np.diag(np.append(1.0, mu / mu[0]))


def _find_rates(
    block: ConstraintBlock, reference: Softness, softness: Softness, k: int, gap: FloatArray, dt: float,
    is_implicit: bool,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return B [1/s] and K d [1/s^2] (k,) of the rows."""
    if reference.rule == "impedance":
        own = softness if softness.rule == "impedance" else reference
        return compute_reference(block, reference, own, k, is_implicit)
    if reference.rule == "rates":
        return _resize(reference.rate, k), _resize(reference.stiffness, k, 0.0)
    # Rigid: no velocity after the step, or the one that closes an open gap.
    is_open = (gap > 0.0) & (block.role in ("contact", "limit"))
    return np.full(k, 1.0 / dt), np.where(is_open, 1.0 / dt**2, 0.0)


def _resize(values: FloatArray, k: int, filling: float | None = None) -> FloatArray:
    """Return the first k of some values; missing ones are the last value, or `filling`."""
    last = values[-1] if filling is None else filling
    return np.append(values, np.full(max(0, k - len(values)), last))[:k]


def _find_weight(
    record: StepRecord, i: int, mass: StepRecord, pairing: Pairing
) -> FloatArray:  # fmt: skip
    """Return the inverse masses of the rows by the engine whose masses are used."""
    block = record.blocks[i]
    if mass is record:
        return block.weight
    j = pairing.partners[pairing.side_of(record)][i]
    if j >= 0 and len(mass.blocks[j].weight) == len(block.weight):
        return mass.blocks[j].weight
    if block.bodies and all(body in mass.weights for body in block.bodies):
        return np.array([sum(float(mass.weights[body]) for body in block.bodies)])
    known = np.atleast_1d(mass.weights.get(block.key, np.nan))
    if np.isfinite(known).all():
        return _resize(known, len(block.weight))
    rows = block.jacobian[: len(block.weight)]
    mine, theirs = (
        np.einsum("ij,ji->i", rows, np.linalg.solve(m, rows.T)) for m in (record.mass, mass.mass)
    )
    return block.weight * theirs / np.where(mine > 0.0, mine, 1.0)


def _find_compliance(
    block: ConstraintBlock, softness: Softness, weight: FloatArray, mu: FloatArray, cone: str,
    edges: FloatArray, jac: FloatArray, inverse: FloatArray,
) -> FloatArray:  # fmt: skip
    """Return R [1/kg] of the rows of the problem."""
    if softness.rule == "impedance":
        made = compute_compliance(block, softness, weight, mu, cone)
        scale = edges.diagonal() if cone == "ellipse" else np.ones(len(edges))
        return np.broadcast_to(made, len(edges)) * scale**2
    if softness.rule == "rates":
        k = jac.shape[0]
        if cone == "pyramid":
            return np.full(len(edges), 2.0 * (k - 1) * softness.compliance[0])
        scale = edges.diagonal() if cone == "ellipse" else np.ones(k)
        return _resize(softness.compliance, k) * scale**2
    rows = edges @ jac
    return softness.compliance[0] * np.einsum("ij,jk,ik->i", rows, inverse, rows)


def _make_cones(rows: _Rows, dt: float) -> Cones:
    """Return the bounds or the cone of the rows of a block."""
    k = len(rows.jacobian)
    if rows.own_cones is not None:
        return rows.own_cones
    if rows.kind == "contact" and rows.cone == "box":
        return Cones.contacts(rows.mu[None, :2], shape="box")
    if rows.kind == "contact":
        return Cones.contacts(float(rows.mu[0]), tangents=k - 1)
    if rows.bounds is not None:
        return Cones.bounded(dt * rows.bounds[0], dt * rows.bounds[1])
    upper = np.full(k, np.inf)
    if rows.kind == "friction":
        return Cones.bounded(np.full(k, -dt * rows.loss), np.full(k, dt * rows.loss))
    return Cones.bounded(-upper if rows.kind == "equality" else np.zeros(k), upper)
