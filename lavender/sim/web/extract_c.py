"""Extract C without Python from the C that Cython writes: given functions and everything that they use.

    translate_modules_to_c(root, modules, work)            return the C of modules of lavender_ext
    extract_c(translations, front, roots)     return one C file with the declarations that `front` and `roots` use

Cython writes the core of a module (`cdef ... noexcept nogil`) and its Python part into one file, and a declaration
that several modules cimport into each of their files. Every file is parsed into its declarations (structs, enums,
typedefs, functions, groups under `#if`). Starting from the roots, each name is resolved to the declaration that
defines it, and the names which that declaration uses are resolved in turn. A function that another module imports by
pointer is replaced by the function itself. If a needed declaration uses Python, the error message names its user.

Names lose the prefix of Cython (`__pyx_f_12lavender_ext_4core_5block_clip` becomes `core_block_clip`), core functions
`lav_x` become `k_x`, and all declarations of the kernels are `static`: if a build omits parts of `front`
(LAV_SWEEPS_ONLY), the compiler drops the functions that only those parts call.

Only the standard library is imported, so that setup.py can run this file before anything is built.
"""

from __future__ import annotations

import hashlib
import json
import re
import runpy
import subprocess
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

PUBLIC = re.compile(r"^cdef public [^(\n]*?\b(lav_\w+)\(", re.MULTILINE)
CIMPORT = re.compile(r"^from lavender_ext\.([\w.]+) cimport", re.MULTILINE)

#: Beginning of the file: settings of floating-point arithmetic, and macros that Cython uses.
PROLOGUE = """\
#include <float.h>
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if defined(__FAST_MATH__) || (defined(_MSC_VER) && defined(_M_FP_FAST))
#error "lavender: -ffast-math changes the results of the kernels; build lavender.c without it"
#endif
#if defined(FLT_EVAL_METHOD) && FLT_EVAL_METHOD > 1
#error "lavender: registers wider than float64 change what the kernels compute; on x86 build with -msse2 -mfpmath=sse"
#endif
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC optimize("fp-contract=off", "no-tree-slp-vectorize")
#elif defined(_MSC_VER)
#pragma fp_contract(off)
#endif

/* The kernels below were written by a translator, which declares variables that are not used. */
#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wunused-parameter"
#pragma GCC diagnostic ignored "-Wunused-variable"
#pragma GCC diagnostic ignored "-Wunused-but-set-variable"
#if !defined(__clang__) /* A loop over the size of a block fills the arrays in question. */
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#endif
#define CYTHON_UNUSED __attribute__((unused))
#elif defined(_MSC_VER)
#pragma warning(disable : 4100 4101 4189 4505)
#define CYTHON_UNUSED
#else
#define CYTHON_UNUSED
#endif
#define likely(x) (x)
#define unlikely(x) (x)
"""
DIRECTIVE = r"#(?:\\\n|/\*.*?\*/|[^\n])*"
OPAQUE = rf"""^[ \t]*{DIRECTIVE}|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'"""  # Texts in which nothing is a mark of C.
COMMENT = re.compile(rf"{OPAQUE}|/\*.*?\*/|//[^\n]*", re.MULTILINE | re.DOTALL)
MARK = re.compile(rf"{OPAQUE}|[{{}};]", re.MULTILINE | re.DOTALL)
DIRECTIVE_LINE = re.compile(
    rf"\s*^[ \t]*({DIRECTIVE})(?:\s*\n)?(?:[ \t]+(?=[^\s#]))?", re.MULTILINE | re.DOTALL
)
WORD = re.compile(r"[A-Za-z_]\w*")
#: The pattern excludes members of structs, which follow `.` or `->`.
NAME = re.compile(r"(?<![\w.])(?<!->)[A-Za-z_]\w*")
DIGITS = re.compile(r"\d+")
#: Words that need no declaration from the kernels: some are defined by the prologue or by the headers.
PREDEFINED = (
    "CYTHON_INLINE",
    "CYTHON_UNUSED",
    "__PYX_EXTERN_C",
    "likely",
    "unlikely",
    "NULL",
    "DL_IMPORT",
    "inline",
)
OPENING = ("if", "ifdef", "ifndef")
#: Beginning of a name of Cython: function, type, enum, or the variant of a function with fused types, such as `0_1`.
MANGLED = re.compile(r"__pyx_(?:[fte]_|fuse_(\d+(?:_\d+)*)__pyx_f_)(?=\d)")


class ExtractionError(Exception):
    """The C of the kernels could not be produced, or needs Python; the message names the place."""


@dataclass
class Item:
    """One declaration."""

    kind: str  # "macro", "type", "prototype", "variable", "function" or "group".
    text: str
    defines: set[str]  # Names that the declaration defines.
    origin: str = ""  # Module that contains the declaration.

    @cached_property
    def used_names(self) -> set[str]:
        """Words that may be names of other declarations."""
        return set(NAME.findall(self.text))


def parse_declarations(text: str, origin: str = "") -> list[Item]:
    """Return the declarations of a C file without comments; those between `#if` and `#endif` form one group."""
    items = []
    at = 0
    while MARK.search(text, at):
        line = DIRECTIVE_LINE.match(text, at)
        word = _get_directive(line)
        if word in OPENING:
            end = _find_end_of_group(text, at)
        else:
            end = line.end() if line else _find_end_of_declaration(text, at)
        part = text[at:end].strip()
        at = end
        if word in OPENING:
            inside = DIRECTIVE_LINE.sub(
                lambda m: m[0] if _get_directive(m) == "define" else "\n", part
            )
            defines: set[str] = set().union(*(item.defines for item in parse_declarations(inside)))
            items.append(Item("group", part, defines, origin))
        elif word == "define":
            items.append(Item("macro", part, {WORD.findall(part)[1]}, origin))
        elif not line:
            items.append(Item(*_parse_declaration(part), origin))
    return items


def _get_directive(match: re.Match[str] | None) -> str:
    """Return the first word of a preprocessor line; an empty text without one."""
    return WORD.findall(match[1])[0] if match else ""


def _find_end_of_group(text: str, at: int) -> int:
    """Return the position after the #endif of the conditional that opens at `at`."""
    depth = 0
    for match in DIRECTIVE_LINE.finditer(text, at):
        word = _get_directive(match)
        depth += (word in OPENING) - (word == "endif")
        if depth == 0:
            return match.end()
    return len(text)


def _find_end_of_declaration(text: str, at: int) -> int:
    """Return the position after the declaration that begins at `at`: after the body of a function, or a semicolon."""
    depth = 0
    has_body = False
    for match in MARK.finditer(text, at):
        mark = match[0]
        if mark == "{" and depth == 0:
            has_body = text[at : match.start()].rstrip().endswith(")")
        depth += (mark == "{") - (mark == "}")
        if depth == 0 and (mark == ";" or (mark == "}" and has_body)):
            return match.end()
    return len(text)


def _parse_declaration(text: str) -> tuple[str, str, set[str]]:
    """Return the kind, the text and the defined names of one declaration."""
    head, brace, _ = text.partition("{")
    before, call, after = head.partition("=")[0].partition("(")
    if text.startswith("typedef"):
        pointer = None if brace else re.search(r"\(\s*\*\s*(\w+)", head)
        ends = re.findall(r"(\w+)\s*(?=;|\[|__attribute__)", text.rpartition("}")[2])
        return "type", text, {pointer[1]} if pointer else set(ends)
    if tag := re.match(r"(struct|union|enum)\s*(\w*)\s*[{;]", text):
        members = re.findall(r"[{,]\s*([A-Za-z_]\w*)", text) if tag[1] == "enum" else []
        return "type" if brace else "prototype", text, {*filter(None, [tag[2]]), *members}
    if call and after.startswith("*"):  # A pointer to a function.
        return "variable", text, {next(word for word in WORD.findall(after) if word != "const")}
    if call:
        return "function" if brace else "prototype", text, {WORD.findall(before)[-1]}
    return "variable", text, set(WORD.findall(before)[-1:])


# -- resolution of names ------------------------------------------------------------------------------------


#: If several files declare a name, a definition replaces a prototype or a pointer.
RANK = {"function": 3, "type": 3, "group": 2, "macro": 2, "variable": 1, "prototype": 0}


def _add_with_dependencies(
    name: str, table: dict[str, list[Item]], done: dict[int, Item], path: tuple[str, ...] = ()
) -> None:
    """Add the declaration of a name after everything that it uses; `path` contains the names that led to it."""
    if name not in table or name in PREDEFINED:
        return
    item = max(table[name], key=lambda item: RANK[item.kind])
    if id(item) in done:
        return
    if name in path:
        raise ExtractionError(f"{' > '.join(path)} > {name} is a cycle")
    for other in table[name]:
        if other.kind == item.kind == "function" and other.text != item.text:
            raise ExtractionError(f"{name} is not the same in {item.origin} and {other.origin}")
    if item.kind == "prototype" and item.text.startswith(("struct", "union")):
        return
    if item.kind in ("variable", "prototype"):
        raise ExtractionError(
            f"{path[-1] if path else 'a root'} needs {name}, which only the Python part defines ({item.origin})"
        )
    for used in sorted(item.used_names - item.defines):
        _add_with_dependencies(used, table, done, (*path, name))
    done[id(item)] = item


def extract_c(
    translations: Iterable[tuple[str, str]], front: str = "", roots: Iterable[str] = ()
) -> str:
    """Return one C file without Python.

    Parameters
    ----------
    translations : iterable of (str, str)
        Name of each module, as `sweep.serial`, and the C that Cython has written for it.
    front : str
        C that uses kernels by their names in the output; it is the end of the file.
    roots : iterable of str
        Core functions by their names in the sources, `lav_x`, that keep names and linkage.

    Returns
    -------
    str
    """
    kept_names = frozenset(roots)
    table: dict[str, list[Item]] = {}
    for module, text in translations:
        # In the C that Cython writes, all declarations are in the #else branch of `#ifndef Py_PYTHON_H`.
        guarded = (
            text.partition("\n#ifndef Py_PYTHON_H\n")[2]
            .partition("\n#else\n")[2]
            .rpartition("\n#endif")[0]
        )
        # Words in strings would be renamed, too; no string of a kernel contains such a word.
        renamed = WORD.sub(
            lambda word: _make_output_name(word[0], kept_names), _remove_comments(guarded)
        )
        for item in parse_declarations(renamed, module):
            for name in item.defines:
                table.setdefault(name, []).append(item)
    items = parse_declarations(_remove_comments(front))
    used = kept_names.union(*(item.used_names for item in items)) - set().union(
        *(item.defines for item in items)
    )
    reached: dict[int, Item] = {}
    for name in sorted(used):
        _add_with_dependencies(name, table, reached)
    missing = sorted(kept_names - set(table))
    if missing:
        raise ExtractionError(f"no such core functions: {', '.join(missing)}")
    return "\n\n".join(
        [PROLOGUE, *(_make_static(item, kept_names) for item in reached.values()), front]
    )


def _remove_comments(text: str) -> str:
    """Return C with a blank in place of each comment, except for those in preprocessor lines."""
    return COMMENT.sub(lambda match: " " if match[0].startswith("/") else match[0], text)


def _make_static(item: Item, kept_names: frozenset[str]) -> str:
    """Return the text of a declaration; a function is `static` unless it keeps its name."""
    text = DIRECTIVE_LINE.sub(r"\n\1\n", item.text).strip()
    text = re.sub(r"[ \t]+\n", "\n", re.sub(r"\n\s*\n", "\n", text))
    if item.kind == "function":
        text = re.sub(r"^(?:static\s+)?(?:CYTHON_INLINE\s+)?", "", text)
        inline = "inline " if "CYTHON_INLINE" in item.used_names else ""
        text = text if item.defines & kept_names else f"static {inline}{text}"
    return text


def _make_output_name(name: str, kept_names: frozenset[str]) -> str:
    """Return a name as it is written to the output: without Cython's prefix, variables with a final underscore."""
    if not name.startswith("__pyx_"):
        if name == "Py_ssize_t":
            return "ptrdiff_t"
        return "k_" + name[4:] if name.startswith("lav_") and name not in kept_names else name
    mangled = MANGLED.match(name)
    if mangled:
        at = mangled.end()
        parts = []
        while number := DIGITS.match(name, at):
            end = number.end() + int(number[0])
            if end == number.end() or name[end : end + 1] != "_":
                break  # The name is a word and a number that Cython added, as in __pyx_t_1.
            parts.append(name[number.end() : end])
            at = end + 1
        if parts:
            return "_".join([*parts[1:], name[at:], *filter(None, mangled.groups())])
    for prefix, form in (("__pyx_v_", "{}_"), ("__pyx_t_", "tmp_{}"), ("__pyx_L", "L{}")):
        if name.startswith(prefix):
            return form.format(name[len(prefix) :])
    return "returned" if name == "__pyx_r" else name


# -- Cython -------------------------------------------------------------------------------------------------


def get_module_path(root: Path, module: str | Path, suffix: str = ".pyx") -> Path:
    """Return the file of a module of lavender_ext; a path of another module is returned unchanged."""
    if isinstance(module, Path):
        return module
    return root.joinpath("lavender_ext", *module.split(".")).with_suffix(suffix)


def list_core_functions(root: Path, modules: Iterable[str | Path]) -> list[str]:
    """Return the names of the core functions `cdef public ... lav_*` in the sources of modules."""
    texts = [get_module_path(root, module).read_text(encoding="utf-8") for module in modules]
    return [name for text in texts for name in PUBLIC.findall(text)]


def _list_sources(root: Path, module: str | Path) -> set[Path]:
    """Return the files of lavender_ext that the translation of a module reads."""
    pending = [get_module_path(root, module)]
    sources = set()
    while pending:
        path = pending.pop()
        if path in sources or not path.exists():
            continue
        sources.add(path)
        names = CIMPORT.findall(path.read_text(encoding="utf-8"))
        pending += [path.with_suffix(".pxd")]
        pending += [get_module_path(root, name, ".pxd") for name in names]
    return sources


def hash_sources(root: Path, modules: Iterable[str | Path], more: Iterable[Path] = ()) -> str:
    """Return a hash of all files from which these modules are extracted, and of the files `more`."""
    paths = {path for name in modules for path in _list_sources(root, name)}
    tools = (root / "lavender_ext" / "build_options.py", Path(__file__))
    digest = hashlib.sha256()
    for path in [*sorted(paths), *tools, *more]:
        digest.update(
            path.name.encode() + b"\0" + path.read_text(encoding="utf-8").encode() + b"\0"
        )
    return digest.hexdigest()


def translate_modules_to_c(
    root: Path, modules: Iterable[str | Path], work: Path, cache: Path | None = None
) -> list[tuple[str, str]]:
    """Return (name, C) of modules, translated by Cython.

    Parameters
    ----------
    root : Path
        Folder that contains lavender_ext.
    modules : iterable of str or Path
        Names in lavender_ext, or paths of .pyx files.
    work : Path
        Folder for new translations.
    cache : Path, optional
        Folder of translations of an ordinary build. A translation that is newer than all its sources is used.
    """
    directives = runpy.run_path(str(root / "lavender_ext" / "build_options.py"))["directives"]()
    options = [f"-X{name}={value}" for name, value in directives.items()]
    how = cache / "how.json" if cache else None
    if not (how and how.exists() and directives in json.loads(how.read_text(encoding="utf-8"))):
        cache = None  # Do not use the translations of a build that is incomplete or has run-time checks.

    def translate_module(module: str | Path) -> tuple[str, str]:
        source = get_module_path(root, module)
        name = module.stem if isinstance(module, Path) else module
        cached = (
            cache.joinpath("lavender_ext", *name.split(".")).with_suffix(".c") if cache else None
        )
        if cached and cached.exists():
            newest = max(path.stat().st_mtime for path in _list_sources(root, module))
            if cached.stat().st_mtime > newest:
                return name, cached.read_text(encoding="utf-8")
        out = work / f"{name}.c"
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "cython",
                *options,
                "--shared=lavender_ext._utility",
                str(source),
                "-o",
                str(out),
            ],
            cwd=root,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            check=False,
        )
        if done.returncode:
            raise ExtractionError(
                f"Cython cannot translate {source}:\n{(done.stdout + done.stderr)[-4000:]}"
            )
        return name, out.read_text(encoding="utf-8")

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(translate_module, modules))
