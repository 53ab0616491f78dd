"""Small problems that records are made of."""

import numpy as np

import lavender as lv


def chain(n, name="chain", **more):
    a = np.diag(np.full(n, 2.0)) - np.diag(np.ones(n - 1), 1) - np.diag(np.ones(n - 1), -1)
    return lv.Problem.linear(a, np.ones(n), name=name, **more)


def stack(n=6, name="stack", **more):
    p = chain(n)
    return lv.Problem.lcp(p.matrix, np.linspace(1.0, -0.2, n), name=name, **more)


def idle_problem():
    return lv.Problem.lcp(np.eye(3), [-1.0, -2.0, -1.0], name="flying apart")


def moving_stack(steps, n=10):
    """A stack whose load changes slowly, as in consecutive steps."""
    p = stack(n)
    return [lv.Problem.lcp(p.matrix, p.b * (1.0 + 1e-3 * i), name=f"step {i}") for i in range(steps)]
