"""Exercise 1: two particles joined by one distance row: derived, by hand and by engine.

Positions x1, x2, masses m1, m2, velocities v1*, v2* before the constraint acts. The joint keeps the length l:

    C(x) = |x2 - x1| - l = 0
    dC/dt = n.(v2 - v1),  n = (x2 - x1)/|x2 - x1|         so J = [-n^T, n^T], one row of six entries
    v+ = v* + M^-1 J^T lambda                              an impulse lambda along n, equal and opposite
    0 = J v+ = J v* + A lambda,  A = J M^-1 J^T = n.n/m1 + n.n/m2 = 1/m1 + 1/m2
    lambda = b / A,  b = -J v* = -n.(v2* - v1*)

A is a number here; b is the speed at which the joint would come apart. Particle 1 (1 kg) stands still,
particle 2 (2 kg) flies off at an angle. One impulse along n makes their speeds along n equal; what is across
stays, and so does momentum: J^T lambda adds up to zero over both. The engine's problem is the same
number, and its pair turns about the common centre from then on.

    python examples/two_particles.py [FIGURE.png]

A file named after a panel holds it alone: tracks.png, distance.png.
"""

import sys

import numpy as np
from panels import save

import lavender as lv

MASS = np.array([1.0, 2.0])  # kg
PLACE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])  # m
SPEED = np.array([[0.0, 0.0, 0.0], [2.0, 1.0, 0.0]])  # m/s
STEPS = 1200


def by_hand():
    """Impulse [N s] and velocities after it (2, 3) [m/s]."""
    n = (PLACE[1] - PLACE[0]) / np.linalg.norm(PLACE[1] - PLACE[0])
    problem = lv.Problem.linear([[1.0 / MASS[0] + 1.0 / MASS[1]]], [-n @ (SPEED[1] - SPEED[0])])
    impulse = lv.solve(problem, "direct").impulse[0]
    return impulse, SPEED + np.outer([-1.0, 1.0] / MASS, impulse * n)


def scene():
    """The same two particles for the engine; bodies without a shape touch nothing."""
    made = lv.Scene(gravity=0.0, dt=1.0 / 240.0, solver_iterations=4)
    a, b = (
        made.add_body(m, position=x, velocity=v, name=f"particle {i + 1}")
        for i, (m, x, v) in enumerate(zip(MASS, PLACE, SPEED, strict=True))
    )
    made.add_joint("distance", a, b)
    return made


def numbers():
    """By hand, the engine's first problem, and its run."""
    impulse, after = by_hand()
    sim = lv.Simulation(scene())
    problem = sim.constraint_problem()
    track, apart, momentum = [], [], []
    for _ in range(STEPS):
        observation, *_ = sim.step()
        track.append(observation["positions"])
        apart.append(np.linalg.norm(observation["positions"][1] - observation["positions"][0]))
        momentum.append(MASS @ observation["velocities"][:, :3])
    return {
        "impulse": impulse,
        "after": after,
        "problem": problem,
        "engine": lv.solve(problem, "sequential_impulses", tol=0, max_iter=4).impulse[0],
        "track": np.array(track),  # (STEPS, 2, 3) m
        "apart": np.array(apart),  # (STEPS,) m
        "momentum": np.array(momentum),  # (STEPS, 3) kg m/s
    }


def draw_tracks(axes, found):
    """Where the particles go."""
    for i in range(2):
        axes.plot(found["track"][:, i, 0], found["track"][:, i, 1], label=f"{MASS[i]:g} kg")
    axes.set(title="tracks", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


def draw_distance(axes, found):
    """The distance over time."""
    axes.plot(1e6 * (found["apart"] - 1.0))
    axes.set(title="distance minus 1 m", xlabel="step", ylabel="[µm]")


PANELS = {"tracks": draw_tracks, "distance": draw_distance}


def main(path="two_particles.png"):
    """Print impulse, velocities and drift, save the figure."""
    found = numbers()
    print(f"A = {found['problem'].dense()[0, 0]:.4f} 1/kg, b = {found['problem'].b[0]:g} m/s")
    print(f"impulse by hand {found['impulse']:.6f} N s, in the engine {found['engine']:.6f} N s")
    for i in range(2):
        print(f"particle {i + 1}: velocity {SPEED[i]} -> {np.round(found['after'][i], 6)} m/s")
    print(f"distance stays within {1e6 * np.abs(found['apart'] - 1.0).max():.1f} µm over {STEPS} steps")
    print(f"momentum changes by {np.abs(found['momentum'] - MASS @ SPEED).max():.1e} kg m/s")
    save(PANELS, found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
