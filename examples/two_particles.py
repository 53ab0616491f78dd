"""Exercise 1: two particles joined by one distance row, derived by hand and computed by the engine.

Particle i has the position x_i [m], the mass m_i [kg] and, before the constraint acts, the velocity v_i* [m/s]. The
joint keeps the length l:

    C(x) = |x2 - x1| - l = 0
    dC/dt = n.(v2 - v1),  n = (x2 - x1)/|x2 - x1|          so J = [-n^T, n^T], one row of six entries
    v+ = v* + M^-1 J^T lambda                              an impulse lambda along n, equal and opposite
    0 = J v+ = J v* + A lambda,  A = J M^-1 J^T = n.n/m1 + n.n/m2 = 1/m1 + 1/m2
    lambda = b / A,  b = -J v* = -n.(v2* - v1*)

A is a number here, and -b is the speed at which the particles separate along the rod. Particle 1 (1 kg) is at rest.
Particle 2 (2 kg) moves at 2 m/s along the rod and at 1 m/s across it. The impulse makes the speeds along n equal. The
speeds across n and the total momentum do not change, since J^T lambda adds up to zero over both particles. In the
engine the pair then rotates about the common centre: with the speed v across, its joint also has half the centripetal
velocity of a step of h, h/2 v^2/l, which keeps the length to second order and adds 0.1 % to the impulse.

    python examples/two_particles.py [FIGURE.png]

A file named after a panel shows it alone: tracks.png, distance.png.
"""

import sys

import numpy as np
from panels import Numbers, put_legend_right, show

import lavender as lv

MASS = np.array([1.0, 2.0])  # kg
POSITION = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])  # m
VELOCITY = np.array([[0.0, 0.0, 0.0], [2.0, 1.0, 0.0]])  # m/s
STEPS = 1200


def solve_by_hand():
    """Return the impulse [N s] and the velocities after it (2, 3) [m/s]."""
    n = (POSITION[1] - POSITION[0]) / np.linalg.norm(POSITION[1] - POSITION[0])
    impulse = -n @ (VELOCITY[1] - VELOCITY[0]) / (1.0 / MASS[0] + 1.0 / MASS[1])
    return impulse, VELOCITY + np.outer([-1.0, 1.0] / MASS, impulse * n)


def build_scene():
    """Build the same two particles for the engine; bodies without a shape touch nothing."""
    scene = lv.Scene(gravity=0.0, dt=1.0 / 240.0, solver_iterations=4)
    a, b = (
        scene.add_body(m, position=x, velocity=v, name=f"particle {i + 1}")
        for i, (m, x, v) in enumerate(zip(MASS, POSITION, VELOCITY, strict=True))
    )
    scene.add_joint("distance", a, b)
    return scene


def run_engine():
    """Return positions (STEPS, 2, 3) [m] and momentum (STEPS, 3) [kg m/s] of the engine's run."""
    sim = lv.Simulation(build_scene())
    positions, momentum = [], []
    for _ in range(STEPS):
        observation, *_ = sim.step()
        positions.append(observation["positions"])
        momentum.append(MASS @ observation["velocities"][:, :3])
    return np.array(positions), np.array(momentum)


def numbers():
    """Return the solution by hand, the engine's first problem and its impulse, and the engine's run."""
    found = Numbers(
        hand=solve_by_hand,
        problem=lambda: lv.Simulation(build_scene()).constraint_problem(),
        engine=lambda: lv.solve(found["problem"], "sequential_impulses", tol=0, max_iter=4).impulse[
            0
        ],
        run=run_engine,
        # m, distance minus length of the rod
        drift=lambda: np.linalg.norm(found["run"][0][:, 1] - found["run"][0][:, 0], axis=1) - 1.0,
    )
    return found


def draw_tracks(axes, found):
    """Draw the paths of the particles."""
    for i in range(2):
        axes.plot(found["run"][0][:, i, 0], found["run"][0][:, i, 1], label=f"{MASS[i]:g} kg")
    axes.set(title="paths", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    put_legend_right(axes)


def draw_distance(axes, found):
    """Draw the error of the distance over the steps."""
    axes.plot(1e6 * found["drift"])
    axes.set(title="distance minus 1 m", xlabel="step", ylabel="[µm]")


PANELS = {"tracks": draw_tracks, "distance": draw_distance}


def print_numbers(found):
    """Print impulse, velocities and drift."""
    impulse, after = found["hand"]
    print(f"A = {found['problem'].dense()[0, 0]:.4f} 1/kg, b = {found['problem'].b[0]:g} m/s")
    print(f"impulse by hand {impulse:.6f} N s, in the engine {found['engine']:.6f} N s")
    for i in range(2):
        print(f"particle {i + 1}: velocity {VELOCITY[i]} -> {np.round(after[i], 6)} m/s")
    print(
        f"the distance changes by at most {1e6 * np.abs(found['drift']).max():.1f} µm in {STEPS} steps"
    )
    change = np.abs(found["run"][1] - MASS @ VELOCITY).max()
    print(f"the momentum changes by at most {change:.1e} kg m/s")


def main(path="two_particles.png"):
    """Print the numbers and draw the figure."""
    show(PANELS, numbers(), print_numbers, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
