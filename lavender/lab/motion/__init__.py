"""Errors of motions: distances of impulses from the solution with proved bounds, and problems with several solutions.

```python
error = lv.motion_error(problem, solution.impulse)     # or solution.motion_error()
error.relative, error.speed, error.bound
lv.find_solutions(problem).spread                             # m/s that Coulomb's law leaves open
```
"""

from lavender.lab.motion.bound import Witness
from lavender.lab.motion.error import MotionError, measure_distance
from lavender.lab.motion.multiple_solutions import (
    Motion,
    SolutionSet,
    converge_to_solution,
    find_solutions,
    get_solutions,
    measure_distance_to_nearest,
    measure_motion_distance,
    motion_error,
)
from lavender.lab.motion.reference import (
    Reference,
    get_reference,
    load_reference,
    save_reference,
    store_reference_if_better,
)
from lavender.lab.motion.unique import prove_uniqueness

__all__ = [
    "Motion",
    "MotionError",
    "Reference",
    "SolutionSet",
    "Witness",
    "converge_to_solution",
    "find_solutions",
    "get_reference",
    "get_solutions",
    "load_reference",
    "measure_distance",
    "measure_distance_to_nearest",
    "measure_motion_distance",
    "motion_error",
    "prove_uniqueness",
    "save_reference",
    "store_reference_if_better",
]
