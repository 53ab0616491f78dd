"""The gallery of named scenes, each with its parameters, its sizes and its purpose.

Lengths are in m, masses in kg, angles in rad. Bodies are numbered from the ground up, so that the order of the
contacts is bottom-up. Each builder registers itself; importing this module fills the table.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from lavender.base.arrays import check_float, check_int
from lavender.base.errors import check_name
from lavender.sim.scene.arithmetic import (
    compute_norm,
    compute_sine_and_cosine,
    convert_frame_to_quaternion,
    rotate_vector,
)
from lavender.sim.scene.parts import convert_to_rotation_matrix, make_quaternion
from lavender.sim.scene.scene import SCENES, Scene, named_scene

__all__ = ["SCENES"]


@named_scene()
def stack(scene: Scene, n: int = 6, size: float = 1.0, mass: float = 1.0) -> None:
    """Stack `n` equal boxes, for which the slowest mode of Gauss-Seidel is known in closed form.

    Six boxes have 24 contacts with 72 rows, or 24 rows without friction. With the plane there are 7 bodies.
    """
    check_int("n", n, 1)
    size = check_float("size", size, above=0.0)
    scene.add_plane()
    for i in range(n):
        scene.add_box((size, size, size), mass, position=(0.0, 0.0, (i + 0.5) * size))


@named_scene()
def pyramid(
    scene: Scene, base: int = 10, size: float = 1.0, mass: float = 1.0, gap: float = 0.05
) -> None:
    """Build a pyramid of rows of boxes, each one box shorter than the row below.

    The contacts are coupled in two directions, and their rows are redundant. A base of 10 boxes gives 55 boxes and 400
    contacts, a base of 20 gives 210 boxes and 1,600 contacts. `gap` is the distance between neighbours as a fraction of
    their size.
    """
    check_int("base", base, 1)
    size = check_float("size", size, above=0.0)
    pitch = size * (1.0 + check_float("gap", gap, low=0.0))
    scene.add_plane()
    for row in range(base):
        for i in range(base - row):
            x = (i - 0.5 * (base - row - 1)) * pitch
            scene.add_box((size, size, size), mass, position=(x, 0.0, (row + 0.5) * size))


@named_scene(friction=0.6)
def card_house(scene: Scene, levels: int = 2, lean: float = 0.3) -> None:
    """Build a card house: thin boxes lean against each other, edge on edge, and are held only by friction.

    Two levels have 7 cards: 3 pairs of leaning cards, and 1 card across two pairs. Three levels have 15 cards. `lean`
    is the angle of a leaning card from the vertical.
    """
    check_int("levels", levels, 1)
    lean = check_float("lean", lean, low=0.05, high=0.7)
    thick, width, tall, mass = 0.04, 0.7, 1.0, 0.2
    s, c = compute_sine_and_cosine(lean)
    half_width = tall * s + thick * c  # [m] Half the width of the base of a pair of leaning cards.
    pitch = 2.0 * half_width + thick
    height = tall * c + thick * s
    scene.add_plane()
    z = 0.0
    for level in range(levels):
        pairs = levels - level
        apex = [(i - 0.5 * (pairs - 1)) * pitch for i in range(pairs)]
        for x in apex:
            for side in (1.0, -1.0):
                place = (x - side * 0.5 * half_width, 0.0, z + 0.5 * height)
                turn = make_quaternion((0.0, 1.0, 0.0), side * lean)
                scene.add_box((thick, width, tall), mass, position=place, quaternion=turn)
        for left, right in pairwise(apex):
            place = (0.5 * (left + right), 0.0, z + height + 0.5 * thick)
            scene.add_box((pitch - 1e-3, width, thick), mass, position=place)
        z += height + thick


@named_scene()
def pile(
    scene: Scene, n: int = 100, kind: str = "spheres", size: float = 0.5, walls: bool = True
) -> None:
    """Drop `n` bodies into a bin, which gives many irregular, moving contacts.

    `kind` is "spheres", "boxes" or "mixed". 1,000 spheres have about 2,500 contacts after they have settled. `seed`
    perturbs the initial positions.
    """
    check_int("n", n, 1)
    size = check_float("size", size, above=0.0)
    check_name("kind of pile", kind, ("spheres", "boxes", "mixed"))
    # Bodies per edge; the bin's height is 5/4 its width.
    side = next(k for k in range(1, n + 1) if 5 * k**3 >= 4 * n)
    pitch = 1.15 * size if kind == "spheres" else 1.5 * size
    half = 0.5 * side * pitch
    rng = np.random.default_rng(scene.parameters.seed)
    scene.add_plane()
    if walls:
        for normal in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)):
            scene.add_plane(normal, -half)
    for i in range(n):
        cell = np.array([i % side, (i // side) % side, i // side**2], float)
        position = (cell + 0.5) * pitch + rng.uniform(-0.05, 0.05, 3) * size
        position[:2] -= half
        if kind == "spheres" or (kind == "mixed" and i % 2):
            scene.add_sphere(0.5 * size, position=position)
        else:
            turn = rng.normal(size=4)
            edges = size * rng.uniform(0.6, 0.9, 3)
            scene.add_box(edges, position=position, quaternion=turn)


@named_scene()
def chain(
    scene: Scene, n: int = 20, tip_mass: float = 1.0, length: float = 0.25, angle: float = 1.2
) -> None:
    """Build a chain of `n` links on ball joints, with a last link of mass `tip_mass`.

    The scene has 3 n joint rows and no contacts. Against the order, one sweep propagates an impulse by one link.
    `angle` is the initial angle of the straight chain from the vertical.
    """
    check_int("n", n, 1)
    length = check_float("length", length, above=0.0)
    s, c = compute_sine_and_cosine(angle)
    down = np.array([s, 0.0, -c])
    turn = make_quaternion((0.0, 1.0, 0.0), np.pi - angle)
    before = -1
    for i in range(n):
        thick = 0.2 * length if i < n - 1 else 0.4 * length
        size = (thick, thick, 0.9 * length)
        mass = tip_mass if i == n - 1 else 1.0
        place = (i + 0.5) * length * down
        link = scene.add_box(size, mass, position=place, quaternion=turn, name=f"link {i}")
        scene.add_joint("ball", before, link, anchor=i * length * down)
        before = link


@named_scene()
def bridge(scene: Scene, n: int = 16, load: float = 10.0) -> None:
    """Build a bridge of `n` planks on hinges between two banks, with a box of mass `load` on it.

    The scene has 5 (n + 1) joint rows and the contacts of the box.
    """
    check_int("n", n, 2)
    planks = []
    for i in range(n):
        place = ((i + 0.5 - 0.5 * n) * 0.5, 0.0, 3.0)
        planks.append(scene.add_box((0.46, 1.0, 0.1), 1.0, position=place, name=f"plank {i}"))
    for i, (a, b) in enumerate(zip([-1, *planks], [*planks, -1], strict=True)):
        scene.add_joint("hinge", a, b, anchor=((i - 0.5 * n) * 0.5, 0.0, 3.0), axis=(0.0, 1.0, 0.0))
    if load > 0.0:
        scene.add_box((0.6, 0.6, 0.6), load, position=(0.0, 0.0, 3.36), name="load")


@named_scene()
def heavy_on_light(scene: Scene, ratio: float = 100.0, n: int = 2) -> None:
    """Stack `n` boxes, the top box with the mass `ratio` and the others with mass 1.

    With R = `ratio`, two boxes and one contact per face, each sweep multiplies the error by R/(1 + R). The scene has
    four contacts per face, so two boxes have 8 contacts.
    """
    check_int("n", n, 2)
    ratio = check_float("ratio", ratio, above=0.0)
    scene.add_plane()
    for i in range(n):
        scene.add_box(mass=ratio if i == n - 1 else 1.0, position=(0.0, 0.0, i + 0.5))


@named_scene()
def table(scene: Scene, legs: int = 9, top_mass: float = 10.0) -> None:
    """Build a table with redundant legs: the distribution of the load is not unique, but the motion is.

    The scene with 9 legs has 10 bodies and 72 contacts. The legs form a square grid, row by row.
    """
    check_int("legs", legs, 3)
    side = int(np.ceil(np.sqrt(legs)))
    pitch = 0.8
    scene.add_plane()
    for i in range(legs):
        x = (i % side - 0.5 * (side - 1)) * pitch
        y = (i // side - 0.5 * (side - 1)) * pitch
        scene.add_box((0.2, 0.2, 1.0), 1.0, position=(x, y, 0.5), name=f"leg {i}")
    edge = side * pitch
    scene.add_box((edge, edge, 0.2), top_mass, position=(0.0, 0.0, 1.1), name="top")


@named_scene()
def ramp(scene: Scene, angle: float = 0.35, size: float = 1.0) -> None:
    """Place a box on a slope of the angle `angle`.

    The box sticks if tan(angle) is smaller than the friction coefficient mu. Otherwise it slides with the acceleration
    g (sin(angle) - mu cos(angle)). The scene has 2 bodies and 4 contacts.
    """
    angle = check_float("angle", angle, low=-1.5, high=1.5)
    size = check_float("size", size, above=0.0)
    turn = make_quaternion((0.0, 1.0, 0.0), angle)
    normal = convert_to_rotation_matrix(turn)[:, 2]
    scene.add_plane(normal, 0.0)
    scene.add_box((size, size, size), position=0.5 * size * normal, quaternion=turn)


@named_scene(patch_radius=0.1)
def spinner(scene: Scene, spin: float = 20.0, radius: float = 0.5) -> None:
    """Spin a ball on a plane with torsional friction.

    The moment of the friction is mu r N, with the friction coefficient mu, the patch radius r and the normal force N.
    The scene has 2 bodies and 1 contact of 4 rows.
    """
    scene.add_plane()
    turning = (0.0, 0.0, check_float("spin", spin))
    scene.add_sphere(radius, position=(0.0, 0.0, radius), angular_velocity=turning)


@named_scene(restitution=1.0, friction=0.0, restitution_threshold=0.01, dt=1.0 / 240.0, substeps=4)
def newtons_cradle(
    scene: Scene, n: int = 5, lifted: int = 1, angle: float = 0.6, gap: float = 0.01
) -> None:
    """Build Newton's cradle of `n` balls on strings, of which `lifted` are released from the angle `angle`.

    The impacts follow one another, and the energy must not increase. The strings have 2 n rows. `gap` separates the
    balls, so that impacts do not coincide.
    """
    check_int("n", n, 2)
    check_int("lifted", lifted, 0, n)
    radius, string, half_spread = 0.25, 2.0, 0.5
    drop = np.sqrt(string * string - half_spread * half_spread)
    for i in range(n):
        pivot = np.array([(i - 0.5 * (n - 1)) * (2.0 * radius + gap), 0.0, 3.0])
        s, c = compute_sine_and_cosine(-angle if i < lifted else 0.0)
        ball = scene.add_sphere(
            radius, position=pivot + drop * np.array([s, 0.0, -c]), name=f"ball {i}"
        )
        for side in (-1.0, 1.0):
            scene.add_joint(
                "distance", -1, ball, anchor_a=pivot + np.array([0.0, side * half_spread, 0.0])
            )


@named_scene()
def four_bar(
    scene: Scene, motor: float | None = None, torque: float = 200.0, tilt: float = 0.4
) -> None:
    """Build a closed loop of three bars and the ground on four oblique hinges, with redundant rows.

    The 3 bodies have 18 degrees of freedom and 20 joint rows (21 with a motor), but one degree of freedom remains.
    `motor` is the speed of the crank [rad/s], `torque` the largest torque of the motor [N m].
    """
    r = convert_to_rotation_matrix(make_quaternion((0.3, 0.2, 1.0), tilt))
    flat = np.array([[0.0, 0.0, 0.0], [0.6, 0.0, 0.8], [2.4, 0.0, 1.6], [2.2, 0.0, 0.0]])
    corner = [rotate_vector(r, p) for p in flat]
    axis = r[:, 1].copy()
    bars = []
    for i in range(3):
        d = corner[i + 1] - corner[i]
        long = compute_norm(d)
        x = d / long
        q = convert_frame_to_quaternion(np.column_stack([x, axis, np.cross(x, axis)]))  # pyright: ignore[reportArgumentType]
        # The bars are offset along the axis, so that they do not overlap.
        position = 0.5 * (corner[i] + corner[i + 1]) + 0.15 * (i - 1) * axis
        name = ("crank", "coupler", "rocker")[i]
        bars.append(
            scene.add_box((long, 0.1, 0.1), long, position=position, quaternion=q, name=name)
        )
    for i, (a, b) in enumerate(zip([-1, *bars], [*bars, -1], strict=True)):
        drive: dict[str, Any] = (
            {} if motor is None or i else {"motor_speed": motor, "motor_torque": torque}
        )
        scene.add_joint("hinge", a, b, anchor=corner[i], axis=axis, **drive)
