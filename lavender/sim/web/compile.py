"""Compile the kernels to WebAssembly modules without Python, from the C that extract_c.py extracts from Cython's C.

    python lavender/sim/web/compile.py FOLDER          from the folder that contains lavender_ext

builds lavender.wasm (`PARTS`), which is independent, and newton.wasm, which a host loads in addition for exact solves.
The second module uses the memory of the first and imports nothing else.

Only the standard library and Cython are imported, so that setup.py can run this file before anything is built.

The core functions `cdef public ... lav_*` of the modules are extracted with everything that they use. There are three
checks:

* the extracted code must not use Python: extraction fails if a core function calls Python, uses a function of another
  module by pointer, or uses a variable of a module;
* no symbol may be undefined, and every exported function must exist: libm and malloc are not linked;
* the finished module has no static data, and its size is below a limit.

The last section of the module is the hash of its sources, so that a module of other sources is detected.

The compiler is ziglang (PyPI, the extra `wasm`), or the one named by LAVENDER_WASM_CC and LAVENDER_WASM_LD, such as
`clang --target=wasm32-wasi` and `wasm-ld`.
"""

from __future__ import annotations

import importlib.util
import os
import runpy
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from threading import get_native_id
from typing import Any

#: Modules of lavender_ext that the page uses.
MODULES = (
    "core.order",
    "engine.arrays",
    "engine.substep",
    "driver.memory",
    "judge.measure",
    "sweep.pgs",
)
#: Largest size of a finished module [bytes].
MAX_MODULE_BYTES = 270_000


@dataclass(frozen=True)
class Part:
    """One WebAssembly module of the page."""

    modules: tuple[str, ...]  # Kernel modules of lavender_ext.
    imports_memory: bool = False  # The module uses the memory of the first one.


#: Modules of the page by name; the first is independent.
PARTS = {
    "lavender": Part(MODULES),
    "newton": Part(
        (
            "core.order",
            "engine.newton_substep",
            "factor.linear",
            "factor.symbolic",
            "judge.measure",
            "newton.solve",
            "newton.warm_start",
            "sweep.pgs",
        ),
        imports_memory=True,
    ),
}
EXTRACT_C: dict[str, Any] = runpy.run_path(str(Path(__file__).resolve().with_name("extract_c.py")))
#: Name of the custom section with the hash of the sources, the last section of the file.
SOURCES_SECTION = "lavender.sources"
DATA_SECTION_ID = 11  # Number of the section of static data.
#: Exported symbols that are not functions: the beginning of free memory, and the ends of the section of static data.
LINKER_SYMBOLS = ("__heap_base", "__data_end", "__global_base")


class BuildFailed(Exception):
    """The module could not be built, or fails a check; the message contains the reason."""


@dataclass(frozen=True)
class Built:
    """Result of a build."""

    size: int  # [bytes]
    functions: tuple[str, ...]  # Exported functions.
    compiler: str  # Command of the compiler.


def explain_missing_requirement() -> str:
    """Return the reason why no module can be built here, or an empty text."""
    if importlib.util.find_spec("Cython") is None:
        return "Cython is not installed (pip install 'lavender-contact[wasm]')"
    named = os.environ.get("LAVENDER_WASM_CC", "")
    if named and shutil.which(shlex.split(named)[0]) is None:
        return f"LAVENDER_WASM_CC names {shlex.split(named)[0]!r}, which does not exist"
    if not named and importlib.util.find_spec("ziglang") is None:
        return (
            "no compiler for WebAssembly: pip install 'lavender-contact[wasm]' brings ziglang, or set "
            "LAVENDER_WASM_CC and LAVENDER_WASM_LD"
        )
    return ""


def hash_sources(root: Path, modules: Iterable[str | Path] = MODULES) -> str:
    """Return a hash of all files that a build of these modules reads; arguments as for `build`."""
    return str(EXTRACT_C["hash_sources"](root, modules))


def is_current(path: Path, root: Path, part: Part) -> bool:
    """Return whether `path` is a module of the part that was built from the sources below `root`."""
    return path.exists() and path.read_bytes().endswith(hash_sources(root, part.modules).encode())


def build(
    out: Path,
    root: Path,
    modules: Iterable[str | Path] = MODULES,
    *,
    max_bytes: int | None = None,
    imports_memory: bool = False,
) -> Built:
    """Build one WebAssembly module from the core functions of several kernel modules.

    Parameters
    ----------
    out : Path
        File to write; its folder exists.
    root : Path
        Folder that contains the package lavender_ext with its sources.
    modules : iterable of str or Path
        Names in lavender_ext, as `judge.measure`, or paths of .pyx files.
    max_bytes : int, optional
        The build fails if the module has this size [bytes] or a larger one. Default: `MAX_MODULE_BYTES`.
    imports_memory : bool
        The module imports the memory of an independent module as env.memory.

    Returns
    -------
    Built
    """
    reason = explain_missing_requirement()
    if reason:
        raise BuildFailed(reason)
    modules = list(modules)
    names = EXTRACT_C["list_core_functions"](root, modules)
    with tempfile.TemporaryDirectory(prefix="lavender-wasm-") as folder:
        source = Path(folder, "module.c")
        try:
            parts = EXTRACT_C["translate_modules_to_c"](
                root, modules, source.parent, root / "build" / "cython"
            )
            source.write_text(EXTRACT_C["extract_c"](parts, roots=names), encoding="utf-8")
        except EXTRACT_C["ExtractionError"] as error:
            raise BuildFailed(str(error)) from None
        data = _compile_to_wasm(source, names, ["--import-memory"] if imports_memory else [])
    _check_module(data, MAX_MODULE_BYTES if max_bytes is None else max_bytes)
    # A custom section has the number 0 and its length, one byte in LEB128 below 128.
    section = (
        bytes([len(SOURCES_SECTION)])
        + SOURCES_SECTION.encode()
        + hash_sources(root, modules).encode()
    )
    data += bytes([0, len(section)]) + section
    try:
        write_atomically(
            out.resolve(), data
        )  # If `out` is a symbolic link, replace its target and keep the link.
    except OSError as error:
        raise BuildFailed(f"cannot write {out}: {error.strerror or error}") from None
    return Built(len(data), tuple(sorted(names)), shlex.join(_find_tools()[0]))


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file atomically: concurrent readers get the old file or the new one."""
    part = path.with_name(f".{path.name}.{os.getpid()}.{get_native_id()}.part")
    try:
        part.write_bytes(data)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _compile_to_wasm(
    source: Path, names: Iterable[str], extra_options: Iterable[str] = ()
) -> bytes:
    """Compile and link one C file without Python headers to a module that exports the functions `names`."""
    compiler, linker, named = _find_tools()
    # Older versions of clang call memset and memcpy; zig uses instructions instead.
    flags = ["-std=c11", "-O3", "-g0", "-w", "-ffp-contract=off", "-ffunction-sections"]
    flags += ["-mbulk-memory"] if named else []
    compiled, linked = source.with_suffix(".o"), source.with_suffix(".wasm")
    _run_command([*compiler, *flags, "-c", str(source), "-o", str(compiled)], source.parent)
    exports = [f"--export={name}" for name in (*names, *LINKER_SYMBOLS)]
    link_options = ["--no-entry", "--gc-sections", "-s", *exports, *extra_options]
    try:
        _run_command([*linker, *link_options, str(compiled), "-o", str(linked)], source.parent)
    except BuildFailed as error:
        if "undefined symbol" not in str(error):
            raise
        raise BuildFailed(
            f"a kernel needs Python, libm or malloc, which WebAssembly does not provide:\n{error}"
        ) from None
    return linked.read_bytes()


def _find_tools() -> tuple[list[str], list[str], bool]:
    """Return the compiler, the linker, and whether an environment variable names the compiler."""
    zig = [sys.executable, "-m", "ziglang"]
    named = shlex.split(os.environ.get("LAVENDER_WASM_CC", ""))
    linker = shlex.split(os.environ.get("LAVENDER_WASM_LD", "")) or [*zig, "wasm-ld"]
    return named or [*zig, "cc", "-target", "wasm32-wasi"], linker, bool(named)


def _run_command(command: list[str], folder: Path) -> None:
    """Run a command in a folder; raise BuildFailed with its output if it fails."""
    env = dict(os.environ)
    if not os.access(
        os.path.expanduser("~"), os.W_OK | os.X_OK
    ):  # zig caches libraries in the home folder.
        env.setdefault("ZIG_GLOBAL_CACHE_DIR", str(folder / "cache"))
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=env,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            check=False,
        )
    except OSError as error:
        raise BuildFailed(f"{command[0]} cannot be run: {error.strerror or error}") from None
    if done.returncode:
        raise BuildFailed(f"{shlex.join(command)} failed:\n{(done.stdout + done.stderr)[-4000:]}")


def _check_module(module: bytes, max_bytes: int) -> None:
    """Raise BuildFailed if the module has static data or is too large; the linker reports its own errors."""
    position = (
        8  # Skip the magic word and the version; number, size and content of each section follow.
    )
    while position < len(module):
        kind = module[position]
        size = 0
        shift = 0
        position = position + 1
        while True:  # Read the section's size, a LEB128 integer.
            byte = module[position]
            position = position + 1
            size |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                break
        if kind == DATA_SECTION_ID:
            raise BuildFailed(
                f"a kernel reads static data ({size} bytes), which only Python initialises"
            )
        position += size
    if len(module) >= max_bytes:
        raise BuildFailed(
            f"the module has {len(module)} bytes; below {max_bytes} bytes are allowed: remove kernels from "
            "its list, or raise MAX_MODULE_BYTES"
        )


if __name__ == "__main__":
    ROOT = Path(__file__).resolve().parents[3]
    try:
        for name, part in PARTS.items():
            out = Path(sys.argv[1], f"{name}.wasm")
            print(build(out, ROOT, part.modules, imports_memory=part.imports_memory))
    except BuildFailed as failure:
        sys.exit(str(failure))
