"""How the examples of the chapter draw; what they draw is in each of them."""

from pathlib import Path


def save(panels, found, path):
    """Every panel below the other, or alone the one that the file is named after."""
    from matplotlib.figure import Figure

    name = Path(str(path)).stem
    shown = [panels[name]] if name in panels else list(panels.values())
    canvas = Figure(figsize=(8, 3.2 * len(shown)), layout="constrained")
    for axes, draw in zip(canvas.subplots(len(shown), squeeze=False).flat, shown, strict=True):
        draw(axes, found)
    canvas.savefig(path)


def beside(axes):
    """The legend beside the axes, where it covers nothing."""
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False)
