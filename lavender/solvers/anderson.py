"""Anderson acceleration of projected Gauss-Seidel: combine the last few sweeps so that their steps nearly cancel.

    y = S(x),   f = D^1/2 (y - x),   x <- Pi(y - sum_i gamma_i (y_{i+1} - y_i)),
    gamma = argmin | f - sum_i gamma_i (f_{i+1} - f_i) |       over the last `memory` sweeps

On a linear problem this is a truncated GMRES with the sweep as preconditioner. It needs neither a symmetric A nor an
energy, so it also accelerates friction. A step that doubles |f| is undone, and the memory is cleared. Sweeps under
Coulomb's law alone do not converge on large piles. From 900 rows on, the first 512 sweeps are therefore under the cone
law, unless a test shows that contacts slip (`lavender_ext/accelerate/accelerated.pyx`, (4) and (5)).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from lavender.base.arrays import check_int
from lavender.solvers._accelerated import CONVEX_OPTION, MAX_MEMORY, SWEEP_OPTION, Accelerated
from lavender.solvers.sweeping import SWEEPS


@dataclass(frozen=True)
class Anderson(Accelerated):
    """Anderson-accelerated sweeps; `order`, `ground` and `seed` as in `lavender.problem.ordering`."""

    convex: int | None = None
    memory: int = 5

    def __post_init__(self) -> None:
        check_int("memory", self.memory, 1, MAX_MEMORY)

    def _get_acceleration(self) -> tuple[int, bool]:
        return self.memory, False


SPEC = replace(
    SWEEPS,
    name="anderson",
    factory=Anderson,
    options={
        "sweep": SWEEP_OPTION,
        "convex": CONVEX_OPTION + "; default None: from 900 rows on up to 512, until contacts slip",
        "memory": "number of sweeps that are combined, from 1 to 16; default 5",
    },
    summary="Anderson acceleration of Gauss-Seidel sweeps",
    reference="Anderson 1965; Walker, Ni 2011; Zhang, O'Donoghue, Boyd 2020 (safeguards)",
)
