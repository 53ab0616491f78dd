"""Snapshots that no simulation has written, with a checksum that fits: every array wrong in every way.

    python tests/hostile_snapshots.py FIRST LAST FOLDER

loads the files of these seeds, steps, judges and forms the problem of whatever is taken, and prints how many were
refused and taken. Only lavender's own errors may come out.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections import Counter
from pathlib import Path

import numpy as np

import lavender as lv
from lavender.engine.layout import HEAD
from lavender.engine.snapshot import ARRAYS, MAGIC

SCENES = (
    ("stack", {"patch_radius": 0.1, "order": "bottom_up"}),
    ("bridge", {"n": 4, "dt": 1 / 60, "substeps": 2}),
    ("pile", {"n": 40, "kind": "mixed", "order": "random"}),
    ("stack", {"n": 3, "solver": "newton"}),
    ("spinner", {"solver": "pgs"}),
)
WHOLE = (-(2**31), -(10**8), -2, -1, 0, 1, 2, 7, 255, 10**6, 10**8, 2**30, 2**31 - 1)
REAL = (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e200, 1e-310, -1.0, 0.0, 1e9)
HEADERS = (
    lambda h, _: {**h, "lengths": [-1, *h["lengths"][1:]]},
    lambda h, _: {**h, "lengths": [1e3, *h["lengths"][1:]]},
    lambda h, _: {**h, "lengths": h["lengths"][:3]},
    lambda h, _: {**h, "lengths": None},
    lambda h, _: {**h, "steps": float("inf")},
    lambda h, _: {**h, "steps": -1},
    lambda h, _: {**h, "steps": True},
    lambda h, _: {**h, "steps": 10**400},
    lambda h, _: {**h, "failed": "1"},
    lambda h, _: {**h, "lost": "\ud800"},
    lambda h, _: {**h, "lost": "nobody"},
    lambda h, _: {**h, "lost": 7},
    lambda h, _: {**h, "fingerprint": []},
    lambda h, _: {**h, "version": [[]]},
    lambda h, _: {k: v for k, v in h.items() if k != "version"},
    lambda h, _: [h],
    lambda h, _: b"[" * 200_000 + b"]" * 200_000,
    lambda h, _: b'{"version":' + b"9" * 5000 + b"}",
    lambda h, _: b"\xff\xfe",
    lambda h, _: b"",
    lambda h, rng: bytes(rng.integers(0, 256, 64, dtype=np.uint8)),
)


def simulation(seed: int) -> lv.Simulation:
    """A scene of `SCENES` after some steps."""
    name, more = SCENES[seed % len(SCENES)]
    sim = lv.Simulation(lv.Scene(name, **more))
    for _ in range(seed % 7):
        sim.step()
    return sim


def write(path: Path, shot: lv.Snapshot, header: object = None) -> None:
    """A file of these arrays with a right checksum; `header` in place of the right one."""
    arrays = [np.ascontiguousarray(getattr(shot, name), code).tobytes() for name, code in ARRAYS]
    if header is None:
        header = right_header(shot)
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    body = b"".join([MAGIC, len(text).to_bytes(8, "little"), text, *arrays])
    path.write_bytes(body + hashlib.sha256(body).digest())


def right_header(shot: lv.Snapshot) -> dict[str, object]:
    """The header that belongs to a snapshot."""
    lengths = [len(getattr(shot, name)) for name, _ in ARRAYS]
    rest = {name: getattr(shot, name) for name in ("fingerprint", "steps", "failed", "lost")}
    return {"version": 1, **rest, "lengths": lengths}


def mangled(sim: lv.Simulation, rng: np.random.Generator) -> tuple[lv.Snapshot, str]:
    """A snapshot with one to three wrong entries, in arrays drawn by name; what was done."""
    state = sim._state.copy()
    names = sorted(name for name, x in state.a.items() if x.size)
    done = []
    for _ in range(int(rng.integers(1, 4))):
        name = "head" if rng.random() < 0.2 else str(rng.choice(names))
        flat = state.a[name].reshape(-1)
        at = int(rng.integers(flat.size if rng.random() < 0.5 else min(flat.size, 24)))
        if flat.dtype == np.float64:
            flat[at] = rng.choice(REAL)
        elif flat.dtype == np.uint64:
            flat[at] = rng.integers(0, 2**64, dtype=np.uint64)
        else:
            flat[at] = rng.choice(WHOLE)
        done.append(f"{name}[{at}] = {flat[at]}")
    shot = sim.snapshot()
    size = shot.size.copy()
    if rng.random() < 0.1:
        k = int(rng.integers(len(size)))
        size[k] = rng.choice(WHOLE)
        done.append(f"size[{k}] = {size[k]}")
    lost = shot.lost if state.a["head"][HEAD["lost"]] < 0 or rng.random() < 0.5 else sim._names[-1]
    fields = (shot.fingerprint, shot.steps, shot.failed, lost)
    return lv.Snapshot(*fields, size, state.real, state.index, state.keys), "; ".join(done)


def try_one(seed: int, path: Path) -> str:
    """One hostile file: `refused` or `taken`, then used."""
    rng = np.random.default_rng(seed)
    sim = simulation(seed)
    if seed % 4 == 3:
        shot = sim.snapshot()
        change = HEADERS[(seed // 4) % len(HEADERS)]
        write(path, shot, change(right_header(shot), rng))
    else:
        shot, _ = mangled(sim, rng)
        write(path, shot)
    try:
        sim.load(path)
    except lv.InputError:
        sim.step()  # as if nothing had been asked
        return "refused"
    use(sim)
    return "taken"


def use(sim: lv.Simulation) -> None:
    """Everything that reads a state; our errors are answers too."""
    for call in (sim.residual, sim.constraint_problem, sim.step, sim.step, sim.residual, sim.step):
        try:
            found = call()
        except lv.LavenderError:
            continue
        if isinstance(found, tuple) and not found[2]:
            check_finite(found[0])


def check_finite(observation: dict) -> None:
    """Every number of an observation that does not end the run is finite."""
    flat = {**observation, **observation["contacts"]}
    for name, x in flat.items():
        if name != "contacts" and not np.isfinite(x).all():
            raise AssertionError(f"{name} is not finite and the simulation goes on")


if __name__ == "__main__":
    first, last, folder = int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])
    found = Counter()
    with np.errstate(all="ignore"):
        for seed in range(first, last):
            found[try_one(seed, folder / "hostile")] += 1
    print(dict(found))
