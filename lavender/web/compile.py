"""The kernels as WebAssembly modules without Python: Cython's C, a C compiler for wasm32, a linker.

    python lavender/web/compile.py FOLDER          from the root of the project, or wherever lavender_ext lies

makes lavender.wasm (`PARTS`), which stands alone, and newton.wasm, which a host that asks for exact solves loads beside
it: it works on the memory of the first and imports nothing else.

Only the standard library and Cython are imported, so that setup.py can run this before anything is built.

Cython translates a module to C that holds its Python part and its core. The linker keeps what the exported
core functions reach, and nothing else; three checks make that safe:

* no symbol may stay undefined, so a core that calls Python, libm or malloc does not link;
* no data may be left (`__data_end == __global_base`), since a module-level variable or an imported function
  pointer is filled by the initialisation of a Python module, which never runs here;
* the finished module is read back: no imports (the memory alone, of one that works beside another), exactly the
  expected functions, a size below its limit.

A custom section of the module holds the hash of the sources it was built from, so that one from other sources
is noticed.

The compiler is ziglang's (PyPI, the extra `wasm`), or what LAVENDER_WASM_CC and LAVENDER_WASM_LD name, such
as `clang --target=wasm32-wasi` and `wasm-ld`.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

__all__ = [
    "LARGEST",
    "MODULES",
    "PARTS",
    "BuildFailed",
    "Built",
    "Part",
    "build",
    "is_current",
    "read_module",
    "source_hash",
    "why_not",
]

#: Modules of lavender_ext that the page and the checks use.
MODULES = (
    "engine.arrays",
    "core.order",
    "core.problem",
    "engine.substep",
    "host.memory",
    "judge.measure",
    "sweep.serial",
)
#: Largest size of a finished module [bytes].
LARGEST = 200_000


@dataclass(frozen=True)
class Part:
    """One module of the page: its kernels, how large it may be [bytes], whether it works in the memory of the first."""

    modules: tuple[str, ...]
    largest: int
    beside: bool = False


#: Modules of the page by name; the first stands alone.
PARTS = {"lavender": Part(MODULES, LARGEST), "newton": Part(("warm.substep",), 130_000, beside=True)}
MEMORY = "env.memory"
CIMPORT = re.compile(r"^from lavender_ext\.([\w.]+) cimport", re.MULTILINE)
#: Name of the custom section with the hash of the sources.
SECTION = "lavender.sources"
#: What the host needs beside the functions: where free memory begins, and the proof that no data is left.
EDGES = ("__heap_base", "__data_end", "__global_base")

#: CPython's headers describe the machine they were installed on; wasm32 has 4-byte pointers. This file stands
#: in for their pyconfig.h.
PYCONFIG = "\n".join(
    [
        "#ifndef Py_PYCONFIG_H",
        "#define Py_PYCONFIG_H",
        *(
            f"#define {name} {value}"
            for name, value in {
                "SIZEOF_SHORT": 2, "SIZEOF_INT": 4, "SIZEOF_LONG": 4, "SIZEOF_LONG_LONG": 8, "SIZEOF_VOID_P": 4,
                "SIZEOF_SIZE_T": 4, "SIZEOF_UINTPTR_T": 4, "SIZEOF_WCHAR_T": 4, "SIZEOF_TIME_T": 8, "SIZEOF_OFF_T": 8,
                "SIZEOF_FLOAT": 4, "SIZEOF_DOUBLE": 8, "SIZEOF_FPOS_T": 16, "SIZEOF_PID_T": 4, "ALIGNOF_LONG": 4,
                "ALIGNOF_SIZE_T": 4,
            }.items()
        ),
        *(
            f"#define {name} 1"
            for name in (
                "STDC_HEADERS", "HAVE_STDINT_H", "HAVE_STDDEF_H", "HAVE_STDLIB_H", "HAVE_STRING_H", "HAVE_SYS_TYPES_H",
                "HAVE_PROTOTYPES", "HAVE_DECL_ISINF", "HAVE_DECL_ISNAN", "HAVE_DECL_ISFINITE", "HAVE_SSIZE_T",
                "HAVE_PTHREAD_STUBS",
            )
        ),
        "#endif",
        "",
    ]
)  # fmt: skip


class BuildFailed(Exception):
    """The module could not be built, or is not what it must be; the message says why."""


@dataclass(frozen=True)
class Built:
    """What was built: size [bytes], exported functions, imports."""

    size: int
    functions: tuple[str, ...]
    imports: tuple[str, ...]
    compiler: str


def why_not() -> str:
    """Why no module can be built here; empty when it can."""
    if importlib.util.find_spec("Cython") is None:
        return "Cython is not installed (pip install 'lavender-contact[wasm]')"
    named = os.environ.get("LAVENDER_WASM_CC", "")
    if named and shutil.which(shlex.split(named)[0]) is None:
        return f"LAVENDER_WASM_CC names {shlex.split(named)[0]!r}, which is not there"
    if not named and importlib.util.find_spec("ziglang") is None:
        return (
            "no compiler for WebAssembly: pip install 'lavender-contact[wasm]' brings ziglang, or set "
            "LAVENDER_WASM_CC and LAVENDER_WASM_LD"
        )
    if not named and sys.version_info < (3, 11):
        return (
            f"the headers of CPython {sys.version_info[0]}.{sys.version_info[1]} do not compile for wasm32; "
            "build with CPython 3.11 or newer"
        )
    if not Path(sysconfig.get_paths()["include"], "Python.h").exists():
        return f"CPython's headers are not in {sysconfig.get_paths()['include']}: install them (python3-dev)"
    return ""


def core_functions(text: str) -> list[str]:
    """Names of the core functions `cdef public ... lav_*` in the source of a module."""
    return re.findall(r"^cdef public [^(\n]*?\b(lav_\w+)\(", text, re.MULTILINE)


def source_hash(root: Path, modules: Iterable[str | Path] = MODULES) -> str:
    """Hash of everything that a build of these modules reads of lavender_ext; arguments as for `build`."""
    open_, seen = _paths(root, modules), set()
    while open_:
        path = open_.pop()
        if path in seen or not path.exists():
            continue
        seen.add(path)
        text = path.read_text(encoding="utf-8")
        open_ += [path.with_suffix(".pxd"), *(_path(root, name, ".pxd") for name in CIMPORT.findall(text))]
    found = hashlib.sha256()
    for path in sorted({*seen, _path(root, "build_options", ".py")}):
        found.update(path.name.encode() + b"\0" + path.read_text(encoding="utf-8").encode() + b"\0")
    return found.hexdigest()


def is_current(path: Path, root: Path, part: Part) -> bool:
    """Whether a module of a part lies at `path` and is of the sources below `root`."""
    return path.exists() and read_module(path.read_bytes()).sources == source_hash(root, part.modules)


def _path(root: Path, name: str, suffix: str) -> Path:
    return root.joinpath("lavender_ext", *name.split(".")).with_suffix(suffix)


def _paths(root: Path, modules: Iterable[str | Path]) -> list[Path]:
    return [m if isinstance(m, Path) else _path(root, m, ".pyx") for m in modules]


def build(
    out: Path,
    root: Path,
    modules: Iterable[str | Path] = MODULES,
    *,
    include: Path | None = None,
    largest: int | None = None,
    beside: bool = False,
) -> Built:
    """Build one module of the core functions of several kernel modules.

    Parameters
    ----------
    out : Path
        File to write; its folder exists.
    root : Path
        Folder that holds the package lavender_ext with its sources.
    modules : iterable of str or Path
        Names in lavender_ext, as `judge.measure`, or paths of .pyx files.
    include : Path, optional
        CPython's headers; None: those of this interpreter.
    largest : int, optional
        Size that is refused [bytes]; `LARGEST`.
    beside : bool
        The module imports its memory, as `MEMORY`: that of one that stands alone.

    Returns
    -------
    Built

    Raises
    ------
    BuildFailed
        No compiler; the kernels need Python, an import or static data; a module too large.
    """
    reason = why_not()
    if reason:
        raise BuildFailed(reason)
    paths = _paths(root, modules)
    names = [name for path in paths for name in core_functions(path.read_text(encoding="utf-8"))]
    compiler, linker, named = _tools()
    options = runpy.run_path(str(root / "lavender_ext" / "build_options.py"))
    with tempfile.TemporaryDirectory(prefix="lavender-wasm-") as folder:
        work = Path(folder)
        headers = work / "include"
        shutil.copytree(include or sysconfig.get_paths()["include"], headers)
        (headers / "pyconfig.h").write_text(PYCONFIG)
        directives = [f"-X{name}={value}" for name, value in options["directives"]().items()]
        flags = [
            *options["COMPILE_FLAGS"],
            *["-O3", "-g0", "-w", "-ffunction-sections", "-fdata-sections"],
            # Older clangs call memset and memcpy where zig writes the instructions that stand for them.
            *(["-mbulk-memory"] if named else []),
            f"-I{headers}",
        ]

        def compile_one(path: Path) -> Path:
            name = f"{path.parent.name}-{path.stem}"
            source, target = work / f"{name}.c", work / f"{name}.o"
            _run([sys.executable, "-m", "cython", *directives, str(path), "-o", str(source)], root)
            _run([*compiler, *flags, "-c", str(source), "-o", str(target)], root)
            return target

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            objects = list(pool.map(compile_one, paths))
        module = work / "module.wasm"
        keep = ["--no-entry", "--gc-sections", "-s", *(f"--export={name}" for name in (*names, *EDGES))]
        keep += ["--import-memory"] if beside else []
        try:
            _run([*linker, *keep, *map(str, objects), "-o", str(module)], root)
        except BuildFailed as error:
            if "undefined symbol" not in str(error):
                raise
            raise BuildFailed(
                f"a kernel needs Python, libm or malloc, which are not there:\n{error}"
            ) from None
        data = module.read_bytes()
        found = read_module(data)
        _check(found, names, len(data), LARGEST if largest is None else largest, (MEMORY,) if beside else ())
        data += _section(SECTION, source_hash(root, paths).encode())
        # Moved into place in one step: whoever reads `out` at the same time sees the old file or the new one.
        out = out.resolve()  # a link stays, what is behind it is replaced
        part = out.with_name(out.name + f".{os.getpid()}")
        if out.exists() and not out.is_file():
            raise BuildFailed(
                f"cannot write {out}: it is no file, and is not replaced; give the name of a file"
            )
        try:
            part.write_bytes(data)
            part.replace(out)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise BuildFailed(f"cannot write {out}: {error.strerror or error}") from None
    return Built(len(data), tuple(sorted(names)), found.imports, shlex.join(compiler))


def _tools() -> tuple[list[str], list[str], bool]:
    """Compiler, linker, and whether a variable of the environment names the compiler."""
    zig = [sys.executable, "-m", "ziglang"]
    named = shlex.split(os.environ.get("LAVENDER_WASM_CC", ""))
    linker = shlex.split(os.environ.get("LAVENDER_WASM_LD", "")) or [*zig, "wasm-ld"]
    return named or [*zig, "cc", "-target", "wasm32-wasi"], linker, bool(named)


def build_library(out: Path, source: Path, names: Iterable[str]) -> Module:
    """One C file that needs no header of Python's, its functions exported with the memory; nothing is imported.

    Raises
    ------
    BuildFailed
        No compiler, or the file needs a function that is not in it.
    """
    compiler, linker, named = _tools()
    if not named and importlib.util.find_spec("ziglang") is None:
        raise BuildFailed(
            "no compiler for WebAssembly: pip install 'lavender-contact[wasm]' brings ziglang, or set "
            "LAVENDER_WASM_CC and LAVENDER_WASM_LD"
        )
    with tempfile.TemporaryDirectory(prefix="lavender-wasm-") as folder:
        compiled, linked = Path(folder, "library.o"), Path(folder, "library.wasm")
        flags = ["-std=c11", "-O3", "-g0", "-ffp-contract=off", *(["-mbulk-memory"] if named else [])]
        _run([*compiler, *flags, "-c", str(source), "-o", str(compiled)], source.parent)
        keep = ["--no-entry", "--gc-sections", "-s", *(f"--export={name}" for name in (*names, *EDGES))]
        _run([*linker, *keep, str(compiled), "-o", str(linked)], source.parent)
        data = linked.read_bytes()
    found = read_module(data)
    if found.imports:
        raise BuildFailed(f"the module imports {', '.join(found.imports)}; it must stand alone")
    out.write_bytes(data)
    return found


def _run(command: list[str], folder: Path) -> None:
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    except OSError as error:
        raise BuildFailed(f"{command[0]} cannot be run: {error.strerror or error}") from None
    if done.returncode:
        raise BuildFailed(f"{shlex.join(command)} failed:\n{(done.stdout + done.stderr)[-4000:]}")


def _check(found: Module, names: list[str], size: int, largest: int, imports: tuple[str, ...]) -> None:
    if found.imports != imports:
        may = f"{', '.join(imports)} alone may be" if imports else "it must stand alone"
        raise BuildFailed(f"the module imports {', '.join(found.imports) or 'nothing'}; {may}")
    edges = {name: found.globals.get(name) for name in EDGES}
    if None in edges.values() or edges["__data_end"] != edges["__global_base"] or found.data_segments:
        raise BuildFailed(
            "a kernel reads or writes static data, which nothing fills outside Python: "
            f"{edges}, {found.data_segments} data segments"
        )
    missing = sorted(set(names) ^ set(found.functions))
    if missing:
        raise BuildFailed(f"exported functions are not those of the sources: {', '.join(missing)}")
    if size >= largest:
        raise BuildFailed(f"the module has {size} bytes; below {largest} are allowed")


@dataclass(frozen=True)
class Module:
    """What a WebAssembly file says of itself: imports, exports, data segments, hash of its sources."""

    imports: tuple[str, ...]
    functions: tuple[str, ...]
    globals: dict[str, int]  # exported constants
    data_segments: int
    sources: str  # empty where the file does not say


def read_module(data: bytes) -> Module:
    """Read the sections of a WebAssembly module (version 1).

    Parameters
    ----------
    data : bytes
        The file.

    Returns
    -------
    Module

    Raises
    ------
    BuildFailed
        Not such a file.
    """
    if data[:8] != b"\0asm\1\0\0\0":
        raise BuildFailed("not a WebAssembly module of version 1")
    sections = {}
    sources = ""
    at = 8
    while at < len(data):
        kind = data[at]
        size, at = _number(data, at + 1)
        if kind:
            sections[kind] = (at, at + size)
        else:
            name, start = _name(data, at)
            if name == SECTION:
                sources = data[start : at + size].decode()
        at += size
    imports, functions, constants = [], [], {}
    if 2 in sections:
        count, at = _number(data, sections[2][0])
        if count:
            name, at = _name(data, at)
            field, at = _name(data, at)
            imports.append(f"{name}.{field}" + (f" and {count - 1} more" if count > 1 else ""))
    values = []
    if 6 in sections:
        count, at = _number(data, sections[6][0])
        for _ in range(count):
            # type, mutability, then i32.const VALUE end
            if data[at] != 0x7F or data[at + 2] != 0x41:
                raise BuildFailed("a global of the module is not a 32-bit constant")
            value, at = _number(data, at + 3, signed=True)
            values.append(value)
            at += 1
    if 7 in sections:
        count, at = _number(data, sections[7][0])
        for _ in range(count):
            name, at = _name(data, at)
            kind = data[at]
            index, at = _number(data, at + 1)
            if kind == 0:
                functions.append(name)
            elif kind == 3:
                constants[name] = values[index]
    segments = _number(data, sections[11][0])[0] if 11 in sections else 0
    return Module(tuple(imports), tuple(functions), constants, segments, sources)


def _number(data: bytes, at: int, signed: bool = False) -> tuple[int, int]:
    # LEB128
    value = shift = 0
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            break
    if signed and byte & 0x40:
        value -= 1 << shift
    return value, at


def _section(name: str, content: bytes) -> bytes:
    # A custom section; lengths below 128 are one byte in LEB128.
    body = bytes([len(name)]) + name.encode() + content
    if len(body) >= 128:
        raise ValueError("a custom section longer than 127 bytes")
    return bytes([0, len(body)]) + body


def _name(data: bytes, at: int) -> tuple[str, int]:
    size, at = _number(data, at)
    return data[at : at + size].decode(), at + size


if __name__ == "__main__":
    ROOT = Path(__file__).resolve().parent.parent.parent
    try:
        for name, part in PARTS.items():
            out = Path(sys.argv[1], f"{name}.wasm")
            print(build(out, ROOT, part.modules, largest=part.largest, beside=part.beside))
    except BuildFailed as failure:
        sys.exit(str(failure))
