"""The other side of `_apart.py`: a process that runs backends by their names."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from lavender.apart.served import answer, begin, receive
from lavender.errors import InputError
from lavender.external._apart import ARRAYS, WORDS
from lavender.external._running import Answer, quiet

__all__ = ["serve"]


def serve(lifeline: int) -> None:
    """Read tasks from standard input, answer on standard output, until the input ends."""
    requests, answers = begin(lifeline)
    from lavender.external.backends import BACKENDS
    from lavender.external.clarabel_cone import NAME
    from lavender.external.native import clarabel

    runs = {backend.name: (backend.run, backend.noisy) for backend in BACKENDS} | {
        NAME: (clarabel.call, False)
    }
    answer(answers, "{}", b"")  # ready
    while True:
        try:
            name, qp, impulse, limit, settings = receive(requests)
        except EOFError:
            return
        run, noisy = runs[name]
        try:
            with quiet(noisy) as said:
                found = run(qp, impulse, limit, settings)
            answer(answers, *_as_data(found, "; ".join(said)))
        except InputError as error:
            answer(answers, json.dumps({"error": str(error)[:WORDS], "kind": InputError.__name__}), b"")
        except BaseException as error:  # a backend may fail in any way; a panic of Rust is no Exception
            answer(answers, json.dumps({"error": f"{type(error).__name__}: {error}"[:WORDS]}), b"")


def _as_data(found: Answer, said: str) -> tuple[str, bytes]:
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
    return json.dumps(words), numbers
