"""Find the geoms and the two bodies of a contact of a MuJoCo model by the contact's name."""

from __future__ import annotations

from typing import Any

from lavender.io.contact_friction import find_geom


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
