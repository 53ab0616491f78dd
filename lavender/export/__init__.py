"""The way out: the kernels as a C library with one header, for engines that are not written in Python.

`lavender export c DIR` writes it, `rust` and `npm` its bindings. From Python `write`, `source`, `HEADER`.
"""

from __future__ import annotations

import re

from lavender.export.library import HEADER, source, write

__all__ = ["HEADER", "source", "struct_fields", "write"]


def struct_fields(header: str, name: str) -> list[tuple[str, str]]:
    """Fields of a struct of the header, in order: ("int32_t", "n_rows"), a pointer as ("const double *", "b")."""
    body = re.search(rf"typedef struct {name} \{{(.*?)\}} {name};", header, re.DOTALL)
    if body is None:
        raise ValueError(f"the header has no struct {name}")
    found = []
    for line in re.sub(r"/\*.*?\*/", "", body[1], flags=re.DOTALL).split(";"):
        words = " ".join(line.split())
        pointer = re.match(r"(.*?)\(\*(\w+)\)\(", words)
        if pointer:
            found.append(("(*)", pointer[2]))
            continue
        match = re.match(r"((?:const )?\w+) (.+)", words)
        if match:
            for part in match[2].split(","):
                star = "*" in part
                found.append((match[1] + (" *" if star else ""), part.replace("*", "").strip()))
    return found
