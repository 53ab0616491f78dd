"""Facts about arrays and files of other engines, each with a function that runs the engine and checks the fact.

The table of docs/engines.md is written from these facts by `python docs/generate.py --pages`.
"""

import importlib
from collections.abc import Callable
from dataclasses import dataclass

PROBE_MODULES = (
    "engine_probes",
    "engine_drake_probes",
    "engine_newton_probes",
    "engine_file_probes",
    "engine_mjcf_probes",
)


@dataclass(frozen=True)
class EngineFact:
    """A fact about an engine, and the handling of it in lavender.

    Parameters
    ----------
    engine : str
    module : str
        Modules, separated by spaces, that must be importable to run `probe`.
    version : str
        Version of the engine with which the fact was found.
    subject, text : str
        Arrays or settings, and what they hold.
    handling : str
        Effect on users of lavender, or how lavender handles it; "" if it does not read this engine's data.
    probe : callable
        Function that returns whether the fact still holds.
    """

    engine: str
    module: str
    version: str
    subject: str
    text: str
    handling: str
    probe: Callable[[], bool]


FACTS: list[EngineFact] = []


def fact(engine, module, version, subject, text, handling=""):
    """Return a decorator that adds a fact with the decorated function as its probe."""

    def add(probe):
        FACTS.append(EngineFact(engine, module, version, subject, text, handling, probe))
        return probe

    return add


def load_facts() -> list[EngineFact]:
    """Return the facts of all modules of probes, in order of engines."""
    for module in PROBE_MODULES:
        importlib.import_module(module)
    engines = list(dict.fromkeys(f.engine for f in FACTS))
    return sorted(FACTS, key=lambda f: engines.index(f.engine))
