"""Velocities by sweeps over speculative contacts, penetration by a projection of positions that adds no velocity.

    target_n = -g/h where the gap g is open, unless the cache says that the contact bears; rows of joints have target 0
    sweeps on A lambda = b, lambda >= 0, disks; then a shift of positions for what is deeper than the slop

`lavender_ext/engine/contacts.pxd`, `projection.pxd`. Any registered solver may take the place of the sweeps.
"""

from lavender.sim.scene.steppers.spec import StepperSpec

SPEC = StepperSpec(
    name="impulses",
    number=0,
    summary="speculative contacts, warm-started sweeps over velocities, position projection",
    reference="Catto, Iterative Dynamics with Temporal Coherence, 2005; Guendelman, Bridson, Fedkiw, 2003",
    boxes=True,
    sweeps=(4, 64),
    order="alternating",
    position_iterations=2,
    solvers=True,
    spin=True,
    rolling=True,
    exact_problem=True,
)
