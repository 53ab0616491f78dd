"""What a phenomenon is, and what an engine gives of it: plain data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_float, check_int
from lavender.base.errors import InputError, UnknownName
from lavender.sim.scene import Scene

GRAVITY = 9.81  # m/s^2
Values = Mapping[str, float]


@dataclass(frozen=True)
class Parameter:
    """A number of a scene: default, range, meaning with unit. A default without a point is a count."""

    default: float
    low: float
    high: float
    text: str


@dataclass(frozen=True)
class Quantity:
    """A number that is measured, as distance from the truth; `bound` is the largest that passes."""

    name: str
    unit: str
    bound: float
    text: str  # what it is, and the reason of the bound


@dataclass(frozen=True, eq=False)
class Track:
    """What an engine did of a scene, sampled in equal times; bodies in the scene's order, static ones too."""

    time: FloatArray  # (k,) s, 0 first
    positions: FloatArray  # (k, n, 3) m
    quaternions: FloatArray  # (k, n, 4) w x y z
    velocities: FloatArray  # (k, n, 6) m/s, rad/s, world
    force: float = float("nan")  # N, of the first joint at the end, where the engine tells it
    cpu: float = float("nan")  # s of CPU for a second of simulation
    setting: str = ""  # step, substeps and sweeps, as run

    def moved(self, body: int) -> FloatArray:
        """Way of a body from where it began (k, 3) [m]."""
        way: FloatArray = self.positions[:, body] - self.positions[0, body]
        return way

    def axis(self, body: int, axis: int) -> FloatArray:
        """A body's own axis in the world (k, 3)."""
        from scipy.spatial.transform import Rotation

        turned: FloatArray = Rotation.from_quat(self.quaternions[:, body], scalar_first=True).as_matrix()[
            ..., axis
        ]
        return turned


@dataclass(frozen=True)
class Phenomenon:
    """A scene whose motion is known."""

    name: str
    title: str
    why: str  # it matters
    truth: str  # with its derivation
    parameters: Mapping[str, Parameter]
    cases: tuple[Values, ...]  # that a run measures
    quantities: tuple[Quantity, ...]  # the first stands in the table
    needs: frozenset[str]  # of an engine: "box", "sphere", "spin", "rolling", "ball joint", "hinge"
    # of parameters, and of what an engine asks of the scene
    build: Callable[[Values, Mapping[str, Any]], Scene]
    seconds: Callable[[Values], float]  # simulated
    measure: Callable[[Values, Track], dict[str, float]]
    interval: float = 1.0 / 60.0  # s between two samples

    def values(self, given: Mapping[str, Any] | None = None) -> dict[str, float]:
        """Every parameter, as given or by default.

        Raises
        ------
        UnknownName
            A parameter that it does not have.
        InputError
            A value outside its range.
        """
        given = given or {}
        for name in given:
            if name not in self.parameters:
                raise UnknownName(f"parameter of {self.name!r}", name, self.parameters)
        found: dict[str, float] = {}
        for name, p in self.parameters.items():
            label = f"{name} of {self.name!r} ({p.text})"
            x = given.get(name, p.default)
            if isinstance(p.default, int):
                found[name] = check_int(label, x, int(p.low), int(p.high))
            else:
                found[name] = check_float(label, x, low=p.low, high=p.high)
        return found

    def scene(self, given: Mapping[str, Any] | None = None, **more: Any) -> Scene:
        """The scene; `more`: parameters of every scene, such as dt and stepper."""
        return self.build(self.values(given), more)


@dataclass(frozen=True)
class Record:
    """One phenomenon in one engine with one case."""

    phenomenon: str
    engine: str
    case: dict[str, float]
    values: dict[str, float] = field(default_factory=dict)  # by name of quantity; nan: not told by the engine
    passed: bool = False
    cpu: float = float("nan")  # s of CPU for a second of simulation
    setting: str = ""
    note: str = ""  # why there are no values

    def value(self, name: str) -> float:
        """A measured number; nan without one."""
        return self.values.get(name, float("nan"))


def crossing(time: FloatArray, x: FloatArray, level: float) -> float:
    """Time at which x (k,) first falls below `level`, between two samples by a straight line; inf where it does not."""
    below = np.flatnonzero(x < level)
    if not len(below):
        return float("inf")
    i = int(below[0])
    if i == 0:
        return float(time[0])
    part = (x[i - 1] - level) / (x[i - 1] - x[i])
    return float(time[i - 1] + part * (time[i] - time[i - 1]))


# A body of a tower has fallen once it is lower than at its start by more than this share of an edge.
FALL_DROP_EDGES = 0.5


def has_fallen(start: FloatArray, now: FloatArray, edge: float = 1.0) -> bool:
    """Return whether a body of a tower has fallen, or is at no finite place.

    Parameters
    ----------
    start, now : (n, 3) m
        Centres of the bodies at the start and now.
    edge : float, m
        Height of one body.
    """
    return not (start[:, 2] - now[:, 2]).max() <= FALL_DROP_EDGES * edge


def judged(phenomenon: Phenomenon, engine: str, case: dict[str, float], track: Track) -> Record:
    """Measure a track. One with poses that are not finite is a note."""
    head: dict[str, Any] = {"phenomenon": phenomenon.name, "engine": engine, "case": case}
    head |= {"cpu": track.cpu, "setting": track.setting}
    bad = [
        ~np.isfinite(x).reshape(len(x), -1).all(axis=1)
        for x in (track.positions, track.quaternions, track.velocities)
    ]
    lost = np.flatnonzero(np.any(bad, axis=0))
    if len(lost):
        return Record(**head, note=f"poses are not finite from {track.time[lost[0]]:.3g} s on")
    if len(track.time) < 2:
        raise InputError(f"a track of {len(track.time)} samples; two are needed")
    values = {name: float(x) for name, x in phenomenon.measure(case, track).items()}
    passed = all(not values[q.name] > q.bound for q in phenomenon.quantities)
    return Record(**head, values=values, passed=passed)
