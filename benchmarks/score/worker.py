"""Step scenes in one engine, in the interpreter of its environment: python -m benchmarks.score.worker ADAPTER.

It answers lines of JSON as benchmarks/engines/served.mjs does: {"scene", "options"} builds a scene, {"steps", "every",
"limit", "expected"} makes steps. An answer has the CPU time and states, after building also the properties that the
engine stores.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import sys
from time import process_time
from typing import Any

from benchmarks.score.adapters import CannotExpress, Running

CHUNK = 50  # steps between two looks at the CPU time
PROBE = 100  # steps after which the rest is not made if it would take more than PROBE_EXCESS times the limit
PROBE_EXCESS = 2.0


def main(name: str) -> None:
    """Answer the requests of standard input."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # Messages that an engine prints go to standard error.
    try:
        create = importlib.import_module(f"benchmarks.score.adapters.{name}").build
        failure = ""
    except Exception as error:
        failure = f"{type(error).__name__}: {error}"
    engine: Running | None = None
    for line in sys.stdin:
        request = json.loads(line)
        try:
            if failure:
                raise RuntimeError(failure)
            if "scene" in request:
                if engine:
                    engine.close()
                engine = create(request["scene"], request["options"])
            answer = advance(engine, request)
        except CannotExpress as error:
            answer = {"cannot": str(error)}
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def advance(engine: Any, request: dict[str, Any]) -> dict[str, Any]:
    """Make steps, `every` of them between two states, until the CPU time is above `limit`; see `simulate`.

    `expected` is the number of steps that the cell still needs, these and those of later simulations.
    """
    steps = request.get("steps", 0)
    every = request.get("every", 1)
    limit = request.get("limit", math.inf)
    expected = request.get("expected", steps)
    done = 0
    cpu = 0.0
    residuals = []
    states = [] if steps else [_read_state(engine)]
    while done < steps and cpu <= limit:
        n = min(CHUNK, every - done % every, steps - done)
        begin = process_time()
        for _ in range(n):
            engine.step()
        cpu += process_time() - begin
        done += n
        if done >= PROBE and cpu / done * expected > PROBE_EXCESS * limit:
            break
        if done % every == 0 or done == steps:
            states.append(_read_state(engine))
            if len(residuals) < request.get("residuals", 0):
                residuals.append(engine.get_residual())
    answer: dict[str, Any] = {"cpu": cpu, "done": done, "states": states}
    found = [x for x in residuals if x is not None]
    answer["residual"] = max(found) if found else None
    if "scene" in request:
        answer["properties"] = [
            [None if x is None else float(x) for x in row] for row in engine.get_properties()
        ]
    return answer


def _read_state(engine: Any) -> list[float | None]:
    numbers = [float(x) for row in engine.get_state() for x in row]
    return [x if math.isfinite(x) else None for x in numbers]


if __name__ == "__main__":
    main(sys.argv[1])
