"""Find for each constraint of one step the same constraint in the step of another engine.

Contacts of the same two bodies are matched by their geoms and then by the smallest sum of distances, whatever their
number of rows; all other constraints by their keys, and equalities with other names by equal rows. A contact without a
partner has the settings that the other engine's geoms give it, if it has the same geoms, or borrows those of the
nearest contact of the same bodies there. A constraint that is not active there has the settings that the other engine's
model gives it, if they are known.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from dataclasses import dataclass, field, replace

import numpy as np

from lavender.io.step_record import ConstraintBlock, Softness, StepRecord

# [m] Added to the distance of two contacts of the same bodies if their geoms have other names.
OTHER_GEOMS_DISTANCE = 1e3
# [-] Rows of two equalities that differ by less than this part of them are the same: float32, and rounded poses.
SAME_ROWS = 1e-3


@dataclass(eq=False)
class Pairing:
    """Partners of the blocks of two records."""

    records: tuple[StepRecord, StepRecord]
    # For each record: index of the partner in the other record, or -1.
    partners: tuple[list[int], list[int]] = field(default_factory=lambda: ([], []))
    # For each record: index of the block in the other record that lends its settings, or -1.
    lenders: tuple[list[int], list[int]] = field(default_factory=lambda: ([], []))

    @classmethod
    def of_records(cls, a: StepRecord, b: StepRecord) -> Pairing:
        """Match the blocks of two records."""
        from scipy.optimize import linear_sum_assignment

        pairing = cls((a, b), ([-1] * len(a.blocks), [-1] * len(b.blocks)))
        groups: dict[str, tuple[list[int], list[int]]] = defaultdict(lambda: ([], []))
        for side, record in enumerate((a, b)):
            for i, block in enumerate(record.blocks):
                groups[block.key][side].append(i)
        for ours, theirs in groups.values():
            if not ours or not theirs:
                continue
            cost = np.array(
                [[measure_distance(a.blocks[i], b.blocks[j]) for j in theirs] for i in ours]
            )
            for i, j in zip(*linear_sum_assignment(cost), strict=True):
                pairing.join(ours[i], theirs[j])
        equalities = [[i for i, x in enumerate(r.blocks) if x.role == "equality"] for r in (a, b)]
        for i, j in itertools.product(*equalities):
            is_free = pairing.partners[0][i] < 0 > pairing.partners[1][j]
            if is_free and have_same_rows(a.blocks[i], b.blocks[j]):
                pairing.join(i, j)
        for side, (record, other) in enumerate(((a, b), (b, a))):
            for i, block in enumerate(record.blocks):
                partner = pairing.partners[side][i]
                if partner < 0 and block.role == "contact":
                    alike = [
                        (measure_distance(block, x), j)
                        for j, x in enumerate(other.blocks)
                        if x.key == block.key
                    ]
                    partner = min(alike)[1] if alike else -1
                pairing.lenders[side].append(partner)
        return pairing

    def join(self, i: int, j: int) -> None:
        """Make block i of the first record and block j of the second one partners."""
        self.partners[0][i], self.partners[1][j] = j, i

    def side_of(self, record: StepRecord) -> int:
        """Return 0 for the first record and 1 for the second."""
        return 0 if record is self.records[0] else 1

    def find(self, source: StepRecord, base: StepRecord, i: int) -> ConstraintBlock | None:
        """Return the block of `source` that is the same as block i of `base`, or lends its settings; else None."""
        if source is base:
            return base.blocks[i]
        side = self.side_of(base)
        if self.partners[side][i] < 0:
            made = self.make_unmatched(source, base.blocks[i])
            if made is not None:
                return made
        j = self.lenders[side][i]
        return None if j < 0 else source.blocks[j]

    def make_unmatched(self, source: StepRecord, block: ConstraintBlock) -> ConstraintBlock | None:
        """Return a contact with the settings that `source` would give it; None if its geoms are not known there."""
        known = source.geom_settings
        settings = [known[x] for x in block.geom_keys or block.geoms if x in known]
        cone = {"pyramidal": "pyramid", "elliptic": "ellipse"}.get(source.settings.get("cone", ""))
        if block.role != "contact" or len(settings) != 2 or cone is None:
            return None
        condim, friction, softness = settings[0].combine(settings[1])
        return replace(
            block,
            condim=condim,
            cone=cone if condim > 1 else "",
            friction=friction,
            softness=softness,
        )

    def find_softness(self, source: StepRecord, base: StepRecord, i: int) -> Softness | None:
        """Return the softness that `source` gives to block i of `base`; None if it is not known."""
        block = self.find(source, base, i)
        return source.softnesses.get(base.blocks[i].key) if block is None else block.softness

    def list_unmatched(self, side: int) -> list[ConstraintBlock]:
        """Return the blocks of one record that the other one does not have."""
        blocks = self.records[side].blocks
        return [x for x, j in zip(blocks, self.partners[side], strict=True) if j < 0]

    def list_unknown(self, side: int) -> list[ConstraintBlock]:
        """Return the blocks of one record to which the other engine's settings are not known."""
        base, source = self.records[side], self.records[1 - side]
        return [
            x for i, x in enumerate(base.blocks)
            if x.role != "friction" and self.find_softness(source, base, i) is None
        ]  # fmt: skip


def have_same_rows(a: ConstraintBlock, b: ConstraintBlock) -> bool:
    """Return whether two equalities, which may have other names, constrain the same velocities."""
    x, y = a.jacobian, b.jacobian
    return x.shape == y.shape and bool(
        np.allclose(x, y, rtol=0.0, atol=SAME_ROWS * np.abs(x).max())
    )


def measure_distance(a: ConstraintBlock, b: ConstraintBlock) -> float:
    """Return the distance of two blocks [m], with `OTHER_GEOMS_DISTANCE` for contacts of other geoms."""
    has_keys = bool(a.geom_keys and b.geom_keys)  # Not in older files.
    ours, theirs = (x.geom_keys if has_keys else x.geoms for x in (a, b))
    are_other = bool(ours and theirs) and set(ours) != set(theirs)
    return float(np.linalg.norm(a.position - b.position)) + OTHER_GEOMS_DISTANCE * are_other
