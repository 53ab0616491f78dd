"""Check that a source distribution and a wheel hold what they must, and nothing a build left behind.

python .ci/check_dist.py FOLDER        the folder with one .tar.gz and one .whl

The source distribution is also unpacked, given other times and permissions, and made again: every byte must come back.
"""

import os
import runpy
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
WASM = runpy.run_path(str(ROOT / "lavender" / "sim" / "web" / "compile.py"))


def names_in(folder: Path) -> tuple[set[str], set[str]]:
    """Paths in the sdist (below its top folder) and in the wheel."""
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    with tarfile.open(sdist) as archive:
        in_sdist = {name.partition("/")[2] for name in archive.getnames()}
    with zipfile.ZipFile(wheel) as archive:
        in_wheel = set(archive.namelist())
    return in_sdist, in_wheel


def problems(in_sdist: set[str], in_wheel: set[str]) -> list[str]:
    """What is missing or out of place, one sentence each."""
    packages = [path for name in ("lavender", "lavender_ext") for path in (ROOT / name).rglob("*")]
    sources = {
        path.relative_to(ROOT).as_posix()
        for path in packages
        if path.is_file() and path.suffix not in {".pyc", ".so", ".pyd", ".c", ".h", ".wasm"}
    }
    tests = {path.relative_to(ROOT).as_posix() for path in (ROOT / "tests").rglob("*.py")}
    kernels = {name.removesuffix(".pyx") for name in sources if name.endswith(".pyx")}
    modules = {name.split(".")[0] for name in in_wheel if name.endswith((".so", ".pyd"))}
    found = [f"sdist lacks {name}" for name in sorted((sources | tests) - in_sdist)]
    for name in (
        "LICENSE",
        "README.md",
        "CHANGELOG.md",
        "setup.py",
        "pyproject.toml",
        ".ci/check_kernels.py",
    ):
        found += [] if name in in_sdist else [f"sdist lacks {name}"]
    found += [f"wheel lacks {name}" for name in sorted(sources - in_wheel)]
    found += [f"wheel lacks the compiled module {name}" for name in sorted(kernels - modules)]
    for path in (
        "lavender/export/c/lavender.c",
        *(f"lavender/sim/web/{name}.wasm" for name in WASM["PARTS"]),
    ):
        found += [] if path in in_sdist else [f"sdist lacks {path}"]
        found += [] if path in in_wheel else [f"wheel lacks {path}"]
    if not any(name.endswith("/licenses/LICENSE") for name in in_wheel):
        found.append("wheel lacks LICENSE")
    ours = (
        "lavender/export/",
        "examples/",
        "tests/export/parity/scenes.c",
    )  # C that is written by hand, and the library
    built = {name for name in in_sdist if not name.startswith(ours)}
    left = [f"sdist holds {name}" for name in built if name.endswith((".c", ".h", ".so", ".pyc", ".o"))]
    kept = {name for name in in_wheel if not name.startswith(ours)}
    left += [f"wheel holds {name}" for name in kept if name.endswith((".c", ".h", ".pyc", ".o"))]
    left += [f"wheel holds {name}" for name in in_wheel if name.split("/")[0] in {"tests", "build", "docs"}]
    return found + sorted(left)


def stale(folder: Path) -> list[str]:
    """WebAssembly modules in the sdist or the wheel that are of other sources than these."""
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    found = []
    with tarfile.open(sdist) as archive, zipfile.ZipFile(wheel) as zipped:
        top = archive.getnames()[0].partition("/")[0]
        for name, part in WASM["PARTS"].items():
            path, sources = f"lavender/sim/web/{name}.wasm", WASM["source_hash"](ROOT, part.modules)
            held = archive.extractfile(f"{top}/{path}")
            for what, data in (("sdist", held.read() if held else b""), ("wheel", zipped.read(path))):
                if not data.endswith(sources.encode()):
                    found.append(f"{path} in the {what} is of other sources")
    return found


def made_again(sdist: Path) -> list[str]:
    """What differs when the sdist is made once more from its own files, later, elsewhere, by someone else."""
    with tempfile.TemporaryDirectory(prefix="lavender-sdist-") as folder:
        with tarfile.open(sdist) as archive:
            archive.extractall(folder, filter="data")
        (top,) = Path(folder).iterdir()
        for number, path in enumerate(sorted(top.rglob("*"), reverse=True)):
            path.chmod(path.stat().st_mode & 0o700)
            os.utime(path, (1e9 + number, 1e9 + number))
        build = [sys.executable, "-m", "build", "--sdist", "--no-isolation", "--outdir", folder, str(top)]
        done = subprocess.run(
            build, capture_output=True, text=True, check=False, env={**os.environ, "TZ": "Asia/Tokyo"}
        )
        if done.returncode:
            return [f"sdist cannot be made from itself: {(done.stdout + done.stderr)[-2000:]}"]
        again = Path(folder, sdist.name).read_bytes()
    if again == sdist.read_bytes():
        return []
    return [f"sdist made from itself differs: {len(again)} bytes for {sdist.stat().st_size}"]


if __name__ == "__main__":
    in_sdist, in_wheel = names_in(Path(sys.argv[1]))
    found = problems(in_sdist, in_wheel)
    found += [] if found else stale(Path(sys.argv[1]))
    found += made_again(next(Path(sys.argv[1]).glob("*.tar.gz")))
    print(
        "\n".join(found)
        or f"sdist: {len(in_sdist)} entries, every byte made again, wheel: {len(in_wheel)} entries, nothing amiss"
    )
    sys.exit(bool(found))
