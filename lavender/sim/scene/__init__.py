"""Scenes: bodies, shapes and joints, built by hand or taken from the gallery."""

from lavender.sim.scene.gallery import SCENES
from lavender.sim.scene.parameters import ON_FAILURE, Parameters
from lavender.sim.scene.parts import Body, Box, Joint, Plane, Sphere
from lavender.sim.scene.scene import Scene, named_scene

__all__ = [
    "ON_FAILURE",
    "SCENES",
    "Body",
    "Box",
    "Joint",
    "Parameters",
    "Plane",
    "Scene",
    "Sphere",
    "named_scene",
]
__dir__ = sorted(__all__).copy  # Completion shows public names only.
