"""The ideal twin of one step: the same step by the rigid laws, without an engine's approximations.

Contacts, limits, equalities and dry friction are rigid: no velocity remains in them after the step, and a contact that
is open may close and not more. The friction cone is round with Coulomb's law. The integrator is MuJoCo's "discrete":
the constraint problem contains the dampings and the actuators that the engine's integrator treats implicitly, and
springs of rows are implicit, which matters if the integrator is exchanged before the softness. Masses, forces,
geometry and coefficients stay.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lavender.causes.matching import Pairing
from lavender.causes.mixture import PARTS, solve_mixture
from lavender.io.step_record import Softness, StepRecord

# [-] Compliance of the twin's rows relative to J M^-1 J^T. It makes impulses of redundant rows unique, and changes
# velocities by about this part of themselves.
RIGID_COMPLIANCE = 1e-9
ROUND_CONES = {"pyramid": "ellipse", "box": "ellipse"}


def make_ideal_twin(record: StepRecord) -> StepRecord:
    """Return the record of the same step by the rigid laws; see the module."""
    rigid = Softness("rigid", compliance=np.array([RIGID_COMPLIANCE]))
    blocks = tuple(
        replace(x, softness=rigid, cone=ROUND_CONES.get(x.cone, x.cone), force=None)
        for x in record.blocks
    )
    has_springs = any(x.softness.rule == "impedance" for x in record.blocks)
    added = record.added_matrix
    fluid = np.zeros_like(added) if record.fluid_matrix is None else record.fluid_matrix
    if not record.uses_damping:
        added = added + record.dt * record.damping_matrix
    if not record.uses_fluid:
        added = added + record.dt * fluid
    symmetric = 0.5 * (added + added.T)  # The problem needs a symmetric matrix.
    dt = record.dt
    rest = symmetric - dt * (
        record.damping_matrix + fluid + record.uses_actuators * record.actuator_matrix
    )
    rest[np.abs(rest) < 1e-12 * np.abs(record.mass).max()] = 0.0
    twin = replace(
        record, engine="rigid", blocks=blocks, uses_damping=True, uses_fluid=True, uses_coriolis=None,
        velocity_change=None, integrator_matrix=rest,
        in_problem=True, implicit_rows=has_springs or record.implicit_rows, law="coulomb", acceleration=None,
        before_noslip=None, softnesses=dict.fromkeys(record.softnesses, rigid),
        settings={"family": "ideal"},
    )  # fmt: skip
    after = solve_mixture(dict.fromkeys(PARTS, twin), Pairing.of_records(twin, twin)).velocity
    return replace(
        twin,
        velocity_after=after,
        acceleration=(after - twin.velocity) / dt,
        moved_by="acceleration",
    )
