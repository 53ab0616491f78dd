"""Identify friction and mass from a recorded slide by gradients through the solve of every step.

A puck on a table is pushed by a known force, slides, and stops. Its speed is recorded with noise. Each step solves

    M v+ = M v + dt (push + gravity) + J^T lambda,      |lambda_t| <= mu lambda_n

and the adjoint runs backwards through the steps: `vjp(velocity=)` of a step returns the cotangent of the speed before
it, and the derivatives by mass and mu. Gradient descent in the logarithms of both uses the step lengths of Barzilai and
Borwein (1988).

    python examples/recorded_slide.py [FIGURE.png]
"""

import sys

import numpy as np
import panels  # noqa: F401 - prints --help

import lavender as lv

DT, STEPS, GRAVITY = 0.02, 60, 9.81  # s, -, m/s2
TRUE = {"mass": 0.7, "mu": 0.35}  # kg, -
NOISE = 0.01  # m/s
START = {"mass": 1.5, "mu": 0.15}
ITERATIONS = 40


def push(k):
    """Return the force along x in step k [N], which acts during the first half second."""
    return 4.0 * np.sin(np.pi * k / 25.0) if k < 25 else 0.0


def step(v, k, mass, mu):
    """Return (problem, solution) of one step from velocity v (3,)."""
    free = v + DT * np.array([push(k) / mass, 0.0, -GRAVITY])
    jac = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # normal, two tangents
    problem = lv.Problem.from_jacobian(jac, mass * np.eye(3), free, cones=lv.Cones.contacts(mu))
    return problem, lv.solve(problem, tol=1e-12)


def slide(mass, mu):
    """Return the speeds along x (STEPS + 1,), and problem and solution of each step."""
    v = np.zeros(3)
    speeds = [0.0]
    taken = []
    for k in range(STEPS):
        problem, solution = step(v, k, mass, mu)
        v = problem.velocity(solution.impulse)
        speeds.append(v[0])
        taken.append((problem, solution))
    return np.array(speeds), taken


def loss(recorded, mass, mu):
    """Return half the mean square error of the speeds [m2/s2], its gradient by (mass, mu), and the contact's states."""
    speeds, taken = slide(mass, mu)
    error = (speeds - recorded) / STEPS
    back = np.zeros(3)
    by_mass = 0.0
    by_mu = 0.0
    states = []
    for k in reversed(range(STEPS)):
        problem, solution = taken[k]
        back = back + np.array([error[k + 1], 0.0, 0.0])
        d = lv.derivative(problem, solution)
        g = d.vjp(velocity=back)
        by_mu += g.mu[0]
        by_mass += g.M.diagonal().sum() - g.v_free[0] * DT * push(k) / mass**2
        back = g.v_free
        states.append(solution.state(0).name)
    return 0.5 * float(np.sum(error**2)) * STEPS, np.array([by_mass, by_mu]), states[::-1]


def numbers():
    """Return (mass, mu, loss) of each iteration of the descent, and the recording."""
    exact, _ = slide(**TRUE)
    recorded = exact + NOISE * np.random.default_rng(0).standard_normal(len(exact))
    x = np.log([START["mass"], START["mu"]])
    before = None
    way = []
    for _ in range(ITERATIONS):
        mass, mu = np.exp(x)
        value, gradient, states = loss(recorded, mass, mu)
        gradient = gradient * np.exp(x)
        way.append((mass, mu, value))
        length = 0.1 / max(np.abs(gradient).max(), 1e-12)
        if before is not None:
            dx, dg = x - before[0], gradient - before[1]
            length = min(abs(dx @ dg) / max(dg @ dg, 1e-30), 5.0 * length)
        before = x.copy(), gradient
        x = x - length * gradient
    return {"recorded": recorded, "way": np.array(way), "states": states}


def figure(found, path):
    """Draw the slide, and mass and mu over the iterations."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(7.2, 3.2), layout="constrained")
    left, right = canvas.subplots(1, 2)
    t = DT * np.arange(STEPS + 1)
    left.plot(t, found["recorded"], ".", markersize=3, label="recorded")
    left.plot(t, slide(**START)[0], "--", label="first guess")
    left.plot(t, slide(*found["way"][-1][:2])[0], label="found")
    left.set(xlabel="time [s]", ylabel="speed [m/s]")
    left.legend(frameon=False, fontsize=9)
    for i, (name, unit) in enumerate((("mass", "kg"), ("mu", "-"))):
        right.plot(found["way"][:, i], label=f"{name} [{unit}]")
        right.axhline(TRUE[name], color="gray", linewidth=0.8)
    right.set(xlabel="iteration")
    right.legend(frameon=False, fontsize=9)
    canvas.savefig(path, dpi=150)


def main(path="recorded_slide.png"):
    """Print the identified parameters and save the figure."""
    found = numbers()
    for iteration in (0, 5, 10, 20, ITERATIONS - 1):
        mass, mu, value = found["way"][iteration]
        print(f"iteration {iteration:>2}: mass {mass:.4f} kg, mu {mu:.4f}, loss {value:.2e} m2/s2")
    print(
        f"true:    mass {TRUE['mass']:.4f} kg, mu {TRUE['mu']:.4f}; the noise alone leaves {0.5 * NOISE**2:.1e}"
    )
    count = {name: found["states"].count(name) for name in sorted(set(found["states"]))}
    print(f"states of the {STEPS} steps: {count}")
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
