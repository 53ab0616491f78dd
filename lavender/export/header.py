"""lavender.h read: its constants, and structs field by field."""

from __future__ import annotations

import re


def strip_comments(header: str) -> str:
    """Return C without its comments."""
    return re.sub(r"/\*.*?\*/", "", header, flags=re.DOTALL)


def constants(header: str) -> dict[str, int]:
    """Numbers of the enums by name."""
    found: dict[str, int] = {}
    for body in re.findall(r"enum \{(.*?)\};", strip_comments(header), re.DOTALL):
        found |= {name: int(value) for name, value in re.findall(r"(\w+)\s*=\s*(-?\d+)", body)}
    return found


def struct_fields(header: str, name: str) -> list[tuple[str, str]]:
    """Fields of a struct in order: ("int32_t", "n_rows"), a pointer ("const double *", "b"), a function ("(*)", .)."""
    body = re.search(rf"typedef struct {name} \{{(.*?)\}} {name};", header, re.DOTALL)
    if body is None:
        raise ValueError(f"the header has no struct {name}")
    found = []
    for line in strip_comments(body[1]).split(";"):
        words = " ".join(line.split())
        pointer = re.match(r"(.*?)\(\*(\w+)\)\(", words)
        if pointer:
            found.append(("(*)", pointer[2]))
            continue
        match = re.match(r"((?:const )?\w+) (.+)", words)
        for part in match[2].split(",") if match else ():
            assert match is not None
            found.append((match[1] + (" *" if "*" in part else ""), part.replace("*", "").strip()))
    return found
