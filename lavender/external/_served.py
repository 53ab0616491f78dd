"""The other side of `apart.py`: a process that runs backends by their names."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.apart import served as apart
from lavender.external.apart import ARRAYS, WORDS
from lavender.external.running import Answer, quiet


def serve(lifeline: int) -> None:
    """Answer the calls of `apart.call`, until they end."""
    apart.serve(lifeline, _runner)


def _runner() -> apart.Handler:
    from lavender.external.backends import BACKENDS

    by_name = {backend.name: backend for backend in BACKENDS}

    def run(message: Any) -> tuple[dict[str, Any], bytes]:
        name, qp, impulse, limit, settings = message
        with quiet(by_name[name].noisy) as said:
            found = by_name[name].run(qp, impulse, limit, settings)
        return _as_data(found, "; ".join(said))

    return run


def _as_data(found: Answer, said: str) -> tuple[dict[str, Any], bytes]:
    sizes: list[int | None] = []
    numbers = b""
    for name in ARRAYS:
        value: Any = getattr(found, name)
        sizes.append(None if value is None else int(np.size(value)))
        numbers += b"" if value is None else np.ascontiguousarray(value, float).tobytes()
    words = {
        "status": found.status.name,
        "words": str(found.words or said)[:WORDS],
        "work": {str(kind): int(count) for kind, count in found.work.items()},
        "sizes": sizes,
    }
    return words, numbers
