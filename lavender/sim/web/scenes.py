"""Data for a host without Python: the layout of the engine's arrays, and the initial arrays of scenes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from lavender.sim.engine import Simulation
from lavender.sim.engine.layout import HEAD, JOINT, JOINT_KINDS, ORDER_NUMBER, SETTING, SIZE
from lavender.sim.engine.snapshot import Snapshot
from lavender.sim.scene import Scene
from lavender_ext.engine.arrays import CAP_CONTACT, CAP_PAIR, SHAPES, compute_array_offsets

#: Scenes of the page, the whole gallery: name, title, description, and the quantity in the caption of each side:
#: "displacement" (largest distance of a body from its initial position, sideways or downwards), "gap" (largest
#: distance between the ends of a joint), "apart" (largest distance of a body of B from the same body of A).
PAGE: tuple[tuple[str, str, str, str], ...] = (
    (
        "stack",
        "Stack of six boxes",
        "24 contacts, 72 rows. The slowest error mode shrinks by cos²(π/12) per sweep; warm starts use the last step.",
        "displacement",
    ),
    (
        "pyramid",
        "Pyramid of 55 boxes",
        "400 contacts with redundant rows: the impulses are not unique, but the motion is.",
        "displacement",
    ),
    (
        "chain",
        "Chain of 20 links",
        "Only joints: the eight values are for contacts and remain 0; E is the error of the joint rows.",
        "gap",
    ),
    (
        "spinner",
        "Spinning ball",
        "One contact of four rows. Torsional friction slows the ball by the moment μ r N. One sweep solves it.",
        "apart",
    ),
    (
        "heavy_on_light",
        "Heavy box on a light one",
        "The upper box has a hundred times the mass: after a sweep, 100/101 of the error remains.",
        "displacement",
    ),
    (
        "card_house",
        "House of cards",
        "Only friction holds the cards: they slide with the velocity error of the solver.",
        "displacement",
    ),
    (
        "bridge",
        "Bridge of 16 planks",
        "Hinges and contacts, with a box ten times as heavy as a plank: it sags if the impulses are too small.",
        "gap",
    ),
    (
        "pile",
        "Pile of a hundred bodies",
        "Boxes and spheres fall on each other: contacts appear and disappear; the cache matches the remaining ones.",
        "apart",
    ),
    (
        "table",
        "Table on nine legs",
        "The legs are redundant: the distribution of the load is not unique, but the motion is.",
        "displacement",
    ),
    ("ramp", "Box on a ramp", "Sticks below tan θ = μ, slides above: one body, four contacts.", "apart"),
    (
        "newtons_cradle",
        "Newton's cradle",
        "Distance joints and impacts: contacts of the same instant are solved one after the other.",
        "apart",
    ),
    (
        "four_bar",
        "Four-bar linkage",
        "A motor drives a closed loop of hinges with redundant rows.",
        "gap",
    ),
)


class Number(NamedTuple):
    """A line above the pictures: medians of a solver value of A and of B over steps first + 1 to last.

    Parameters
    ----------
    text : str
        Label.
    field : str
        One of `SOLVER_FIELDS`.
    first, last : int
        Range of steps. If both are 0, the value of the first substep of the first step is read.
    over : str
        "AB" for the ratio A/B, "BA" for B/A, or "" for no ratio.
    """

    text: str
    field: str
    first: int
    last: int
    over: str


class Side(NamedTuple):
    """Settings of one side; `warm_start` is WARM or COLD."""

    iterations: int
    warm_start: bool
    order: str = "given"
    solver: str = "sweeps"


COLD, WARM = False, True


class Preset(NamedTuple):
    """A button of the page: two settings of one scene side by side.

    Parameters
    ----------
    name : str
        Name in the address of the page.
    title : str
    scene : str
    sides : (Side, Side)
    note : str
        Description of the comparison.
    numbers : tuple of Number
    """

    name: str
    title: str
    scene: str
    sides: tuple[Side, Side]
    note: str
    numbers: tuple[Number, ...] = ()


_FINAL_RESIDUAL = "residual after the last sweep [N s]"
_FINAL_VIOLATION = "remaining approach velocity [m/s]"

#: The five experiments of docs/chapter.md under its numbers; links of the chapter open them.
EXPERIMENTS = (
    Preset(
        name="experiment=1",
        title="1 directly, or by sweeps",
        scene="stack",
        sides=(Side(16, COLD, solver="newton"), Side(64, COLD)),
        note="A converges after a few factorisations; B has a larger error after 64 sweeps. Both start each step from "
        "zero impulses. In the plots over the sweeps, each point of A is a factorisation.",
        numbers=(
            Number(_FINAL_RESIDUAL, "residual_final", 20, 60, "BA"),
            Number(_FINAL_VIOLATION, "violation_final", 20, 60, "BA"),
        ),
    ),
    Preset(
        name="experiment=2",
        title="2 inequalities, sweep by sweep",
        scene="stack",
        sides=(Side(8, COLD, "bottom_up"), Side(32, COLD, "bottom_up")),
        note="Pause and step: the plots show the error after every sweep. Each impulse is clamped in its own row, so "
        "that the error falls from sweep to sweep; it would not if impulses were clamped only at the end.",
        numbers=(
            Number(_FINAL_RESIDUAL, "residual_final", 0, 0, "AB"),
            Number(_FINAL_VIOLATION, "violation_final", 0, 0, "AB"),
        ),
    ),
    Preset(
        name="experiment=3",
        title="3 two orders",
        scene="stack",
        sides=(Side(4, COLD, "bottom_up"), Side(4, COLD, "top_down")),
        note="The same sweeps, from the ground up and from the top down. B has the smaller residual, A the smaller "
        "approach velocity: compare orders by the error of all rows, E.",
        numbers=(
            Number(_FINAL_RESIDUAL, "residual_final", 20, 60, "AB"),
            Number(_FINAL_VIOLATION, "violation_final", 20, 60, "AB"),
        ),
    ),
    Preset(
        name="experiment=4",
        title="4 four sweeps or 64",
        scene="stack",
        sides=(Side(4, COLD, "bottom_up"), Side(64, COLD, "bottom_up")),
        note="B does sixteen times as many sweeps; both start from zero impulses and sweep from the ground up. The "
        "ratio of the errors depends on the time, because A moves sideways.",
        numbers=tuple(
            Number(_FINAL_RESIDUAL, "residual_final", *steps, "AB")
            for steps in ((0, 0), (20, 60), (180, 240))
        ),
    ),
    Preset(
        name="experiment=5",
        title="5 warm or cold",
        scene="stack",
        sides=(Side(4, WARM, "alternating"), Side(4, COLD, "alternating")),
        note="Four sweeps in both. A finds its contacts in the cache and starts from the impulses of the last step; B "
        "starts from zero impulses.",
        numbers=(
            Number("residual before the first sweep [N s]", "residual_initial", 20, 90, "BA"),
            Number("contacts found in the cache", "cache_matches", 20, 90, ""),
        ),
    ),
)

#: The page opens with the first preset.
PRESETS = (
    Preset(
        name="chain-cold",
        title="a chain, 16 sweeps: warm against cold",
        scene="chain",
        sides=(Side(16, WARM), Side(16, COLD)),
        note="16 sweeps per substep in both. A starts from the impulses of the last substep, B from zero impulses: its "
        "links separate.",
    ),
    Preset(
        name="4-warm-64-cold",
        title="4 warm against 64 cold",
        scene="stack",
        sides=(Side(4, WARM), Side(64, COLD)),
        note="B does sixteen times as many sweeps as A and still creeps, because each step starts from zero impulses.",
    ),
    Preset(
        name="bottom-up-top-down",
        title="bottom-up against top-down, cold",
        scene="stack",
        sides=(Side(16, COLD, "bottom_up"), Side(16, COLD, "top_down")),
        note="The same sweeps in opposite orders, each time from zero impulses: both towers drift sideways.",
    ),
    Preset(
        name="heavy-on-light",
        title="heavy on light",
        scene="heavy_on_light",
        sides=(Side(16, WARM), Side(16, COLD)),
        note="The upper box is a hundred times as heavy. It stays in A and slips off in B.",
    ),
    Preset(
        name="newton-against-sweeps",
        title="newton against sweeps, cold",
        scene="heavy_on_light",
        sides=(Side(16, COLD, solver="newton"), Side(64, COLD)),
        note="Each step starts from zero impulses. A needs a few Newton steps; B does 64 sweeps, and the box slips.",
    ),
    Preset(
        name="cards",
        title="a house of cards",
        scene="card_house",
        sides=(Side(16, WARM), Side(16, COLD)),
        note="A is stable. B slides with the error of its sweeps, and falls after some seconds.",
    ),
)


def describe_layout() -> dict[str, Any]:
    """Return the arrays and the numbered entries of this build of the kernels.

    Returns
    -------
    dict
        arrays: buffer -> names in order; size, head, setting, joint, joint_kinds: name -> index or number; orders:
        name -> number.
    """
    return {
        "arrays": {buffer: tuple(names) for buffer, names in SHAPES.items()},
        "size": {**SIZE, "cap_pair": CAP_PAIR, "cap_contact": CAP_CONTACT},
        "head": HEAD,
        "setting": SETTING,
        "joint": JOINT,
        "joint_kinds": JOINT_KINDS,
        "orders": ORDER_NUMBER,
    }


def describe_snapshot(start: Snapshot) -> dict[str, Any]:
    """Return the sizes of a snapshot and, as lists of numbers, its arrays that are not all zero.

    The numbers are exact in JSON, which uses the shortest text that reads back as the same double.
    """
    first = compute_array_offsets(start.size)
    arrays = {}
    for names, buffer in zip(map(tuple, SHAPES.values()), (start.real, start.index, start.keys), strict=True):
        ends = [*(first[name] for name in names[1:]), len(buffer)]
        for name, end in zip(names, ends, strict=True):
            values = buffer[first[name] : end]
            if np.any(values) or np.any(np.signbit(values.astype(float))):
                arrays[name] = values.tolist()
    return {"size": start.size.tolist(), "arrays": arrays}


def collect_page_data() -> dict[str, Any]:
    """Return all data that the page reads: layout, scenes and presets."""
    scenes = []
    for name, title, note, measure in PAGE:
        scene = Scene(name)
        common = scene.parameters
        scenes.append(
            {
                "name": name,
                "title": title,
                "note": note,
                "measure": measure,
                "dt": common.dt,
                "substeps": common.substeps,
                "newton_substeps": Scene(name, solver="newton").parameters.substeps,
                "bodies": [body.name for body in scene.bodies],
                **describe_snapshot(Simulation(scene).snapshot()),
            }
        )
    presets = [
        {
            **preset._asdict(),
            "sides": [
                {
                    **side._asdict(),
                    "warm_start": int(side.warm_start),
                    "order": ORDER_NUMBER[side.order],
                    "box": 0,
                }
                for side in preset.sides
            ],
            "numbers": [number._asdict() for number in preset.numbers],
        }
        for preset in (*PRESETS, *EXPERIMENTS)
    ]
    return {"layout": describe_layout(), "scenes": scenes, "presets": presets}
