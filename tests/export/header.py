"""Read lavender.h: its constants, and the fields of its structs."""

from __future__ import annotations

import re


def strip_comments(header: str) -> str:
    """Return C without its comments."""
    return re.sub(r"/\*.*?\*/", "", header, flags=re.DOTALL)


def parse_enum_constants(header: str) -> dict[str, int]:
    """Return the numbers of all enums by name."""
    numbers: dict[str, int] = {}
    for body in re.findall(r"enum \{(.*?)\};", strip_comments(header), re.DOTALL):
        numbers |= {name: int(value) for name, value in re.findall(r"(\w+)\s*=\s*(-?\d+)", body)}
    return numbers


def parse_struct_fields(header: str, name: str) -> list[tuple[str, str]]:
    """Return (type, name) of the fields of a struct in order.

    Examples are ("int32_t", "n_rows"), ("const double *", "b"), and ("(*)", "clock") for a pointer to a function.
    """
    body = re.search(rf"typedef struct {name} \{{(.*?)\}} {name};", header, re.DOTALL)
    if body is None:
        raise ValueError(f"the header has no struct {name}")
    pairs = []
    for line in strip_comments(body[1]).split(";"):
        declaration = " ".join(line.split())
        pointer = re.match(r"(.*?)\(\*(\w+)\)\(", declaration)
        if pointer:
            pairs.append(("(*)", pointer[2]))
            continue
        match = re.match(r"((?:const )?\w+) (.+)", declaration)
        for part in match[2].split(",") if match else ():
            assert match is not None
            pairs.append((match[1] + (" *" if "*" in part else ""), part.replace("*", "").strip()))
    return pairs
