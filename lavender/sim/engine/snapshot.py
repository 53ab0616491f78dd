"""Snapshots of a simulation, in memory and in a file.

A file consists of a magic word, the length of a JSON header (8 bytes, little-endian), the header (version, fingerprint
of the scene, counters, lengths), the arrays size, real, index and keys as little-endian bytes, and the SHA-256 of
everything before it. Nothing in it is executed when it is read.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from os import PathLike
from typing import Any

import numpy as np

from lavender.base.errors import InputError
from lavender.io.stored import read_bytes, write_bytes
from lavender.sim.engine.check import check_snapshot_fields
from lavender_ext.engine.arrays import compute_buffer_lengths

MAGIC = b"LAVENDER-SNAPSHOT\n"
VERSION = 2
HEADER_FIELDS = ("fingerprint", "steps", "failed", "lost")
ARRAYS = (("size", "<i4"), ("real", "<f8"), ("index", "<i4"), ("keys", "<u8"))


@dataclass(frozen=True, eq=False)
class Snapshot:
    """State of a simulation, for `Simulation.restore`.

    Parameters
    ----------
    fingerprint : str
        Hash of the scene.
    steps : int
        Number of steps done.
    failed : int
        Number of failed solves.
    lost : str
        Name of the body with a non-finite state, or empty.
    size : int32 array
    real : float64 array
    index : int32 array
    keys : uint64 array
        The engine's buffers.
    """

    fingerprint: str
    steps: int
    failed: int
    lost: str
    size: np.ndarray = field(repr=False)
    real: np.ndarray = field(repr=False)
    index: np.ndarray = field(repr=False)
    keys: np.ndarray = field(repr=False)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the snapshot to a file with version and checksum; an existing file is replaced atomically."""
        arrays = [
            np.ascontiguousarray(getattr(self, name), code).tobytes() for name, code in ARRAYS
        ]
        header = {name: getattr(self, name) for name in HEADER_FIELDS}
        lengths_of = [len(getattr(self, name)) for name, _ in ARRAYS]
        head = json.dumps({"version": VERSION, **header, "lengths": lengths_of}).encode()
        body = b"".join([MAGIC, len(head).to_bytes(8, "little"), head, *arrays])
        write_bytes(path, body + hashlib.sha256(body).digest())

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Snapshot:
        """Read a file written by `save`.

        Raises
        ------
        InputError
            The file is not a snapshot, is damaged, or has another version.
        """
        data = read_bytes(path, "the snapshot")
        if not data.startswith(MAGIC):
            raise InputError(
                f"{str(path)!r} does not begin as a snapshot of lavender; a file that Snapshot.save wrote is needed"
            )
        body, checksum = data[:-32], data[-32:]
        if hashlib.sha256(body).digest() != checksum:
            raise InputError(
                f"the snapshot {str(path)!r} is damaged: its checksum does not match its content. Save or copy it again"
            )
        try:
            return cls._parse(body)
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            if isinstance(error, InputError):
                raise InputError(f"the snapshot {str(path)!r} cannot be read: {error}") from None
            raise InputError(
                f"the snapshot {str(path)!r} is damaged, because its data do not match its header: save or "
                "copy it again"
            ) from None

    @classmethod
    def _parse(cls, body: bytes) -> Snapshot:
        """Build a snapshot from the bytes before the checksum; raise an error if they are inconsistent."""
        start = len(MAGIC) + 8
        end = start + int.from_bytes(body[len(MAGIC) : start], "little")
        header = json.loads(body[start:end])
        if header["version"] != VERSION:
            raise InputError(
                f"the snapshot has version {str(header['version'])[:40]}, and this lavender reads version "
                f"{VERSION}: save it again with this lavender"
            )
        arrays: dict[str, Any] = {}
        for (name, code), n in zip(ARRAYS, header["lengths"], strict=True):
            if type(n) is not int or not 0 <= n <= len(body):
                raise ValueError("lengths")
            x = np.frombuffer(body, code, n, end)
            end += x.nbytes
            arrays[name] = x.astype(x.dtype.newbyteorder("="))
        snapshot = cls(**{name: header[name] for name in HEADER_FIELDS} | arrays)
        check_snapshot_fields(snapshot)
        used = compute_buffer_lengths(snapshot.size)
        if end != len(body) or [max(n, 1) for n in used] != [
            max(n, 1) for n in header["lengths"][1:]
        ]:
            raise ValueError("lengths")
        return snapshot
