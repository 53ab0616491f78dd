"""What `auto` loses against the best of our own solvers, as text."""

from __future__ import annotations

from collections.abc import Sequence

from lavender.bench.regret import SHIFT, Regret, summary

__all__ = ["table"]


def table(found: Sequence[Regret], rows: int = 12) -> str:
    """The summary and the worst of `found` as text."""
    s = summary(found)
    counts = (
        f"{s.count} problems and levels that one of our solvers reached, {s.unsolved} of them not by auto; "
        f"{s.nobody} that nobody reached"
    )
    lines = [
        counts,
        f"{'regret':<28}{'geometric mean':>15}{'95th percentile':>17}{'worst':>9}",
        f"{f'(t + {1e6 * SHIFT:.0f} us) / (best + same)':<28}{s.mean:>15.2f}{s.p95:>17.2f}{s.worst:>9.2f}",
        f"{'t / best':<28}{s.plain_mean:>15.2f}{s.plain_p95:>17.2f}{s.plain_worst:>9.2f}",
        "",
    ]
    for r in sorted(found, key=lambda r: -r.shifted)[:rows]:
        if r.best:
            word = f"{r.shifted:7.2f}" if r.auto_solved else " failed"
            times = f"auto {1e3 * r.auto_time:.3f} ms, {r.best} {1e3 * r.best_time:.3f} ms"
            lines += [
                f"{word}  {r.case}, {r.rows} rows, {r.law}, to {r.level:.0e}: {times}",
                f"         {r.reason}",
                f"         {r.auto_ran[:160]}",
            ]
    return "\n".join(lines)
