"""Errors of motions: distances of impulses from the solution with proved bounds, and problems with several solutions.

```python
error = lv.motion_error(problem, solution.impulse)     # or solution.motion_error()
error.relative, error.speed, error.bound
lv.find_solutions(problem).spread                             # m/s that Coulomb's law leaves open
```
"""

from lavender.lab.motion.bound import Witness
from lavender.lab.motion.error import MotionError, measure
from lavender.lab.motion.multiple_solutions import (
    Motion,
    SolutionSet,
    branch,
    distance,
    find_solutions,
    get_solutions,
    motion_error,
    nearest,
)
from lavender.lab.motion.reference import Reference, adopt, load_reference, reference, save_reference
from lavender.lab.motion.unique import uniqueness

__all__ = [
    "Motion",
    "MotionError",
    "Reference",
    "SolutionSet",
    "Witness",
    "adopt",
    "branch",
    "distance",
    "find_solutions",
    "get_solutions",
    "load_reference",
    "measure",
    "motion_error",
    "nearest",
    "reference",
    "save_reference",
    "uniqueness",
]
