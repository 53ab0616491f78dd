"""Eight contacts of a stack as an LCP: what each sweep of projected Gauss-Seidel knows, and a wrong way.

Eight unit boxes stand on each other; contact i lies under box i. Box 5 has just been hit from below and
moves up, so contact 5 will open while the boxes above it are pushed. With v* the velocities before
the impulses and J the difference of neighbours,

    w = A l - b,   A = J J^T,   b = -J v*,       0 <= l  complementary to  w >= 0

The wrong way: solve A l = b, then clamp the negative impulses to zero, once. The clamped contacts no
longer pull, but their neighbours were computed as if they did.

    python examples/toy_stack.py [FIGURE.png]
"""

import sys

import numpy as np

import lavender as lv
from lavender.residuals import natural_map

N = 8
GRAVITY_STEP = 9.81 / 60.0  # m/s, gravity over one step
KICK = 1.0  # m/s, box 5 upwards
SWEEPS = 400


def problem():
    """The toy stack: A (8, 8) [1/kg], b (8,) [m/s]."""
    jacobian = np.eye(N) - np.eye(N, k=-1)  # velocity of a box minus that of the one below
    velocity = np.full(N, -GRAVITY_STEP)
    velocity[4] += KICK
    return lv.Problem.lcp(jacobian @ jacobian.T, -jacobian @ velocity, name="toy stack")


def numbers():
    """Impulse and slack of every contact after each sweep, r_p, and the wrong way beside them."""
    toy = problem()
    impulse = np.zeros((SWEEPS + 1, N))
    for sweep in range(SWEEPS):
        impulse[sweep + 1] = lv.solve(toy, "pgs", impulse=impulse[sweep], tol=0.0, max_iter=1).impulse
    clamped = np.maximum(np.linalg.solve(toy.dense(), toy.b), 0.0)
    return {
        "problem": toy,
        "impulse": impulse,  # (SWEEPS + 1, N) N s
        "slack": np.array([toy.slack(x) for x in impulse]),  # (SWEEPS + 1, N) m/s
        "r_p": np.array([natural_map(toy, x) for x in impulse]),
        "exact": lv.solve(toy, "direct", tol=1e-12).impulse,
        "clamped": clamped,
        "clamped_slack": toy.slack(clamped),
        "clamped_r_p": natural_map(toy, clamped),
    }


def figure(found, path):
    """Impulse, slack and r_p against sweeps."""
    from matplotlib.figure import Figure

    canvas = Figure(figsize=(12, 4), layout="constrained")
    left, middle, right = canvas.subplots(1, 3)
    sweeps = np.arange(SWEEPS + 1)
    for i in range(N):
        left.plot(sweeps, found["impulse"][:, i], color=f"C{i}", label=f"contact {i + 1}")
        left.plot(SWEEPS, found["clamped"][i], "x", color=f"C{i}")
        middle.plot(sweeps, found["slack"][:, i], color=f"C{i}")
    left.set(
        title="impulse (x: solved, then clamped)", ylabel="impulse [N s]", xlabel="sweeps", xscale="symlog"
    )
    left.legend(fontsize=7)
    middle.set(title="slack", ylabel="slack [m/s]", xlabel="sweeps", xscale="symlog")
    right.semilogy(sweeps, np.maximum(found["r_p"], 1e-17), label="projected Gauss-Seidel")
    right.axhline(found["clamped_r_p"], color="k", linestyle="--", label="solved, then clamped once")
    right.set(title="$r_p$ = |l - max(0, l - w)|", xlabel="sweeps")
    right.legend(fontsize=8)
    canvas.savefig(path)


def main(path="toy_stack.png"):
    """Print the table, save the figure."""
    found = numbers()
    print(f"{'contact':<14}" + "".join(f"{i + 1:>9}" for i in range(N)))
    for name in ("exact", "clamped", "clamped_slack"):
        print(f"{name:<14}" + "".join(f"{x + 0.0:>9.4f}" for x in found[name]))
    for sweep in (0, 1, 4, 16, 64, SWEEPS):
        print(f"after {sweep:>3} sweeps  r_p {found['r_p'][sweep]:.2e}")
    print(
        f"solved, then clamped once  r_p {found['clamped_r_p']:.2e}: "
        f"boxes still approach at {-found['clamped_slack'].min():.3f} m/s"
    )
    figure(found, path)
    print(f"figure: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
