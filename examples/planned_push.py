"""Plan a push across a stick-slip switch: gradient descent with and without the distance to the next switch.

A box on the floor shall stop 0.3 m further on after 30 steps. The unknowns are the pushes of the first 15 steps, which
start equal and too weak to move it. While the box sticks, the derivative of its final position is 0: it exists, but
descent makes no progress. `distance` is the additional impulse of a step at which the box starts to slide. The second
descent tries pushes beyond these switches whenever a step along the gradient does not reduce the error, and continues
from there if the result is closer to the goal.

    python examples/planned_push.py [FIGURE.png]
"""

import sys

import numpy as np
import panels  # noqa: F401 - prints --help

import lavender as lv

DT, STEPS, PUSHED = 0.02, 30, 15  # s, -, -
MASS, MU, GRAVITY = 2.0, 0.5, 9.81  # kg, -, m/s2
GOAL = 0.3  # m
WEAK = 0.8  # fraction of the largest push at which the box still sticks
ITERATIONS = 60
JAC = np.array([[0.0, 1.0], [1.0, 0.0]])  # normal, tangent of a box that moves along x and z


def run(pushes):
    """Return the final position [m], the speeds, and problem and solution of each step; pushes (PUSHED,) [N s]."""
    v = np.zeros(2)
    x = 0.0
    speeds = []
    taken = []
    for k in range(STEPS):
        u = pushes[k] if k < PUSHED else 0.0
        free = v + np.array([u / MASS, -DT * GRAVITY])
        problem = lv.Problem.from_jacobian(
            JAC, MASS * np.eye(2), free, cones=lv.Cones.contacts(MU, 1)
        )
        solution = lv.solve(problem, tol=1e-12)
        v = problem.velocity(solution.impulse)
        x += DT * v[0]
        speeds.append(v[0])
        taken.append((problem, solution))
    return x, np.array(speeds), taken


def gradient(taken):
    """Return d x / d pushes (PUSHED,) [m/(N s)], and the additional impulse [N s] to each step's next switch."""
    back = np.zeros(2)
    by_push = np.zeros(PUSHED)
    lacks = np.zeros(PUSHED)
    switching = 0
    for k in reversed(range(STEPS)):
        d = lv.derivative(*taken[k])
        back = back + np.array([DT, 0.0])  # the speed of this step contributes to x
        back = d.vjp(velocity=back).v_free
        switching += len(d.switching)
        if k < PUSHED:
            by_push[k] = back[0] / MASS
            lacks[k] = d.distance[0] if d.states[0].name == "sticks" else 0.0
    return by_push, lacks, switching


def descent(heeds):
    """Return the pushes and the error [m] of each iteration."""
    u = np.full(PUSHED, WEAK * MU * MASS * GRAVITY * DT)
    errors = []
    crossed = 0
    x, _, taken = run(u)
    for _ in range(ITERATIONS):
        errors.append(abs(x - GOAL))
        by_push, lacks, _ = gradient(taken)
        slope = float(by_push @ by_push)
        tried = (
            [u + (GOAL - x) / slope * by_push * part for part in (1.0, 0.3, 0.1)]
            if slope > 0.0
            else []
        )
        if heeds and lacks.any():
            tried.append(u + 1.01 * lacks + 1e-6 * (lacks > 0.0))
        for i, other in enumerate(tried):
            found = run(other)
            if abs(found[0] - GOAL) < abs(x - GOAL):
                crossed += heeds and i == len(tried) - 1
                u, (x, _, taken) = other, found
                break
    return {"pushes": u, "errors": np.array(errors), "crossed": int(crossed)}


def numbers():
    """Return the results of both descents."""
    return {"gradient descent": descent(False), "with the distance to the switch": descent(True)}


def figure(found, path):
    """Draw the errors over the iterations, and the final speeds."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(7.2, 3.2), layout="constrained")
    left, right = canvas.subplots(1, 2)
    for (name, way), style in zip(found.items(), ("--", "-"), strict=True):
        left.semilogy(np.maximum(way["errors"], 1e-13), style, label=name)
        right.plot(DT * np.arange(1, STEPS + 1), run(way["pushes"])[1], style)
    left.set(xlabel="iteration", ylabel="distance from the goal [m]")
    right.set(xlabel="time [s]", ylabel="speed of the box [m/s]")
    canvas.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=9)
    canvas.savefig(path, dpi=150)


def main(path="planned_push.png"):
    """Print both results and save the figure."""
    found = numbers()
    for name, way in found.items():
        print(
            f"{name}: {way['errors'][0]:.3f} m from the goal at first, {way['errors'][-1]:.1e} m after "
            f"{ITERATIONS} iterations, {way['crossed']} of them across a switch"
        )
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
