"""The text of a comparison: cautions, the largest differences with their causes, what differs, and what to try."""

from __future__ import annotations

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.causes.difference import Difference, Part
from lavender.causes.facts import Proposal, list_facts, list_parts_of, list_proposals, name_engine
from lavender.causes.smaller_steps import COUNT

MIN_SHOWN_PART = 0.01  # [-] Parts below this fraction of the difference are not listed.
# [-] If more of the difference is left by the solvers, the text says so before it names a cause.
MAX_SOLVER_PART = 0.1
MAX_PART_RATIO = 10.0  # [-] Parts that are larger by this factor than the difference cancel.
UNTRUSTED = ("solver", "lost digits", "rest")
WORDS = {
    "solver": "unfinished solving",
    "lost digits": "lost digits: the integrator uses the forces, and only the acceleration is exact",
    "noslip": "pass against slip",
    "state": "rounding of the state",
    "rest": "not explained",
    "shape": "cone",
}


def describe(comparison: Difference) -> str:
    """Return the text of a comparison."""
    a, b = comparison.a, comparison.b
    dt = f"one step of {a.dt * 1e3:g} ms, {len(a.velocity)} velocities"
    if comparison.is_ideal:
        smaller = f" in {COUNT} smaller steps" if "time step" in comparison.parts else ""
        head = f"why: {b.engine} against the rigid laws{smaller}, {dt}, {b.n_rows} rows"
    else:
        head = f"compare: {a.engine} and {b.engine}, {dt}, {a.n_rows} and {b.n_rows} rows"
    lines = [head, *list_cautions(comparison)]
    quantities = comparison.list_quantities()
    if not quantities:
        largest = float(np.abs(comparison.difference).max(initial=0.0))
        return "\n".join([*lines, f"The velocities are equal to rounding ({largest:.1e})."])
    for q in quantities:
        first, second = float(q.row @ a.velocity_after), float(q.row @ b.velocity_after)
        values = f"{first:.4g} and {second:.4g}"
        if comparison.is_ideal:
            values = f"{second:.4g}, by the rigid laws {first:.3g}"
        lines.append(f"{q.name}: {values} {q.unit}, difference {second - first:+.3g}")
        lines += [f"   {line}" for line in list_part_lines(comparison, q.row)]
    facts = [] if comparison.is_ideal else list_facts(comparison)
    if facts:
        lines.append(f"What differs ({name_engine(a, b)} and {name_engine(b, a)}):")
        lines += [f"   {list_parts_of(fact)}: {fact.text}" for fact in facts]
    proposals = list_proposals(comparison)
    lines += [write_proposal(p, comparison) for p in proposals]
    return "\n".join(lines)


def list_cautions(comparison: Difference) -> list[str]:
    """Return sentences that come before any cause: unfinished solving, parts that cancel, unsolved mixtures."""
    lines = [f"Caution: {w}." for w in comparison.warnings]
    total = comparison.difference
    i = int(np.argmax(np.abs(total)))
    size = float(np.abs(total[i]))
    for name in UNTRUSTED:
        left = float(comparison.parts[name].mean[i])
        if abs(left) > max(MAX_SOLVER_PART * size, comparison.rounding) and size > 0.0:
            share = f"{100.0 * abs(left) / size:.0f} % of the largest difference"
            lines.append(f"Caution: {WORDS[name]} makes {share}.")
    return lines + list_cancelling(comparison)


def list_cancelling(comparison: Difference) -> list[str]:
    """Return a sentence if causes cancel in a velocity, whether its difference is large, small or zero."""
    total = np.abs(comparison.difference)
    every = [x for p in comparison.parts.values() for x in (p, *p.parts)]
    largest = np.max([np.abs(p.changes).max(axis=0) for p in every], axis=0, initial=0.0)
    # Velocities that nothing moves as much as the largest difference are of no interest.
    size = max(comparison.rounding, float(total.max(initial=0.0)))
    cancels = np.flatnonzero((largest > MAX_PART_RATIO * total) & (largest > size))
    if not len(cancels):
        return []
    i = int(cancels[np.argmax(largest[cancels])])
    times = f"{largest[i] / total[i]:.2g} times" if total[i] > comparison.rounding else "without"
    more = f", and so {len(cancels) - 1} other velocities" if len(cancels) > 1 else ""
    changed = f"single causes change {comparison.a.names[i]} by up to {largest[i]:.2g}"
    end = "they cancel, and the difference says little about each"
    return [f"Caution: {changed}, {times} a difference{more}: {end}."]


def list_part_lines(comparison: Difference, row: FloatArray) -> list[str]:
    """Return a line for each part of a velocity's difference, the largest first."""
    a, b = comparison.a, comparison.b
    total = abs(float(row @ comparison.difference))
    lines = []
    for part, mean, low, high in comparison.rank(row):
        if max(abs(low), abs(high)) < max(MIN_SHOWN_PART * total, comparison.rounding):
            continue
        line = f"{part.name:<11} {mean:+.2g}"
        if high - low > 0.02 * abs(mean):
            alone = ""
            if not comparison.is_ideal:
                alone = (
                    f"; alone in {name_engine(a, b)} {float(part.alone_in_a @ row):+.2g}, in "
                    f"{name_engine(b, a)} {float(part.alone_in_b @ row):+.2g}"
                )
            line += f"   ({low:+.2g} to {high:+.2g} by the order of exchange{alone})"
        lines.append(line + write_inner_parts(part, row, total))
    return lines


def write_inner_parts(part: Part, row: FloatArray, total: float) -> str:
    """Return the parts within an ingredient, if there are several."""
    shown = [(p.name, float(p.mean @ row)) for p in part.parts]
    shown = [(name, mean) for name, mean in shown if abs(mean) >= MIN_SHOWN_PART * total]
    if not shown:
        return ""
    return ": " + ", ".join(f"{WORDS.get(name, name)} {mean:+.2g}" for name, mean in shown)


def write_proposal(proposal: Proposal, comparison: Difference) -> str:
    """Return a sentence about what to try."""
    share = f"{100.0 * proposal.improvement:.0f} %"
    where = "" if comparison.is_ideal else f" in {name_engine(comparison.b, comparison.a)}"
    return (
        f"Try{where}: {proposal.text} (solved: the largest difference falls by {share}, to "
        f"{proposal.left:.2g})."
    )
