"""Check that the compiled core of every kernel module needs neither Python nor static data.

    python .ci/check_kernels.py [FILE.pyx ...]        without files: every module in lavender_ext

What the core functions (`cdef public ... lav_*`) reach must stand alone: the same C then compiles to
WebAssembly without an interpreter. An ordinary build never shows a breach, because the whole extension module
has Python at hand. So each module is translated, compiled with one section per function, and linked with only
its core functions as roots; the linker drops the Python part, and in what is left

* a relocation to a symbol outside the object may only name `ALLOWED` (else: a call into Python, an exception,
  a parallel loop, libm, malloc);
* no writable section may be left (else: a module-level variable or an imported function pointer, which only
  the initialisation of the Python module would fill), and no read-only data but the literals of instructions
  (else: a table or a string).

The sources are read too: signatures of core functions are fixed-width and `noexcept nogil`, directives stand
in lavender_ext/build_options.py alone, and nothing imports lavender. And the C is read as strict C11 (`DIALECT`), once
as gcc and clang compile it, once as a compiler without vector types does: of warnings only `CYTHONS_OWN` may come.
"""

from __future__ import annotations

import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
OPTIONS = runpy.run_path(str(ROOT / "lavender_ext" / "build_options.py"))

#: sqrt and floor are exact, so every libm gives the same bits; compilers write the mem functions themselves.
ALLOWED = frozenset({"sqrt", "floor", "memcpy", "memset", "memmove"})

#: Standard C: no extension of a compiler without a guard, no array of variable length (MSVC has none).
#: The table of a module's Python names is one string of Cython's, of any length.
DIALECT = ["-std=c11", "-pedantic", "-Wvla", "-Wall", "-Wno-unused-function", "-Wno-overlength-strings"]
#: The plain branch of every `#if defined(__GNUC__)` of ours.
PLAIN = ["-DLAVENDER_ONE_LANE"]
#: What Cython writes into each module: tables of functions for other modules, as pointers to objects.
CYTHONS_OWN = "ISO C forbids conversion of function pointer to object pointer type"

#: Modules of these names are exempt from the check of what a core reaches, with the reason. `threaded` yields and
#: sleeps by the system's calls; `checked_sweeps` calls the Python faces of kernels one after the other, `many` and
#: `call` the kernels themselves, and allocate what these need; `checks` and `blocks` read arrays of Python, `method`
#: and `solve` lead the driver's newton for Python. The arithmetic of all is that of other modules, which this
#: check sees, but for the logarithms by which `checked_sweeps` guesses about sweeps; that of `pgs`, `serial`,
#: `gauss_seidel`, `accelerated`, `direct`, `lemke`, `principal`, `measure` and `watch` is cut out for the C library,
#: which refuses what needs Python.
EXEMPT = {
    "threaded": "threads",
    "pgs": "called by serial; the C library has it whole",
    "gauss_seidel": "called by serial; the C library has it whole",
    "serial": "calls loops over blocks by pointer; the C library has it whole",
    "accelerated": "calls sweeps by pointer; the C library has it whole",
    "checked_sweeps": "calls kernels, guesses how long they will take",
    "checks": "reads arrays of Python, computes nothing",
    "blocks": "reads and fills arrays of Python, computes nothing",
    "many": "allocates and calls kernels, computes nothing",
    "call": "allocates, copies islands out and calls kernels, computes nothing",
    "direct": "calls rounds of pivots by pointer; the C library has it whole",
    "lemke": "calls the rounds of direct; the C library has it whole",
    "principal": "called by direct; the C library has it whole",
    "measure": "thin entries of the judge for Python; the C library has it whole",
    "watch": "the loop of sweeps and checks for Python; the C library has it whole",
    "method": "leads the steps of a method for Python, computes nothing",
    "start": "makes room for Python; its arithmetic is in the substep's core",
    "solve": "calls the turns that the driver calls, in arrays of Python",
}

#: Types that have one size everywhere, as a host outside C must build them; structs end in _t too.
FIXED = re.compile(r"(void|float|double|u?int(8|16|32|64)_t|\w+_t)$")
NOT_FIXED = {"size_t", "ssize_t", "ptrdiff_t", "intptr_t", "uintptr_t", "Py_ssize_t", "wchar_t"}

CORE = re.compile(
    r"^cdef public (?!enum\b|struct\b|union\b|class\b)(?P<head>[^(\n]*?)(?P<name>\w+)"
    r"\((?P<args>[^)]*)\)(?P<tail>[^:]*):",
    re.MULTILINE,
)
HEADER = re.compile(r"#\s*cython\s*:(.*)", re.I)


@dataclass
class Verdict:
    """What was found in one module: its core functions, their code in bytes, warnings of Cython's own, breaches."""

    module: str
    functions: list[str] = field(default_factory=list)
    code: int = 0
    warnings: int = 0
    breaches: list[str] = field(default_factory=list)
    exempt: str = ""

    def __str__(self) -> str:
        core = f"{len(self.functions)} core functions, {self.code} bytes of code"
        said = f"exempt ({self.exempt})" if self.exempt else core
        lines = [f"{self.module}: {said}, {self.warnings} warnings of Cython's own in strict C11"]
        return "\n".join([*lines, *(f"  BREACH {text}" for text in self.breaches)])


def type_of(declaration: str) -> str:
    """The type in `const double* x`, without const and pointer stars: `double`."""
    words = [word for word in declaration.replace("*", " ").split() if word != "const"]
    return " ".join(words[:-1]) if len(words) > 1 else " ".join(words)


def read_source(path: Path) -> tuple[list[str], list[str]]:
    """Names of the core functions in a .pyx file, and what its text breaks."""
    text = path.read_text(encoding="utf-8")
    names, breaches = [], []
    for line in text.splitlines():
        if line.strip() and not line.startswith("#"):
            break
        header = HEADER.match(line)
        if header:
            breaches.append(
                f"directives at the head ({header[1].strip()}): they belong in build_options.py, "
                "or the debug build does not reach this module"
            )
    if re.search(r"^\s*(from|import|cimport)\s+lavender\b(?!_)", text, re.M):
        breaches.append("imports lavender: the kernels stand below it")
    for match in CORE.finditer(text):
        name = match["name"]
        if not name.startswith("lav_"):
            breaches.append(f"{name}: a public function is a core function and is named lav_*")
            continue
        names.append(name)
        if match["tail"].split() != ["noexcept", "nogil"]:
            breaches.append(f"{name}: must be declared noexcept nogil")
        declarations = [f"{match['head']} {name}", *filter(str.strip, match["args"].split(","))]
        for declaration in declarations:
            kind, shown = type_of(declaration), " ".join(declaration.split())
            if "[" in declaration or kind in NOT_FIXED or not FIXED.match(kind):
                breaches.append(f"{name}: '{shown}' is not of a fixed-width type or a pointer to one")
            elif kind.endswith("int64_t") and "*" not in declaration:
                breaches.append(f"{name}: '{shown}' passes a 64-bit integer by value (JavaScript: BigInt)")
    if not names and not breaches:
        breaches.append("has no core function `cdef public ... lav_*(...) noexcept nogil`")
    return names, breaches


def run(*command: str | Path, cwd: Path = ROOT, **env: str) -> str:
    """Standard output of a command; RuntimeError with the end of its messages if it fails."""
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd, env={**os.environ, **env}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        shown = shlex.join(map(str, command))
        said = (done.stdout + done.stderr)[-3000:]
        raise RuntimeError(f"{shown} failed with status {done.returncode}:\n{said}")
    return done.stdout


LOADING = Lock()  # runpy changes sys.modules


@cache
def cut() -> dict[str, Any]:
    """What takes the C of a build; it stands on a floor above the kernels."""
    return runpy.run_path(str(ROOT / "lavender" / "sim" / "web" / "cut.py"))


def translate(path: Path, root: Path, work: Path) -> Path:
    """Cython's C of a module; of one of the kernels that of the build in place, where it is newer than its sources."""
    c_file = work / f"{path.stem}.c"
    if path.is_relative_to(ROOT / "lavender_ext"):
        module = ".".join(path.relative_to(ROOT / "lavender_ext").with_suffix("").parts)
        with LOADING:
            found = cut()
        [(_, text)] = found["translate"](ROOT, [module], work, ROOT / "build" / "cython")
        c_file.write_text(text, encoding="utf-8")
        return c_file
    directives = [f"-X{name}={value}" for name, value in OPTIONS["directives"]().items()]
    # What Python's side needs stands in a module of its own, as in an ordinary build: half of what would be compiled.
    shared = "--shared=lavender_ext._utility"
    run(sys.executable, "-m", "cython", *directives, shared, path, "-o", c_file, cwd=root)
    return c_file


def read_dialect(c_file: Path) -> tuple[int, list[str]]:
    """Warnings of Cython's own, and what is not standard C otherwise."""
    compiler = shlex.split(os.environ.get("CC", "cc"))
    include = "-I" + sysconfig.get_paths()["include"]
    found: dict[str, None] = {}
    own = 0
    for more in ([], PLAIN):
        command = [
            *compiler,
            *OPTIONS["COMPILE_FLAGS"],
            *DIALECT,
            *more,
            include,
            "-fsyntax-only",
            str(c_file),
        ]
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env={**os.environ, "LC_ALL": "C"}
        )
        lines = [line for line in done.stderr.splitlines() if re.search(r"\b(warning|error):", line)]
        own = max(own, sum(CYTHONS_OWN in line for line in lines))
        found.update(dict.fromkeys(line.partition(": ")[2] for line in lines if CYTHONS_OWN not in line))
        if done.returncode and not found:
            raise RuntimeError(f"{shlex.join(command)} failed:\n{done.stderr}")
    return own, [f"not strict C11: {text}" for text in found]


def link_core(c_file: Path, names: list[str], root: Path, work: Path) -> Path:
    """The object file that holds what the functions `names` of a translated module reach, and nothing else."""
    compiler = shlex.split(os.environ.get("CC", "cc"))
    whole, core = (work / (c_file.stem + suffix) for suffix in (".o", ".core.o"))
    sections = ["-ffunction-sections", "-fdata-sections", "-fno-jump-tables", "-fno-tree-switch-conversion"]
    plain = [
        "-fno-stack-protector",
        "-fno-asynchronous-unwind-tables",
        "-U_FORTIFY_SOURCE",
        "-fPIC",
        "-w",
        "-O1",
    ]
    include = "-I" + sysconfig.get_paths()["include"]
    run(*compiler, *OPTIONS["COMPILE_FLAGS"], *sections, *plain, include, "-c", c_file, "-o", whole, cwd=root)
    roots = [f"-Wl,-u,{name}" for name in names]
    run(*compiler, "-r", "-nostdlib", "-no-pie", "-Wl,--gc-sections", *roots, whole, "-o", core, cwd=root)
    return core


def read_object(core: Path) -> tuple[int, list[str]]:
    """Bytes of code in a linked core, and what it breaks."""
    code, breaches = 0, []
    section = re.compile(
        r"\] (?P<name>\.\S+)\s+(?:PROGBITS|NOBITS)\s+\S+ \S+ (?P<size>\S+) \S+\s+(?P<flags>\w*)"
        r"\s+\d+\s+\d+\s+\d+$",
        re.MULTILINE,
    )
    for match in section.finditer(run("readelf", "-SW", core, cwd=core.parent)):
        name, size, flags = match["name"], int(match["size"], 16), match["flags"]
        if "A" not in flags or not size or name.startswith(".note"):
            continue
        if "X" in flags:
            code += size
        elif "W" in flags:
            breaches.append(
                f"reads or writes static data: {name}, {size} bytes, which no one fills outside Python"
            )
        elif not name.startswith(".rodata.cst"):
            breaches.append(f"reads a constant table or string: {name}, {size} bytes")
    symbol_line = re.compile(r"^\s*\d+: \S+\s+\S+ \w+\s+\w+\s+\w+\s+(?!UND)\S+ (\S+)$", re.MULTILINE)
    defined = set(symbol_line.findall(run("readelf", "-sW", core, cwd=core.parent)))
    used_by: dict[str, set[str]] = {}
    user = ""
    for line in run("readelf", "-rW", core, cwd=core.parent).splitlines():
        head = re.match(r"Relocation section '\.rela?(\S+)'", line)
        if head:
            user = re.sub(r"^\.text\.(unlikely\.|hot\.|startup\.)?", "", head[1])
        entry = re.match(r"[0-9a-f]{8,16}\s+[0-9a-f]{8,16}\s+R_\S+\s+[0-9a-f]{8,16}\s+(\S+)", line)
        if entry and not entry[1].startswith("."):
            symbol = entry[1].split("@")[0]
            if symbol not in defined and symbol not in ALLOWED:
                used_by.setdefault(symbol, set()).add(user)
    breaches += [
        f"needs {symbol} (in {', '.join(sorted(users))})" for symbol, users in sorted(used_by.items())
    ]
    return code, breaches


def check(path: Path, root: Path = ROOT) -> Verdict:
    """Check one .pyx file.

    Parameters
    ----------
    path : Path
        The module; what it cimports is found from `root`.
    root : Path, optional
        The folder that holds the package lavender_ext.

    Returns
    -------
    Verdict
        Without breaches when the core stands alone.

    Raises
    ------
    RuntimeError
        If Cython, the compiler or the linker fails.
    """
    path, root = path.resolve(), root.resolve()
    inside = path.relative_to(root) if path.is_relative_to(root) else Path(path.name)
    name = ".".join(inside.with_suffix("").parts)
    verdict = Verdict(name, exempt=EXEMPT.get(path.stem, ""))
    if not verdict.exempt:
        verdict.functions, verdict.breaches = read_source(path)
    if verdict.functions or verdict.exempt:
        with tempfile.TemporaryDirectory() as work:
            c_file = translate(path, root, Path(work))
            verdict.warnings, found = read_dialect(c_file)
            verdict.breaches += found
            if verdict.functions:
                core = link_core(c_file, verdict.functions, root, Path(work))
                verdict.code, found = read_object(core)
                verdict.breaches += found
    return verdict


def tools_missing() -> str:
    """Why the check cannot run here; empty when it can."""
    if not sys.platform.startswith("linux"):
        return "the check reads ELF objects, so it runs on Linux"
    needed = [shlex.split(os.environ.get("CC", "cc"))[0], "readelf"]
    absent = [tool for tool in needed if shutil.which(tool) is None]
    return f"not found: {', '.join(absent)} (a C compiler and binutils are needed)" if absent else ""


def main(arguments: list[str]) -> int:
    """Print a verdict for each module; 0 when all are pure."""
    missing = tools_missing()
    if missing:
        print(missing, file=sys.stderr)
        return 2
    paths = [Path(name) for name in arguments] or sorted((ROOT / "lavender_ext").rglob("*.pyx"))
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        verdicts = list(pool.map(check, paths))
    for verdict in verdicts:
        print(verdict)
    return int(not verdicts or any(verdict.breaches for verdict in verdicts))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
