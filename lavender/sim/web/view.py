"""A film in the page: a server on this machine that hands out frames as they come."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlsplit

from lavender.sim.engine.film import Film
from lavender.sim.web.pages import HERE, Handler, bound

MOST_FRAMES = 2000  # of one answer


class Viewer:
    """Serves the page `view.html` for a film until it is closed; a context manager.

    Parameters
    ----------
    film : Film
        May grow while it is shown.
    port : int
        On the loopback address; 0 takes a free one.
    browser : bool
        Open the page.
    end : callable, optional
        Called once, by `close`.

    Raises
    ------
    InputError
        A port that is taken.
    """

    def __init__(
        self, film: Film, *, port: int = 0, browser: bool = True, end: Callable[[], Any] = lambda: None
    ) -> None:
        self.film = film
        self._end: Callable[[], Any] | None = end
        self._server = bound(partial(_FilmHandler, film), port)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()
        if browser:
            import webbrowser

            webbrowser.open(self.address)

    @property
    def address(self) -> str:
        """Where the page is."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/view.html"

    def wait(self) -> None:
        """Until Ctrl-C; the film stays to be looked at."""
        self.film.ended = True
        try:
            self._thread.join()
        except KeyboardInterrupt:
            pass
        finally:
            self.close()

    def close(self) -> None:
        """End the film and the server."""
        if self._end is None:
            return
        end, self._end = self._end, None
        self.film.ended = True
        end()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class _FilmHandler(Handler):
    def __init__(self, film: Film, *arguments: Any) -> None:
        self._film = film
        super().__init__(*arguments, directory=str(HERE / "page"))

    def do_GET(self) -> None:
        """The page's files; `film.json`, the header; `frames?from=K&stride=S`, frames from number K on."""
        host = self.headers.get("Host", "").rsplit(":", 1)[0]
        if host not in ("127.0.0.1", "localhost"):  # a name that a foreign page has bent to this machine
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        address = urlsplit(self.path)
        if address.path == "/film.json":
            self._answer("application/json", json.dumps(self._film.header).encode(), {})
        elif address.path == "/frames":
            self._frames(parse_qs(address.query))
        else:
            super().do_GET()

    def _frames(self, query: dict[str, list[str]]) -> None:
        try:
            first, stride = (int(query.get(name, ["0"])[0]) for name in ("from", "stride"))
            if first < 0:
                raise ValueError
        except ValueError:
            self.send_error(HTTPStatus.BAD_REQUEST)
            return
        film = self._film
        ended = film.ended
        if stride != film.stride:  # every other frame has been dropped: begin again
            first = 0
        found = film.frames(first)[:MOST_FRAMES]
        whole = ended and first + len(found) >= len(film)
        more = {"X-First": str(first), "X-Stride": str(film.stride), "X-Ended": str(int(whole))}
        self._answer("application/octet-stream", found.astype("<f4").tobytes(), more)

    def _answer(self, kind: str, data: bytes, headers: dict[str, str]) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)
