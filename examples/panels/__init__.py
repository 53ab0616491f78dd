"""What the examples share: --help, numbers that are computed when they are read, and figures of several panels."""

import sys
from collections.abc import Mapping
from pathlib import Path

_script = sys.modules["__main__"]
_folder = Path(getattr(_script, "__file__", None) or "").resolve().parent
# Only scripts of the folder examples/ print their help: the documentation build imports this module, too.
if _folder == Path(__file__).resolve().parents[1] and {"-h", "--help"} & set(sys.argv[1:]):
    print(_script.__doc__.strip())
    raise SystemExit


class Numbers(Mapping):
    """Results by name. Each is computed when it is first read, so that a panel computes only what it draws."""

    def __init__(self, **functions):
        self._functions = functions
        self._values = {}

    def __getitem__(self, name):
        if name not in self._values:
            self._values[name] = self._functions[name]()
        return self._values[name]

    def __iter__(self):
        return iter(self._functions)

    def __len__(self):
        return len(self._functions)


def show(panels, numbers, print_numbers, path):
    """Draw the panel that the file is named after. For the script's own name print all numbers and draw all panels.

    Any other name ends the script with an error that lists the panels.
    """
    name = Path(str(path)).stem
    if name not in panels:
        own = Path(print_numbers.__code__.co_filename).stem
        if name != own:
            raise SystemExit(
                f"{path}: name the figure after a panel ({', '.join(panels)}), or {own} for all panels"
            )
        print_numbers(numbers)
    save(panels, numbers, path)
    print(f"figure: {path}")


def save(panels, numbers, path):
    """Save the panel that the file is named after, otherwise all panels, one below the other."""
    from matplotlib.figure import Figure

    name = Path(str(path)).stem
    shown = [panels[name]] if name in panels else list(panels.values())
    canvas = Figure(figsize=(7.2, 3.2 * len(shown)), layout="constrained")
    for axes, draw in zip(canvas.subplots(len(shown), squeeze=False).flat, shown, strict=True):
        draw(axes, numbers)
    canvas.savefig(path, dpi=150)


def put_legend_right(axes):
    """Put the legend to the right of the axes, where it covers no curve."""
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=9, frameon=False)
