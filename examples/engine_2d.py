"""A two-dimensional engine in NumPy and `lv.RowBuilder`: circles fall into a box in which a motor turns a bar.

The engine is the part between the two lines: each step applies gravity, finds contacts, builds and solves the rows with
a warm start, and moves the bodies. Body 0 is the bar, on a hinge with a motor; the others are circles.

    python examples/engine_2d.py [FIGURE.png]

A file named after a panel shows it alone: paths.png, speed.png. The figure needs Matplotlib and the folder
`examples/panels`. Without the folder, only the numbers are printed.
"""

import sys

import numpy as np

import lavender as lv

try:
    import panels
except ModuleNotFoundError:  # This file was copied without the folder.
    panels = None

# ------------------------------------------------------------------------------------------------------------------
DT = 1 / 60  # s
STEPS = 300
GRAVITY = np.array([0.0, -9.81, 0.0])  # m/s^2
RADIUS = 0.25  # m
HALF_LENGTH = 0.8  # m
PIVOT = np.array([0.0, 1.9])  # m
SPEED, MAX_TORQUE, FRICTION = 1.5, 30.0, 0.5  # rad/s, N m, -
WALLS = (((0.0, 1.0), 0.0), ((1.0, 0.0), -2.0), ((-1.0, 0.0), -2.0))  # inward normal, offset [m]
MAX_GAP = (
    0.05  # m: a contact is added at smaller distances, so that nothing is passed within a step
)


def find_contacts(position, angle):
    """Yield (a, b, point, normal, gap, feature) of each circle with walls, the bar and the circles before it."""
    along = np.array([np.cos(angle[0]), np.sin(angle[0])])
    for i in range(1, len(position)):
        for side, (wall, offset) in enumerate(WALLS):
            normal = np.array(wall)
            yield (
                -1,
                i,
                position[i] - RADIUS * normal,
                normal,
                position[i] @ normal - offset - RADIUS,
                side,
            )
        nearest = np.clip((position[i] - position[0]) @ along, -HALF_LENGTH, HALF_LENGTH)
        others = [
            (0, position[0] + nearest * along, 0.0),
            *((j, position[j], RADIUS) for j in range(1, i)),
        ]
        for j, centre, radius in others:
            distance = np.linalg.norm(position[i] - centre)
            normal = (position[i] - centre) / distance
            yield j, i, centre + radius * normal, normal, distance - radius - RADIUS, 0


def simulate():
    """Return positions (STEPS, n, 2) [m], speeds of the bar (STEPS,) [rad/s], and the last residual [-]."""
    position = np.array([PIVOT, *((x, y) for y in (2.6, 3.2, 3.8) for x in (-1.2, -0.4, 0.5, 1.3))])
    n = len(position)
    inv_mass = np.ones(n)  # 1/kg
    inv_inertia = np.array([3 / HALF_LENGTH**2, *[2 / RADIUS**2] * (n - 1)])  # 1/(kg m^2)
    angle = np.zeros(n)
    velocity = np.zeros((n, 3))
    solution = None
    frames = []
    speeds = []
    for _ in range(STEPS):
        builder = lv.RowBuilder(
            inv_mass, inv_inertia, velocity + DT * GRAVITY, DT, position, slop=0.002
        )
        builder.hinge(-1, 0, PIVOT, anchor_b=position[0])
        builder.motor(-1, 0, speed=SPEED, max_torque=MAX_TORQUE)
        for *contact, gap, feature in find_contacts(position, angle):
            if gap < MAX_GAP:
                builder.contact(*contact, gap=gap, mu=FRICTION, feature=feature)
        problem = builder.problem()
        solution = lv.solve(problem, impulse=solution)
        velocity = builder.velocity_after(problem, solution.impulse)
        position = position + DT * velocity[:, :2]
        angle = angle + DT * velocity[:, 2]
        frames.append(position)
        speeds.append(velocity[0, 2])
    return np.array(frames), np.array(speeds), solution.residual.relative


# ------------------------------------------------------------------------------------------------------------------


def numbers():
    """Return the run, the largest penetrations over its steps [m], and the drift of the hinge [m]."""
    run = simulate()
    depth = np.array([largest_depth(x) for x in run[0]])
    return {"run": run, "depth": depth, "drift": np.linalg.norm(run[0][:, 0] - PIVOT, axis=1).max()}


def largest_depth(position):
    """Return the largest penetration [m] of circles with walls and each other."""
    return -min(c[4] for c in find_contacts(position, np.zeros(1)) if c[0] != 0)


def draw_paths(axes, found):
    """Draw the paths of the circles and their places at the end."""
    frames = found["run"][0]
    for i in range(1, frames.shape[1]):
        (line,) = axes.plot(*frames[:, i].T, linewidth=0.8)
        turn = np.linspace(0.0, 2 * np.pi, 60)
        circle = frames[-1, i] + RADIUS * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        axes.plot(*circle.T, color=line.get_color())
    angle = DT * found["run"][1].sum()
    half = HALF_LENGTH * np.array([np.cos(angle), np.sin(angle)])
    axes.plot(*np.stack([PIVOT - half, PIVOT + half], axis=1), "k", linewidth=2, label="bar")
    axes.plot(*PIVOT, "ko", label="hinge")
    axes.set(
        title=f"paths of {STEPS} steps, and the end", xlabel="x [m]", ylabel="y [m]", aspect="equal"
    )
    panels.put_legend_right(axes)


def draw_speed(axes, found):
    """Draw the speed of the bar over time."""
    axes.plot(DT * np.arange(1, STEPS + 1), found["run"][1])
    axes.axhline(SPEED, color="k", linewidth=0.8, linestyle="--", label="wanted")
    axes.set(title="speed of the bar", xlabel="time [s]", ylabel="[rad/s]")
    panels.put_legend_right(axes)


PANELS = {"paths": draw_paths, "speed": draw_speed}


def print_numbers(found):
    """Print speeds, penetration and drift."""
    frames, speeds, residual = found["run"]
    print(
        f"{frames.shape[1]} bodies, {STEPS} steps of {1e3 * DT:.1f} ms, last relative residual {residual:.0e}"
    )
    print(
        f"bar: {SPEED:.2f} rad/s wanted, {speeds.min():.2f} when circles hit it, {speeds[-1]:.2f} at the end"
    )
    print(
        f"largest penetration {1e3 * found['depth'].max():.1f} mm, at the end {1e3 * found['depth'][-1]:.1f} mm"
    )
    print(f"largest distance of the bar from its hinge: {found['drift']:.0e} m")


def main(path="engine_2d.png"):
    """Print the numbers and draw the figure."""
    if panels is None:
        print_numbers(numbers())
        print("no figure: the folder examples/panels is missing")
    else:
        panels.show(PANELS, numbers(), print_numbers, path)


if __name__ == "__main__":
    main(*sys.argv[1:])
