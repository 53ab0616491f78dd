"""Snapshots of a simulation, in memory and in a file.

A file is the magic word, the length of a JSON header (8 bytes, little-endian), the header (version,
fingerprint of the scene, counters, lengths), the arrays size, real, index and keys as little-endian bytes,
and the SHA-256 of all before. Nothing in it is executed when it is read.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path

import numpy as np

from lavender.engine.layout import N_SIZES
from lavender.errors import InputError
from lavender_ext.engine import substep

__all__ = ["Snapshot"]

MAGIC = b"LAVENDER-SNAPSHOT\n"
VERSION = 1
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
        """Write to a file, versioned and checksummed."""
        arrays = [np.ascontiguousarray(getattr(self, name), code).tobytes() for name, code in ARRAYS]
        header = json.dumps(
            {
                "version": VERSION,
                "fingerprint": self.fingerprint,
                "steps": self.steps,
                "failed": self.failed,
                "lost": self.lost,
                "lengths": [len(getattr(self, name)) for name, _ in ARRAYS],
            }
        ).encode()
        body = b"".join([MAGIC, len(header).to_bytes(8, "little"), header, *arrays])
        Path(path).write_bytes(body + hashlib.sha256(body).digest())

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Snapshot:
        """Read a file written by `save`.

        Raises
        ------
        InputError
            No such file, not a snapshot, of another version, or damaged.
        """
        try:
            data = Path(path).read_bytes()
        except OSError as error:
            raise InputError(f"cannot read the snapshot {str(path)!r}: {error.strerror}") from None
        if not data.startswith(MAGIC):
            raise InputError(f"{str(path)!r} is not a lavender snapshot")
        body, checksum = data[:-32], data[-32:]
        if hashlib.sha256(body).digest() != checksum:
            raise InputError(f"the snapshot {str(path)!r} is damaged: its checksum does not fit")
        try:
            start = len(MAGIC) + 8
            end = start + int.from_bytes(body[len(MAGIC) : start], "little")
            header = json.loads(body[start:end])
            if header["version"] != VERSION:
                raise InputError(
                    f"the snapshot {str(path)!r} has version {header['version']}; {VERSION} is read here"
                )
            arrays = {}
            for (name, code), n in zip(ARRAYS, header["lengths"], strict=True):
                x = np.frombuffer(body, code, n, end)
                end += x.nbytes
                arrays[name] = x.astype(x.dtype.newbyteorder("="))
            if end != len(body) or len(arrays["size"]) != N_SIZES or min(arrays["size"]) < 0:
                raise ValueError("lengths")
            used = substep.lengths(arrays["size"])
            if [max(n, 1) for n in used] != [max(n, 1) for n in header["lengths"][1:]]:
                raise ValueError("lengths")
            return cls(
                str(header["fingerprint"]),
                int(header["steps"]),
                int(header["failed"]),
                str(header["lost"]),
                **arrays,
            )
        except (ValueError, KeyError, TypeError, UnicodeDecodeError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"the snapshot {str(path)!r} does not hold what its header says") from None
