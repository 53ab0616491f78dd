"""The way out: the kernels as a C library with one header, for engines that are not written in Python.

`lavender export c DIR` writes it. From Python `write`, `source`, `HEADER`, and `engine_image`, a simulation as
`lav_engine_open` reads it.
"""

from lavender.export.library import HEADER, source, write
from lavender.export.view import engine_image

__all__ = ["HEADER", "engine_image", "source", "write"]
