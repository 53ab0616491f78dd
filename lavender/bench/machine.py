"""The machine and the versions that a timing belongs to."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import re
from collections.abc import Iterable, Mapping
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

from lavender._version import __version__
from lavender.bench.record import Run

__all__ = ["cpu_name", "describe", "memory", "memory_share", "versions"]

SHARE = 0.5  # of the machine's memory, which the processes of backends may take together
LEAST = 2 * 2**30  # bytes: below that, packages of compiled code do not start

BASE = ("numpy", "scipy", "qpsolvers", "osqp", "qdldl")


def cpu_name() -> str:
    """Model of the processor, as the system names it."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        found = re.search(
            r"^(?:model name|Model)\s*:\s*(.+)$", info.read_text(errors="replace"), re.MULTILINE
        )
        if found:
            return found[1].strip()
    return platform.processor() or platform.machine() or "unknown"


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


def versions(packages: Iterable[str] = ()) -> dict[str, str]:
    """Version of each installed distribution; those that are not installed are left out."""
    found = {}
    for name in sorted({*BASE, *packages}):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def describe(plan: Mapping[str, Any], packages: Iterable[str] = (), threads: int = 1) -> Run:
    """The run that starts now. Its identity holds CPU, versions and plan, not the time."""
    facts = {
        "lavender": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": cpu_name(),
        "cores": os.cpu_count() or 1,
        "threads": threads,
        "versions": versions(packages),
    }
    # What decides how a single measurement comes out; which cases and solvers are asked for does not.
    same = {**facts, "plan": {k: plan[k] for k in ("repeats", "campaign") if k in plan}}
    digest = hashlib.sha256(json.dumps(same, sort_keys=True, default=str).encode()).hexdigest()[:12]
    started = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return Run(run=digest, started=started, plan=dict(plan), **facts)  # type: ignore[arg-type]
