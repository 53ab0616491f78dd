"""Data types of phenomena: a phenomenon, its parameters and quantities, an engine's motion, and a record."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_float, check_int
from lavender.base.errors import InputError, UnknownName
from lavender.sim.scene import Scene

GRAVITY = 9.81  # [m/s^2]
Values = Mapping[str, float]


@dataclass(frozen=True)
class Parameter:
    """A scene parameter: default, range, and meaning with unit. A default of type int marks an integer parameter."""

    default: float
    low: float
    high: float
    text: str


@dataclass(frozen=True)
class Quantity:
    """A measured quantity of a phenomenon, expressed as its deviation from the exact value.

    Parameters
    ----------
    name, unit : str
    bound : float
        Largest value that passes.
    text : str
        Meaning, and the reason of the bound.
    """

    name: str
    unit: str
    bound: float
    text: str


@dataclass(frozen=True, eq=False)
class Track:
    """Motion of a scene in an engine at k equidistant times; the n bodies (also static ones) have the scene's order.

    Parameters
    ----------
    time : (k,) s
        Starts at 0.
    positions : (k, n, 3) m
    quaternions : (k, n, 4)
        w x y z.
    velocities : (k, n, 6) m/s, rad/s
        In the world frame.
    force : float, N
        Force of the first joint at the end; nan if the engine does not return it.
    cpu : float, s
        CPU time per second of simulation.
    setting : str
        Step, substeps and sweeps of the run.
    """

    time: FloatArray
    positions: FloatArray
    quaternions: FloatArray
    velocities: FloatArray
    force: float = float("nan")
    cpu: float = float("nan")
    setting: str = ""

    def compute_displacement(self, body: int) -> FloatArray:
        """Return the displacement (k, 3) [m] of a body from its initial position."""
        displacement: FloatArray = self.positions[:, body] - self.positions[0, body]
        return displacement

    def compute_body_axis(self, body: int, axis: int) -> FloatArray:
        """Return a body's axis (k, 3) in the world frame."""
        from scipy.spatial.transform import Rotation

        rotated: FloatArray = Rotation.from_quat(self.quaternions[:, body], scalar_first=True).as_matrix()[
            ..., axis
        ]
        return rotated


@dataclass(frozen=True)
class Phenomenon:
    """A scene with known motion.

    Parameters
    ----------
    name, title : str
    why : str
        Reason why it matters.
    truth : str
        The exact motion and its derivation.
    parameters : mapping of str to Parameter
    cases : tuple of mappings
        Parameter values that a run measures.
    quantities : tuple of Quantity
        Measured quantities; the table of all phenomena shows the first.
    needs : frozenset of str
        Features that an engine must have: "box", "sphere", "spin", "rolling", "ball joint", "hinge".
    build : callable
        Builds the scene from parameter values and from scene parameters that the engine prescribes.
    seconds : callable
        Returns the duration to simulate [s] for parameter values.
    measure : callable
        Computes the quantities from a track.
    interval : float, s
        Time between two samples.
    """

    name: str
    title: str
    why: str
    truth: str
    parameters: Mapping[str, Parameter]
    cases: tuple[Values, ...]
    quantities: tuple[Quantity, ...]
    needs: frozenset[str]
    build: Callable[[Values, Mapping[str, Any]], Scene]
    seconds: Callable[[Values], float]
    measure: Callable[[Values, Track], dict[str, float]]
    interval: float = 1.0 / 60.0

    def complete_parameters(self, overrides: Mapping[str, Any] | None = None) -> dict[str, float]:
        """Return the values of all parameters: defaults replaced by `overrides`.

        Raises
        ------
        UnknownName
            A name is not a parameter of this phenomenon.
        InputError
            A value is outside its range.
        """
        overrides = overrides or {}
        for name in overrides:
            if name not in self.parameters:
                raise UnknownName(f"parameter of {self.name!r}", name, self.parameters)
        values: dict[str, float] = {}
        for name, p in self.parameters.items():
            label = f"{name} of {self.name!r} ({p.text})"
            x = overrides.get(name, p.default)
            if isinstance(p.default, int):
                values[name] = check_int(label, x, int(p.low), int(p.high))
            else:
                values[name] = check_float(label, x, low=p.low, high=p.high)
        return values

    def build_scene(self, overrides: Mapping[str, Any] | None = None, **more: Any) -> Scene:
        """Build the scene; `more` holds parameters that all scenes have, such as dt and stepper."""
        return self.build(self.complete_parameters(overrides), more)


@dataclass(frozen=True)
class Record:
    """One case of a phenomenon in one engine.

    Parameters
    ----------
    phenomenon, engine : str
    case : dict
        Parameter values.
    values : dict
        Measured quantities by name; a quantity that the engine does not return is nan.
    passed : bool
        All quantities are within their bounds.
    cpu : float, s
        CPU time per second of simulation.
    setting : str
        Step, substeps and sweeps of the run.
    note : str
        Reason why there are no values.
    """

    phenomenon: str
    engine: str
    case: dict[str, float]
    values: dict[str, float] = field(default_factory=dict)
    passed: bool = False
    cpu: float = float("nan")
    setting: str = ""
    note: str = ""

    def get_value(self, name: str) -> float:
        """Return a measured number, nan if there is none."""
        return self.values.get(name, float("nan"))


def find_crossing_time(time: FloatArray, x: FloatArray, level: float) -> float:
    """Compute the time at which x (k,) first falls below `level`, by linear interpolation; inf if it does not."""
    below = np.flatnonzero(x < level)
    if not len(below):
        return float("inf")
    i = int(below[0])
    if i == 0:
        return float(time[0])
    fraction = (x[i - 1] - level) / (x[i - 1] - x[i])
    return float(time[i - 1] + fraction * (time[i] - time[i - 1]))


# A body of a tower has fallen if it is lower than at its start by more than this fraction of an edge.
FALL_DROP_EDGES = 0.5


def has_fallen(start: FloatArray, now: FloatArray, edge: float = 1.0) -> bool:
    """Return whether a body of a tower has fallen, or its position is not finite.

    Parameters
    ----------
    start, now : (n, 3) m
        Centres of the bodies at the start and now.
    edge : float, m
        Height of one body.
    """
    return not (start[:, 2] - now[:, 2]).max() <= FALL_DROP_EDGES * edge


def measure_track(phenomenon: Phenomenon, engine: str, case: dict[str, float], track: Track) -> Record:
    """Measure the quantities of a track; if poses are not finite, the record has a note instead."""
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
        raise InputError(f"the track has {len(track.time)} samples; at least two are needed")
    values = {name: float(x) for name, x in phenomenon.measure(case, track).items()}
    passed = all(not values[q.name] > q.bound for q in phenomenon.quantities)
    return Record(**head, values=values, passed=passed)
