"""Make the moving picture of the page that runs the kernels: docs/static/web.gif.

    python docs/film.py [OUT.gif] [--preset cards] [--seconds 5] [--pace 1.5]

Chromium without a window (playwright, the extra `dev`) opens the page at a preset; every frame is some whole steps and
a picture of both sides and of the caption that measures them, so each run makes the same film. Pillow writes it with
one palette for all frames. A file above `MOST` bytes is not written.
"""

import argparse
import io
import sys
from pathlib import Path

from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # benchmarks

from benchmarks.page import opened

MOST = 150_000  # bytes
FRAMES = 10  # a second
COLORS = 32
WIDTH = 720  # pixels
OUT = Path(__file__).resolve().parent / "static" / "web.gif"


def frames(preset, seconds, pace):
    """PIL images, `FRAMES` a second; `pace` simulated seconds in each."""
    options = {"viewport": {"width": WIDTH, "height": 900}, "color_scheme": "light"}
    with opened(
        preset, **options, reduced_motion="reduce"
    ) as page:  # nothing moves but by the frame
        page.evaluate("lavender.play(false)")
        first = page.locator("#caption").bounding_box()
        last = page.locator(".side canvas").last.bounding_box()
        clip = {
            "x": 0,
            "y": first["y"] - 6,
            "width": WIDTH,
            "height": last["y"] + last["height"] + 10 - first["y"],
        }
        dt = page.evaluate("lavender.scene.dt")
        steps = 0
        for k in range(int(seconds * FRAMES)):
            due = round(k * pace / FRAMES / dt)
            page.evaluate(f"lavender.advance({due - steps})")
            steps = due
            yield Image.open(io.BytesIO(page.screenshot(clip=clip))).convert("RGB")


def write(out, images):
    """One palette, made of the first, the middle and the last frame."""
    some = [images[0], images[len(images) // 2], images[-1]]
    sheet = Image.new("RGB", (some[0].width, 3 * some[0].height))
    for k, image in enumerate(some):
        sheet.paste(image, (0, k * image.height))
    palette = sheet.quantize(COLORS, dither=Image.Dither.NONE)
    plain = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    hold = [1000 // FRAMES] * (len(plain) - 1) + [1500]
    data = io.BytesIO()
    plain[0].save(
        data, "GIF", save_all=True, append_images=plain[1:], duration=hold, loop=0, optimize=True
    )
    size = len(data.getvalue())
    if size > MOST:
        sys.exit(f"{len(plain)} frames are {size} bytes; {MOST} are allowed: fewer --seconds")
    out.write_bytes(data.getvalue())
    print(f"{out}: {len(plain)} frames of {plain[0].width} x {plain[0].height}, {size} bytes")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", nargs="?", type=Path, default=OUT)
    parser.add_argument("--preset", default="cards")
    parser.add_argument("--seconds", type=float, default=5.0, help="of the film")
    parser.add_argument(
        "--pace", type=float, default=1.5, help="simulated seconds in a second of the film"
    )
    given = parser.parse_args()
    write(given.out, list(frames(given.preset, given.seconds, given.pace)))
