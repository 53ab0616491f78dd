"""The kernels as WebAssembly modules without Python: what extract_c.py takes out of Cython's C, a compiler for wasm32.

    python lavender/sim/web/compile.py FOLDER          from the root of the project, or wherever lavender_ext lies

makes lavender.wasm (`PARTS`), which stands alone, and newton.wasm, which a host that asks for exact solves loads beside
it: it works on the memory of the first and imports nothing else.

Only the standard library and Cython are imported, so that setup.py can run this before anything is built.

The core functions `cdef public ... lav_*` of the modules are cut out with what they reach. Three checks make that safe:

* what is reached must not name Python: a core that calls Python, a function of another module by pointer or a
  variable of a module is not cut out;
* no symbol may stay undefined, and every function must be there to be exported: libm or malloc do not link;
* the finished module has no static data, and a size below its limit.

The last section of the module is the hash of the sources it was built from, so that one from other sources is
noticed.

The compiler is ziglang's (PyPI, the extra `wasm`), or what LAVENDER_WASM_CC and LAVENDER_WASM_LD name, such
as `clang --target=wasm32-wasi` and `wasm-ld`.
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
MODULES = ("engine.arrays", "engine.substep", "host.memory", "judge.measure")
#: Largest size of a finished module [bytes].
LARGEST = 220_000


@dataclass(frozen=True)
class Part:
    """One module of the page: its kernels, whether it works in the memory of the first."""

    modules: tuple[str, ...]
    beside: bool = False


#: Modules of the page by name; the first stands alone.
PARTS = {
    "lavender": Part(MODULES),
    "newton": Part(
        ("engine.newton_substep", "judge.measure", "newton.solve", "newton.warm_start"), beside=True
    ),
}
EXTRACT_C: dict[str, Any] = runpy.run_path(str(Path(__file__).resolve().with_name("extract_c.py")))
#: Name of the custom section with the hash of the sources, which ends the file.
SECTION = "lavender.sources"
DATA = 11  # number of the section of static data
#: What the host needs beside the functions: where free memory begins, and the proof that no data is left.
EDGES = ("__heap_base", "__data_end", "__global_base")


class BuildFailed(Exception):
    """The module could not be built, or is not what it must be; the message says why."""


@dataclass(frozen=True)
class Built:
    """What was built: size [bytes], exported functions."""

    size: int
    functions: tuple[str, ...]
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
    return ""


def source_hash(root: Path, modules: Iterable[str | Path] = MODULES) -> str:
    """Hash of everything that a build of these modules reads; arguments as for `build`."""
    return str(EXTRACT_C["source_hash"](root, modules))


def is_current(path: Path, root: Path, part: Part) -> bool:
    """Whether a module of a part lies at `path` and is of the sources below `root`."""
    return path.exists() and path.read_bytes().endswith(source_hash(root, part.modules).encode())


def build(
    out: Path,
    root: Path,
    modules: Iterable[str | Path] = MODULES,
    *,
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
    largest : int, optional
        Size that is refused [bytes]; `LARGEST`.
    beside : bool
        The module imports its memory, as env.memory: that of one that stands alone.

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
    modules = list(modules)
    names = EXTRACT_C["core_functions"](root, modules)
    with tempfile.TemporaryDirectory(prefix="lavender-wasm-") as folder:
        source = Path(folder, "module.c")
        try:
            parts = EXTRACT_C["translate"](root, modules, source.parent, root / "build" / "cython")
            source.write_text(EXTRACT_C["extract_c"](parts, roots=names), encoding="utf-8")
        except EXTRACT_C["ExtractionError"] as error:
            raise BuildFailed(str(error)) from None
        data = _compiled(source, names, ["--import-memory"] if beside else [])
    _check(data, LARGEST if largest is None else largest)
    data += section(SECTION, source_hash(root, modules).encode())
    out = out.resolve()  # a link stays, what is behind it is replaced
    if out.exists() and not out.is_file():
        raise BuildFailed(f"cannot write {out}: it is no file, and is not replaced; give the name of a file")
    try:
        put(out, data)
    except OSError as error:
        raise BuildFailed(f"cannot write {out}: {error.strerror or error}") from None
    return Built(len(data), tuple(sorted(names)), shlex.join(_tools()[0]))


def put(path: Path, data: bytes) -> None:
    """Write a file in one step: whoever reads it at the same time sees the old one or the new one."""
    part = path.with_name(f".{path.name}.{os.getpid()}.{get_native_id()}.part")
    try:
        part.write_bytes(data)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _compiled(source: Path, names: Iterable[str], more: Iterable[str] = ()) -> bytes:
    """The module of one C file that needs no header of Python's: what these functions reach."""
    compiler, linker, named = _tools()
    # Older clangs call memset and memcpy where zig writes the instructions that stand for them.
    flags = ["-std=c11", "-O3", "-g0", "-w", "-ffp-contract=off", "-ffunction-sections"]
    flags += ["-mbulk-memory"] if named else []
    compiled, linked = source.with_suffix(".o"), source.with_suffix(".wasm")
    _run([*compiler, *flags, "-c", str(source), "-o", str(compiled)], source.parent)
    keep = ["--no-entry", "--gc-sections", "-s", *(f"--export={name}" for name in (*names, *EDGES)), *more]
    try:
        _run([*linker, *keep, str(compiled), "-o", str(linked)], source.parent)
    except BuildFailed as error:
        if "undefined symbol" not in str(error):
            raise
        raise BuildFailed(f"a kernel needs Python, libm or malloc, which are not there:\n{error}") from None
    return linked.read_bytes()


def _tools() -> tuple[list[str], list[str], bool]:
    """Compiler, linker, and whether a variable of the environment names the compiler."""
    zig = [sys.executable, "-m", "ziglang"]
    named = shlex.split(os.environ.get("LAVENDER_WASM_CC", ""))
    linker = shlex.split(os.environ.get("LAVENDER_WASM_LD", "")) or [*zig, "wasm-ld"]
    return named or [*zig, "cc", "-target", "wasm32-wasi"], linker, bool(named)


def _run(command: list[str], folder: Path) -> None:
    env = dict(os.environ)
    if not os.access(os.path.expanduser("~"), os.W_OK | os.X_OK):  # where zig keeps libraries
        env.setdefault("ZIG_GLOBAL_CACHE_DIR", str(folder / "cache"))
    try:
        done = subprocess.run(
            command, cwd=folder, env=env, capture_output=True, encoding="utf-8", errors="replace", check=False
        )
    except OSError as error:
        raise BuildFailed(f"{command[0]} cannot be run: {error.strerror or error}") from None
    if done.returncode:
        raise BuildFailed(f"{shlex.join(command)} failed:\n{(done.stdout + done.stderr)[-4000:]}")


def _check(module: bytes, largest: int) -> None:
    """No byte of static data, and a size below the limit; what the linker has left out or added it tells itself."""
    at = 8  # behind the magic word and the version: number, size and content of each section
    while at < len(module):
        kind, size, shift, at = module[at], 0, 0, at + 1
        while True:  # LEB128
            byte, at = module[at], at + 1
            size |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                break
        if kind == DATA:
            raise BuildFailed(
                f"a kernel reads static data ({size} bytes), which nothing fills outside Python"
            )
        at += size
    if len(module) >= largest:
        raise BuildFailed(f"the module has {len(module)} bytes; below {largest} are allowed")


def section(name: str, content: bytes) -> bytes:
    """A custom section of a module, to be appended; lengths below 128 are one byte in LEB128."""
    body = bytes([len(name)]) + name.encode() + content
    if len(body) >= 128:
        raise ValueError("a custom section longer than 127 bytes")
    return bytes([0, len(body)]) + body


if __name__ == "__main__":
    ROOT = Path(__file__).resolve().parents[3]
    try:
        for name, part in PARTS.items():
            out = Path(sys.argv[1], f"{name}.wasm")
            print(build(out, ROOT, part.modules, beside=part.beside))
    except BuildFailed as failure:
        sys.exit(str(failure))
