"""Ways to step by name: one file each, its SPEC one line here.

A stepper owns what happens in a substep between collision and integration. Bodies, shapes, joints, motors, collision,
matching of contacts, snapshots, films, orders and budgets are the engine's. The kernels are `lavender_ext/engine/`.
"""

from lavender.base.errors import UnknownName
from lavender.sim.scene.steppers import avbd, impulses, soft_step, xpbd
from lavender.sim.scene.steppers.spec import Option, StepperSpec

__all__ = ["STEPPERS", "Option", "StepperSpec", "get_stepper"]

STEPPERS = {spec.name: spec for spec in (impulses.SPEC, soft_step.SPEC, xpbd.SPEC, avbd.SPEC)}


def get_stepper(name: str) -> StepperSpec:
    """The stepper of that name."""
    spec = STEPPERS.get(name) if isinstance(name, str) else None
    if spec is None:
        raise UnknownName("stepper", name, STEPPERS)
    return spec
