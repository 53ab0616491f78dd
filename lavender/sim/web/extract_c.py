"""C without Python, cut out of the C that Cython writes: what given functions reach, and nothing else.

    translate(root, modules, work)      the C of modules of lavender_ext
    extract_c(translations, front, roots)     one C file of what `front` (C of ours, at its end) and `roots` use

Cython writes a module's core (`cdef ... noexcept nogil`) and its Python part into one file, and what several modules
cimport into each of them. Every file is read token by token into its declarations (structs, enums, typedefs, functions,
groups under `#if`); a name leads to the declaration that makes it, and what that uses leads on. Bodies of functions,
nine tenths of all tokens, are read of those that are reached. A function that another module imports by pointer is the
function itself here. What is reached must not name Python: who uses it is told.

Names lose what Cython puts before them (`__pyx_f_12lavender_ext_4core_5block_clip` is `core_block_clip`), core
functions `lav_x` become `k_x`, and everything of the kernels is `static`: a build that leaves some of `front` out
(LAV_SWEEPS_ONLY) leaves out what only that calls, as every compiler does.

Only the standard library is imported, so that setup.py can run this before anything is built.
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

#: What stands before everything: how floating point must be compiled, and words of Cython's own.
PROLOGUE = """\
#include <float.h>
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if defined(__FAST_MATH__) || (defined(_MSC_VER) && defined(_M_FP_FAST))
#error "lavender: -ffast-math changes what the kernels compute; build lavender.c without it"
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

/* The kernels below come out of a translator: what it declares and never uses is no mistake of theirs. */
#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wunused-parameter"
#pragma GCC diagnostic ignored "-Wunused-variable"
#pragma GCC diagnostic ignored "-Wunused-but-set-variable"
#if !defined(__clang__) /* which guesses at arrays that a loop over the size of a block fills */
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
#: All that may hold a brace which opens or closes no block, and those that do.
BRACE = re.compile(
    r"""\n[ \t]*\#(?:\\\n|/\*.*?\*/|[^\n])*|/\*.*?\*/|//[^\n]*|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'|[{}]""",
    re.DOTALL,
)
WORD = re.compile(r"[A-Za-z_]\w*")
NUMBER = re.compile(r"\d+")
#: Words that lead nowhere: those of the prologue, and C's.
PROVIDED = frozenset(
    WORD.findall(
        """CYTHON_INLINE CYTHON_UNUSED __PYX_EXTERN_C likely unlikely NULL DL_IMPORT auto break case char const continue
        default do double else enum extern float for goto if inline int long register return short signed sizeof static
        struct switch typedef union unsigned void volatile while"""
    )
)
OPENING = ("if", "ifdef", "ifndef")
MANGLED = re.compile(r"__pyx_(?:f|t|e|fuse_\d+)_(?=\d)")


class ExtractionError(Exception):
    """The C of the kernels could not be made, or needs Python; the message says where."""


class Token(NamedTuple):
    """A word of C and what stands before it."""

    kind: str
    text: str
    before: str  # white space


@dataclass
class Item:
    """One declaration: the names it makes, those it uses, its text."""

    kind: str  # macro, type, prototype, variable, function, group
    part: list[Token]
    makes: set[str] = field(default_factory=set)
    origin: str = ""
    kept: frozenset[str] = frozenset()  # core functions that keep their names

    @cached_property
    def whole(self) -> list[Token]:
        """All tokens, those of bodies one by one."""
        out: list[Token] = []
        for token in self.part:
            if token.kind != "body":
                out.append(token)
                continue
            inside = tokens(token.text[1:])
            out += [Token("mark", "{", token.before), *inside]
        return out

    @cached_property
    def text(self) -> str:
        """As it is written out."""
        # Words are told from what they stand in: no string of a kernel is one.
        return WORD.sub(lambda match: _plain(match.group(), self.kept), _text(self.whole))

    @cached_property
    def uses(self) -> set[str]:
        """Words that may be names of other declarations."""
        used: set[str] = set()
        last = ""
        for token in self.whole:
            words = [token.text] if token.kind == "name" and last not in (".", "->") else []
            if token.kind == "directive":
                words = WORD.findall(token.text)
            last = "->" if last == "-" and token.text == ">" else token.text
            used.update(words)
        return {_plain(name, self.kept) for name in used}

    def rename(self, origin: str, kept: frozenset[str]) -> None:
        """Give names as they are written out."""
        self.origin, self.kept = origin, kept
        self.makes = {_plain(name, kept) for name in self.makes}


def tokens(text: str, bodies: bool = False) -> Iterator[Token]:
    """Words, literals, marks and lines of the preprocessor; comments are white space.

    bodies : what stands in braces behind a parenthesis is one token, with its braces.
    """
    before, last, at = "", "", 0
    while at >= 0:
        start, at = at, -1
        for match in TOKEN.finditer(text, start):
            kind = match.lastgroup or ""
            said = match[kind]
            if kind == "skip":
                before += said if said.isspace() else " "
                continue
            before += match["space"] or ""
            if bodies and said == "{" and last == ")":
                kind, at = "body", _end_of_block(text, match.end())
                said = text[match.start("mark") : at]
            last = said
            yield Token(kind, said.lstrip() if kind == "directive" else said, before)
            before = ""
            if kind == "body":
                break


def _end_of_block(text: str, at: int) -> int:
    """Behind the brace that closes the block whose first character stands at `at`."""
    depth = 1
    for match in BRACE.finditer(text, at):
        depth += (match[0] == "{") - (match[0] == "}")
        if depth == 0:
            return match.end()
    return len(text)


def read(text: str) -> list[Item]:
    """The declarations of a C file one by one, those between `#if` and `#endif` together."""
    guarded = text.partition("\n#ifndef Py_PYTHON_H\n")[2].partition(
        "\n#else\n"
    )  # of Cython: all in the last branch
    return list(_declarations(list(tokens(guarded[2].rpartition("\n#endif")[0] or text, bodies=True))))


def _declarations(stream: list[Token]) -> Iterator[Item]:
    at = 0
    while at < len(stream):
        word, stop = _word(stream[at]), at + 1
        if word in OPENING:
            stop = _end_of_group(stream, at)
            yield _group(stream[at:stop])
        elif word == "define":
            yield Item("macro", [stream[at]], {WORD.findall(stream[at].text)[1]})
        elif not word:
            stop = _end_of_declaration(stream, at)
            yield _item(stream[at:stop])
        at = stop


def _word(token: Token) -> str:
    """The first word of a line of the preprocessor; empty for anything else."""
    if token.kind != "directive":
        return ""
    found = WORD.search(token.text)
    return found.group() if found else ""


def _end_of_group(stream: list[Token], at: int) -> int:
    """Behind the #endif of the conditional that opens at `at`."""
    depth = 0
    for i in range(at, len(stream)):
        word = _word(stream[i])
        depth += (word in OPENING) - (word == "endif")
        if depth == 0:
            return i + 1
    return len(stream)


def _end_of_declaration(stream: list[Token], at: int) -> int:
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


def _text(part: list[Token]) -> str:
    out = []
    for i, token in enumerate(part):
        before = token.before if i else ""
        if before.count("\n") > 1:
            before = re.sub(r"\n\s*\n", "\n", before)
        if token.kind == "directive" or (i and part[i - 1].kind == "directive"):
            before = "\n" if i else ""
        out.append(before + token.text)
    return re.sub(r"[ \t]+\n", "\n", "".join(out))


def _group(part: list[Token]) -> Item:
    made = Item("group", part)
    for item in _declarations([token for token in part if token.kind != "directive"]):
        made.makes |= item.makes
    made.makes |= {WORD.findall(token.text)[1] for token in part if _word(token) == "define"}
    return made


def _item(part: list[Token]) -> Item:
    """One declaration from its tokens: what it is, and what it is called."""
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
        made = Item("prototype" if words[2:3] == [";"] else "type", part, {words[1]} if brace != 1 else set())
        depth = 0
        for i in range(brace, len(words)) if words[0] == "enum" else ():
            depth += (words[i] == "(") - (words[i] == ")")
            if depth == 0 and words[i] in ("{", ",") and part[i + 1].kind == "name":
                made.makes.add(words[i + 1])
        return made
    first = words.index("=") if "=" in words else len(words) - 1
    if call < first and words[call + 1] == "*":  # a pointer to a function
        return Item("variable", part, {words[min(i for i in names if i > call and words[i] != "const")]})
    if call < first:
        return Item("function" if brace > call else "prototype", part, {words[call - 1]})
    before = [i for i in names if i < first]
    return Item("variable", part, {words[before[-1]]} if before else set())


# -- what is reached ----------------------------------------------------------------------------------------


class _Table:
    """Declarations of all files by the names they make; a definition goes before a prototype or a pointer."""

    RANK: ClassVar = {"function": 3, "type": 3, "group": 2, "macro": 2, "variable": 1, "prototype": 0}

    def __init__(self, items: Iterable[Item]) -> None:
        self.by_name: dict[str, list[Item]] = {}
        for item in items:
            for name in item.makes:
                self.by_name.setdefault(name, []).append(item)

    def reach(self, roots: Iterable[str]) -> list[Item]:
        """What the names lead to, in an order in which everything stands before its use."""
        done: dict[int, Item] = {}
        for name in sorted(roots):
            self._visit(name, done, ())
        return list(done.values())

    def _visit(self, name: str, done: dict[int, Item], path: tuple[str, ...]) -> None:
        if name not in self.by_name or name in PROVIDED:
            return
        every = self.by_name[name]
        item = max(every, key=lambda item: self.RANK[item.kind])
        if id(item) in done:
            return
        if name in path:
            raise ExtractionError(f"{' > '.join(path)} > {name} comes round")
        for other in every:
            if other.kind == item.kind == "function" and other.part != item.part and other.text != item.text:
                raise ExtractionError(f"{name} is not the same in {item.origin} and {other.origin}")
        if item.kind in ("variable", "prototype"):
            if item.kind == "prototype" and item.text.startswith(("struct", "union")):
                return
            raise ExtractionError(
                f"{path[-1] if path else 'somebody'} needs {name}, which only Python's side has ({item.origin})"
            )
        for used in sorted(item.uses - item.makes):
            self._visit(used, done, (*path, name))
        done[id(item)] = item


def extract_c(translations: Iterable[tuple[str, str]], front: str = "", roots: Iterable[str] = ()) -> str:
    """One C file without Python.

    Parameters
    ----------
    translations : iterable of (str, str)
        Name of each module, as `sweep.serial`, and the C that Cython has made of it.
    front : str
        C that uses kernels by their names here; it stands at the end.
    roots : iterable of str
        Core functions by their names in the sources, `lav_x`, that keep names and linkage.

    Returns
    -------
    str
    """
    kept = frozenset(roots)
    items = []
    for name, text in translations:
        found = read(text)
        for item in found:
            item.rename(name, kept)
        items += found
    table, own = _Table(items), read(front)
    made = set().union(*(item.makes for item in own))
    reached = table.reach(set().union(*(item.uses for item in own), kept) - made)
    missing = sorted(kept - set(table.by_name))
    if missing:
        raise ExtractionError(f"no such core functions: {', '.join(missing)}")
    return "\n\n".join([PROLOGUE, *(_private(item, kept) for item in reached), front])


def _private(item: Item, kept: frozenset[str]) -> str:
    text = item.text
    if item.kind == "function":
        text = re.sub(r"^(?:static\s+)?(?:CYTHON_INLINE\s+)?", "", text)
        inline = "inline " if "CYTHON_INLINE" in item.uses else ""
        text = text if item.makes & kept else f"static {inline}{text}"
    return text


def _plain(name: str, kept: frozenset[str]) -> str:
    """A name without what Cython puts before it; one of a variable ends in an underscore, no other one does."""
    if not name.startswith("__pyx_"):
        if name == "Py_ssize_t":
            return "ptrdiff_t"
        return "k_" + name[4:] if name.startswith("lav_") and name not in kept else name
    mangled = MANGLED.match(name)
    if mangled:
        at, parts = mangled.end(), []
        while number := NUMBER.match(name, at):
            end = number.end() + int(number[0])
            if end == number.end() or name[end : end + 1] != "_":
                break  # a number of Cython's own, as in __pyx_t_1
            parts.append(name[number.end() : end])
            at = end + 1
        if parts:
            return "_".join([*parts[1:], name[at:]])
    for prefix, form in (("__pyx_v_", "{}_"), ("__pyx_t_", "tmp_{}"), ("__pyx_L", "L{}")):
        if name.startswith(prefix):
            return form.format(name[len(prefix) :])
    return "returned" if name == "__pyx_r" else name


# -- Cython -------------------------------------------------------------------------------------------------


def path_of(root: Path, module: str | Path, suffix: str = ".pyx") -> Path:
    """The file of a module of lavender_ext, or a path of one elsewhere as it is."""
    if isinstance(module, Path):
        return module
    return root.joinpath("lavender_ext", *module.split(".")).with_suffix(suffix)


def core_functions(root: Path, modules: Iterable[str | Path]) -> list[str]:
    """Names of the core functions `cdef public ... lav_*` in the sources of modules."""
    texts = [path_of(root, module).read_text(encoding="utf-8") for module in modules]
    return [name for text in texts for name in PUBLIC.findall(text)]


def _sources(root: Path, module: str | Path) -> set[Path]:
    """Files of lavender_ext that the translation of a module reads."""
    open_, seen = [path_of(root, module)], set()
    while open_:
        path = open_.pop()
        if path in seen or not path.exists():
            continue
        seen.add(path)
        names = CIMPORT.findall(path.read_text(encoding="utf-8"))
        open_ += [path.with_suffix(".pxd")]
        open_ += [path_of(root, name, ".pxd") for name in names]
    return seen


def source_hash(root: Path, modules: Iterable[str | Path], more: Iterable[Path] = ()) -> str:
    """Hash of everything that a cut of these modules is made of, and of `more` files."""
    paths = {path for name in modules for path in _sources(root, name)}
    how = (root / "lavender_ext" / "build_options.py", Path(__file__))
    found = hashlib.sha256()
    for path in [*sorted(paths), *how, *more]:
        found.update(path.name.encode() + b"\0" + path.read_text(encoding="utf-8").encode() + b"\0")
    return found.hexdigest()


def translate(
    root: Path, modules: Iterable[str | Path], work: Path, made: Path | None = None
) -> list[tuple[str, str]]:
    """The C of modules of lavender_ext below `root` (or of paths of .pyx files), by Cython.

    made : folder of translations of an ordinary build; one that is newer than all its sources is taken.
    """
    directives = runpy.run_path(str(root / "lavender_ext" / "build_options.py"))["directives"]()
    given = [f"-X{name}={value}" for name, value in directives.items()]
    how = made / "how.json" if made else None
    if not (how and how.exists() and directives in json.loads(how.read_text(encoding="utf-8"))):
        made = None  # with every check on, or unfinished

    def one(module: str | Path) -> tuple[str, str]:
        source = path_of(root, module)
        name = module.stem if isinstance(module, Path) else module
        there = made.joinpath("lavender_ext", *name.split(".")).with_suffix(".c") if made else None
        if there and there.exists():
            newest = max(path.stat().st_mtime for path in _sources(root, module))
            if there.stat().st_mtime > newest:
                return name, there.read_text(encoding="utf-8")
        out = work / f"{name}.c"
        done = subprocess.run(
            [sys.executable, "-m", "cython", *given, "--shared=lavender_ext._utility", str(source), "-o", str(out)],
            cwd=root, capture_output=True, encoding="utf-8", errors="replace", check=False,
        )  # fmt: skip
        if done.returncode:
            raise ExtractionError(f"Cython cannot translate {source}:\n{(done.stdout + done.stderr)[-4000:]}")
        return name, out.read_text(encoding="utf-8")

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(one, modules))
