"""What a host without Python is given: layouts, and scenes as the numbers of their start."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from lavender.sim.engine import Simulation
from lavender.sim.engine.layout import HEAD, JOINT, JOINT_KINDS, ORDER_NUMBER, SETTING, SIZE
from lavender.sim.engine.snapshot import Snapshot
from lavender.sim.scene import Scene
from lavender_ext.engine.arrays import CAP_CONTACT, CAP_PAIR, SHAPES, offsets

#: Scenes of the page, the whole gallery: name, title, what to look for, what the caption measures of each side:
#: "displacement" (largest distance of a body from its start, sideways or downwards), "gap" (how far the ends of a joint
#: are apart), "apart" (how far a body of B is from the same of A).
PAGE: tuple[tuple[str, str, str, str], ...] = (
    (
        "stack",
        "Stack of six boxes",
        "24 contacts, 72 rows. The slowest error shrinks by cos²(π/12) a sweep; warm starts go on from the last step.",
        "displacement",
    ),
    (
        "pyramid",
        "Pyramid of 55 boxes",
        "400 contacts, more rows than the bodies can tell apart: the impulses are not unique, the motion is.",
        "displacement",
    ),
    (
        "chain",
        "Chain of 20 links",
        "Joints alone: the eight values speak of contacts and stay 0, the error of the joint rows is E.",
        "gap",
    ),
    (
        "spinner",
        "Spinning ball",
        "One contact of four rows. Patch friction slows the ball with μ r N; one sweep solves a single contact.",
        "apart",
    ),
    (
        "heavy_on_light",
        "Heavy box on a light one",
        "A hundred times the mass on top: a sweep leaves 100/101 of the error.",
        "displacement",
    ),
    (
        "card_house",
        "House of cards",
        "Cards that stand by friction alone: what a solver leaves over, they slide by.",
        "displacement",
    ),
    (
        "bridge",
        "Bridge of 16 planks",
        "Hinges and contacts together, a box ten times as heavy as a plank on it: it sags by what impulses miss.",
        "gap",
    ),
    (
        "pile",
        "Pile of a hundred bodies",
        "Boxes and spheres that fall on each other: contacts come and go, the cache matches those that stay.",
        "apart",
    ),
    (
        "table",
        "Table on nine legs",
        "More legs than it needs: how they share the load is not unique, how it moves is.",
        "displacement",
    ),
    ("ramp", "Box on a ramp", "Sticks below tan θ = μ, slides above it: one body, four contacts.", "apart"),
    (
        "newtons_cradle",
        "Newton's cradle",
        "Distance joints and impacts: contacts of one instant, solved one after the other.",
        "apart",
    ),
    (
        "four_bar",
        "Four-bar linkage",
        "A motor drives a closed loop of hinges: one row more than the loop needs.",
        "gap",
    ),
)


class Number(NamedTuple):
    """A line above the pictures: of A and of B, medians of one of `SOLVER_FIELDS` over steps first + 1 to last.

    Without any step (0 to 0) of the very first solve, which is one substep.
    """

    text: str
    field: str
    first: int
    last: int
    over: str  # "AB" for the ratio A/B, "BA" for B/A, or "" without


class Side(NamedTuple):
    """What is set on one side."""

    iterations: int
    warm_start: bool  # WARM or COLD
    order: str = "given"
    solver: str = "sweeps"


COLD, WARM = False, True


class Preset(NamedTuple):
    """A button of the page: two settings of one scene side by side."""

    name: str  # in the page's address
    title: str
    scene: str
    sides: tuple[Side, Side]
    note: str  # what to see
    numbers: tuple[Number, ...] = ()


_LEFT = "residual after the last sweep [N s]"
_APPROACH = "approach velocity left [m/s]"

#: The chapter's five, under its numbers (docs/chapter.md), opened by a link.
EXPERIMENTS = (
    Preset(
        name="experiment=1",
        title="1 directly, or by sweeps",
        scene="stack",
        sides=(Side(16, COLD, solver="newton"), Side(64, COLD)),
        note="A factorises a few times and is done; B sweeps 64 times and leaves more. Both begin each "
        "step from nothing. "
        "In the plots along the sweeps each point of A is a factorisation.",
        numbers=(
            Number(_LEFT, "residual_final", 20, 60, "BA"),
            Number(_APPROACH, "violation_final", 20, 60, "BA"),
        ),
    ),
    Preset(
        name="experiment=2",
        title="2 inequalities, sweep by sweep",
        scene="stack",
        sides=(Side(8, COLD, "bottom_up"), Side(32, COLD, "bottom_up")),
        note="Pause and step: the plots show the error after every sweep. Each impulse is clamped in its "
        "own row, so that "
        "the error falls from sweep to sweep; clamping once at the end would not do.",
        numbers=(
            Number(_LEFT, "residual_final", 0, 0, "AB"),
            Number(_APPROACH, "violation_final", 0, 0, "AB"),
        ),
    ),
    Preset(
        name="experiment=3",
        title="3 two orders",
        scene="stack",
        sides=(Side(4, COLD, "bottom_up"), Side(4, COLD, "top_down")),
        note="The same sweeps, from the ground up and from the top down. By the residual B looks better, "
        "by the approach "
        "velocity A does: compare orders by the error of all rows, E.",
        numbers=(
            Number(_LEFT, "residual_final", 20, 60, "AB"),
            Number(_APPROACH, "violation_final", 20, 60, "AB"),
        ),
    ),
    Preset(
        name="experiment=4",
        title="4 four sweeps or 64",
        scene="stack",
        sides=(Side(4, COLD, "bottom_up"), Side(64, COLD, "bottom_up")),
        note="B sweeps sixteen times as often; both from nothing, from the ground up. How much less it "
        "leaves depends on "
        "when you look: A moves sideways.",
        numbers=tuple(
            Number(_LEFT, "residual_final", *steps, "AB") for steps in ((0, 0), (20, 60), (180, 240))
        ),
    ),
    Preset(
        name="experiment=5",
        title="5 warm or cold",
        scene="stack",
        sides=(Side(4, WARM, "alternating"), Side(4, COLD, "alternating")),
        note="Four sweeps in both. A finds its contacts in the cache and begins where the last step "
        "ended; B begins from "
        "nothing.",
        numbers=(
            Number("residual before the first sweep [N s]", "residual_initial", 20, 90, "BA"),
            Number("contacts found in the cache", "cache_matches", 20, 90, ""),
        ),
    ),
)

#: The first opens the page.
PRESETS = (
    Preset(
        name="chain-cold",
        title="a chain, 16 sweeps: warm against cold",
        scene="chain",
        sides=(Side(16, WARM), Side(16, COLD)),
        note="16 sweeps a substep in both; A starts them from the impulses of the last one, B from "
        "nothing: its links part.",
    ),
    Preset(
        name="4-warm-64-cold",
        title="4 warm against 64 cold",
        scene="stack",
        sides=(Side(4, WARM), Side(64, COLD)),
        note="B works sixteen times as hard as A and still creeps: each step starts from nothing.",
    ),
    Preset(
        name="bottom-up-top-down",
        title="bottom-up against top-down, cold",
        scene="stack",
        sides=(Side(16, COLD, "bottom_up"), Side(16, COLD, "top_down")),
        note="The same sweeps in opposite orders, each time from nothing: both towers walk sideways.",
    ),
    Preset(
        name="heavy-on-light",
        title="heavy on light",
        scene="heavy_on_light",
        sides=(Side(16, WARM), Side(16, COLD)),
        note="The upper box is a hundred times as heavy. A carries it, B lets it slip off.",
    ),
    Preset(
        name="newton-against-sweeps",
        title="newton against sweeps, cold",
        scene="heavy_on_light",
        sides=(Side(16, COLD, solver="newton"), Side(64, COLD)),
        note="Each step starts from nothing. A takes a few Newton steps to the answer; B sweeps 64 times "
        "and the box slips.",
    ),
    Preset(
        name="cards",
        title="a house of cards",
        scene="card_house",
        sides=(Side(16, WARM), Side(16, COLD)),
        note="A stands. B slides by what its sweeps leave over, and falls after some seconds.",
    ),
)


def layout() -> dict[str, Any]:
    """Arrays and numbered entries, as this build of the kernels has them.

    Returns
    -------
    dict
        arrays: buffer -> names in order; size, head, setting, joint, joint_kinds: name -> place, number; orders:
        name -> number; steppers: name -> what it writes.
    """
    return {
        "arrays": {buffer: tuple(names) for buffer, names in SHAPES.items()},
        "size": {**SIZE, "cap_pair": CAP_PAIR, "cap_contact": CAP_CONTACT},
        "head": HEAD,
        "setting": SETTING,
        "joint": JOINT,
        "joint_kinds": JOINT_KINDS,
        "orders": ORDER_NUMBER,
        "steppers": {name: _stepper(name) for name in ("impulses", "soft_step")},
    }


def _stepper(name: str) -> dict[str, dict[str, Any]]:
    """What a stepper writes into `head` and `setting`."""
    state = Simulation(Scene("stack", stepper=name)).snapshot()
    first = offsets(state.size)
    head, setting = state.index[first["head"] :], state.real[first["setting"] :]
    numbers = {place: int(head[HEAD[place]]) for place in ("stepper", "relaxing", "position_iterations")}
    return {"head": numbers, "setting": {p: float(setting[SETTING[p]]) for p in ("hertz", "ratio", "push")}}


def describe(start: Snapshot) -> dict[str, Any]:
    """Sizes, and every array that is not all zero as a list of numbers, of a snapshot.

    Exact when written as JSON, since the shortest text of a double that reads back as the same double is written.
    """
    first = offsets(start.size)
    arrays = {}
    for names, buffer in zip(map(tuple, SHAPES.values()), (start.real, start.index, start.keys), strict=True):
        ends = [*(first[name] for name in names[1:]), len(buffer)]
        for name, end in zip(names, ends, strict=True):
            values = buffer[first[name] : end]
            if np.any(values) or np.any(np.signbit(values.astype(float))):
                arrays[name] = values.tolist()
    return {"size": start.size.tolist(), "arrays": arrays}


def page_scenes() -> dict[str, Any]:
    """Everything that the page reads: layout, scenes and presets."""
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
                **describe(Simulation(scene).snapshot()),
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
    return {"layout": layout(), "scenes": scenes, "presets": presets}
