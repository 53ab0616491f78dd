"""Write the state of a simulation as the image that the C library steps."""

from __future__ import annotations

import numpy as np

from lavender.sim.engine.simulation import Simulation

MAGIC = b"LAVIMG1\0"  # Magic word of the images that `lav_engine_open` reads and `lav_engine_image` writes.


def engine_image(simulation: Simulation) -> bytes:
    """Return the state of a simulation as an image for `lav_engine_open`.

    The image contains a magic word, a hash, sizes (10) int32, reals, int32 padded to 8 bytes, and keys.

    Parameters
    ----------
    simulation : Simulation
        A simulation of any scene; the image includes its sweeps and order.

    Returns
    -------
    bytes
    """
    state = simulation.snapshot()
    index = state.index.astype("<i4").tobytes()
    body = state.size.astype("<i4").tobytes() + state.real.astype("<f8").tobytes()
    body += index + bytes(-len(index) % 8) + state.keys.astype("<u8").tobytes()
    h = 0
    full = 2**64 - 1
    for word in np.frombuffer(body, "<u8").tolist():
        h = ((h ^ word) * 0x9E3779B97F4A7C15) & full
        h ^= h >> 29
    return MAGIC + (h ^ h >> 32).to_bytes(8, "little") + body
