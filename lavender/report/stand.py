"""The map of towers and engines as a table."""

from __future__ import annotations

from collections.abc import Sequence

from lavender.bench.stand import Line

__all__ = ["table"]


def _letters(found: Sequence[Line]) -> dict[tuple[int, float], str]:
    # towers and sweeps a second that more than one line has
    count: dict[tuple[int, float], int] = {}
    for line in found:
        if line.sweeps:
            key = (line.boxes, round(line.work, 6))
            count[key] = count.get(key, 0) + 1
    out: dict[tuple[int, float], str] = {}
    for n in {key[0] for key in count}:
        shared = sorted(key for key, times in count.items() if key[0] == n and times > 1)
        out |= {key: chr(ord("a") + i) if i < 26 else f"a{i}" for i, key in enumerate(shared)}
    return out


def table(found: Sequence[Line]) -> str:
    """The map as a markdown table, by tower and step; lines of one tower and letter spend equally many sweeps."""
    letters = _letters(found)
    out = [
        "| boxes | dt [s] | engine | sweeps | substeps | sweeps a second | stood [s] | drift [mm] | µs a step |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for line in sorted(found, key=lambda x: (x.boxes, -x.dt)):
        sweeps = str(line.sweeps) if line.sweeps else "to a tolerance"
        work = (
            f"{line.work:,.0f} {letters.get((line.boxes, round(line.work, 6)), '')}".strip()
            if line.sweeps
            else "–"
        )
        stood = f"{line.seconds:g}" if line.stands else f"**fell at {line.stood:.1f}**"
        drift = f"{1e3 * line.drift:.2g}" if line.stands else "–"
        out.append(
            f"| {line.boxes} | 1/{round(1 / line.dt)} | {line.engine} | {sweeps} | {line.substeps} | {work} | {stood} "
            f"| {drift} | {1e6 * line.cost:,.3g} |"
        )
    return "\n".join(out)
