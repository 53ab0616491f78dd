"""The scorecard: engines on contact scenes with truth formulas; `python -m benchmarks score`.

`scenes` has the scenes, `settings` the engines with their packages and settings, `adapters` one file per Python engine
(those under Node are in `benchmarks.engines`), `records` the table of results. The engines' environments import
`worker` and `adapters` only, so that this module does not import lavender.
"""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    """Import the command when it is used."""
    if name == "command":
        from benchmarks.score.run import command

        return command
    raise AttributeError(name)
