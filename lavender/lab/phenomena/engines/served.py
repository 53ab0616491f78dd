"""The other side of `running`: a process that steps scenes in an engine."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.apart import served as apart


def serve(lifeline: int) -> None:
    """Answer the tasks of `running.Apart`, until they end."""
    apart.serve(lifeline, _runner)


def _runner() -> apart.Handler:
    from lavender.lab.phenomena.engines import WAYS, follow, make

    def run(message: Any) -> tuple[dict[str, Any], bytes]:
        name, scene, seconds, interval = message
        engine = make(WAYS[name], scene)
        try:
            track = follow(engine, seconds, interval)
        finally:
            engine.close()
        k, n = track.positions.shape[:2]
        last = np.array([track.force, track.cpu])
        parts = (track.time, track.positions, track.quaternions, track.velocities, last)
        numbers = b"".join(np.ascontiguousarray(x, float).tobytes() for x in parts)
        return {"samples": k, "bodies": n, "setting": track.setting}, numbers

    return run
