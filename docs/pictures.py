"""Make the pictures of pages for README and the documentation: docs/static/report.png, audit.png, compare.png.

    python docs/pictures.py [report] [audit] [compare]

Each picture is the first screen of a page that the command has just written, in Chromium without a window (playwright,
the extra `dev`). A page with a warning that is not `ACCEPTED`, such as that of a busy machine, is refused: the earlier
picture stays.
`audit` needs the models of gymnasium (extra `robots`).
"""

import argparse
import io
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # benchmarks

from benchmarks.page import browse

STATIC = Path(__file__).resolve().parent / "static"
STEP = str(
    Path(__file__).resolve().parent.parent / "tests" / "causes" / "recorded" / "gripper_{}.npz"
)
#: Arguments of the command, and width and height of its first screen in pixels.
PICTURES = {
    "report": (["report"], (1180, 1000)),
    "audit": (["audit", "MODEL", "--worlds", "64", "--steps", "200"], (1100, 778)),
    "compare": (
        [
            "compare",
            STEP.format("mujoco_4.0.0"),
            STEP.format("genesis_1.4.5"),
            "--out",
            "lavender-compare",
        ],
        (1000, 430),
    ),
}
#: Beginnings of warnings that a picture may show. After 4 iterations, far from a solution, the impulses of admm add up
#: to 12 J on three cases of the default suite; the first report of every reader says so, too.
ACCEPTED = ("gains energy: admm in 3 runs",)
MODEL = "humanoidstandup.xml"
COLORS = 64


def show(page: Path, size: tuple[int, int]) -> bytes:
    """Return the first screen of a page as PNG, or end if the page shows a warning."""
    width, height = size
    with browse(viewport={"width": width, "height": height}, color_scheme="light") as tab:
        tab.goto(page.as_uri())
        shown = tab.locator("p.warn").all_inner_texts()
        if warnings := [text for text in shown if not text.startswith(ACCEPTED)]:
            sys.exit(f"{page}: the page shows a warning, no picture: {warnings[0]}")
        return tab.screenshot()


def main() -> None:
    """Write the pictures whose names are given, or all of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help=f"pictures: {', '.join(PICTURES)} (default: all)")
    for name in parser.parse_args().names or PICTURES:
        arguments, size = PICTURES[name]
        if "MODEL" in arguments:
            import gymnasium

            model = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / MODEL
            arguments = [str(model) if one == "MODEL" else one for one in arguments]
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "lavender", *arguments]
            subprocess.run(
                command, cwd=folder, stdout=subprocess.DEVNULL, check=False
            )  # 1: e.g. too few contacts
            image = Image.open(
                io.BytesIO(show(Path(folder) / f"lavender-{name}" / "index.html", size))
            )
            image.quantize(COLORS, dither=Image.Dither.NONE).save(
                STATIC / f"{name}.png", optimize=True
            )
        print(
            f"{STATIC / name}.png: {(STATIC / name).with_suffix('.png').stat().st_size / 1000:.0f} kB"
        )


if __name__ == "__main__":
    main()
