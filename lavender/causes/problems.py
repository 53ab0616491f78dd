"""The constraint problem of a `StepRecord`, and a record of a `Problem` of which no more is known.

    step = problem_of_record(record)
    step.velocity_of(lavender.solve(step.problem, "newton").impulse)    # moved by the engine's own integrator

A record of a problem and an engine's impulses has a step of 1 s that starts at v*. The velocity of a surface is the
target of its rows without compliance; the target of softened friction rows is an engine's damping, so that their
surface has the velocity 0 unless it is given.
"""

from __future__ import annotations

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.causes.matching import Pairing
from lavender.causes.mixture import PARTS, StepProblem, assemble
from lavender.io.step_record import ConstraintBlock, Softness, StepRecord
from lavender.problem import Problem
from lavender.problem.cones import CONTACT, CONTACT_BOX, CONTACT_ELLIPSE, ROUND

ROUNDING = 8.0 * np.finfo(float).eps  # [-] A target of this part of its terms is rounding.
MAX_ENTRIES = 4_000_000  # Larger dense matrices of a problem are not made.


def problem_of_record(record: StepRecord) -> StepProblem:
    """Return the constraint problem of a step, in the order of its blocks, with the engine's integrator.

    Parameters
    ----------
    record : StepRecord

    Returns
    -------
    StepProblem
        `problem` with the references and compliances that the engine makes from its settings, or None without rows;
        `velocity_of` returns the velocity after the step for any impulses of its rows.
    """
    blocks = [(record, i) for i in range(len(record.blocks))]
    pairing = Pairing.of_records(record, record)
    return assemble(dict.fromkeys(PARTS, record), pairing, blocks=blocks)


def record_of_problem(
    problem: Problem, impulse: FloatArray, surface_velocity: FloatArray | None = None
) -> StepRecord:
    """Return the record of a problem and an engine's impulses (m,) [N s].

    Raises
    ------
    CapabilityError
        The problem was given as a matrix, or is too large.
    """
    free = problem.velocity(np.zeros(problem.m)).ravel()
    n = len(free)
    if n * max(n, problem.m) > MAX_ENTRIES:
        raise CapabilityError(
            f"the problem has {problem.m} rows and {n} velocities: too many to solve it in variants"
        )
    jac = problem.jacobian.toarray()
    own = jac @ free
    target = problem.b + own
    target[np.abs(target) <= ROUNDING * (np.abs(problem.b) + np.abs(own))] = 0.0
    soft = np.zeros(problem.m) if problem.compliance is None else np.array(problem.compliance)
    friction = problem.cones.friction_rows
    surface = target.copy()
    surface[friction] = np.where(soft > 0.0, 0.0, target)[friction]
    if surface_velocity is not None:
        surface[friction] = surface_velocity[friction]
    motion = problem.engine_motion
    change = None
    if motion is not None and motion.moved_by == "acceleration":
        change = motion.change if np.array_equal(motion.impulse, impulse) else None
    after = problem.velocity(impulse).ravel() if change is None else free + change
    zero, empty = np.zeros(n), np.zeros((n, n))
    blocks = tuple(
        _make_block(problem, k, jac, target, surface, soft, impulse)
        for k in range(problem.cones.n_blocks)
    )
    return StepRecord(
        engine="engine", dt=1.0, velocity=free, velocity_after=after, mass=_make_mass(problem, n),
        coriolis=zero, gravity_map=np.zeros((n, 3)), gravity=np.zeros(3), force=zero,
        damping_matrix=empty, damping_force=zero, actuator_matrix=empty, actuator_force=zero,
        integrator_matrix=empty, integrator_force=zero, stiffness_matrix=empty, uses_damping=True,
        uses_actuators=True, uses_stiffness=False, in_problem=True, implicit_rows=False,
        blocks=blocks, law="coulomb" if problem.friction == "coulomb" else "cone",
        names=tuple(f"velocity {i}" for i in range(n)), angular=np.zeros(n, bool),
        acceleration=change, moved_by="forces" if change is None else "acceleration",
    )  # fmt: skip


def _make_mass(problem: Problem, n: int) -> FloatArray:
    """Return M (n, n); a body that cannot move has no rows, and an arbitrary mass."""
    if problem.generalized is not None:
        return np.array([problem.generalized.momentum_of(row) for row in np.eye(n)])
    rows = problem.rows
    assert rows is not None
    mass = np.eye(n)
    for i, (inverse, inertia) in enumerate(zip(rows.inv_mass, rows.inv_inertia, strict=True)):
        at = 6 * i
        if inverse > 0.0:
            mass[range(at, at + 3), range(at, at + 3)] = 1.0 / inverse
        block = np.asarray(inertia, float)
        if np.linalg.matrix_rank(block) == 3:
            mass[at + 3 : at + 6, at + 3 : at + 6] = np.linalg.inv(block)
    return mass


def _make_block(
    problem: Problem, k: int, jac: FloatArray, target: FloatArray, surface: FloatArray,
    soft: FloatArray, impulse: FloatArray,
) -> ConstraintBlock:  # fmt: skip
    """Return one block of the problem."""
    cones = problem.cones
    rows = slice(int(cones.ptr[k]), int(cones.ptr[k + 1]))
    count = rows.stop - rows.start
    kind = int(cones.kind[k])
    is_contact = bool(cones.is_contact[k])
    tangents = count - 1
    cone, role = "", "contact" if is_contact else "bounds"
    friction = np.zeros(0)
    if is_contact and tangents:
        friction = np.full(tangents, float(cones.mu[k]))
        if kind in (CONTACT_BOX, CONTACT_ELLIPSE):
            friction = cones.coefficients[k][:2].copy()
        cone = "own"
        if kind == CONTACT or (kind == ROUND and len(friction) == tangents):
            cone = "ellipse"
        elif kind == CONTACT_BOX:
            cone = "box"
        elif kind == CONTACT_ELLIPSE:
            cone = "ellipse"
    return ConstraintBlock(
        problem.block_name(k), role, jac[rows], np.zeros(count), np.ones(count),
        Softness("rates", rate=np.ones(count), stiffness=np.zeros(count), compliance=soft[rows]),
        cone=cone, condim=count if is_contact else 1, friction=friction,
        surface_velocity=surface[rows], bias=target[rows] - surface[rows], force=impulse[rows].copy(),
        bounds=None if is_contact else np.array([cones.lower[rows], cones.upper[rows]]),
        own_cones=cones.select([k]) if cone == "own" else None,
    )  # fmt: skip
