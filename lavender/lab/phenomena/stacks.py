"""Phenomena of bodies that stand or fall: tipping, overhang, a heavy box on light ones, an arch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lavender.lab.phenomena.analytic_solutions import compute_min_arch_thickness, compute_tipping_time
from lavender.lab.phenomena.parts import (
    GRAVITY,
    Parameter,
    Phenomenon,
    Quantity,
    Track,
    Values,
    find_crossing_time,
    has_fallen,
)
from lavender.sim.scene import Scene
from lavender.sim.scene.parts import make_quaternion

TIP_ANGLE = 0.5  # [rad] Tilt at which a box counts as tipped.
BRICK_SIZE = (1.0, 0.5, 0.25)  # [m] Length, width and height of a brick.
MAX_STANDING_DROP = 0.1  # [m] A stack or arch has fallen if a brick or stone ends lower by more than this.
WRONG_TIPPING = Quantity("wrong side", "", 0.0, "1 if it tips and should stand, or stands and should tip")
WRONG_DROP = Quantity(
    "wrong side", "", 0.0, "1 if it drops by 0.1 m and should stand, or stands and should drop"
)


def _build_tall_box(p: Values, more: Mapping[str, Any]) -> Scene:
    """Build a tall box on a slope, as a level plane with inclined gravity."""
    angle = math.atan(p["slope"] * p["width"])
    gravity = (GRAVITY * math.sin(angle), 0.0, -GRAVITY * math.cos(angle))
    scene = Scene(**{"gravity": gravity, "friction": 2.0, **more})
    scene.add_plane()
    scene.add_box((p["width"], p["width"], 1.0), position=(0.0, 0.0, 0.5))
    return scene


def _measure_tipping(p: Values, track: Track) -> dict[str, float]:
    """Measure the error of the time to tip, and whether the box wrongly tips or stands."""
    up = track.compute_body_axis(1, 2)
    tilt = np.arctan2(np.hypot(up[:, 0], up[:, 1]), up[:, 2])
    truth = compute_tipping_time(p["width"], 1.0, p["slope"] * p["width"], TIP_ANGLE)
    if p["slope"] < 1.0:
        return {"time": 0.0, "wrong side": float(tilt.max() >= TIP_ANGLE)}
    time = find_crossing_time(track.time, -tilt, -TIP_ANGLE)
    return {"time": abs(time - truth), "wrong side": float(time == math.inf)}


def _build_overhanging_bricks(p: Values, more: Mapping[str, Any]) -> Scene:
    """Build bricks on each other: from the top down, brick k overhangs the next one by 1/(2 k) of its length."""
    scene = Scene(**{"gravity": GRAVITY, "friction": 0.5, **more})
    scene.add_plane()
    n, x = int(p["bricks"]), 0.0
    for i in range(n):
        scene.add_box(BRICK_SIZE, position=(x, 0.0, (i + 0.5) * BRICK_SIZE[2]))
        if i < n - 1:
            x += p["reach"] * BRICK_SIZE[0] / (2 * (n - 1 - i))
    return scene


def _measure_overhang(p: Values, track: Track) -> dict[str, float]:
    """Measure the drop of the top brick, and whether it wrongly drops or stands."""
    drop = max(0.0, -float(track.compute_displacement(track.positions.shape[1] - 1)[-1, 2]))
    return {
        "drop": drop if p["reach"] < 1.0 else 0.0,
        "wrong side": float((drop > MAX_STANDING_DROP) != (p["reach"] > 1.0)),
    }


def _build_heavy_on_light(p: Values, more: Mapping[str, Any]) -> Scene:
    """Build a heavy box on light ones."""
    return Scene(
        "heavy_on_light", n=int(p["boxes"]), ratio=p["ratio"], **{"gravity": GRAVITY, "friction": 0.5, **more}
    )


def _measure_loaded_stack(p: Values, track: Track) -> dict[str, float]:
    """Measure how far boxes sink, and whether one falls."""
    sink = float((track.positions[0] - track.positions[-1])[:, 2].max())
    return {"sink": max(0.0, sink), "fell": float(has_fallen(track.positions[0], track.positions[-1]))}


def _build_arch(p: Values, more: Mapping[str, Any]) -> Scene:
    """Build a pointed arch of stones between two inclined planes."""
    lean, half = math.atan(p["lean"]), int(p["stones"]) // 2
    thick = p["thickness"] * compute_min_arch_thickness(half, lean)
    s, c = math.sin(lean), math.cos(lean)
    scene = Scene(**{"gravity": GRAVITY, "friction": 1.0, **more})
    scene.add_plane((s, 0.0, c))
    scene.add_plane((-s, 0.0, c))
    foot = half * s + 0.5 * thick * c  # Horizontal distance from the apex to the centre of a foot.
    for side in (-1.0, 1.0):
        for i in range(half):
            # The centre of the foot is on its skewback, at a height of the horizontal distance times tan(lean).
            x, z = side * (foot - (i + 0.5) * s), foot * s / c + (i + 0.5) * c
            scene.add_box(
                (thick, 1.0, 1.0),
                position=(x, 0.0, z),
                quaternion=make_quaternion((0.0, 1.0, 0.0), -side * lean),
            )
    return scene


def _measure_arch(p: Values, track: Track) -> dict[str, float]:
    """Measure the largest drop of a stone, and whether the arch wrongly falls or stands."""
    drop = max(0.0, -float((track.positions - track.positions[:1])[-1, :, 2].min()))
    stands = p["thickness"] > 1.0
    return {"drop": drop if stands else 0.0, "wrong side": float((drop > MAX_STANDING_DROP) != (not stands))}


STACK_PHENOMENA = (
    Phenomenon(
        name="tipping",
        title="a tall box on a slope, rough enough not to slide",
        why="whether a body tips or slides matters for every push of a robot and every loaded lorry",
        truth=(
            "it tips if tan(theta) > w/h: its weight passes outside its base; the time to 0.5 rad "
            "by the integral of energy about the edge"
        ),
        parameters={
            "width": Parameter(0.5, 0.1, 1.0, "over its height of 1 m [-]"),
            "slope": Parameter(1.1, 0.5, 2.0, "tan(theta) over w/h [-]"),
        },
        cases=({"slope": 0.95}, {"slope": 0.98}, {"slope": 1.02}, {"slope": 1.1}),
        quantities=(
            Quantity("time", "s", 0.05, "distance from the time to tip by 0.5 rad; three samples"),
            WRONG_TIPPING,
        ),
        needs=frozenset({"box"}),
        build=_build_tall_box,
        seconds=lambda p: min(
            5.0, 1.0 + compute_tipping_time(p["width"], 1.0, p["slope"] * p["width"], TIP_ANGLE)
        ),
        measure=_measure_tipping,
    ),
    Phenomenon(
        name="overhang",
        title="bricks that reach over one another",
        why="contacts loaded on an edge: an engine that sinks or shrinks its boxes loses them",
        truth="n bricks stand if they overhang at most sum of 1/(2 k), k = 1 ... n - 1: the centre is over each edge",
        parameters={
            "reach": Parameter(0.98, 0.5, 1.5, "overhang over the largest one [-]"),
            "bricks": Parameter(5, 2, 20, "number of them"),
        },
        cases=(
            {"reach": 0.98},
            {"reach": 1.02},
            {"reach": 0.98, "bricks": 10},
            {"reach": 1.02, "bricks": 10},
        ),
        quantities=(Quantity("drop", "m", 0.01, "of the top brick in 10 s, if it should stand"), WRONG_DROP),
        needs=frozenset({"box"}),
        build=_build_overhanging_bricks,
        seconds=lambda p: 10.0,
        measure=_measure_overhang,
    ),
    Phenomenon(
        name="stack_load",
        title="a heavy box on light ones for a minute",
        why="a robot on a crate, a press on a part: sweeps leave R/(1 + R) of the error",
        truth="it stays in place: every contact carries the weight above it",
        parameters={
            "ratio": Parameter(100.0, 1.0, 1e4, "mass of the top over that of the others [-]"),
            "boxes": Parameter(3, 2, 20, "number of them"),
        },
        cases=({"ratio": 1.0}, {"ratio": 100.0}, {"ratio": 1e4}),
        quantities=(
            Quantity("sink", "m", 0.01, "largest drop of a box at the end; a hundredth of its edge"),
            Quantity("fell", "", 0.0, "1 if a box ends half an edge lower than it started"),
        ),
        needs=frozenset({"box"}),
        build=_build_heavy_on_light,
        seconds=lambda p: 60.0,
        measure=_measure_loaded_stack,
        interval=0.1,
    ),
    Phenomenon(
        name="arch",
        title="a pointed arch of stones without mortar",
        why="it stands by thrust alone: the contacts of a whole structure must be correct at once",
        truth=(
            "limit analysis: it stands if one thrust keeps the resultant inside every joint "
            "(`analytic_solutions.compute_pointed_arch_thrust_bounds`); the thinnest such arch is the unit of thickness"
        ),
        parameters={
            "thickness": Parameter(1.1, 0.5, 2.0, "over the thinnest that stands [-]"),
            "stones": Parameter(8, 2, 20, "number of them; an odd number is rounded down"),
            "lean": Parameter(0.5, 0.2, 0.9, "tangent of a leg's angle from upright [-]"),
        },
        cases=({"thickness": 1.1}, {"thickness": 0.9}, {"thickness": 1.05}, {"thickness": 0.95}),
        quantities=(
            Quantity("drop", "m", 0.05, "largest of a stone in 10 s, if it should stand"),
            WRONG_DROP,
        ),
        needs=frozenset({"box"}),
        build=_build_arch,
        seconds=lambda p: 10.0,
        measure=_measure_arch,
    ),
)
