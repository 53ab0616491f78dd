"""The machine and the versions that a timing belongs to."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import re
import subprocess
import sysconfig
from collections.abc import Iterable, Mapping
from datetime import datetime, timezone
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from lavender._version import __version__
from lavender.lab.bench.record import Run
from lavender_ext.sweep import serial

SHARE = 0.5  # of the machine's memory, which the processes of backends may take together
LEAST = 2 * 2**30  # bytes: below that, packages of compiled code do not start

BASE = ("numpy", "scipy", "qpsolvers", "osqp")


def _cpuinfo(name: str) -> str:
    """What Linux says of the first processor under that name; empty elsewhere."""
    with contextlib.suppress(OSError):
        told = Path("/proc/cpuinfo").read_text(errors="replace")
        if found := re.search(rf"^(?:{name})\s*:\s*(.+)$", told, re.MULTILINE):
            return found[1].strip()
    return ""


def cpu_name() -> str:
    """Model of the processor, as the system names it."""
    return _cpuinfo("model name|Model") or platform.processor() or platform.machine() or "unknown"


def memory() -> int:
    """Bytes of memory of this machine, or of the container that it is; 0 where that is not known."""
    found = []
    with contextlib.suppress(AttributeError, ValueError, OSError):
        found.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with contextlib.suppress(ValueError, OSError):
            found.append(int(Path(path).read_text()))
    return min((n for n in found if n > 0), default=0)


def memory_share(processes: int = 1) -> int:
    """Bytes that each of so many processes of backends may take: half of the memory together, 2 GiB each at least."""
    return max(LEAST, int(SHARE * memory() / max(1, processes))) if memory() else 0


def versions(packages: Iterable[str] = (), base: Iterable[str] = BASE) -> dict[str, str]:
    """Version of each installed distribution, or of that of a module; those that are not installed are left out."""
    found = {}
    for name in sorted({*base, *packages}):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found |= {dist: metadata.version(dist) for dist in _distributions().get(name, ())[:1]}
    return found


@cache
def _distributions() -> Mapping[str, list[str]]:
    return metadata.packages_distributions()  # by module; reads the lists of all that is installed


def describe(plan: Mapping[str, Any], packages: Iterable[str] = ()) -> Run:
    """The run that starts now. Its identity holds CPU, versions and plan, not the time."""
    facts = {
        "lavender": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": cpu_name(),
        "cores": os.cpu_count() or 1,
        "threads": 1,
        "versions": versions(packages),
    }
    # What decides how a single measurement comes out; which cases and solvers are asked for does not.
    same: dict[str, Any] = {**facts, "plan": {k: plan[k] for k in ("repeats", "campaign") if k in plan}}
    build = build_facts()
    same["build"] = build
    digest = hashlib.sha256(json.dumps(same, sort_keys=True, default=str).encode()).hexdigest()[:12]
    started = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return Run(
        run=digest,
        started=started,
        plan=dict(plan),
        build=build | clock(),
        load=load(),
        **facts,  # type: ignore[arg-type]
    )


def load() -> float | None:
    """Processes that wanted a processor, mean of the last minute; None where the system does not say."""
    with contextlib.suppress(AttributeError, OSError):
        return float(os.getloadavg()[0])
    return None


def running() -> float | None:
    """Processes that want a processor now, this one among them; elsewhere than on Linux as `load`."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        return float(Path("/proc/loadavg").read_text().split()[3].partition("/")[0])
    return load()


def clock() -> dict[str, str]:
    """Frequency of the processor now, and what governs it, as far as the system says."""
    mhz = _cpuinfo("cpu MHz")
    found = {"clock": f"{float(mhz):.0f} MHz"} if mhz else {}
    with contextlib.suppress(OSError):
        found["governor"] = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor").read_text().strip()
    return found


@cache
def build_facts() -> dict[str, str]:
    """What was built, and of what: commit of a checkout or hash of a wheel's kernels, compiler, flags, BLAS."""
    package = Path(__file__).resolve().parents[2]
    library = Path(str(serial.__file__))
    found = {"commit": commit} if (commit := commit_of(package.parent)) else {}
    kernels = hashlib.sha256()
    for path in sorted(library.parents[1].rglob(f"*{library.suffix}")):
        kernels.update(path.read_bytes())
    found["kernels"] = kernels.hexdigest()[:12]
    found |= build_of(library.read_bytes())
    flags = sysconfig.get_config_var("CFLAGS")
    found |= {"python_flags": " ".join(str(flags).split())} if flags else {}
    from threadpoolctl import threadpool_info

    blas = [f"{i['internal_api']} {i['version']}" for i in threadpool_info() if i.get("user_api") == "blas"]
    return found | {"blas": ", ".join(sorted(set(blas)))}


def commit_of(root: Path) -> str:
    """Of a checkout, with a mark where files differ from it; empty elsewhere."""
    if not (root / ".git").exists():
        return ""
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        said = subprocess.run(
            ["git", "--no-optional-locks", "-C", str(root),
             "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"],
            capture_output=True, encoding="utf-8", errors="replace", timeout=10, check=True,
        )  # fmt: skip
        return said.stdout.strip()
    return ""


def build_of(library: bytes) -> dict[str, str]:
    """Compiler and Cython that a compiled module names; what it does not name is left out."""
    found = {}
    compiler = re.search(rb"GCC: \([^)\x00]*\) [\d.]+|clang version [\d.]+|MSVC [\d.]+", library)
    if compiler:
        found["compiler"] = compiler[0].decode()
    cython = re.search(rb"_cython_(\d+)_(\d+)_(\d+)", library)
    if cython:
        found["cython"] = ".".join(part.decode() for part in cython.groups())
    return found
