"""Check the kernels: their core needs neither Python nor static data, and their C is standard.

    python .ci/check_kernels.py

The core functions (`cdef public ... lav_*`) and everything they call must be self-contained, so that the same C
compiles to WebAssembly without an interpreter. An ordinary build does not detect violations, because an extension
module links Python anyway. Therefore the core functions of all modules are built as one WebAssembly module by
`lavender/sim/web/compile.py`, which rejects Python, exceptions, parallel loops, libm, malloc, variables and tables, and
names the functions that need them.

The sources are checked as well: signatures of core functions must be fixed-width and `noexcept nogil`, and directives
may be set in lavender_ext/build_options.py only. The C is checked as strict C11 (`DIALECT`), as gcc and clang compile
it and as a compiler without vector types does: the only permitted warning is `TABLES`.
"""

from __future__ import annotations

import os
import re
import runpy
import shlex
import subprocess
import sys
import sysconfig
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy

ROOT = Path(__file__).resolve().parent.parent
OPTIONS = runpy.run_path(str(ROOT / "lavender_ext" / "build_options.py"))

#: Standard C: compiler extensions only with a guard, no variable-length arrays (MSVC does not support them).
#: Overlong strings are permitted: Cython writes a module's Python names as one string.
DIALECT = [
    "-std=c11",
    "-pedantic",
    "-Wvla",
    "-Wall",
    "-Wno-unused-function",
    "-Wno-overlength-strings",
]
#: Selects the branch without vector types of every `#if defined(__GNUC__)` in the kernels.
PLAIN = ["-DLAVENDER_ONE_LANE"]
#: Warnings from function tables that Cython writes for other modules, and from that of NumPy's headers.
TABLES = re.compile(
    "ISO C forbids conversion of (function|object) pointer to (object|function) pointer type"
)

#: Types with the same size on every platform, so that a host outside C can build them; struct names also end in _t.
FIXED = re.compile(r"(void|float|double|u?int(8|16|32|64)_t|\w+_t)$")
NOT_FIXED = {"size_t", "ssize_t", "ptrdiff_t", "intptr_t", "uintptr_t", "Py_ssize_t", "wchar_t"}

CORE = re.compile(
    r"^cdef public (?!enum\b|struct\b|union\b|class\b)(?P<head>[^(\n]*?)(?P<name>\w+)"
    r"\((?P<args>[^)]*)\)(?P<tail>[^:]*):",
    re.MULTILINE,
)
HEADER = re.compile(r"#\s*cython\s*:(.*)", re.I)


def type_of(declaration: str) -> str:
    """Return the type in a declaration without const and pointers: `double` for `const double* x`."""
    words = [word for word in declaration.replace("*", " ").split() if word != "const"]
    return " ".join(words[:-1]) if len(words) > 1 else " ".join(words)


def read_source(path: Path) -> list[str]:
    """Return the rule violations in the text of a .pyx file."""
    text = path.read_text(encoding="utf-8")
    breaches = []
    for line in text.splitlines():
        if line.strip() and not line.startswith("#"):
            break
        header = HEADER.match(line)
        if header:
            breaches.append(
                f"directives at the head ({header[1].strip()}): they belong in build_options.py, "
                "or the debug build does not reach this module"
            )
    for match in CORE.finditer(text):
        name = match["name"]
        if not name.startswith("lav_"):
            breaches.append(f"{name}: a public function is a core function and is named lav_*")
            continue
        if match["tail"].split() != ["noexcept", "nogil"]:
            breaches.append(f"{name}: must be declared noexcept nogil")
        declarations = [f"{match['head']} {name}", *filter(str.strip, match["args"].split(","))]
        for declaration in declarations:
            kind = type_of(declaration)
            shown = " ".join(declaration.split())
            if "[" in declaration or kind in NOT_FIXED or not FIXED.match(kind):
                breaches.append(
                    f"{name}: '{shown}' is not of a fixed-width type or a pointer to one"
                )
            elif kind.endswith("int64_t") and "*" not in declaration:
                breaches.append(
                    f"{name}: '{shown}' passes a 64-bit integer by value (JavaScript: BigInt)"
                )
    return breaches


def run(*command: str | Path, cwd: Path = ROOT, **env: str) -> str:
    """Return the standard output of a command; raise RuntimeError with the end of its messages if it fails."""
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env={**os.environ, **env},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        shown = shlex.join(map(str, command))
        said = (done.stdout + done.stderr)[-3000:]
        raise RuntimeError(f"{shown} failed with status {done.returncode}:\n{said}")
    return done.stdout


def read_dialect(c_file: Path) -> list[str]:
    """Return the warnings of the C compiler about nonstandard C, except those of Cython's own tables."""
    compiler = shlex.split(os.environ.get("CC", "cc"))
    folders = [
        sysconfig.get_paths()["include"],
        str(ROOT),
        str(ROOT / "lavender_ext" / "batch"),
        numpy.get_include(),
    ]
    found: dict[str, None] = {}
    text = c_file.read_text(encoding="utf-8")
    guarded = PLAIN[0].removeprefix("-D") in text or re.search(r'(lanes|manifolds)\.h"', text)
    for more in (
        ([], PLAIN) if guarded else ([],)
    ):  # without the guard both compilations are the same
        command = [
            *compiler,
            *OPTIONS["COMPILE_FLAGS"],
            *DIALECT,
            *more,
            *(f"-I{folder}" for folder in folders),
            "-fsyntax-only",
            str(c_file),
        ]
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env={**os.environ, "LC_ALL": "C"}
        )
        lines = [
            line for line in done.stderr.splitlines() if re.search(r"\b(warning|error):", line)
        ]
        found.update(
            dict.fromkeys(line.partition(": ")[2] for line in lines if not TABLES.search(line))
        )
        if done.returncode and not found:
            raise RuntimeError(f"{shlex.join(command)} failed:\n{done.stderr}")
    return [f"not strict C11: {text}" for text in found]


def check(work: Path) -> tuple[list[str], str]:
    """Return the violations of all kernels, and a summary of the checks; `work` is a folder for outputs."""
    kernels = ROOT / "lavender_ext"
    sources = sorted(kernels.rglob("*.pyx"))
    modules = [".".join(path.relative_to(kernels).with_suffix("").parts) for path in sources]
    breaches = [f"{path.name}: {text}" for path in sources for text in read_source(path)]
    web = runpy.run_path(str(ROOT / "lavender" / "sim" / "web" / "compile.py"))
    files = []
    for name, text in web["EXTRACT_C"]["translate_modules_to_c"](
        ROOT, modules, work, ROOT / "build" / "cython"
    ):
        files.append(work / f"{name}.c")
        files[-1].write_text(text, encoding="utf-8")
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for name, found in zip(modules, pool.map(read_dialect, files), strict=True):
            breaches += [f"{name}: {text}" for text in found]
    told = f"{len(modules)} modules are strict C11"
    try:
        made = web["build"](work / "core.wasm", ROOT, modules, max_bytes=2**24)
        told += f"; {len(made.functions)} core functions stand alone, in {made.size} bytes of WebAssembly"
    except web["BuildFailed"] as error:
        breaches.append(str(error))
    return breaches, told


def main() -> int:
    """Print the violations and return 1 if there are any, else print the summary and return 0."""
    with tempfile.TemporaryDirectory() as work:
        breaches, told = check(Path(work))
    print("\n".join(f"BREACH {text}" for text in breaches) or told)
    return int(bool(breaches))


if __name__ == "__main__":
    sys.exit(main())
