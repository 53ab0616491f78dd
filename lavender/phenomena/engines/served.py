"""The other side of `running`: a process that steps scenes in an engine."""

from __future__ import annotations

import json

import numpy as np

from lavender.apart.served import answer, begin, receive
from lavender.errors import CapabilityError

__all__ = ["serve"]

WORDS = 500  # characters of a reason


def serve(lifeline: int) -> None:
    """Read tasks from standard input, answer on standard output, until the input ends."""
    requests, answers = begin(lifeline)
    from lavender.phenomena.engines import WAYS, follow, make

    answer(answers, "{}", b"")  # ready
    while True:
        try:
            name, scene, seconds, look = receive(requests)
        except EOFError:
            return
        try:
            engine = make(WAYS[name], scene)
            try:
                track = follow(engine, seconds, look)
            finally:
                engine.close()
            k, n = track.positions.shape[:2]
            words = {"looks": k, "bodies": n, "setting": track.setting}
            parts = [
                track.time, track.positions, track.quaternions, track.velocities,
                np.array([track.force, track.cpu]),
            ]  # fmt: skip
            answer(
                answers, json.dumps(words), b"".join(np.ascontiguousarray(x, float).tobytes() for x in parts)
            )
        except CapabilityError as error:
            answer(answers, json.dumps({"cannot": str(error)[:WORDS]}), b"")
        except BaseException as error:  # an engine may fail in any way
            answer(answers, json.dumps({"error": f"{type(error).__name__}: {error}"[:WORDS]}), b"")
