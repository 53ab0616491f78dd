"""Data for a host without Python: the layout of the engine's arrays, and the initial arrays of scenes."""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from lavender.base.errors import InputError
from lavender.io.stored import as_path, check_writable, write_text
from lavender.sim.engine import Simulation
from lavender.sim.engine.layout import HEAD, JOINT, JOINT_KINDS, ORDER_NUMBER, SETTING, SIZE
from lavender.sim.engine.snapshot import Snapshot
from lavender.sim.engine.state import JOINT_GIVE
from lavender.sim.scene import Scene
from lavender_ext.engine.arrays import CAP_CONTACT, CAP_PAIR, SHAPES, compute_array_offsets

#: Texts and settings of the page. A scene has a name of the gallery and the quantity in the caption of each side
#: ("measure"): "displacement" (largest distance of a body from its initial position, sideways or downwards), "gap"
#: (largest distance between the ends of a joint), "apart" (largest distance of a body of B from the same body of A).
#: A preset is a button with two settings of a scene side by side; "name" is its part of the page's address. The page
#: opens with the first preset. The presets with numbers are the five experiments of docs/course/chapter.md; its links
#: open them. A number is a line above the pictures: the medians of a solver value ("field") of A and B over steps first
#: + 1 to last, or if both are 0 the value of the first substep, and their ratio A/B ("AB"), B/A ("BA") or none ("").
SCENE_VERSION = 1  # Version of the files of `write_scene`.
PRESETS_PATH = Path(__file__).resolve().parent / "page" / "presets.json"


def describe_layout() -> dict[str, Any]:
    """Return the arrays and the numbered entries of this build of the kernels.

    arrays: buffer -> names in order; size, head, setting, joint, joint_kinds: name -> index or number; orders: name ->
    number.
    """
    return {
        "arrays": {buffer: tuple(names) for buffer, names in SHAPES.items()},
        "size": {**SIZE, "cap_pair": CAP_PAIR, "cap_contact": CAP_CONTACT},
        "head": HEAD,
        "setting": SETTING,
        "joint_give": JOINT_GIVE,
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
    for names, buffer in zip(
        map(tuple, SHAPES.values()), (start.real, start.index, start.keys), strict=True
    ):
        ends = [*(first[name] for name in names[1:]), len(buffer)]
        for name, end in zip(names, ends, strict=True):
            values = buffer[first[name] : end]
            if np.any(values) or np.any(np.signbit(values.astype(float))):
                arrays[name] = values.tolist()
    return {"size": start.size.tolist(), "arrays": arrays}


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Return the initial state of a scene and its step sizes, as the page reads them."""
    return {
        "dt": scene.parameters.dt,
        "substeps": scene.parameters.substeps,
        "newton_substeps": scene.with_parameters(solver="newton").parameters.substeps,
        "bodies": [body.name for body in scene.bodies],
        **describe_snapshot(Simulation(scene).snapshot()),
    }


def write_scene(scene: Scene, path: str | PathLike[str], title: str = "") -> None:
    """Write a scene to a file (.json) that the page opens with its button "Open".

    Parameters
    ----------
    scene : Scene
        A scene of the gallery with other parameters, or one built by hand. It must use sequential impulses.
    path : path
    title : str, optional
        Name in the list of scenes; the name of the file by default.
    """
    if not isinstance(scene, Scene):
        raise InputError(
            f"scene is a {type(scene).__name__}; a Scene is needed: lv.Scene({scene!r:.40})"
        )
    if scene.parameters.solver != "sequential_impulses":
        raise InputError(
            f"the scene uses {scene.parameters.solver!r}, and the page sweeps: pass a scene with the default solver "
            "and select newton in the page"
        )
    title = title or as_path(path).stem
    # Joints that open show an error of the solver better than the motion of a body.
    measure = "gap" if scene.joints else "displacement"
    entry = {"name": title, "title": title, "note": "", "measure": measure, **describe_scene(scene)}
    contents = {"lavender_scene": SCENE_VERSION, "layout": describe_layout(), "scene": entry}
    write_text(check_writable(path), json.dumps(contents, allow_nan=False, separators=(",", ":")))


def collect_page_data() -> dict[str, Any]:
    """Return all data that the page reads: layout, scenes and presets."""
    contents = json.loads(PRESETS_PATH.read_text(encoding="utf-8"))
    for entry in contents["scenes"]:
        entry |= describe_scene(Scene(entry["name"]))
    for side in (side for preset in contents["presets"] for side in preset["sides"]):
        side |= {
            "warm_start": int(side["warm_start"]),
            "order": ORDER_NUMBER[side["order"]],
            "box": 0,
        }
    return {"layout": describe_layout(), **contents}
