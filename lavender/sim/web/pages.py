"""Write the folder of the page, build its modules, and serve it on this machine."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import lavender_ext
from lavender.base.errors import InputError, LavenderError
from lavender.io.stored import (
    check_writable,
    load_or_make_file,
    make_folder,
    write_bytes,
    write_text,
)
from lavender.sim.web import compile as wasm
from lavender.sim.web.scenes import collect_page_data

HERE = Path(__file__).resolve().parent
ROOT = Path(lavender_ext.__file__).resolve().parent.parent  # The folder that contains lavender_ext.
SHIPPED = HERE  # Folder of the WebAssembly modules that the package contains.


def build_module(out: Path, name: str = "lavender") -> wasm.Built:
    """Compile the kernels to a WebAssembly module: "lavender", or "newton", which extends it."""
    check_writable(out)
    part = wasm.PARTS[name]
    try:
        return wasm.build(out, ROOT, part.modules, imports_memory=part.imports_memory)
    except wasm.BuildFailed as error:
        raise LavenderError(str(error)) from None


def get_or_build_module(
    say: Callable[[str], Any] = lambda text: None, name: str = "lavender"
) -> bytes:
    """Return a module of the present kernels: the one in the package, or a new one, stored there if possible."""
    shipped = SHIPPED / f"{name}.wasm"

    def make() -> bytes:
        if reason := wasm.explain_missing_requirement():
            state = "is of other kernels" if shipped.exists() else "is not in this installation"
            raise LavenderError(
                f"the WebAssembly module {name} {state} and cannot be built: {reason}"
            )
        say(f"building the WebAssembly module {name} (about 25 s of CPU time, once)")
        with TemporaryDirectory() as folder:
            out = Path(folder, shipped.name)
            build_module(out, name)
            return out.read_bytes()

    return load_or_make_file(
        shipped, lambda _: wasm.is_current(shipped, ROOT, wasm.PARTS[name]), make
    )


def write_page(folder: Path, say: Callable[[str], Any] = lambda text: None) -> Path:
    """Write the page into a folder for any file server and return the path of index.html.

    The page needs neither Python nor a network.
    """
    make_folder(check_writable(folder, folder=True))
    modules = {name: get_or_build_module(say, name) for name in wasm.PARTS}
    try:
        for source in filter(Path.is_file, (HERE / "page").rglob("*")):
            target = folder / source.relative_to(HERE / "page")
            write_bytes(make_folder(target.parent) / target.name, source.read_bytes())
        for name, data in modules.items():
            write_bytes(folder / f"{name}.wasm", data)
        text = json.dumps(collect_page_data(), allow_nan=False, separators=(",", ":"))
        write_text(folder / "scenes.json", text)
    except OSError as error:
        raise InputError(f"cannot write the page into {folder}: {error}") from None
    return folder / "index.html"


def compare_with_native_kernels(say: Callable[[str], Any] = lambda text: None) -> bool:
    """Return whether the modules under Node give the bits of the native kernels; print the differences."""
    script = ROOT / "tests" / "sim" / "web" / "check_wasm_exports.mjs"
    if not script.is_file():
        raise LavenderError(
            f"{script.name} is part of a checkout of the project (tests/sim/web), and not of this installation: clone "
            "the project and install it from there with pip install -e '.[wasm]'"
        )
    node = shutil.which("node")
    if node is None:
        raise LavenderError(
            "node, which runs the check, is not installed: install Node 18 or newer"
        )
    modules = {name: get_or_build_module(say, name) for name in wasm.PARTS}
    with TemporaryDirectory(prefix="lavender-web-") as folder:
        for name, data in modules.items():
            Path(folder, f"{name}.wasm").write_bytes(data)
        command = [node, str(script), str(Path(folder, "lavender.wasm"))]
        env = {**os.environ, "PYTHON": sys.executable}
        return subprocess.run(command, env=env, check=False).returncode == 0


class _Handler(SimpleHTTPRequestHandler):
    """Handler with its own table of content types, because the table of the system may be incomplete or wrong."""

    extensions_map = {  # noqa: RUF012 - as the base class has it
        "": "application/octet-stream",
        ".css": "text/css",
        ".html": "text/html; charset=utf-8",
        ".js": "text/javascript; charset=utf-8",
        ".json": "application/json",
        ".txt": "text/plain; charset=utf-8",
        ".wasm": "application/wasm",
    }

    def end_headers(self) -> None:
        """Forbid browsers to cache the files."""
        self.send_header("Cache-Control", "no-cache")
        super().end_headers()

    def log_message(self, format: str, *arguments: Any) -> None:  # noqa: A002 - the base class names it so
        """Print nothing about single requests."""


def create_file_server(folder: Path) -> ThreadingHTTPServer:
    """Create a server of `folder` on a free port of the loopback address without starting it."""
    return ThreadingHTTPServer(("127.0.0.1", 0), partial(_Handler, directory=str(folder)))
