"""Small problems that records are made of."""

import numpy as np

import lavender as lv


def chain(n, name="chain", **more):
    a = np.diag(np.full(n, 2.0)) - np.diag(np.ones(n - 1), 1) - np.diag(np.ones(n - 1), -1)
    return lv.Problem.linear(a, np.ones(n), name=name, **more)


def stack(n=6, name="stack", **more):
    p = chain(n)
    return lv.Problem.lcp(p.matrix, np.linspace(1.0, -0.2, n), name=name, **more)


def moving_stack(steps, n=10):
    """A stack whose load changes slowly, as in consecutive steps."""
    p = stack(n)
    return [
        lv.Problem.lcp(p.matrix, p.b * (1.0 + 1e-3 * i), name=f"step {i}") for i in range(steps)
    ]


def bricks(layers, noise, seed=0):
    """A tower of three bricks a layer, every second layer crosswise, one ten times as heavy; contacts at corners.

    noise [m/s]: of the normal velocities that are asked for.
    """
    rng = np.random.default_rng(seed)
    layer, side = np.divmod(np.arange(3 * layers), 3)
    across = (layer % 2 == 1)[:, None]
    place = np.where(across, (side[:, None] - 1) * [0.05, 0.0], (side[:, None] - 1) * [0.0, 0.05])
    half = np.where(across, [0.0245, 0.075], [0.075, 0.0245])
    mass = np.where(np.arange(3 * layers) == rng.integers(3 * layers), 1.0, 0.1)
    size = np.column_stack([half, np.full(3 * layers, 0.015)])
    squares = (size**2).sum(axis=1, keepdims=True) - size**2
    body, corner = [], []
    for upper in range(3 * layers):
        for lower in range(3 * layer[upper] - 3, 3 * layer[upper]) if layer[upper] else [-1]:
            on = [upper] if lower < 0 else [upper, lower]
            low = (place[on] - half[on]).max(axis=0)
            high = (place[on] + half[on]).min(axis=0)
            body += 4 * [(lower, upper)]
            corner += [(x, y, 0.0) for x in (low[0], high[0]) for y in (low[1], high[1])]
    pair = np.array(body, np.int32)
    point = np.array(corner)
    k = len(body)
    centre = np.column_stack([place, np.zeros(3 * layers)])
    rows = lv.Rows(
        inv_mass=1.0 / mass,
        inv_inertia=(3.0 / (mass[:, None] * squares))[:, :, None] * np.eye(3),
        v_free=2e-3 * rng.normal(size=(3 * layers, 6)) - [0.0, 0.0, 9.81 * 2e-3, 0.0, 0.0, 0.0],
        contact_body=pair,
        normal=np.tile([0.0, 0.0, 1.0], (k, 1)),
        tangent=np.tile([1.0, 0.0, 0.0], (k, 1)),
        arm_a=np.where(pair[:, :1] >= 0, point - centre[pair[:, 0]] + [0.0, 0.0, 0.015], 0.0),
        arm_b=point - centre[pair[:, 1]] - [0.0, 0.0, 0.015],
    )
    target = np.zeros((k, 3))
    target[:, 0] = noise * rng.normal(size=k)
    return lv.Problem.from_rows(rows, target=target.ravel(), mu=0.5)


def idle_problem():
    return lv.Problem.lcp(np.eye(3), [-1.0, -2.0, -1.0], name="flying apart")
