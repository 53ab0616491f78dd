"""Tables of kernels beside the machine's limits, as text."""

from __future__ import annotations

from collections.abc import Sequence

from lavender.bench.kernels import FOOTPRINTS, Limit, Row

__all__ = ["limits_table", "scaling_table", "table"]


def _number(x: float, form: str = "{:.3g}") -> str:
    return "-" if x != x else form.format(x)


def table(rows: Sequence[Row]) -> list[str]:
    """Lines of a Markdown table."""
    lines = [
        "| case | size | time | unit | ns / unit | bytes / unit | instructions / unit | limit | share | residual |",
        "|---|---|---:|---|---:|---:|---:|---|---:|---:|",
    ]
    for r in rows:
        micro = 1e6 * r.seconds
        time = f"{micro:.2f} us" if micro < 1e3 else f"{micro / 1e3:.2f} ms"
        limit = r.limit_name and f"{r.limit_name} {1e9 * r.limit / r.work:.3g} ns"
        lines.append(
            f"| {r.case} | {r.size} | {time} | {r.unit} | {r.per_unit:.3g} | {_number(r.bytes, '{:.0f}')} | "
            f"{_number(r.instructions)} | {limit} | {_number(r.share, '{:.2f}')} | {_number(r.residual, '{:.1e}')} |"
        )
    return lines


def limits_table(found: Sequence[Limit]) -> list[str]:
    """Lines of a Markdown table of the machine's limits."""
    kinds = ("read", "triad", "chase")
    value = {(x.name, x.kib): x for x in found}
    lines = ["| footprint | read | triad | dependent load |", "|---:|---:|---:|---:|"]
    for kib in FOOTPRINTS:
        cells = [f"{value[k, kib].value:.3g} {value[k, kib].unit}" for k in kinds]
        lines.append(f"| {kib:,} KiB | " + " | ".join(cells) + " |")
    return [*lines, "", f"dependent product and sum: {value['chain', 0].value:.2f} ns"]


def scaling_table(rows: Sequence[dict[str, float]]) -> list[str]:
    """Lines of a Markdown table of `scaling`."""
    lines = [
        "| contacts | build s | 100 sweeps s | residual | ns / contact and sweep | bare ns | share | MB |",
        "|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    return lines + [
        f"| {r['contacts']:,.0f} | {r['build']:.3f} | {r['solve']:.3f} | {r['residual']:.1e} | {r['sweep']:.1f} | "
        f"{r['bare']:.1f} | {r['bare'] / r['sweep']:.2f} | {r['megabytes']:.0f} |"
        for r in rows
    ]
