"""Describe the machine and the versions with which times were measured."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
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
from statistics import fmean
from typing import Any

from lavender._version import __version__
from lavender.base.errors import require_packages
from lavender.solvers import registry
from lavender_ext.sweep import serial

BASE_PACKAGES = ("numpy", "scipy", "qpsolvers", "osqp")


def _read_cpuinfo_entry(name: str) -> str:
    """Return Linux's value of an entry for the first processor; empty on other systems."""
    with contextlib.suppress(OSError):
        text = Path("/proc/cpuinfo").read_text(errors="replace")
        if found := re.search(rf"^(?:{name})\s*:\s*(.+)$", text, re.MULTILINE):
            return found[1].strip()
    return ""


def get_cpu_name() -> str:
    """Return the model of the processor, as the system names it."""
    return (
        _read_cpuinfo_entry("model name|Model")
        or platform.processor()
        or platform.machine()
        or "unknown"
    )


def get_total_memory() -> int:
    """Return the memory of this machine or of its container [bytes]; 0 if it is not known."""
    found = []
    with contextlib.suppress(AttributeError, ValueError, OSError):
        found.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with contextlib.suppress(ValueError, OSError):
            found.append(int(Path(path).read_text()))
    return min((n for n in found if n > 0), default=0)


def get_versions(
    packages: Iterable[str] = (), base: Iterable[str] = BASE_PACKAGES
) -> dict[str, str]:
    """Return the version of each installed distribution, or of a module's; missing ones are left out."""
    found = {}
    for name in sorted({*base, *packages}):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            owners = metadata.packages_distributions().get(name, ())[:1]
            found |= {dist: metadata.version(dist) for dist in owners}
    return found


def describe_run(plan: Mapping[str, Any], packages: Iterable[str] = ()) -> dict[str, Any]:
    """Return the row of a machine, its versions and a plan; `run` is a hash of these, without the time."""
    facts: dict[str, Any] = {
        "lavender": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": get_cpu_name(),
        "cores": os.cpu_count() or 1,
        "threads": 1,
        "versions": get_versions(packages),
    }
    build = describe_build()
    # These facts affect a single measurement; the selection of cases and solvers does not.
    identity = {
        **facts,
        "plan": {k: plan[k] for k in ("repeats", "campaign") if k in plan},
        "build": build,
    }
    digest = hashlib.sha256(json.dumps(identity, sort_keys=True, default=str).encode()).hexdigest()[
        :12
    ]
    started = datetime.now(timezone.utc).isoformat(timespec="seconds")
    build = build | get_processor_clock()
    return {
        "kind": "machine",
        "run": digest,
        "started": started,
        "plan": dict(plan),
        "build": build,
        "load": get_load_average(),
        "whole": True,
        **facts,
    }


def get_load_average() -> float | None:
    """Return the mean number of runnable processes in the last minute; None if the system does not provide it."""
    with contextlib.suppress(AttributeError, OSError):
        return float(os.getloadavg()[0])
    return None


def count_runnable_processes() -> float | None:
    """Return the number of runnable processes now, including this one; `get_load_average` if not on Linux."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        return float(Path("/proc/loadavg").read_text().split()[3].partition("/")[0])
    return get_load_average()


def make_busy_warning(
    loads: Iterable[float | None], cores: int, consequence: str = "", own: int = 1
) -> str:
    """Return a warning if other processes used the processors, else an empty text.

    `loads` are the numbers of runnable processes during a measurement (None if unknown), `own` of them its own.
    """
    known = [load for load in loads if load is not None]
    # The mean load may exceed the number of cores by 0.5, since the system's own processes run, too.
    if not known or fmean(known) <= max(cores, own) + 0.5:
        return ""
    return (
        f"The machine was busy: load {fmean(known):.1f} on {cores} core{'s' * (cores != 1)} during the measurement. "
        f"{consequence}"
    ).rstrip()


def get_processor_clock() -> dict[str, str]:
    """Return the frequency of the processor and its governor, if the system provides them."""
    mhz = _read_cpuinfo_entry("cpu MHz")
    found = {"clock": f"{float(mhz):.0f} MHz"} if mhz else {}
    with contextlib.suppress(OSError):
        found["governor"] = (
            Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor").read_text().strip()
        )
    return found


@cache
def describe_build() -> dict[str, str]:
    """Describe the build: commit of a checkout, hashes of kernels and solvers, compiler, flags, BLAS."""
    package = Path(__file__).resolve().parents[1]
    library = Path(str(serial.__file__))
    found = {}
    if (package.parent / ".git").exists():
        # The commit of a checkout, marked if files differ from it.
        command = [
            "git",
            "--no-optional-locks",
            "-C",
            str(package.parent),
            "describe",
            "--always",
            "--dirty",
        ]
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            described = subprocess.run(
                [*command, "--abbrev=12", "--exclude=*"],
                capture_output=True,
                encoding="utf-8",
                errors="replace",
                timeout=10,
                check=True,
            )
            found["commit"] = described.stdout.strip()
    kernels = hashlib.sha256()
    for path in sorted(library.parents[1].rglob(f"*{library.suffix}")):
        kernels.update(path.read_bytes())
    found["kernels"] = kernels.hexdigest()[:12]
    found["solvers"] = hash_solver_sources()
    content = library.read_bytes()  # A compiled module names its compiler and Cython's version.
    if compiler := re.search(
        rb"GCC: \([^)\x00]*\) [\d.]+|clang version [\d.]+|MSVC [\d.]+", content
    ):
        found["compiler"] = compiler[0].decode()
    if cython := re.search(rb"_cython_(\d+)_(\d+)_(\d+)", content):
        found["cython"] = ".".join(part.decode() for part in cython.groups())
    flags = sysconfig.get_config_var("CFLAGS")
    found |= {"python_flags": " ".join(str(flags).split())} if flags else {}
    require_packages("the description of the machine", "threadpoolctl")
    from threadpoolctl import threadpool_info

    blas = [
        f"{i['internal_api']} {i['version']}"
        for i in threadpool_info()
        if i.get("user_api") == "blas"
    ]
    return found | {"blas": ", ".join(sorted(set(blas)))}


def hash_solver_sources() -> str:
    """Return a hash of the source files of all registered solvers, plug-ins included."""
    sources = hashlib.sha256()
    for name, spec in sorted(registry.specs().items()):
        factory = spec.factory
        module = factory.partition(":")[0] if isinstance(factory, str) else factory.__module__
        with contextlib.suppress(
            ImportError, ValueError, OSError
        ):  # no such module, or one without a file
            found = importlib.util.find_spec(module)
            if found is not None and found.origin is not None:
                sources.update(name.encode() + Path(found.origin).read_bytes())
    return sources.hexdigest()[:12]
