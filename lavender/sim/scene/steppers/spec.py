"""What a stepper is and can do, as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lavender.base.arrays import number, whole_number
from lavender.base.errors import InputError, UnknownName


@dataclass(frozen=True)
class Option:
    """A number of a stepper: where it stands in the engine's arrays, its default and its range."""

    place: str  # of `setting`, or of `head` for a whole number
    default: float
    low: float
    high: float
    text: str  # meaning and unit

    @property
    def is_whole(self) -> bool:
        """Whether it is a count."""
        return isinstance(self.default, int)


@dataclass(frozen=True)
class StepperSpec:
    """One way to step: its number in the kernels, and what a scene may ask of it."""

    name: str
    number: int  # H_STEPPER of lavender_ext/engine/arrays.pxd
    summary: str
    reference: str
    sweeps: tuple[int, int]  # least and largest `solver_iterations`
    order: str  # default sweep order of a scene
    position_iterations: int  # default; 0: it has no position projection
    solvers: bool = False  # another solver may take the place of its sweeps
    spin: bool = False  # friction of a patch against spinning
    rolling: bool = False  # friction against rolling
    boxes: bool = False  # friction of each tangent by itself, Scene(friction_shape="box")
    restitution: bool = True
    residuals: bool = True  # `observation["solver"]` holds residuals; else NaN
    exact_problem: bool = False  # `constraint_problem()` solved by sequential_impulses gives the step's bits
    options: Mapping[str, Option] = field(default_factory=dict)

    def values(self, given: Mapping[str, Any]) -> dict[str, float]:
        """Every option, as given or by default."""
        for name in given:
            if name not in self.options:
                raise UnknownName(f"option of stepper {self.name!r}", name, self.options)
        found: dict[str, float] = {}
        for name, option in self.options.items():
            x = given.get(name, option.default)
            label = f"{name} of stepper {self.name!r}"
            if option.is_whole:
                found[name] = whole_number(label, x, int(option.low), int(option.high))
            else:
                found[name] = number(label, x, low=option.low, high=option.high)
        return found

    def refuses(self, spin: bool, restitution: bool, rolling: bool = False) -> str | None:
        """None where it takes a scene with these, else the reason."""
        if spin and not self.spin:
            return f"stepper {self.name!r} has no spin friction; leave patch_radius at 0, or take 'impulses'"
        if rolling and not self.rolling:
            return f"stepper {self.name!r} has no rolling friction; leave rolling_radius at 0, or take 'impulses'"
        if restitution and not self.restitution:
            return f"stepper {self.name!r} has no restitution; leave it at 0, or take another stepper"
        return None

    def check(self, spin: bool, restitution: bool, rolling: bool) -> None:
        """Raise `InputError` where it does not take a scene with these."""
        reason = self.refuses(spin, restitution, rolling)
        if reason:
            raise InputError(reason)
