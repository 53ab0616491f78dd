"""Sensitivity of a robot's motion to every contact, from one solve with the adjoint of a step.

A biped in the plane: a torso (x, z, pitch), and on each side a thigh and a shank with a foot. The left heel lands and
slides while the right toe still holds. The scalar is the torso's forward speed after the step. One `vjp(velocity=)`
gives its derivative by the target of every row, every coefficient of friction and all other data; it is verified by
solves with one number changed.

    python examples/which_contact.py [FIGURE.png]
"""

import sys
from dataclasses import replace

import numpy as np
import panels  # noqa: F401 - prints --help

import lavender as lv

MASSES = {"torso": 8.0, "thigh": 2.0, "shank": 1.0}  # kg
LENGTH, FOOT, DT = 0.4, 0.1, 0.01  # m, m, s
Q = np.array(
    [0.0, 0.78, 0.1, 0.25, -0.55, -0.35, -0.05]
)  # x, z, pitch; hip and knee left, then right
SPEED = np.array([1.2, -0.9, 0.2, -0.5, -0.3, 1.5, 0.3])  # m/s, rad/s
COMPLIANCE = 1e-3  # 1/kg
MU = 0.2


def points(q):
    """Return the centres of the five bodies, and heel and toe of both feet, (9, 2) [m]."""
    x, z, pitch = q[:3]
    hip = np.array([x, z])
    bodies = [hip + 0.2 * np.array([np.sin(pitch), np.cos(pitch)])]
    feet = []
    for i in (3, 5):
        a = pitch + q[i]
        b = pitch + q[i] + q[i + 1]
        thigh, shank = (np.array([np.sin(angle), -np.cos(angle)]) for angle in (a, b))
        knee = hip + LENGTH * thigh
        ankle = knee + LENGTH * shank
        bodies += [hip + 0.5 * LENGTH * thigh, knee + 0.5 * LENGTH * shank]
        half = (
            0.5 * FOOT * np.array([np.cos(b + 0.2), np.sin(b + 0.2)])
        )  # a foot is fixed to its shank
        feet += [ankle - half, ankle + half]
    return np.array(bodies + feet)


def turned(q):
    """Return the angles of the five bodies [rad]."""
    return np.array([q[2], q[2] + q[3], q[2] + q[3] + q[4], q[2] + q[5], q[2] + q[5] + q[6]])


def slopes(function, q, h=1e-6):
    """Return central differences of a function of q."""
    return np.stack(
        [(function(q + h * e) - function(q - h * e)) / (2.0 * h) for e in np.eye(len(q))], axis=-1
    )


def robot():
    """Return the step's problem; rows: two knee limits, then normal and tangent of heels and toes."""
    jac, spin = slopes(points, Q), slopes(turned, Q)
    each = [MASSES["torso"], *[MASSES["thigh"], MASSES["shank"]] * 2]
    inertia = [0.1 * m * LENGTH**2 for m in each]
    mass = sum(m * j.T @ j for m, j in zip(each, jac[:5], strict=True))
    mass = (
        mass
        + sum(i * np.outer(s, s) for i, s in zip(inertia, spin, strict=True))
        + 0.01 * np.eye(7)
    )
    force = -9.81 * sum(m * j[1] for m, j in zip(each, jac[:5], strict=True))
    free = SPEED + DT * np.linalg.solve(mass, force)
    knees = np.zeros((2, 7))
    knees[0, 4] = knees[1, 6] = -1.0
    rows = [knees, *(j[[1, 0]] for j in jac[5:])]
    height = points(Q)[5:, 1] - points(Q)[5:, 1].min()
    target = np.concatenate([Q[[4, 6]] / DT, np.stack([-height / DT, np.zeros(4)], axis=1).ravel()])
    cones = lv.Cones.bounded(np.zeros(2), np.full(2, np.inf)) + lv.Cones.contacts(np.full(4, MU), 1)
    names = ["knee left", "knee right", "heel left", "toe left", "heel right", "toe right"]
    return lv.Problem.from_jacobian(
        np.concatenate(rows),
        mass,
        free,
        target=target,
        cones=cones,
        names=names,
        compliance=np.full(10, COMPLIANCE),
    )


def numbers():
    """Return the derivatives of the torso's speed by targets and mu, and two of them by differences."""
    problem = robot()
    solution = lv.solve(problem, tol=1e-12)
    d = lv.derivative(problem, solution)
    weigh = np.eye(7)[0]
    g = d.vjp(velocity=weigh)

    def speed(other):
        return other.velocity(lv.solve(other, tol=1e-13).impulse)[0]

    row = int(np.argmax(np.abs(g.target)))
    block = 2 + int(np.argmax(np.abs(g.mu[2:])))
    h = 1e-5
    moved = [
        replace(problem, b=problem.b + s * h * np.eye(problem.m)[row], guess=None) for s in (1, -1)
    ]
    rubbed = [
        replace(
            problem,
            cones=replace(problem.cones, mu=problem.cones.mu + s * h * np.eye(6)[block]),
            guess=None,
        )
        for s in (1, -1)
    ]
    differences = [(speed(a) - speed(b)) / (2.0 * h) for a, b in (moved, rubbed)]
    return {
        "problem": problem,
        "d": d,
        "target": g.target,
        "mu": g.mu,
        "differences": differences,
        "at": (row, block),
    }


def figure(found, path):
    """Draw a bar for every row and every coefficient."""
    from matplotlib.figure import Figure

    p = found["problem"]
    canvas = Figure(figsize=(7.2, 3.6), layout="constrained")
    left, right = canvas.subplots(1, 2)
    left.barh([p.row_name(i) for i in range(p.m)], found["target"])
    left.set(xlabel="d speed / d target [-]")
    right.barh(
        [f"{p.names[i]}: {found['d'].states[i].name}" for i in range(2, 6)], 1e3 * found["mu"][2:]
    )
    right.set(xlabel="d speed / d mu [mm/s]")
    for axes in (left, right):
        axes.invert_yaxis()
        axes.axvline(0.0, color="gray", linewidth=0.8)
    canvas.savefig(path, dpi=150)


def main(path="which_contact.png"):
    """Print every row and save the figure."""
    found = numbers()
    p, d = found["problem"], found["d"]
    print(f"{'row':<22}{'state':>12}{'by its target':>16}{'by mu [m/s]':>14}")
    for i in range(p.m):
        block = p.block_of(i)
        state = d.states[block].rows[i - int(p.cones.ptr[block])]
        by_mu = f"{found['mu'][block]:>14.5f}" if p.row_name(i).endswith("tangent 1") else ""
        print(f"{p.row_name(i):<22}{state:>12}{found['target'][i]:>16.5f}{by_mu}")
    row, block = found["at"]
    off = [
        abs(found["target"][row] - found["differences"][0]),
        abs(found["mu"][block] - found["differences"][1]),
    ]
    print(f"most by {p.row_name(row)}; differences of two solves agree within {max(off):.1e}")
    print(f"exists: {d.exists}; nearest switch {d.distance.min():.2g} N s away")
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
