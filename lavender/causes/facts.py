"""What differs between two records, as sentences with the numbers that a user can change; and what to change.

A proposed change is solved before it is named: it is a mixture of the second engine with ingredients of the first one,
or, against the rigid laws, the engine's own step with another setting.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.causes.difference import Difference
from lavender.causes.matching import Pairing
from lavender.causes.mixture import INGREDIENTS, PARTS, solve_mixture
from lavender.causes.smaller_steps import COUNT
from lavender.io.step_record import ConstraintBlock, Softness, StepRecord
from lavender.report.text import format_count

RELATIVE_TOLERANCE = 1e-6  # [-] Numbers that differ by less are not facts.
# [-] A change is proposed if the largest difference falls by at least this part.
MIN_IMPROVEMENT = 0.1
# [-] Of several changes, the smallest one is proposed whose improvement is at most this much below the best.
IMPROVEMENT_TOLERANCE = 0.02
SETTABLE = ("mass", "force", "integrator", "softness", "friction")
WEIGHT_TOLERANCE = 1e-4  # [-] The same, of masses and inverse masses in float32.
ROLE_WORDS = {
    "contact": ("contact", "contacts"), "limit": ("limit", "limits"),
    "equality": ("equality", "equalities"), "friction": ("joint's dry friction", "joints' dry friction"),
}  # fmt: skip


@dataclass(frozen=True)
class Fact:
    """A difference of two records."""

    part: str  # Of `PARTS`.
    text: str


@dataclass(frozen=True)
class Proposal:
    """A change of the second engine, and the difference that is left with it."""

    text: str
    left: float  # [m/s, rad/s] Largest difference that remains.
    before: float  # [m/s, rad/s]
    causes: tuple[str, ...] = ()  # Ingredients that are exchanged.

    @property
    def improvement(self) -> float:
        """Part by which the largest difference falls [-]."""
        return 1.0 - self.left / self.before if self.before > 0.0 else 0.0


def list_facts(comparison: Difference) -> list[Fact]:
    """Return what differs between the records, by the parts of a step."""
    a, b, pairing = comparison.a, comparison.b, comparison.pairing
    facts = [
        *_compare_matrices(a, b),
        *_compare_weights(a, b, pairing),
        *_compare_rows(a, b, pairing),
        *_compare_softness(a, b, pairing),
    ]
    return facts + list(_compare_friction(a, b, pairing))


def _find_limit(a: StepRecord, b: StepRecord) -> float:
    """Return the relative difference [-] of masses up to which they are equal to rounding."""
    return WEIGHT_TOLERANCE if "float32" in (a.precision, b.precision) else RELATIVE_TOLERANCE


def _differ(x: Any, y: Any, limit: float = RELATIVE_TOLERANCE) -> bool:
    """Return whether numbers differ by more than rounding."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    return x.shape != y.shape or bool(
        (np.abs(x - y) > limit * np.maximum(np.abs(x), np.abs(y)) + 1e-12).any()
    )


def _list_numbers(values: Any) -> str:
    """Return numbers with four digits, separated by spaces."""
    return " ".join(f"{x:.4g}" for x in np.ravel(values))


def _compare_matrices(a: StepRecord, b: StepRecord) -> Iterator[Fact]:
    """Yield differences of masses, forces, dampings and integrators."""

    def find_largest(x: FloatArray, y: FloatArray) -> int:
        size = np.maximum(np.abs(x), np.abs(y))
        return int(np.argmax(np.abs(x - y) / np.where(size > 0.0, size, 1.0)))

    limit = _find_limit(a, b)
    for part, name, word, unit in (
        ("mass", "mass", "mass of", "kg m2"),
        ("damping", "damping_matrix", "damping of", "N m s"),
        ("actuators", "actuator_matrix", "actuator damping of", "N m s"),
        ("force", "stiffness_matrix", "stiffness of", "N m"),
    ):
        x, y = np.diag(getattr(a, name)), np.diag(getattr(b, name))
        if _differ(x, y, limit):
            i = find_largest(x, y)
            unit = unit if a.angular[i] else unit.replace(" m2", "").replace("N m s", "N s/m")
            unit = "N/m" if unit == "N m" and not a.angular[i] else unit
            more = int(np.count_nonzero(np.abs(x - y) > limit * np.maximum(x, y))) - 1
            others = f" and {more} other velocities" if more > 0 else ""
            yield Fact(part, f"{word} {a.names[i]}{others}: {x[i]:.4g} and {y[i]:.4g} {unit}")
    if _differ(a.gravity, b.gravity):
        text = f"gravity: {_list_numbers(a.gravity)} and {_list_numbers(b.gravity)} m/s2"
        yield Fact("force", text)
    for part, name, word in (
        ("force", "force", "force on"), ("actuators", "actuator_force", "actuator force on"),
    ):  # fmt: skip
        x, y = getattr(a, name), getattr(b, name)
        if np.abs(x - y).max(initial=0.0) > RELATIVE_TOLERANCE * (1.0 + np.abs(x).max(initial=0.0)):
            i = int(np.argmax(np.abs(x - y)))
            unit = "N m" if a.angular[i] else "N"
            yield Fact(part, f"{word} {a.names[i]}: {x[i]:.4g} and {y[i]:.4g} {unit}")
    added = a.added_matrix, b.added_matrix
    if a.in_problem != b.in_problem and any(np.any(x) for x in added):
        words = ["inside" if x.in_problem else "outside" for x in (a, b)]
        i = int(np.argmax(np.abs(np.diag(added[0])) + np.abs(np.diag(added[1]))))
        yield Fact(
            "method",
            f"implicit damping and actuators (of {a.names[i]} and others): {words[0]} and {words[1]} the constraint "
            "problem",
        )
    elif _differ(np.diag(added[0]), np.diag(added[1])) and not _differ(
        np.diag(a.damping_matrix), np.diag(b.damping_matrix)
    ):
        i = find_largest(np.diag(added[0]), np.diag(added[1]))
        terms = (f"{x[i, i]:.4g}" for x in added)
        yield Fact(
            "method", f"implicit terms added to the mass of {a.names[i]}: {' and '.join(terms)}"
        )
    if a.implicit_rows != b.implicit_rows:
        words = ["implicit" if x.implicit_rows else "explicit" for x in (a, b)]
        yield Fact("method", f"springs of the constraint rows: {words[0]} and {words[1]}")
    names = [x.settings.get("integrator") for x in (a, b)]
    if all(names) and names[0] != names[1]:
        yield Fact("method", f"integrator: {names[0]} and {names[1]}")


def _compare_weights(a: StepRecord, b: StepRecord, pairing: Pairing) -> Iterator[Fact]:
    """Yield differences of the inverse masses from which the engines make compliances, if the masses are equal."""
    pairs = [
        (x, x.weight[0], b.blocks[j].weight[0])
        for x, j in zip(a.blocks, pairing.partners[0], strict=True) if j >= 0
    ]  # fmt: skip
    limit = _find_limit(a, b)
    if _differ(np.diag(a.mass), np.diag(b.mass), limit):
        return
    unlike = [(x, y, z) for x, y, z in pairs if abs(y - z) > limit * max(abs(y), abs(z))]
    if unlike:
        block, x, y = max(unlike, key=lambda p: abs(p[1] - p[2]) / max(abs(p[1]), abs(p[2])))
        more = f" and {len(unlike) - 1} others" if len(unlike) > 1 else ""
        yield Fact(
            "mass",
            f"inverse mass (invweight) that the engine uses for the compliance of {block.key}{more}: {x:.4g} and "
            f"{y:.4g} 1/kg, with equal masses",
        )


def _compare_rows(a: StepRecord, b: StepRecord, pairing: Pairing) -> Iterator[Fact]:
    """Yield rows that only one record has, and differences of gaps and axes."""
    for side, (own, other) in enumerate(((a, b), (b, a))):
        alone = pairing.list_unmatched(side)
        for role, words in ROLE_WORDS.items():
            names = [x.key for x in alone if x.role == role]
            if names:
                counts = {n: names.count(n) for n in dict.fromkeys(names)}
                listed = [f"{n} x {name}" if n > 1 else name for name, n in counts.items()]
                more = f" and {len(listed) - 4} others" if len(listed) > 4 else ""
                count = format_count(len(names), *words) if len(words) > 1 else len(names)
                part = "coefficient" if role == "friction" else "rows"
                yield Fact(
                    part,
                    f"{count} only {name_engine(own, other)} has: {', '.join(listed[:4])}{more}",
                )
        unknown = list(dict.fromkeys(x.key for x in pairing.list_unknown(side) if x in alone))
        if unknown:
            more = f" and {len(unknown) - 3} others" if len(unknown) > 3 else ""
            yield Fact(
                "rows",
                f"settings that {name_engine(other, own)} would give to {', '.join(unknown[:3])}{more} are unknown: "
                f"those of {name_engine(own, other)} are used",
            )
    pairs = [(x, b.blocks[j]) for x, j in zip(a.blocks, pairing.partners[0], strict=True) if j >= 0]
    gaps = [(abs(x.gap[0] - y.gap[0]), x, y) for x, y in pairs if len(x.gap) and len(y.gap)]
    is_float32 = "float32" in (a.precision, b.precision)
    limit = WEIGHT_TOLERANCE if is_float32 else RELATIVE_TOLERANCE
    moved = [g for g in gaps if g[0] > limit * abs(g[1].gap[0]) + 1e-12]
    if moved:
        _, x, y = max(moved, key=lambda g: g[0])
        rest = f" ({format_count(len(moved), 'row')} differ)" if len(moved) > 1 else ""
        yield Fact("rows", f"gap of {x.key}: {x.gap[0]:.4g} and {y.gap[0]:.4g}{rest}")
    margins = [(x, y) for x, y in pairs if _differ(x.margin, y.margin)]
    if margins:
        x, y = margins[0]
        yield Fact("rows", f"margin of {x.key}: {x.margin:.4g} and {y.margin:.4g}")


def _group(
    pairs: list[tuple[ConstraintBlock, Any, Any]], write: Callable[[Any], Any]
) -> list[tuple[str, str, str]]:
    """Return (blocks, first, second) of pairs of values whose texts differ, grouped by these texts."""
    groups: dict[tuple[str, str, str], list[str]] = defaultdict(list)
    for block, x, y in pairs:
        first, second = write(x), write(y)
        if first is not None and second is not None and first != second:
            groups[block.role, first, second].append(block.key)
    result = []
    for (role, first, second), keys in sorted(groups.items(), key=lambda g: -len(g[1])):
        count = format_count(len(keys), *ROLE_WORDS[role])
        result.append((f"{count} ({keys[0]}, ...)" if len(keys) > 1 else keys[0], first, second))
    return result


def _compare_softness(a: StepRecord, b: StepRecord, pairing: Pairing) -> Iterator[Fact]:
    """Yield differences of the softness of rows that both have."""
    pairs = [
        (x, x.softness, b.blocks[j].softness)
        for x, j in zip(a.blocks, pairing.partners[0], strict=True) if j >= 0
    ]  # fmt: skip

    def write_reference(s: Softness) -> str:
        if s.rule == "rigid":
            return "rigid"
        if s.rule == "rates":
            return f"damping rate {s.rate[0]:.4g} 1/s, stiffness {s.stiffness[0]:.4g} 1/s2"
        return f"solref {_list_numbers(s.solref)}"

    def write_compliance(s: Softness) -> str:
        if s.rule == "rigid":
            return "rigid"
        if s.rule == "rates":
            return f"compliance {s.compliance[0]:.4g}"
        return f"solimp {_list_numbers(s.solimp)}"

    for what, first, second in _group(pairs, write_reference):
        yield Fact("reference", f"reference of {what}: {first} and {second}")
    for what, first, second in _group(pairs, write_compliance):
        yield Fact("compliance", f"compliance of {what}: {first} and {second}")
    ratios = [
        (block, x, y) for block, x, y in pairs
        if block.has_friction and x.rule == y.rule == "impedance"
    ]  # fmt: skip
    for what, first, second in _group(ratios, lambda s: f"{s.impratio:g}"):
        yield Fact("compliance", f"impratio of {what}: {first} and {second}")
    fixed = [x.settings.get("constraint_timeconst") for x in (a, b)]
    for own, value, other in ((a, fixed[0], b), (b, fixed[1], a)):
        if not value:
            continue
        used = [x for x in own.blocks if x.softness.rule == "impedance"]
        if any(abs(float(x.softness.solref[0]) - value) < 1e-9 for x in used):
            yield Fact(
                "reference",
                f"{name_engine(own, other)} uses constraint_timeconst={value:g} where the file gives no solref",
            )


def _compare_friction(a: StepRecord, b: StepRecord, pairing: Pairing) -> Iterator[Fact]:
    """Yield differences of cones, coefficients and laws."""
    pairs = [
        (x, x, b.blocks[j])
        for x, j in zip(a.blocks, pairing.partners[0], strict=True) if j >= 0
    ]  # fmt: skip
    contacts = [p for p in pairs if p[0].role == "contact"]

    def write_cone(x: ConstraintBlock) -> str:
        word = {"pyramid": "pyramid", "ellipse": "round"}.get(x.cone, "no friction")
        return f"{word}, condim {x.condim}"

    def write_friction(x: ConstraintBlock) -> str | None:
        if x.role == "contact":
            return _list_numbers(x.friction[: x.condim - 1]) if x.condim > 1 else None
        return f"{x.loss:.4g}" if x.role == "friction" else None

    for what, first, second in _group(contacts, write_cone):
        yield Fact("shape", f"cone of {what}: {first} and {second}")
    if a.law != b.law:
        words = {"cone": "convex relaxation", "coulomb": "Coulomb"}
        yield Fact("law", f"friction law: {words[a.law]} and {words[b.law]}")
    for what, first, second in _group(
        [p for p in pairs if p[1].condim == p[2].condim], write_friction
    ):
        yield Fact("coefficient", f"friction of {what}: {first} and {second}")


def name_engine(record: StepRecord, other: StepRecord) -> str:
    """Return the engine's name without its version, unless both have the same."""
    first, second = (x.engine.partition(" ")[0] for x in (record, other))
    return first if first != second else record.engine


def list_proposals(comparison: Difference) -> list[Proposal]:
    """Return the changes of the second engine that reduce the largest difference, best first; each one is solved."""
    if comparison.is_ideal:
        return _propose_settings(comparison)
    a, active = comparison.a, comparison.active
    settable = [x for x in active if x in SETTABLE]
    whole = comparison.b.velocity_after
    solver = whole - comparison.mixtures[(True,) * len(active)].velocity if active else 0.0
    before = float(np.abs(comparison.difference).max(initial=0.0))
    found = []
    for size in range(1, len(settable) + 1):
        for chosen in itertools.combinations(settable, size):
            bits = tuple(name not in chosen for name in active)
            velocity = comparison.mixtures[bits].velocity + solver
            left = float(np.abs(velocity - a.velocity_after).max(initial=0.0))
            text = ", ".join(describe_change(comparison, name) for name in chosen)
            found.append(Proposal(text, left, before, chosen))
    best = max((p.improvement for p in found), default=0.0)
    if best < MIN_IMPROVEMENT:
        return []
    good = [p for p in found if p.improvement >= best - IMPROVEMENT_TOLERANCE]
    size = min(len(p.causes) for p in good)
    return sorted((p for p in good if len(p.causes) == size), key=lambda p: p.left)[:1]


def describe_change(comparison: Difference, name: str) -> str:
    """Return the setting of the second engine that gives it an ingredient of the first one."""
    a, b, pairing = comparison.a, comparison.b, comparison.pairing
    family = b.settings.get("family")
    if name == "softness":
        pairs = [
            (a.blocks[i].softness, x.softness)
            for x, i in zip(b.blocks, pairing.partners[1], strict=True) if i >= 0
        ]  # fmt: skip
        ours = {_list_numbers(x.solref): x.solref for x, y in pairs
                if x.rule == y.rule == "impedance" and _differ(x.solref, y.solref)}  # fmt: skip
        fixed = b.settings.get("constraint_timeconst")
        replaced = [y for x, y in pairs if _differ(x.solref, y.solref)]
        times = {float(x.solref[0]) for x, y in pairs if _differ(x.solref, y.solref)}
        only_times = all(
            x.rule == y.rule == "impedance" and not _differ(x.solref[1], y.solref[1])
            and not _differ(x.solimp, y.solimp)
            for x, y in pairs
        )  # fmt: skip
        # Contacts mix the time constants of two geoms, of which one may have the fixed one.
        if (
            fixed
            and len(times) == 1
            and only_times
            and min(float(y.solref[0]) for y in replaced) >= fixed - 1e-9
        ):
            return f"constraint_timeconst={times.pop():g}"
        if len(ours) == 1 and not any(_differ(x.solimp, y.solimp) for x, y in pairs):
            return f'solref="{next(iter(ours))}"'
    if name == "integrator":
        if family == "genesis" and b.in_problem and not a.in_problem:
            return "integrator=Euler"
        own = a.settings.get("integrator")
        if family == "mujoco" == a.settings.get("family") and own != b.settings.get("integrator"):
            return f"integrator={own}"
    if name == "friction" and family == "mujoco":
        cones = {x.cone for x in a.blocks if x.cone}, {x.cone for x in b.blocks if x.cone}
        if len(cones[0]) == 1 and cones[0] != cones[1]:
            return (
                f"cone={ {'pyramid': 'pyramidal', 'ellipse': 'elliptic'}[cones[0].pop()] }".replace(
                    " ", ""
                )
            )
    words = {"mass": "masses", "force": "forces", "integrator": "integrator, damping and gains",
             "softness": "solref and solimp", "friction": "friction"}  # fmt: skip
    return f"the {words[name]} of {name_engine(a, b)}"


def _propose_settings(comparison: Difference) -> list[Proposal]:
    """Return settings of one engine that bring its step nearer to the rigid laws, best first."""
    record, ideal = comparison.b, comparison.a.velocity_after
    before = float(np.abs(comparison.exact_b - ideal).max(initial=0.0))
    found = []
    for text, causes, changed in _iterate_settings(record):
        try:
            step = solve_mixture(
                dict.fromkeys(PARTS, changed), Pairing.of_records(changed, changed)
            )
        except (ValueError, np.linalg.LinAlgError):
            continue
        left = float(np.abs(step.velocity - ideal).max(initial=0.0))
        found.append(Proposal(text, left, before, causes))
    if "time step" in comparison.parts:
        finer = comparison.difference - comparison.parts["time step"].alone_in_b
        before = float(np.abs(comparison.difference).max(initial=0.0))
        left = float(np.abs(finer).max(initial=0.0))
        found.append(Proposal(f"timestep={record.dt / COUNT:g}", left, before, ("time step",)))
    found = [p for p in found if p.improvement >= MIN_IMPROVEMENT]
    return sorted(found, key=lambda p: p.left)[:3]


def _iterate_settings(record: StepRecord) -> Iterator[tuple[str, tuple[str, ...], StepRecord]]:
    """Yield (text, causes, record with it) of settings that an engine with MuJoCo's impedance model has."""
    if record.settings.get("family") not in ("mujoco", "genesis"):
        return

    roles = {x.role for x in record.blocks if x.softness.rule == "impedance"}
    # MJCF has other names for the rows of a joint than for contacts.
    suffix = (
        {"friction": "friction", "limit": "limit"}.get(next(iter(roles)), "")
        if len(roles) == 1
        else ""
    )

    def soften(**changes: Any) -> StepRecord:
        blocks = tuple(
            replace(x, softness=replace(x.softness, **changes))
            if x.softness.rule == "impedance"
            else x
            for x in record.blocks
        )
        return replace(record, blocks=blocks)

    stiff = np.array([0.99, 0.999, 0.001, 0.5, 2.0])
    short = np.array([2.0 * record.dt, 1.0])
    yield f'solimp{suffix}="0.99 0.999 0.001"', ("softness",), soften(solimp=stiff)
    yield f'solref{suffix}="{short[0]:g} 1"', ("softness",), soften(solref=short)
    both = soften(solref=short, solimp=stiff)
    yield (
        f'solref{suffix}="{short[0]:g} 1" with solimp{suffix}="0.99 0.999 0.001"',
        ("softness",),
        both,
    )
    if record.settings["family"] == "mujoco":
        discrete = replace(
            record, in_problem=True, implicit_rows=True, uses_damping=True, uses_actuators=True,
            uses_stiffness=True,
        )  # fmt: skip
        if not record.in_problem:
            yield "integrator=discrete", ("integrator",), discrete
        if any(x.cone == "pyramid" for x in record.blocks):
            round_cones = replace(record, blocks=tuple(
                replace(x, cone="ellipse" if x.cone else "") for x in record.blocks
            ))  # fmt: skip
            yield "cone=elliptic", ("friction",), round_cones
        if any(x.has_friction for x in record.blocks):
            ratio = 10.0 * max(x.softness.impratio for x in record.blocks)
            yield f"impratio={ratio:g}", ("softness",), soften(impratio=ratio)


def list_parts_of(fact: Fact) -> str:
    """Return the ingredient of a fact."""
    return next(name for name, parts in INGREDIENTS.items() if fact.part in parts)
