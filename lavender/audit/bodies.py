"""Find the geoms and the two bodies of a contact of a MuJoCo model by the contact's name."""

from __future__ import annotations

from typing import Any


def get_geoms(contact: str) -> str:
    """Return the names of both geoms of a contact, without the contact's number."""
    return contact.partition(" (")[2].rstrip(")") or contact


def find_bodies(mj: Any, model: Any, contact: str) -> str:
    """Return the names of the two bodies of a contact, sorted; bodies that are welded together have one name.

    Without two geoms, as for a flex, it is the names of the sides themselves.
    """
    sides = get_geoms(contact).split(", ")
    geoms = [find_geom(mj, model, side) for side in sides]
    if len(geoms) != 2 or min(geoms) < 0:
        return get_geoms(contact)
    bodies = [int(model.body_weldid[model.geom_bodyid[geom]]) for geom in geoms]
    kind = mj.mjtObj.mjOBJ_BODY
    return " and ".join(sorted(mj.mj_id2name(model, kind, b) or f"body {b}" for b in bodies))


def find_geom(mj: Any, model: Any, name: str) -> int:
    """Return the number of a geom by its name, or by its number if it has no name; -1 if there is none."""
    geom = int(mj.mj_name2id(model, mj.mjtObj.mjOBJ_GEOM, name))
    return int(name) if geom < 0 and name.isdigit() and int(name) < model.ngeom else geom
