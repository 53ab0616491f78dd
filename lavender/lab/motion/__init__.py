"""How wrong the motion is, not only the impulse: distances to the solution, with a bound; several solutions.

```python
error = lv.motion_error(problem, solution.impulse)     # or solution.motion_error()
error.relative, error.speed, error.bound
lv.motions(problem).spread                             # m/s that Coulomb's law leaves open
```
"""

from lavender.lab.motion.bound import Witness
from lavender.lab.motion.error import MotionError, measure
from lavender.lab.motion.multiple_solutions import (
    Motion,
    Motions,
    branch,
    distance,
    motion_error,
    motions,
    motions_of,
    nearest,
)
from lavender.lab.motion.reference import Reference, adopt, load_reference, reference, save_reference
from lavender.lab.motion.unique import uniqueness

__all__ = [
    "Motion",
    "MotionError",
    "Motions",
    "Reference",
    "Witness",
    "adopt",
    "branch",
    "distance",
    "load_reference",
    "measure",
    "motion_error",
    "motions",
    "motions_of",
    "nearest",
    "reference",
    "save_reference",
    "uniqueness",
]
