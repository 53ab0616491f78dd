"""A push planned through a stick-slip change: descent that reads how far the next switch is, and one that does not.

A box stands on the floor and is to stop 0.3 m further on after 30 steps. The pushes of the first 15 steps are sought,
all the same at first and too weak to move it. As long as it sticks, the derivative of where it ends is 0: it exists,
and leads nowhere. `distance` says how much more impulse a step takes until the box slides. The second descent tries
the pushes beyond these switches whenever a step along the gradient gains nothing, and goes on from there if that is
nearer to the goal.

    python examples/planned_push.py [FIGURE.png]
"""

import sys

import numpy as np

import lavender as lv

DT, STEPS, PUSHED = 0.02, 30, 15  # s, -, -
MASS, MU, GRAVITY = 2.0, 0.5, 9.81  # kg, -, m/s2
GOAL = 0.3  # m
WEAK = 0.8  # of the push that friction just holds
TURNS = 60
JAC = np.array([[0.0, 1.0], [1.0, 0.0]])  # normal, tangent of a box that moves along x and z


def run(pushes):
    """Where the box ends [m], its speeds, and the steps' problems and solutions; pushes (PUSHED,) [N s]."""
    v, x, speeds, taken = np.zeros(2), 0.0, [], []
    for k in range(STEPS):
        u = pushes[k] if k < PUSHED else 0.0
        free = v + np.array([u / MASS, -DT * GRAVITY])
        problem = lv.Problem.from_jacobian(JAC, MASS * np.eye(2), free, cones=lv.Cones.contacts(MU, 1))
        solution = lv.solve(problem, tol=1e-12)
        v = problem.velocity(solution.impulse)
        x += DT * v[0]
        speeds.append(v[0])
        taken.append((problem, solution))
    return x, np.array(speeds), taken


def gradient(taken):
    """d x / d pushes (PUSHED,) [m/(N s)], and what each step lacks to its next switch [N s]."""
    back, by_push, lacks, switching = np.zeros(2), np.zeros(PUSHED), np.zeros(PUSHED), 0
    for k in reversed(range(STEPS)):
        d = lv.derivative(*taken[k])
        back = back + np.array([DT, 0.0])  # this step's speed moves x
        back = d.vjp(velocity=back).v_free
        switching += len(d.switching)
        if k < PUSHED:
            by_push[k] = back[0] / MASS
            lacks[k] = d.distance[0] if d.states[0].name == "sticks" else 0.0
    return by_push, lacks, switching


def descent(heeds):
    """Pushes and the error [m] of each turn."""
    u = np.full(PUSHED, WEAK * MU * MASS * GRAVITY * DT)
    errors, crossed = [], 0
    x, _, taken = run(u)
    for _ in range(TURNS):
        errors.append(abs(x - GOAL))
        by_push, lacks, _ = gradient(taken)
        slope = float(by_push @ by_push)
        tried = [u + (GOAL - x) / slope * by_push * part for part in (1.0, 0.3, 0.1)] if slope > 0.0 else []
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
    """Both descents."""
    return {"as it is": descent(False), "heeding the switches": descent(True)}


def figure(found, path):
    """Errors turn by turn, and the speeds at the end."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(8, 3.4), layout="constrained")
    left, right = canvas.subplots(1, 2)
    for name, way in found.items():
        left.semilogy(np.maximum(way["errors"], 1e-13), label=name)
        right.plot(DT * np.arange(1, STEPS + 1), run(way["pushes"])[1], label=name)
    left.set(xlabel="turn", ylabel="distance from the goal [m]")
    right.set(xlabel="time [s]", ylabel="speed of the box [m/s]")
    left.legend(frameon=False, fontsize=8)
    canvas.savefig(path)


def main(path="planned_push.png"):
    """Print both ends, save the figure."""
    found = numbers()
    for name, way in found.items():
        print(
            f"{name}: {way['errors'][0]:.3f} m from the goal at first, {way['errors'][-1]:.1e} m after {TURNS} turns, "
            f"{way['crossed']} of them across a switch"
        )
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
