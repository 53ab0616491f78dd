"""Draw the diagrams of the pages: `python docs/drawings.py`.

Diagrams explain definitions and have no measured numbers. They are SVG files in docs/static/drawings.
"""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, FancyBboxPatch, Polygon, Rectangle

FOLDER = Path(__file__).resolve().parent / "static" / "drawings"
INK, BLUE, RED, GREY, GREEN = "#222222", "#2b6cb0", "#c05621", "#718096", "#2f855a"
ARROW = {"arrowstyle": "-|>", "shrinkA": 0, "shrinkB": 0, "lw": 1.6, "mutation_scale": 13}


def make_axes(width, height, *, limits=None, frame=False):
    """Return a figure and its axes, without ticks unless `frame`."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots()
    if not frame:
        axes.set_axis_off()
        axes.set_aspect("equal")
    if limits is not None:
        axes.set(xlim=limits[0], ylim=limits[1])
    return figure, axes


def draw_arrow(axes, start, end, label, color, offset=(0.08, 0.08)):
    """Draw an arrow with a label at its end."""
    axes.annotate("", end, start, arrowprops={**ARROW, "color": color})
    axes.text(end[0] + offset[0], end[1] + offset[1], label, color=color, fontsize=11)


def draw_contact():
    """Draw two bodies, the normal from body a to body b, a tangent, the arms and the gap."""
    figure, axes = make_axes(5.2, 3.4, limits=((-2.6, 3.2), (-1.9, 2.2)))
    axes.add_patch(Ellipse((-0.9, -0.75), 2.6, 1.7, angle=12, fc="#e2e8f0", ec=INK))
    axes.add_patch(Ellipse((1.05, 1.15), 2.2, 1.5, angle=-18, fc="#e2e8f0", ec=INK))
    a, b = np.array([-0.9, -0.75]), np.array([1.05, 1.15])
    on_a, on_b = np.array([-0.05, 0.02]), np.array([0.32, 0.48])
    for point, name, offset in ((a, "body a", (-0.62, -0.3)), (b, "body b", (0.12, 0.1))):
        axes.plot(*point, "o", color=INK, ms=4)
        axes.text(*(point + offset), name, fontsize=11)
    n = (on_b - on_a) / np.linalg.norm(on_b - on_a)
    draw_arrow(axes, a, on_a, "arm a", GREEN, (-0.95, -0.25))
    draw_arrow(axes, b, on_b, "arm b", GREEN, (0.45, 0.12))
    draw_arrow(axes, on_a, on_a + 1.25 * n, "normal n,\nfrom a to b", BLUE, (-1.95, -0.45))
    draw_arrow(axes, on_a, on_a + 1.1 * np.array([n[1], -n[0]]), "tangent t", RED, (0.05, -0.12))
    axes.plot(*zip(on_a, on_b, strict=True), ls=":", color=INK)
    axes.text(0.45, 0.02, "gap", fontsize=11)
    return figure


def draw_cones():
    """Draw the bound of friction seen from above: a disk, a box, and the edges of a pyramid."""
    figure, axes = make_axes(5.2, 2.5, limits=((-1.5, 6.9), (-1.75, 1.75)))
    angle = np.linspace(0, 2 * np.pi, 5)
    for x, title in ((0, "disk"), (2.7, "box"), (5.4, "pyramid")):
        axes.add_patch(Circle((x, 0), 1, fc="#ebf8ff", ec=BLUE))
        axes.annotate(
            "", (x + 1.35, 0), (x - 1.35, 0), arrowprops={**ARROW, "color": GREY, "lw": 0.8}
        )
        axes.annotate("", (x, 1.35), (x, -1.35), arrowprops={**ARROW, "color": GREY, "lw": 0.8})
        axes.text(x, -1.7, title, ha="center", fontsize=11)
    axes.add_patch(Rectangle((1.7, -1), 2, 2, fc="none", ec=RED, lw=1.6))
    axes.add_patch(Polygon(np.c_[5.4 + np.cos(angle), np.sin(angle)], fc="none", ec=RED, lw=1.6))
    axes.text(1.02, 0.08, "μ λₙ", fontsize=10, color=BLUE)
    axes.text(-1.45, 1.2, "tangent\nimpulses", fontsize=9, color=GREY)
    return figure


def draw_errors():
    """Draw the relative residual of the zero impulse, of an answer, `tol` and the floor on one axis."""
    figure, axes = make_axes(6.4, 1.7, limits=((1e-17, 30), (-1, 1.6)), frame=True)
    axes.set_xscale("log")
    axes.spines[["left", "right", "top"]].set_visible(False)
    axes.set_yticks([])
    axes.axvspan(1e-17, 2e-15, color="#e2e8f0")
    axes.axvspan(2e-15, 1e-6, color="#f0fff4")
    for x, text, color in (
        (1, "zero impulse", INK),
        (3e-4, "your answer", RED),
        (1e-6, "tol", GREEN),
        (2e-15, "round-off floor", GREY),
    ):
        axes.plot([x, x], [-1, 0.75], color=color, lw=2)
        axes.text(x, 0.9, text, color=color, ha="center", fontsize=10)
    axes.text(3e-11, -0.3, "CONVERGED", color=GREEN, ha="center", fontsize=10)
    axes.set_xlabel("relative residual")
    return figure


def draw_auto():
    """Draw the stages of `auto`."""
    figure, axes = make_axes(7.2, 1.9, limits=((-0.2, 15.2), (-1.5, 1.6)))
    boxes = (
        (0, 0, "problem", "#e2e8f0"),
        (3, 0.85, "sweeps\n(anderson)", "#ebf8ff"),
        (3, -0.85, "convex law,\nadmm", "#ebf8ff"),
        (6.6, 0, "factorisation\n(newton, direct)", "#fffaf0"),
        (10.0, 0, "both in turn", "#fffaf0"),
        (12.8, 0, "judge", "#f0fff4"),
    )
    for x, y, text, color in boxes:
        axes.add_patch(
            FancyBboxPatch((x, y - 0.42), 1.9, 0.84, boxstyle="round,pad=0.12", fc=color, ec=INK)
        )
        axes.text(x + 0.95, y, text, ha="center", va="center", fontsize=8)
    for start, end in (
        ((1.9, 0.15), (2.86, 0.8)),
        ((1.9, -0.15), (2.86, -0.8)),
        ((4.9, 0.8), (6.45, 0.15)),
        ((4.9, -0.8), (6.45, -0.15)),
        ((8.5, 0), (9.85, 0)),
        ((11.9, 0), (12.65, 0)),
    ):
        axes.annotate("", end, start, arrowprops={**ARROW, "color": INK, "lw": 1.1})
    axes.text(2.3, 1.42, "cheap to iterate", fontsize=8, ha="right", color=GREY)
    axes.text(2.3, -1.45, "large, with friction", fontsize=8, ha="right", color=GREY)
    return figure


def draw_kink():
    """Draw the friction impulse against a tangential velocity: the kink at which sticking becomes sliding."""
    figure, axes = make_axes(4.6, 2.6, limits=((-2.2, 2.6), (-1.45, 1.6)), frame=True)
    push = np.linspace(-2.2, 2.6, 200)
    axes.plot(push, -np.clip(push, -1, 1), color=BLUE, lw=2.2)
    axes.axhline(0, color=GREY, lw=0.6)
    axes.plot([1], [-1], "o", color=RED)
    axes.plot([0.55, 0.55], [-1.3, -0.55], ls=":", color=INK)
    axes.annotate(
        "",
        (1, -1.3),
        (0.55, -1.3),
        arrowprops={**ARROW, "arrowstyle": "<|-|>", "color": RED, "lw": 1.1},
    )
    axes.text(1.08, -1.36, "distance", color=RED, fontsize=10)
    axes.text(-0.4, 0.75, "sticks: slope −1/A", fontsize=10)
    axes.text(1.25, -0.82, "slides: slope 0", fontsize=10)
    axes.set(xlabel="tangential velocity without friction", ylabel="friction impulse / (μ λₙ)")
    axes.spines[["right", "top"]].set_visible(False)
    axes.set_xticks([])
    return figure


#: File name -> the function that draws it.
DRAWINGS = {
    "contact": draw_contact,
    "cones": draw_cones,
    "errors": draw_errors,
    "auto": draw_auto,
    "kink": draw_kink,
}


def main():
    """Write every drawing with the same bytes on every run."""
    mpl.rcParams.update(
        {"svg.hashsalt": "lavender", "svg.fonttype": "path", "font.family": "DejaVu Sans"}
    )
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, draw in DRAWINGS.items():
        draw().savefig(FOLDER / f"{name}.svg", metadata={"Date": None}, facecolor="white")


if __name__ == "__main__":
    main()
