"""Export the kernels as a C library with one header, for engines that are not written in Python.

The command `lavender export c DIR` writes the library; from Python, `write` does. `source` returns lavender.c, `HEADER`
is the path of the header, and `engine_image` returns a simulation in the format of `lav_engine_open`.
"""

from lavender.export.image import engine_image
from lavender.export.library import HEADER, source, write

__all__ = ["HEADER", "engine_image", "source", "write"]
__dir__ = sorted(__all__).copy  # Completion shows public names only.
