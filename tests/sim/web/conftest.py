"""A browser without a window, the page served to it, and visits that must end without a complaint."""

import threading

import pytest
from worked import chromium

from lavender.base.errors import LavenderError
from lavender.sim.engine import SOLVER_FIELDS
from lavender.sim.web import pages
from lavender.sim.web.compile import explain_missing_requirement

PATIENCE = 600_000  # ms, for what hangs: on a loaded machine a page takes its time


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    try:
        pages.write_page(folder)
    except LavenderError as error:
        if not explain_missing_requirement():  # what it is made with is there: it must be made
            raise
        pytest.skip(str(error))
    server = pages.create_file_server(folder)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}/"
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed (extra: dev)"
    )
    found = chromium()
    with playwright.sync_playwright() as p:
        # Containers and root have no user namespaces to build the sandbox from.
        browser = p.chromium.launch(executable_path=found, args=["--no-sandbox"], timeout=PATIENCE)
        yield browser
        browser.close()


@pytest.fixture
def new_page(browser):
    """An empty page in a context of its own."""
    contexts = []

    def make(**options):
        contexts.append(browser.new_context(**options))
        contexts[-1].set_default_timeout(PATIENCE)
        return contexts[-1].new_page()

    yield make
    for context in contexts:
        context.close()


class Visit:
    """A page with what it complained of and what it asked for."""

    def __init__(self, page, address):
        self.page = page
        self.context = page.context
        self.address = address
        self.complaints, self.requests = [], []
        self.page.on(
            "console", lambda m: m.type in ("error", "warning") and self.complaints.append(m.text)
        )
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("requestfailed", lambda request: self.complaints.append(request.url))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(address)
        self.page.wait_for_selector("html[data-ready=true]")

    def side(self, i):
        return self.page.locator(f".side[data-side='{i}']")

    def values(self, i):
        """The eight values of a side: exactly, and as they are shown."""
        cells = [self.side(i).locator(f"td[data-field='{field}']") for field in SOLVER_FIELDS]
        return [float(c.get_attribute("data-value")) for c in cells], [
            c.text_content() for c in cells
        ]

    def js(self, expression):
        return self.page.evaluate(expression)


@pytest.fixture
def visit(new_page, address):
    visits = []

    def start(path="#stack", at=address, **options):
        visits.append(
            Visit(new_page(**{"viewport": {"width": 1280, "height": 900}, **options}), at + path)
        )
        return visits[-1]

    yield start
    for v in visits:
        assert v.complaints == []
        assert {url.rsplit("/", 1)[0] for url in v.requests if "/vendor/" not in url} == {
            v.address.rsplit("/", 1)[0]
        }
