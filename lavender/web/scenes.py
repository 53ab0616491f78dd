"""What a host without Python is given: layouts, and scenes as the numbers of their start."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.engine import Simulation
from lavender.engine.layout import CAP_CONTACT, CAP_PAIR, HEAD, JOINT, SETTING, SIZE
from lavender.engine.snapshot import Snapshot
from lavender.engine.state import ORDER_NUMBER
from lavender.scene import Scene
from lavender_ext.engine.arrays import SHAPES, offsets
from lavender_ext.host import memory

__all__ = ["PAGE", "describe", "layout", "page_scenes"]

#: Scenes of the page: name in the gallery, parameters, title, what to look for.
PAGE: tuple[tuple[str, dict[str, Any], str, str], ...] = (
    (
        "stack",
        {},
        "Stack of six boxes",
        "24 contacts, 72 rows. The slowest error shrinks by cos²(π/12) a sweep; warm starts go on from the last step.",
    ),
    (
        "pyramid",
        {},
        "Pyramid of 55 boxes",
        "400 contacts, more rows than the bodies can tell apart: the impulses are not unique, the motion is.",
    ),
    (
        "chain",
        {},
        "Chain of 20 links",
        "Joints alone: the eight values speak of contacts and stay 0, the error of the joint rows is E.",
    ),
    (
        "spinner",
        {},
        "Spinning ball",
        "One contact of four rows. Patch friction slows the ball with μ r N; one sweep solves a single contact.",
    ),
)


def layout() -> dict[str, Any]:
    """Structs, arrays and numbered entries, as this build of the kernels has them.

    Returns
    -------
    dict
        structs: name -> field -> type ("i4", "f8", "3f8", "p" for a pointer); native: name -> size and offsets
        [bytes]; arrays: buffer -> names in order; size, head, setting,
        joint: name -> place; orders: name -> number.
    """
    native = {name: {"size": size, "offsets": offsets} for name, (size, offsets) in memory.layout().items()}
    return {
        "structs": memory.STRUCTS,
        "native": native,
        "arrays": {buffer: tuple(names) for buffer, names in SHAPES.items()},
        "size": {**SIZE, "cap_pair": CAP_PAIR, "cap_contact": CAP_CONTACT},
        "head": HEAD,
        "setting": SETTING,
        "joint": JOINT,
        "orders": ORDER_NUMBER,
    }


def describe(start: Snapshot) -> dict[str, Any]:
    """Sizes, and every array that is not all zero as a list of numbers, of a snapshot.

    Parameters
    ----------
    start : Snapshot

    Returns
    -------
    dict
        size (10,), arrays: name -> numbers; exact when written as JSON, since the shortest text of a double
        that reads back as the same double is written.
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
    """Everything that the page reads: layout and scenes."""
    scenes = []
    for name, parameters, title, note in PAGE:
        scene = Scene(name, **parameters)
        common = scene.parameters
        scenes.append(
            {
                "name": name,
                "title": title,
                "note": note,
                "dt": common.dt,
                "substeps": common.substeps,
                "bodies": [body.name for body in scene.bodies],
                **describe(Simulation(scene).snapshot()),
            }
        )
    return {"layout": layout(), "scenes": scenes}
