"""Phenomena of what stands and falls: tipping, overhang, a heavy box on light ones, an arch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lavender.lab.phenomena.analytic_solutions import thinnest_arch, tipping_time
from lavender.lab.phenomena.parts import (
    GRAVITY,
    Parameter,
    Phenomenon,
    Quantity,
    Track,
    Values,
    crossing,
    has_fallen,
)
from lavender.sim.scene import Scene
from lavender.sim.scene.parts import quaternion

TIPPED = 0.5  # rad
BRICK = (1.0, 0.5, 0.25)  # m
MAX_STANDING_DROP = 0.1  # m: a brick or stone that ends lower than this does not stand.
TIPS = Quantity("wrong side", "", 0.0, "1 if it tips and should stand, or stands and should tip")
DROPS = Quantity("wrong side", "", 0.0, "1 if it drops by 0.1 m and should stand, or stands and should drop")


def _tall(p: Values, more: Mapping[str, Any]) -> Scene:
    angle = math.atan(p["slope"] * p["width"])
    gravity = (GRAVITY * math.sin(angle), 0.0, -GRAVITY * math.cos(angle))
    scene = Scene(**{"gravity": gravity, "friction": 2.0, **more})
    scene.add_plane()
    scene.add_box((p["width"], p["width"], 1.0), position=(0.0, 0.0, 0.5))
    return scene


def _tipping(p: Values, track: Track) -> dict[str, float]:
    up = track.axis(1, 2)
    tilt = np.arctan2(np.hypot(up[:, 0], up[:, 1]), up[:, 2])
    truth = tipping_time(p["width"], 1.0, p["slope"] * p["width"], TIPPED)
    if p["slope"] < 1.0:
        return {"time": 0.0, "wrong side": float(tilt.max() >= TIPPED)}
    time = crossing(track.time, -tilt, -TIPPED)
    return {"time": abs(time - truth), "wrong side": float(time == math.inf)}


def _bricks(p: Values, more: Mapping[str, Any]) -> Scene:
    # from the top down each reaches 1/(2 k) of its length over the next
    scene = Scene(**{"gravity": GRAVITY, "friction": 0.5, **more})
    scene.add_plane()
    n, x = int(p["bricks"]), 0.0
    for i in range(n):
        scene.add_box(BRICK, position=(x, 0.0, (i + 0.5) * BRICK[2]))
        if i < n - 1:
            x += p["reach"] * BRICK[0] / (2 * (n - 1 - i))
    return scene


def _overhang(p: Values, track: Track) -> dict[str, float]:
    drop = max(0.0, -float(track.moved(track.positions.shape[1] - 1)[-1, 2]))
    return {
        "drop": drop if p["reach"] < 1.0 else 0.0,
        "wrong side": float((drop > MAX_STANDING_DROP) != (p["reach"] > 1.0)),
    }


def _heavy(p: Values, more: Mapping[str, Any]) -> Scene:
    return Scene(
        "heavy_on_light", n=int(p["boxes"]), ratio=p["ratio"], **{"gravity": GRAVITY, "friction": 0.5, **more}
    )


def _loaded(p: Values, track: Track) -> dict[str, float]:
    sink = float((track.positions[0] - track.positions[-1])[:, 2].max())
    return {"sink": max(0.0, sink), "fell": float(has_fallen(track.positions[0], track.positions[-1]))}


def _arch(p: Values, more: Mapping[str, Any]) -> Scene:
    lean, half = math.atan(p["lean"]), int(p["stones"]) // 2
    thick = p["thickness"] * thinnest_arch(half, lean)
    s, c = math.sin(lean), math.cos(lean)
    scene = Scene(**{"gravity": GRAVITY, "friction": 1.0, **more})
    scene.add_plane((s, 0.0, c))
    scene.add_plane((-s, 0.0, c))
    foot = half * s + 0.5 * thick * c  # level way from the apex to the middle of a foot
    for side in (-1.0, 1.0):
        for i in range(half):
            # the foot's middle lies on its skewback, whose height is level way times tan(lean)
            x, z = side * (foot - (i + 0.5) * s), foot * s / c + (i + 0.5) * c
            scene.add_box(
                (thick, 1.0, 1.0), position=(x, 0.0, z), quaternion=quaternion((0.0, 1.0, 0.0), -side * lean)
            )
    return scene


def _arch_stands(p: Values, track: Track) -> dict[str, float]:
    drop = max(0.0, -float((track.positions - track.positions[:1])[-1, :, 2].min()))
    stands = p["thickness"] > 1.0
    return {"drop": drop if stands else 0.0, "wrong side": float((drop > MAX_STANDING_DROP) != (not stands))}


STACKS = (
    Phenomenon(
        name="tipping",
        title="a tall box on a slope, rough enough not to slide",
        why="what tips and what slides decides every push of a robot and every loaded lorry",
        truth=(
            "it tips where tan(theta) > w/h: its weight passes outside its foot; the time to 0.5 rad "
            "by the integral of energy about the edge"
        ),
        parameters={
            "width": Parameter(0.5, 0.1, 1.0, "over its height of 1 m [-]"),
            "slope": Parameter(1.1, 0.5, 2.0, "tan(theta) over w/h [-]"),
        },
        cases=({"slope": 0.95}, {"slope": 0.98}, {"slope": 1.02}, {"slope": 1.1}),
        quantities=(
            Quantity("time", "s", 0.05, "distance from the time to tip by 0.5 rad; three samples"),
            TIPS,
        ),
        needs=frozenset({"box"}),
        build=_tall,
        seconds=lambda p: min(5.0, 1.0 + tipping_time(p["width"], 1.0, p["slope"] * p["width"], TIPPED)),
        measure=_tipping,
    ),
    Phenomenon(
        name="overhang",
        title="bricks that reach over one another",
        why="contacts loaded on an edge: an engine that sinks or shrinks its boxes loses them",
        truth="n bricks stand while they reach at most sum of 1/(2 k), k = 1 ... n - 1: the centre over each edge",
        parameters={
            "reach": Parameter(0.98, 0.5, 1.5, "over the longest [-]"),
            "bricks": Parameter(5, 2, 20, "number of them"),
        },
        cases=(
            {"reach": 0.98},
            {"reach": 1.02},
            {"reach": 0.98, "bricks": 10},
            {"reach": 1.02, "bricks": 10},
        ),
        quantities=(Quantity("drop", "m", 0.01, "of the top brick in 10 s, where it should stand"), DROPS),
        needs=frozenset({"box"}),
        build=_bricks,
        seconds=lambda p: 10.0,
        measure=_overhang,
    ),
    Phenomenon(
        name="stack_load",
        title="a heavy box on light ones, a minute",
        why="a robot on a crate, a press on a part: sweeps leave R/(1 + R) of the error",
        truth="it stays where it was put: every contact carries the weight above it",
        parameters={
            "ratio": Parameter(100.0, 1.0, 1e4, "mass of the top over that of the others [-]"),
            "boxes": Parameter(3, 2, 20, "number of them"),
        },
        cases=({"ratio": 1.0}, {"ratio": 100.0}, {"ratio": 1e4}),
        quantities=(
            Quantity("sink", "m", 0.01, "largest of a box at the end; a hundredth of its edge"),
            Quantity("fell", "", 0.0, "1 if a box ends half an edge lower than it began"),
        ),
        needs=frozenset({"box"}),
        build=_heavy,
        seconds=lambda p: 60.0,
        measure=_loaded,
        interval=0.1,
    ),
    Phenomenon(
        name="arch",
        title="a pointed arch of stones without mortar",
        why="stands by thrust alone: the contacts of a whole structure must be right at once",
        truth=(
            "limit analysis: it stands where one thrust keeps the resultant inside every joint (`truths.arch_thrust`); "
            "the thinnest such arch is the unit of thickness"
        ),
        parameters={
            "thickness": Parameter(1.1, 0.5, 2.0, "over the thinnest that stands [-]"),
            "stones": Parameter(8, 2, 20, "number of them; of an odd number one is left out"),
            "lean": Parameter(0.5, 0.2, 0.9, "tangent of a leg's angle from upright [-]"),
        },
        cases=({"thickness": 1.1}, {"thickness": 0.9}, {"thickness": 1.05}, {"thickness": 0.95}),
        quantities=(Quantity("drop", "m", 0.05, "largest of a stone in 10 s, where it should stand"), DROPS),
        needs=frozenset({"box"}),
        build=_arch,
        seconds=lambda p: 10.0,
        measure=_arch_stands,
    ),
)
