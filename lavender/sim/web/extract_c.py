"""Extract C without Python from the C that Cython writes: given functions and everything that they use.

    translate_modules_to_c(root, modules, work)            return the C of modules of lavender_ext
    extract_c(translations, front, roots)     return one C file with the declarations that `front` and `roots` use

Cython writes the core of a module (`cdef ... noexcept nogil`) and its Python part into one file, and a declaration
that several modules cimport into each of their files. Every file is parsed into its declarations (structs, enums,
typedefs, functions, groups under `#if`). Starting from the roots, each name is resolved to the declaration that
defines it, and the names which that declaration uses are resolved in turn. Bodies of functions, nine tenths of all
tokens, are only parsed if the function is needed. A function that another module imports by pointer is replaced by the
function itself. If a needed declaration uses Python, the error message names its user.

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
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import ClassVar, NamedTuple

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
TOKEN = re.compile(
    r"""(?P<directive>(?<![^\n])[ \t]*\#(?:\\\n|/\*.*?\*/|[^\n])*)
      |(?P<skip>\n|/\*.*?\*/|//[^\n]*|[^\S\n]+(?=\n|/[/*]|\Z))
      |(?P<space>[^\S\n]*)(?:
       (?P<name>[A-Za-z_]\w*)
      |(?P<literal>"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'|\.?\d(?:[eEpP][+-]|[\w.])*)
      |(?P<mark>[^\s\w]))""",
    re.VERBOSE | re.DOTALL,
)
#: Matches braces, and texts that may contain a brace that is not one: preprocessor lines, comments and literals.
BRACE = re.compile(
    r"""\n[ \t]*\#(?:\\\n|/\*.*?\*/|[^\n])*|/\*.*?\*/|//[^\n]*|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'|[{}]""",
    re.DOTALL,
)
WORD = re.compile(r"[A-Za-z_]\w*")
DIGITS = re.compile(r"\d+")
#: Words that need no declaration from the kernels: keywords of C, and words that the prologue defines.
PREDEFINED = frozenset(
    WORD.findall(
        """CYTHON_INLINE CYTHON_UNUSED __PYX_EXTERN_C likely unlikely NULL DL_IMPORT auto break case char const continue
        default do double else enum extern float for goto if inline int long register return short signed sizeof static
        struct switch typedef union unsigned void volatile while"""
    )
)
OPENING = ("if", "ifdef", "ifndef")
#: Beginning of a name of Cython: function, type, enum, or the variant of a function with fused types, such as `0_1`.
MANGLED = re.compile(r"__pyx_(?:[fte]_|fuse_(\d+(?:_\d+)*)__pyx_f_)(?=\d)")


class ExtractionError(Exception):
    """The C of the kernels could not be produced, or needs Python; the message names the place."""


class Token(NamedTuple):
    """A token of C with the white space before it."""

    kind: str
    text: str
    before: str


@dataclass
class Item:
    """One declaration."""

    kind: str  # "macro", "type", "prototype", "variable", "function" or "group".
    part: list[Token]
    defines: set[str] = field(default_factory=set)  # Names that the declaration defines.
    origin: str = ""  # Module that contains the declaration.
    kept_names: frozenset[str] = frozenset()  # Core functions that keep their names.

    @cached_property
    def all_tokens(self) -> list[Token]:
        """All tokens, with the bodies of functions split into tokens."""
        out: list[Token] = []
        for token in self.part:
            if token.kind != "body":
                out.append(token)
                continue
            inside = tokenize_c(token.text[1:])
            out += [Token("mark", "{", token.before), *inside]
        return out

    @cached_property
    def output_text(self) -> str:
        """Text of the declaration in the output."""
        # Words in strings would be renamed, too; no string of a kernel contains such a word.
        return WORD.sub(
            lambda match: _make_output_name(match.group(), self.kept_names), _join_tokens(self.all_tokens)
        )

    @cached_property
    def used_names(self) -> set[str]:
        """Words that may be names of other declarations."""
        used: set[str] = set()
        last = ""
        for token in self.all_tokens:
            words = [token.text] if token.kind == "name" and last not in (".", "->") else []
            if token.kind == "directive":
                words = WORD.findall(token.text)
            last = "->" if last == "-" and token.text == ">" else token.text
            used.update(words)
        return {_make_output_name(name, self.kept_names) for name in used}

    def rename(self, origin: str, kept_names: frozenset[str]) -> None:
        """Set the module and the kept names, and replace the defined names by their names in the output."""
        self.origin, self.kept_names = origin, kept_names
        self.defines = {_make_output_name(name, kept_names) for name in self.defines}


def tokenize_c(text: str, bodies: bool = False) -> Iterator[Token]:
    """Yield words, literals, marks and preprocessor lines of C; comments are white space.

    With `bodies`, the text in braces after a closing parenthesis is one token, including its braces.
    """
    before, last, at = "", "", 0
    while at >= 0:
        start, at = at, -1
        for match in TOKEN.finditer(text, start):
            kind = match.lastgroup or ""
            word = match[kind]
            if kind == "skip":
                before += word if word.isspace() else " "
                continue
            before += match["space"] or ""
            if bodies and word == "{" and last == ")":
                kind, at = "body", _find_end_of_block(text, match.end())
                word = text[match.start("mark") : at]
            last = word
            yield Token(kind, word.lstrip() if kind == "directive" else word, before)
            before = ""
            if kind == "body":
                break


def _find_end_of_block(text: str, at: int) -> int:
    """Return the position after the brace that closes the block with its first character at `at`."""
    depth = 1
    for match in BRACE.finditer(text, at):
        depth += (match[0] == "{") - (match[0] == "}")
        if depth == 0:
            return match.end()
    return len(text)


def parse_declarations(text: str) -> list[Item]:
    """Return the declarations of a C file; those between `#if` and `#endif` form one group."""
    # In the C that Cython writes, all declarations are in the #else branch of `#ifndef Py_PYTHON_H`.
    guarded = text.partition("\n#ifndef Py_PYTHON_H\n")[2].partition("\n#else\n")
    return list(
        _iterate_declarations(list(tokenize_c(guarded[2].rpartition("\n#endif")[0] or text, bodies=True)))
    )


def _iterate_declarations(stream: list[Token]) -> Iterator[Item]:
    """Yield the declarations of a sequence of tokens."""
    at = 0
    while at < len(stream):
        word, stop = _get_directive(stream[at]), at + 1
        if word in OPENING:
            stop = _find_end_of_group(stream, at)
            yield _make_conditional_group(stream[at:stop])
        elif word == "define":
            yield Item("macro", [stream[at]], {WORD.findall(stream[at].text)[1]})
        elif not word:
            stop = _find_end_of_declaration(stream, at)
            yield _parse_declaration(stream[at:stop])
        at = stop


def _get_directive(token: Token) -> str:
    """Return the first word of a preprocessor line; an empty text for any other token."""
    if token.kind != "directive":
        return ""
    match = WORD.search(token.text)
    return match.group() if match else ""


def _find_end_of_group(stream: list[Token], at: int) -> int:
    """Return the position after the #endif of the conditional that opens at `at`."""
    depth = 0
    for i in range(at, len(stream)):
        word = _get_directive(stream[i])
        depth += (word in OPENING) - (word == "endif")
        if depth == 0:
            return i + 1
    return len(stream)


def _find_end_of_declaration(stream: list[Token], at: int) -> int:
    """Return the position after the declaration that begins at `at`."""
    depth = 0
    for i in range(at, len(stream)):
        if stream[i].kind == "body" and depth == 0:
            return i + 1
        text = stream[i].text if stream[i].kind == "mark" else ""
        if text in ("(", "[", "{"):
            depth += 1
        elif text in (")", "]", "}"):
            depth -= 1
        elif text == ";" and depth == 0:
            return i + 1
    return len(stream)


def _join_tokens(part: list[Token]) -> str:
    """Return the text of tokens, without empty lines, and with preprocessor lines on lines of their own."""
    out = []
    for i, token in enumerate(part):
        before = token.before if i else ""
        if before.count("\n") > 1:
            before = re.sub(r"\n\s*\n", "\n", before)
        if token.kind == "directive" or (i and part[i - 1].kind == "directive"):
            before = "\n" if i else ""
        out.append(before + token.text)
    return re.sub(r"[ \t]+\n", "\n", "".join(out))


def _make_conditional_group(part: list[Token]) -> Item:
    """Return the group of all declarations between `#if` and `#endif`."""
    group = Item("group", part)
    for item in _iterate_declarations([token for token in part if token.kind != "directive"]):
        group.defines |= item.defines
    group.defines |= {WORD.findall(token.text)[1] for token in part if _get_directive(token) == "define"}
    return group


def _parse_declaration(part: list[Token]) -> Item:
    """Return one declaration with its kind and the names that it defines, from its tokens."""
    words = ["{" if token.kind == "body" else token.text for token in part]
    names = [i for i, token in enumerate(part) if token.kind == "name"]
    brace = words.index("{") if "{" in words else -1
    call = words.index("(") if "(" in words else len(words)
    if words[0] == "typedef":
        pointers = [i for i in range(len(words) - 2) if words[i : i + 2] == ["(", "*"]]
        if pointers and brace < 0:
            return Item("type", part, {words[pointers[0] + 2]})
        last = len(words) - 1 - words[::-1].index("}") if brace >= 0 else 0
        return Item(
            "type",
            part,
            {words[i] for i in names if i > last and words[i + 1] in (";", "[", "__attribute__")},
        )
    if words[0] in ("struct", "union", "enum") and (brace in (1, 2) or words[2:3] == [";"]):
        item = Item("prototype" if words[2:3] == [";"] else "type", part, {words[1]} if brace != 1 else set())
        depth = 0
        for i in range(brace, len(words)) if words[0] == "enum" else ():
            depth += (words[i] == "(") - (words[i] == ")")
            if depth == 0 and words[i] in ("{", ",") and part[i + 1].kind == "name":
                item.defines.add(words[i + 1])
        return item
    first = words.index("=") if "=" in words else len(words) - 1
    if call < first and words[call + 1] == "*":  # A pointer to a function.
        return Item("variable", part, {words[min(i for i in names if i > call and words[i] != "const")]})
    if call < first:
        return Item("function" if brace > call else "prototype", part, {words[call - 1]})
    before = [i for i in names if i < first]
    return Item("variable", part, {words[before[-1]]} if before else set())


# -- resolution of names ------------------------------------------------------------------------------------


class _Table:
    """Declarations of all files, by the names that they define. A definition replaces a prototype or a pointer."""

    RANK: ClassVar = {"function": 3, "type": 3, "group": 2, "macro": 2, "variable": 1, "prototype": 0}

    def __init__(self, items: Iterable[Item]) -> None:
        self.by_name: dict[str, list[Item]] = {}
        for item in items:
            for name in item.defines:
                self.by_name.setdefault(name, []).append(item)

    def collect_needed_declarations(self, roots: Iterable[str]) -> list[Item]:
        """Return all declarations that the names need, ordered so that each precedes its use."""
        done: dict[int, Item] = {}
        for name in sorted(roots):
            self._add_with_dependencies(name, done, ())
        return list(done.values())

    def _add_with_dependencies(self, name: str, done: dict[int, Item], path: tuple[str, ...]) -> None:
        """Add the declaration of a name and everything that it uses; `path` contains the names that led to it."""
        if name not in self.by_name or name in PREDEFINED:
            return
        candidates = self.by_name[name]
        item = max(candidates, key=lambda item: self.RANK[item.kind])
        if id(item) in done:
            return
        if name in path:
            raise ExtractionError(f"{' > '.join(path)} > {name} is a cycle")
        for other in candidates:
            if (
                other.kind == item.kind == "function"
                and other.part != item.part
                and other.output_text != item.output_text
            ):
                raise ExtractionError(f"{name} is not the same in {item.origin} and {other.origin}")
        if item.kind in ("variable", "prototype"):
            if item.kind == "prototype" and item.output_text.startswith(("struct", "union")):
                return
            raise ExtractionError(
                f"{path[-1] if path else 'a root'} needs {name}, which only the Python part defines ({item.origin})"
            )
        for used in sorted(item.used_names - item.defines):
            self._add_with_dependencies(used, done, (*path, name))
        done[id(item)] = item


def extract_c(translations: Iterable[tuple[str, str]], front: str = "", roots: Iterable[str] = ()) -> str:
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
    items = []
    for name, text in translations:
        declarations = parse_declarations(text)
        for item in declarations:
            item.rename(name, kept_names)
        items += declarations
    table, front_items = _Table(items), parse_declarations(front)
    defined = set().union(*(item.defines for item in front_items))
    reached = table.collect_needed_declarations(
        set().union(*(item.used_names for item in front_items), kept_names) - defined
    )
    missing = sorted(kept_names - set(table.by_name))
    if missing:
        raise ExtractionError(f"no such core functions: {', '.join(missing)}")
    return "\n\n".join([PROLOGUE, *(_make_static(item, kept_names) for item in reached), front])


def _make_static(item: Item, kept_names: frozenset[str]) -> str:
    """Return the text of a declaration; a function is `static` unless it keeps its name."""
    text = item.output_text
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
        at, parts = mangled.end(), []
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
    pending, sources = [get_module_path(root, module)], set()
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
        digest.update(path.name.encode() + b"\0" + path.read_text(encoding="utf-8").encode() + b"\0")
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
        cached = cache.joinpath("lavender_ext", *name.split(".")).with_suffix(".c") if cache else None
        if cached and cached.exists():
            newest = max(path.stat().st_mtime for path in _list_sources(root, module))
            if cached.stat().st_mtime > newest:
                return name, cached.read_text(encoding="utf-8")
        out = work / f"{name}.c"
        done = subprocess.run(
            [sys.executable, "-m", "cython", *options, "--shared=lavender_ext._utility", str(source), "-o", str(out)],
            cwd=root, capture_output=True, encoding="utf-8", errors="replace", check=False,
        )  # fmt: skip
        if done.returncode:
            raise ExtractionError(f"Cython cannot translate {source}:\n{(done.stdout + done.stderr)[-4000:]}")
        return name, out.read_text(encoding="utf-8")

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(translate_module, modules))
