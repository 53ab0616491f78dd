"""Inverse kinematics of an arm by a quadratic program in each step: backends alone, and through lavender.

A planar arm of six joints follows an ellipse with its tip, as the controllers of pink and mink do: in each step the
joint displacement dq minimises |J dq - e|^2 + POSTURE^2 |q + dq - q_rest|^2 within the limits of joint angles and
speeds. P = J'J + POSTURE^2 I has eigenvalues down to 1e-6, so that the default tolerance of a backend leaves an error
in the directions that do not move the tip, and this error grows from step to step. Reference: quadprog, an active-set
method, or `newton` if it is not installed.

    python examples/inverse_kinematics.py [FIGURE.png]
"""

import sys

import numpy as np
import panels
import qpsolvers
import scipy.sparse as sp

import lavender as lv

N_JOINTS, N_STEPS, DT = 6, 400, 0.01  # -, -, s
LENGTH = 0.3  # m of each link
POSTURE = 1e-3  # m/rad, weight of the posture
MAX_SPEED, MAX_ANGLE = 1.5, 0.8  # rad/s, rad
REST = np.full(N_JOINTS, 0.4)  # rad
BACKENDS = tuple(
    name for name in ("osqp", "proxqp", "clarabel", "piqp") if name in qpsolvers.available_solvers
)


def get_tip(angles):
    """Return the position of the tip [m] and its Jacobian [m/rad]."""
    directions = np.cumsum(angles)
    links = LENGTH * np.array([np.cos(directions), np.sin(directions)])
    ends = np.cumsum(links[:, ::-1], axis=1)[:, ::-1]  # from each joint to the tip
    return links.sum(axis=1), np.array([-ends[1], ends[0]])


def get_target(step):
    """Return the position on the ellipse [m]."""
    phase = 2.0 * np.pi * step / N_STEPS
    start, _ = get_tip(REST)
    return start + np.array([0.3 * (np.cos(phase) - 1.0), 0.25 * np.sin(phase)])


def make_program(angles, step):
    """Return P, q and the bounds of the displacement of a step."""
    tip, jac = get_tip(angles)
    P = jac.T @ jac + POSTURE**2 * np.eye(N_JOINTS)
    q = -jac.T @ (get_target(step) - tip) - POSTURE**2 * (REST - angles)
    lower = np.maximum(-MAX_SPEED * DT, -MAX_ANGLE - angles)
    upper = np.minimum(MAX_SPEED * DT, MAX_ANGLE - angles)
    return {"P": P, "q": q, "lb": np.minimum(lower, 0.0), "ub": np.maximum(upper, 0.0)}


def solve_alone(P, solver, **arrays):
    """Return x of a backend with its default settings."""
    matrix = P if solver == "quadprog" else sp.csc_matrix(P)
    return qpsolvers.solve_qp(matrix, solver=solver, **arrays)


def follow(solve, name):
    """Return the angles of all steps (N_STEPS, N_JOINTS) [rad] with `solve_alone` or `solve_qp` of lavender.qp."""
    angles = REST.copy()
    path = []
    for step in range(1, N_STEPS + 1):
        angles = angles + solve(**make_program(angles, step), solver=name)
        path.append(angles)
    return np.array(path)


def numbers():
    """Return the distance of the angles from quadprog's [rad] in each step, by backend, alone and through lavender."""
    if "quadprog" in qpsolvers.available_solvers:
        reference = follow(solve_alone, "quadprog")
    else:
        reference = follow(lv.qp.solve_qp, "newton")
    return {
        name: {
            where: np.abs(follow(solve, name) - reference).max(axis=1)
            for where, solve in (("alone", solve_alone), ("lavender", lv.qp.solve_qp))
        }
        for name in BACKENDS
    }


def main(path="inverse_kinematics.png"):
    """Print the largest distance by backend, and draw the distance against time."""
    from matplotlib.figure import Figure

    found = numbers()
    canvas = Figure(figsize=(7.2, 3.2), layout="constrained")
    axes = canvas.subplots()
    time = DT * np.arange(1, N_STEPS + 1)
    for i, (name, distances) in enumerate(found.items()):
        alone, through = (distances[where].max() for where in ("alone", "lavender"))
        print(f"{name:9} alone {alone:.1e} rad, through lavender {through:.1e} rad")
        axes.semilogy(time, np.maximum(distances["alone"], 1e-16), f"C{i}", label=f"{name} alone")
        axes.semilogy(time, np.maximum(distances["lavender"], 1e-16), f"C{i}--")
    axes.plot([], [], "k--", label="through lavender")
    axes.set(xlabel="time [s]", ylabel="distance from quadprog's path [rad]")
    panels.put_legend_right(axes)
    canvas.savefig(path, dpi=150)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
