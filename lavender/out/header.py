"""lavender.h read: its constants, structs field by field, functions; and these as a module of JavaScript."""

from __future__ import annotations

import re

STRUCTS = ("lav_problem", "lav_options", "lav_budget", "lav_verdict", "lav_motion", "lav_result")


def _bare(header: str) -> str:
    return re.sub(r"/\*.*?\*/", "", header, flags=re.DOTALL)


def constants(header: str) -> dict[str, int]:
    """Numbers of the enums by name."""
    found: dict[str, int] = {}
    for body in re.findall(r"enum \{(.*?)\};", _bare(header), re.DOTALL):
        found |= {name: int(value) for name, value in re.findall(r"(\w+)\s*=\s*(-?\d+)", body)}
    return found


def struct_fields(header: str, name: str) -> list[tuple[str, str]]:
    """Fields of a struct in order: ("int32_t", "n_rows"), a pointer ("const double *", "b"), a function ("(*)", .)."""
    body = re.search(rf"typedef struct {name} \{{(.*?)\}} {name};", header, re.DOTALL)
    if body is None:
        raise ValueError(f"the header has no struct {name}")
    found = []
    for line in _bare(body[1]).split(";"):
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


def functions(header: str) -> list[tuple[str, str, list[str]]]:
    """(what it returns, name, arguments) of every function."""
    found = re.findall(r"LAV_API ((?:const )?\w+ \*?)(\w+)\((.*?)\);", _bare(header), re.DOTALL)
    return [
        (kind.strip(), name, [] if args.strip() == "void" else [" ".join(a.split()) for a in args.split(",")])
        for kind, name, args in found
    ]


def _typescript(header: str) -> list[str]:
    """Structs as interfaces: what a caller gives, fields of his choice; what comes back, all of them."""
    numbers = {"uint64_t": "bigint"}
    out = []
    for name in ("lav_problem", "lav_options", "lav_verdict", "lav_result"):
        fields, given = [], name in ("lav_problem", "lav_options")
        for kind, field in struct_fields(header, name):
            if kind == "(*)" or field == "size" or (name, field) == ("lav_options", "method"):
                continue
            of = kind.replace("const", "").replace("*", "").strip()
            said = "Verdict" if of == "lav_verdict" else numbers.get(of, "number")
            said = f"ArrayLike<{said}>" if "*" in kind else said
            mark = "?" if given and field not in ("n_blocks", "n_rows") else ""
            fields.append(f"{field}{mark}: {said};")
        out.append(f"export interface {name.removeprefix('lav_').title()} {{ {' '.join(fields)} }}")
    return out


def javascript(header: str) -> tuple[str, str]:
    """(module, types) of the constants and of where the fields of structs lie in WebAssembly's 32-bit memory."""
    numbers = constants(header)
    sizes = {"double": 8, "uint64_t": 8, "int32_t": 4, "uint32_t": 4}
    layouts: dict[str, dict[str, tuple[str, int]]] = {}
    total: dict[str, int] = {}
    for name in ("lav_verdict", *(s for s in STRUCTS if s != "lav_verdict")):
        at, layouts[name] = 0, {}
        for kind, field in struct_fields(header, name):
            size = 4 if "*" in kind else total.get(kind) or sizes[kind]
            align = 8 if kind in total else size
            at = (at + align - 1) // align * align
            layouts[name][field] = (kind.replace("const ", "").replace(" ", ""), at)
            at += size
        total[name] = (
            (at + 7) // 8 * 8
            if any(k in ("double", "uint64_t", *total) for k, _ in layouts[name].values())
            else at
        )
    module = ["// Made of lavender.h: its constants, and where fields lie in a module of 32-bit pointers."]
    module += [f"export const {name} = {value};" for name, value in numbers.items()]
    module.append("export const STRUCTS = {")
    for name, fields in layouts.items():
        inside = ", ".join(f"{field}: ['{kind}', {at}]" for field, (kind, at) in fields.items())
        module.append(f"  {name}: {{ size: {total[name]}, fields: {{ {inside} }} }},")
    types = [f"export const {name}: {value};" for name, value in numbers.items()]
    types.append(
        "export const STRUCTS: Record<string, { size: number; fields: Record<string, [string, number]> }>;"
    )
    return "\n".join([*module, "};", ""]), "\n".join([*types, *_typescript(header), ""])
