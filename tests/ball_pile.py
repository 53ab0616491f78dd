"""Piles of balls that creep, as a small engine steps them.

Balls of random number, sizes, masses and friction fall into an open box and are pressed together in steps of 1/60 s,
each solved by `newton` to 1e-4 from the impulses of the last step. On these problems contacts under load are between
sticking and slipping (docs/methods.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

import lavender as lv

DT = 1 / 60  # s
CONTACT_GAP = 0.02  # m, a gap that is a contact already
WALLS = ((1, 1), (0, 1), (0, -1), (2, 1), (2, -1))  # axis and side: floor, and four walls


class Pile:
    """Balls in a box, y up."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        n = int(rng.integers(40, 170))
        self.mu = float(rng.choice([0.3, 0.5, 0.5, 0.7, 1.0]))
        spread = rng.choice([0.0, 0.0, 0.1, 0.3])
        heavy = rng.choice([1.0, 1.0, 10.0])
        self.radius = 0.5 * (1.0 + spread * rng.uniform(-1.0, 1.0, n))  # m
        self.side = np.ceil((n / rng.choice([1.0, 2.0])) ** (1 / 3)) + rng.choice(
            [0.2, 0.6, 1.0]
        )  # m
        k = int(self.side)
        i = np.arange(n)
        grid = [
            (i % k + 0.6) * self.side / k,
            i // k**2 * 1.1 + 0.55,
            (i // k % k + 0.6) * self.side / k,
        ]
        self.place = np.transpose(grid) + rng.uniform(-0.05, 0.05, (n, 3))
        self.mass = np.where(rng.random(n) < 0.1, heavy, 1.0) * (self.radius / 0.5) ** 3  # kg
        self.velocity = np.zeros((n, 6))

    def contacts(self) -> tuple[Any, Any, Any]:
        """Bodies (c, 2), normals (c, 3) and gaps (c,) of all pairs nearer than CONTACT_GAP."""
        out = []
        for axis, sign in WALLS:
            gap = sign * self.place[:, axis] + (self.side if sign < 0 else 0.0) - self.radius
            out += [
                (-1, i, sign * np.eye(3)[axis], gap[i]) for i in np.flatnonzero(gap < CONTACT_GAP)
            ]
        apart = self.place[None] - self.place[:, None]
        length = np.sqrt((apart**2).sum(axis=-1))
        gap = length - self.radius - self.radius[:, None]
        pairs = np.argwhere(np.triu(gap < CONTACT_GAP, 1))
        out += [(i, j, apart[i, j] / length[i, j], gap[i, j]) for i, j in pairs]
        a, b, normal, gap = zip(*out, strict=True)
        return np.column_stack([a, b]).astype(np.int32), np.array(normal), np.array(gap)

    def problem(self) -> lv.Problem:
        """Of the next step; gaps may close, a fifth of what overlaps beyond 5 mm is pushed out, at most at 1 m/s."""
        body, normal, gap = self.contacts()
        across = np.where(abs(normal[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        tangent = np.cross(normal, across)
        target = np.zeros((len(gap), 3))
        target[:, 0] = np.where(gap > 0.0, -gap / DT, np.clip(0.2 * (-gap - 0.005) / DT, 0.0, 1.0))
        rows = lv.Rows(
            inv_mass=1.0 / self.mass,
            inv_inertia=(2.5 / (self.mass * self.radius**2))[:, None, None] * np.eye(3),
            v_free=self.velocity - [0.0, 9.81 * DT, 0.0, 0.0, 0.0, 0.0],
            contact_body=body,
            normal=normal,
            tangent=tangent / np.linalg.norm(tangent, axis=1, keepdims=True),
            arm_a=np.where(body[:, :1] >= 0, normal * self.radius[body[:, :1]], 0.0),
            arm_b=-normal * self.radius[body[:, 1:]],
        )
        # A wall is told by the axis of its normal.
        name = np.where(body[:, 0] >= 0, body[:, 0], len(self.mass) + abs(normal).argmax(axis=1))
        key = (name.astype(np.uint64) << np.uint64(32)) | body[:, 1].astype(np.uint64)
        return lv.Problem.from_rows(rows, target=target.ravel(), mu=self.mu, key=key)

    def problems(self, steps: int) -> Iterator[tuple[int, lv.Problem]]:
        """Of step 0 to the last, and the pile steps on."""
        last: tuple[lv.Problem, Any] | None = None
        for step in range(steps + 1):
            problem = self.problem()
            yield step, problem
            start = None if last is None else problem.carry(last)
            impulse = lv.solve(problem, "newton", tol=1e-4, max_iter=60, impulse=start).impulse
            self.velocity = problem.velocity(impulse).reshape(-1, 6)
            last = (problem, impulse)
            self.place += DT * self.velocity[:, :3]
