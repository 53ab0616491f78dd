"""The other side of `apart.py`: a process that runs backends by their names."""

from __future__ import annotations

from typing import Any

from lavender.base.apart import served as apart
from lavender.external.apart import ARRAYS, WORDS
from lavender.external.running import quiet


def serve(lifeline: int) -> None:
    """Answer the calls of `apart.call`, until they end."""
    apart.serve(lifeline, _runner)


def _runner() -> apart.Handler:
    from lavender.external.backends import BACKENDS

    by_name = {backend.name: backend for backend in BACKENDS}

    def run(message: Any) -> tuple[dict[str, Any], list[Any]]:
        name, qp, impulse, limit, settings = message
        with quiet(by_name[name].noisy) as said:
            found = by_name[name].run(qp, impulse, limit, settings)
        work = {str(kind): int(count) for kind, count in found.work.items()}
        words = str(found.words or "; ".join(said))[:WORDS]
        arrays = [getattr(found, name) for name in ARRAYS]
        return {"status": found.status.name, "words": words, "work": work}, arrays

    return run
