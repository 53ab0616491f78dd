"""Phenomena of friction: stick, slide, stop, lift, roll, roll to rest, spin down."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lavender.lab.phenomena.parts import (
    GRAVITY,
    Parameter,
    Phenomenon,
    Quantity,
    Track,
    Values,
    find_crossing_time,
)
from lavender.sim.scene import Scene

FRICTION_PARAMETER = Parameter(0.5, 0.05, 2.0, "coefficient of friction [-]")
SPEED_PARAMETER = Parameter(3.0, 0.1, 10.0, "initial speed [m/s]")
# [m] Size of the block, so low that it does not tip at friction coefficients up to 5.
BLOCK_SIZE = (1.0, 1.0, 0.2)
RADIUS = 0.5  # [m] Radius of the ball.
PATCH_RADIUS = 0.1  # [m] Radius of the contact patch.
ROLLING_RADIUS = 0.02  # [m] Coefficient of rolling friction, mu_r.


def _build_block_on_slope(p: Values, more: Mapping[str, Any]) -> Scene:
    """Build a block on a slope: gravity is inclined and the plane level, so that no engine rounds a rotated plane."""
    angle = math.atan(p["slope"] * p["mu"])
    gravity = (GRAVITY * math.sin(angle), 0.0, -GRAVITY * math.cos(angle))
    scene = Scene(**{"gravity": gravity, "friction": p["mu"], **more})
    scene.add_plane()
    scene.add_box(BLOCK_SIZE, position=(0.0, 0.0, 0.5 * BLOCK_SIZE[2]))
    return scene


def _measure_creep(p: Values, track: Track) -> dict[str, float]:
    """Measure the speed of creep over the last two seconds."""
    x, late = track.compute_displacement(1), int(np.searchsorted(track.time, track.time[-1] - 2.0 - 1e-9))
    return {"creep": float(np.linalg.norm(x[-1] - x[late])) / float(track.time[-1] - track.time[late])}


def _measure_acceleration(p: Values, track: Track) -> dict[str, float]:
    """Measure the error of the acceleration along the slope, and whether the block wrongly sticks or slides."""
    angle = math.atan(p["slope"] * p["mu"])
    truth = max(0.0, GRAVITY * (math.sin(angle) - p["mu"] * math.cos(angle)))
    late = track.time >= 0.25 - 1e-9
    acceleration = float(np.polyfit(track.time[late], track.velocities[late, 1, 0], 1)[0])
    middle = 0.5 * GRAVITY * abs(math.sin(angle) - p["mu"] * math.cos(angle))
    wrong = abs(acceleration) >= middle if p["slope"] < 1.0 else acceleration <= middle
    return {"acceleration": abs(acceleration - truth), "wrong side": float(wrong)}


def _build_sliding_block(p: Values, more: Mapping[str, Any]) -> Scene:
    """Build a block that slides on a level plane."""
    scene = Scene(**{"friction": p["mu"], **more})
    scene.add_plane()
    scene.add_box(BLOCK_SIZE, position=(0.0, 0.0, 0.5 * BLOCK_SIZE[2]), velocity=(p["speed"], 0.0, 0.0))
    return scene


def _compute_stop_time(p: Values) -> float:
    """Return the exact time [s] until the block stops."""
    return p["speed"] / (p["mu"] * GRAVITY)


def _measure_stop(p: Values, track: Track) -> dict[str, float]:
    """Measure the errors of the stopping distance and time, and the speed at rest."""
    truth = p["speed"] ** 2 / (2 * p["mu"] * GRAVITY)
    speed = track.velocities[:, 1, 0]
    stopped = find_crossing_time(track.time, speed, 0.1 * p["speed"]) / 0.9
    last = track.time >= track.time[-1] - 0.5
    x = track.compute_displacement(1)[:, 0]
    rest = np.ptp(x[last]) / np.ptp(track.time[last])
    return {
        "distance": abs(x[-1] / truth - 1.0),
        "time": abs(stopped - _compute_stop_time(p)),
        "speed at rest": rest,
    }


def _measure_lift(p: Values, track: Track) -> dict[str, float]:
    """Measure the largest height of the block above the plane while it slides."""
    slides = track.time <= 0.9 * _compute_stop_time(p)
    return {"lift": max(0.0, float(track.compute_displacement(1)[slides, 2].max()))}


def _build_sliding_ball(p: Values, more: Mapping[str, Any]) -> Scene:
    """Build a ball that slides on a level plane."""
    scene = Scene(**{"friction": p["mu"], **more})
    scene.add_plane()
    scene.add_sphere(RADIUS, position=(0.0, 0.0, RADIUS), velocity=(p["speed"], 0.0, 0.0))
    return scene


def _measure_roll(p: Values, track: Track) -> dict[str, float]:
    """Measure the errors of the rolling speed and of the time until the ball rolls."""
    speed, spin = track.velocities[:, 1, 0], track.velocities[:, 1, 4]
    slip = speed - RADIUS * spin
    # The slip speed falls linearly from v to 0.
    time = find_crossing_time(track.time, slip, 0.1 * p["speed"]) / 0.9
    return {
        "speed": abs(speed[-1] / (5 / 7 * p["speed"]) - 1.0),
        "time": abs(time - 2 * p["speed"] / (7 * p["mu"] * GRAVITY)),
    }


def _build_rolling_ball(p: Values, more: Mapping[str, Any]) -> Scene:
    """Build a ball that rolls on a level plane with rolling friction."""
    scene = Scene(**{"friction": p["mu"], "rolling_radius": p["rolling"], **more})
    scene.add_plane()
    angular_velocity = (0.0, p["speed"] / RADIUS, 0.0)
    scene.add_sphere(
        RADIUS,
        position=(0.0, 0.0, RADIUS),
        velocity=(p["speed"], 0.0, 0.0),
        angular_velocity=angular_velocity,
    )
    return scene


def _compute_rolling_time(p: Values) -> float:
    """Return the exact time [s] until the ball stops: twice the distance over the speed, as it slows uniformly."""
    return 7 * RADIUS * p["speed"] / (5 * p["rolling"] * GRAVITY)


def _measure_roll_to_rest(p: Values, track: Track) -> dict[str, float]:
    """Measure the error of the rolling distance, and the speed that is left."""
    truth = 7 * RADIUS * p["speed"] ** 2 / (10 * p["rolling"] * GRAVITY)
    return {
        "distance": abs(float(track.compute_displacement(1)[-1, 0]) / truth - 1.0),
        "left": abs(float(track.velocities[-1, 1, 0])),
    }


def _build_spinning_ball(p: Values, more: Mapping[str, Any]) -> Scene:
    """Build a ball that spins on a level plane with torsional friction."""
    scene = Scene(**{"friction": p["mu"], "patch_radius": p["patch"], **more})
    scene.add_plane()
    scene.add_sphere(RADIUS, position=(0.0, 0.0, RADIUS), angular_velocity=(0.0, 0.0, p["spin"]))
    return scene


def _compute_spin_time(p: Values) -> float:
    """Return the exact time [s] until the spin stops: I = 2/5 m R^2, torque mu r m g."""
    return p["spin"] * 0.4 * RADIUS**2 / (p["mu"] * p["patch"] * GRAVITY)


def _measure_spin_down(p: Values, track: Track) -> dict[str, float]:
    """Measure the error of the spin over time, and the spin that is left."""
    truth = p["spin"] * np.maximum(0.0, 1.0 - track.time / _compute_spin_time(p))
    spin = track.velocities[:, 1, 5]
    return {"spin": float(np.abs(spin - truth).max()) / p["spin"], "left": abs(float(spin[-1]))}


FRICTION_PHENOMENA = (
    Phenomenon(
        name="stick",
        title="a block on a slope below its angle of friction",
        why="objects that are put down must stay: on shelves, in grasps, in parking spaces",
        truth="0: friction m g sin(theta) needs less than mu m g cos(theta) while tan(theta) < mu",
        parameters={"mu": FRICTION_PARAMETER, "slope": Parameter(0.9, 0.0, 0.99, "tan(theta)/mu [-]")},
        cases=({"slope": 0.5}, {"slope": 0.9}, {"slope": 0.98}),
        quantities=(Quantity("creep", "m/s", 1e-6, "speed over the last 2 of 4 s; 1e-6 is 9 cm a day"),),
        needs=frozenset({"box"}),
        build=_build_block_on_slope,
        seconds=lambda p: 4.0,
        measure=_measure_creep,
    ),
    Phenomenon(
        name="slide",
        title="a block on a slope, over a grid of friction and slope",
        why="friction is measured by the angle at which a body begins to slide",
        truth="a = g (sin(theta) - mu cos(theta)) above the angle of friction by Newton's law along the slope, else 0",
        parameters={"mu": FRICTION_PARAMETER, "slope": Parameter(1.2, 0.0, 2.0, "tan(theta)/mu [-]")},
        cases=tuple({"mu": mu, "slope": s} for mu in (0.2, 0.5, 1.0) for s in (0.9, 0.99, 1.01, 1.1, 1.5)),
        quantities=(
            Quantity("acceleration", "m/s^2", 1e-2, "distance from the exact value; 1e-2 is 0.1 % of g"),
            Quantity("wrong side", "", 0.0, "1 if it sticks and should slide, or slides and should stick"),
        ),
        needs=frozenset({"box"}),
        build=_build_block_on_slope,
        seconds=lambda p: 1.5,
        measure=_measure_acceleration,
    ),
    Phenomenon(
        name="stop",
        title="a sliding block comes to rest",
        why="a pushing robot plans by the position at which a pushed object stops",
        truth="v^2/(2 mu g) after v/(mu g), as m v^2/2 = mu m g s; afterwards at rest",
        parameters={"mu": FRICTION_PARAMETER, "speed": SPEED_PARAMETER},
        cases=({}, {"mu": 0.2, "speed": 1.0}, {"mu": 1.0, "speed": 5.0}),
        quantities=(
            Quantity("distance", "", 0.02, "relative; first order in a step of 1/60 s is 1 to 3 %"),
            Quantity("time", "s", 1 / 60, "one step"),
            Quantity("speed at rest", "m/s", 1e-5, "over the last 0.5 s"),
        ),
        needs=frozenset({"box"}),
        build=_build_sliding_block,
        seconds=lambda p: _compute_stop_time(p) + 1.0,
        measure=_measure_stop,
    ),
    Phenomenon(
        name="lift",
        title="height of a sliding block above its plane",
        why="the convex relaxation of friction lets a sliding contact open at mu times its speed",
        truth="0: no force acts upwards, m g acts downwards",
        parameters={"mu": FRICTION_PARAMETER, "speed": SPEED_PARAMETER},
        cases=({}, {"mu": 1.0, "speed": 5.0}),
        quantities=(Quantity("lift", "m", 1e-4, "largest value while it slides; a tenth of the slop"),),
        needs=frozenset({"box"}),
        build=_build_sliding_block,
        seconds=_compute_stop_time,
        measure=_measure_lift,
    ),
    Phenomenon(
        name="roll",
        title="a ball slides until it rolls",
        why="bowling, billiards, wheels that spin",
        truth=(
            "5/7 v after 2 v/(7 mu g): v falls by mu g t and R omega grows by 5/2 mu g t until they meet; angular "
            "momentum about the point of contact is kept"
        ),
        parameters={"mu": FRICTION_PARAMETER, "speed": SPEED_PARAMETER},
        cases=({}, {"mu": 0.1, "speed": 3.0}, {"mu": 1.0, "speed": 10.0}),
        quantities=(
            Quantity("speed", "", 0.01, "relative, one second after it should roll"),
            Quantity("time", "s", 1 / 60, "one step"),
        ),
        needs=frozenset({"sphere"}),
        build=_build_sliding_ball,
        seconds=lambda p: 2 * p["speed"] / (7 * p["mu"] * GRAVITY) + 1.0,
        measure=_measure_roll,
    ),
    Phenomenon(
        name="roll_to_rest",
        title="a rolling ball comes to rest",
        why="tyres, balls on a lawn, wheels in gravel: without rolling friction nothing that rolls comes to rest",
        truth=(
            "after 7 R v^2/(10 mu_r g): rolling without slip it has 7/10 m v^2, and the moment mu_r m g takes "
            "mu_r m g/R of it on each metre; the disk holds as long as mu_r/R <= 7/5 mu"
        ),
        parameters={
            "mu": FRICTION_PARAMETER,
            "rolling": Parameter(ROLLING_RADIUS, 1e-3, 0.03, "mu_r [m]"),
            "speed": Parameter(2.0, 0.1, 10.0, "initial speed [m/s]"),
        },
        cases=({}, {"mu": 1.0, "rolling": 0.03, "speed": 3.0}),
        quantities=(
            Quantity("distance", "", 0.02, "relative"),
            Quantity("left", "m/s", 1e-3, "speed half a second after it should have stopped"),
        ),
        needs=frozenset({"sphere", "rolling"}),
        build=_build_rolling_ball,
        seconds=lambda p: _compute_rolling_time(p) + 0.5,
        measure=_measure_roll_to_rest,
    ),
    Phenomenon(
        name="spin_down",
        title="a ball spins on the spot, on a patch",
        why="soft fingers and tyres resist rotation; without torsional friction nothing that spins comes to rest",
        truth="omega falls linearly at mu r m g/I: the patch of radius r carries the torque mu r m g",
        parameters={
            "mu": FRICTION_PARAMETER,
            "patch": Parameter(PATCH_RADIUS, 1e-3, 1.0, "radius of the patch [m]"),
            "spin": Parameter(10.0, 0.1, 100.0, "initial spin [rad/s]"),
        },
        cases=({}, {"mu": 1.0, "spin": 30.0}),
        quantities=(
            Quantity(
                "spin", "", 0.02, "largest distance from the linear decay, relative to the initial spin"
            ),
            Quantity("left", "rad/s", 1e-3, "half a second after it should have stopped"),
        ),
        needs=frozenset({"sphere", "spin"}),
        build=_build_spinning_ball,
        seconds=lambda p: _compute_spin_time(p) + 0.5,
        measure=_measure_spin_down,
    ),
)
