"""Snapshots of a simulation, in memory and in a file.

A file is the magic word, the length of a JSON header (8 bytes, little-endian), the header (version,
fingerprint of the scene, counters, lengths), the arrays size, real, index and keys as little-endian bytes,
and the SHA-256 of all before. Nothing in it is executed when it is read.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from os import PathLike, fsync
from pathlib import Path
from typing import Any

import numpy as np

from lavender.base.errors import InputError
from lavender.io.stored import pack_header, read_whole_file, unpack_header, write_atomically
from lavender.sim.engine.check import well_formed
from lavender_ext.engine.arrays import lengths

MAGIC = b"LAVENDER-SNAPSHOT\n"
VERSION = 1
MOST_HEADER = 2**20  # bytes
WORDS = ("fingerprint", "steps", "failed", "lost")
ARRAYS = (("size", "<i4"), ("real", "<f8"), ("index", "<i4"), ("keys", "<u8"))


@dataclass(frozen=True, eq=False)
class Snapshot:
    """State of a simulation, for `Simulation.restore`."""

    fingerprint: str  # of the scene
    steps: int
    failed: int  # solves that failed
    lost: str  # body whose state is not finite, or empty
    size: np.ndarray = field(repr=False)  # int32
    real: np.ndarray = field(repr=False)  # float64
    index: np.ndarray = field(repr=False)  # int32
    keys: np.ndarray = field(repr=False)  # uint64

    def save(self, path: str | PathLike[str]) -> None:
        """Write to a file, versioned and checksummed; a file of that name is replaced when the new one is whole."""
        well_formed(self)
        arrays = [np.ascontiguousarray(getattr(self, name), code).tobytes() for name, code in ARRAYS]
        header = {name: getattr(self, name) for name in WORDS}
        lengths_of = [len(getattr(self, name)) for name, _ in ARRAYS]
        body = pack_header(MAGIC, {"version": VERSION, **header, "lengths": lengths_of}) + b"".join(arrays)
        checksum = hashlib.sha256(body).digest()
        write_atomically(path, lambda part: _write(part, body + checksum))

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Snapshot:
        """Read a file written by `save`."""
        data = read_whole_file(path, "the snapshot")
        if not data.startswith(MAGIC):
            raise InputError(f"{str(path)!r} is not a lavender snapshot")
        body, checksum = data[:-32], data[-32:]
        if hashlib.sha256(body).digest() != checksum:
            raise InputError(f"the snapshot {str(path)!r} is damaged: its checksum does not fit")
        try:
            found = cls._parsed(body)
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            if isinstance(error, InputError):
                raise InputError(f"the snapshot {str(path)!r} cannot be read: {error}") from None
            raise InputError(f"the snapshot {str(path)!r} does not hold what its header says") from None
        return found

    @classmethod
    def _parsed(cls, body: bytes) -> Snapshot:
        header, end = unpack_header(body, MAGIC, MOST_HEADER)
        if header["version"] != VERSION:
            raise InputError(f"it has version {str(header['version'])[:40]}; {VERSION} is read here")
        arrays: dict[str, Any] = {}
        for (name, code), n in zip(ARRAYS, header["lengths"], strict=True):
            if type(n) is not int or not 0 <= n <= len(body):
                raise ValueError("lengths")
            x = np.frombuffer(body, code, n, end)
            end += x.nbytes
            arrays[name] = x.astype(x.dtype.newbyteorder("="))
        found = cls(**{name: header[name] for name in WORDS} | arrays)
        well_formed(found)
        used = lengths(found.size)
        if end != len(body) or [max(n, 1) for n in used] != [max(n, 1) for n in header["lengths"][1:]]:
            raise ValueError("lengths")
        return found


def _write(part: Path, data: bytes) -> None:
    with open(part, "wb") as stream:
        stream.write(data)
        stream.flush()
        fsync(stream.fileno())
