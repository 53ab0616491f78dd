"""Frame rate of the page that runs the kernels, and processor time of a frame, in headless Chromium.

    python -m benchmarks page [ADDRESS ...] [--seconds 8]

ADDRESS is the part after # of the page's address; by default the pyramid with sweeps on both sides, the pyramid with
`newton` on one side, and the pile. Frames are those that the page requested (requestAnimationFrame). Milliseconds are
processor time of the main thread: for each part of the script, called separately, for their sum, and for all work of a
frame (layout, painting of canvases, transfer to the compositor, and the steps of missed frames).
"""

import os
import shutil
import tempfile
import threading
from contextlib import contextmanager
from pathlib import Path

import click

from benchmarks.output import markdown
from lavender.base.errors import SolverUnavailable
from lavender.sim.web import pages

ADDRESSES = (
    "scene=pyramid&a=16,warm,given&b=16,warm,given&speed=1&play=1",
    "scene=pyramid&a=16,warm,given,newton&b=16,warm,given&speed=1&play=1",
    "scene=pile&a=16,warm,given&b=16,warm,given&speed=1&play=1",
)
COUNT = """() => {
  const app = window.lavender;
  const inner = app.frame;
  window.found = { frames: 0, from: app.steps, begun: performance.now() };
  app.frame = function (now) {
    window.found.frames += 1;
    inner.call(this, now);
  };
}"""
#: Work of a frame at 60 frames per second: two steps of both sides, the pictures, and one of eight parts of the page
#: (error of every sweep, recorded in one of sixteen steps, charts over time, tables, caption).
PARTS = {
    "steps": "lavender.sides.forEach((side) => { side.step(0, false); side.step(0, false); })",
    "watching": "lavender.sides.forEach((side) => { side.step(0, true); side.step(0, false); })",
    "pictures": "lavender.sides.forEach((side) => side.draw())",
    "the rest": "lavender.parts.forEach((part) => part())",
}


@contextmanager
def browse(**options):
    """Yield an empty page of headless Chromium, and close it at the end; `options` are those of `new_page`.

    Raises
    ------
    SolverUnavailable
        Chromium or playwright is not installed.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise SolverUnavailable(
            "playwright is not installed: pip install 'lavender-contact[dev]'"
        ) from None
    names = ("chromium", "chromium-browser", "google-chrome")
    browser_path = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, names)), None)
    if browser_path is None:
        raise SolverUnavailable(
            f"none of {', '.join(names)} is installed, and CHROMIUM names no browser"
        )
    with sync_playwright() as p:
        # In containers and as root there are no user namespaces for the sandbox.
        browser = p.chromium.launch(executable_path=browser_path, args=["--no-sandbox"])
        yield browser.new_page(**options)
        browser.close()


@contextmanager
def opened(address, **options):
    """Open the page of this checkout, as `browse` does, and close it at the end."""
    with tempfile.TemporaryDirectory() as folder, browse(**options) as page:
        pages.write_page(Path(folder), print)
        server = pages.create_file_server(Path(folder))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page.goto(f"http://127.0.0.1:{server.server_address[1]}/#{address}")
        page.wait_for_selector("html[data-ready=true]")
        page.wait_for_function("!lavender.waiting")
        yield page
        server.shutdown()


def spent(session):
    """Return the processor time of the main thread so far [ms]."""
    found = {m["name"]: m["value"] for m in session.send("Performance.getMetrics")["metrics"]}
    return 1000 * found["TaskDuration"]


def cpu(page, session, code, times):
    """Return the processor time of the main thread in one execution of `code` [ms], the mean of `times`."""
    before = spent(session)
    # uPlot paints in a microtask: wait for one after each execution.
    page.evaluate(
        f"async () => {{ for (let k = 0; k < {times}; k++) {{ {code}; await null; await null; }} }}"
    )
    return (spent(session) - before) / times


def measured(page, seconds):
    """Return frames and simulated time per second, and milliseconds of each part of a frame, as text."""
    page.wait_for_function("lavender.steps > 10")
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable", {"timeDomain": "threadTicks"})
    before = spent(session)
    page.evaluate(COUNT)
    page.wait_for_timeout(1000 * seconds)
    found = page.evaluate(
        "() => ({...found, to: lavender.steps, passed: performance.now() - found.begun})"
    )
    thread = spent(session) - before
    dt = page.evaluate("lavender.scene.dt")
    page.evaluate("lavender.play(false)")
    parts = {name: cpu(page, session, code, 40) for name, code in PARTS.items()}
    parts["watching"] = max(parts["watching"] - parts["steps"], 0.0) / 8
    parts["the rest"] /= 8
    parts["script"] = sum(parts.values())
    parts["main thread"] = thread / found["frames"]
    passed = found["passed"] / 1000
    return (
        f"{found['frames'] / passed:.1f}",
        f"{(found['to'] - found['from']) * dt / passed:.2f}",
        *(f"{ms:.2f}" for ms in parts.values()),
    )


@click.command("page")
@click.argument("addresses", nargs=-1, metavar="[ADDRESS]...")
@click.option("--seconds", default=8.0, show_default=True)
def command(addresses, seconds):
    """Measure frame rate and processor time of the page that runs the kernels, in Chromium."""
    rows = []
    for address in addresses or ADDRESSES:
        with opened(address, viewport={"width": 1280, "height": 1000}) as page:
            rows.append([address.split("&speed")[0], *measured(page, seconds)])
    head = (
        "address",
        "frames/s",
        "simulated s/s",
        *(f"{name} [ms]" for name in (*PARTS, "script", "main thread")),
    )
    click.echo(markdown(head, rows))
