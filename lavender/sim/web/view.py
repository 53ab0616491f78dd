"""Serve a film to the page on this machine, with new frames as they are added."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlsplit

from lavender.sim.engine.film import Film
from lavender.sim.web.pages import HERE, Handler, create_server

MAX_FRAMES_PER_ANSWER = 2000


class Viewer:
    """Server of the page `view.html` for a film until it is closed; a context manager.

    Parameters
    ----------
    film : Film
        Frames may be added while it is shown.
    port : int
        Port on the loopback address; 0 selects a free one.
    browser : bool
        Open the page.
    end : callable, optional
        Called once, by `close`.

    Raises
    ------
    InputError
        The port is in use.
    """

    def __init__(
        self, film: Film, *, port: int = 0, browser: bool = True, end: Callable[[], Any] = lambda: None
    ) -> None:
        self.film = film
        self._end: Callable[[], Any] | None = end
        self._server = create_server(partial(_FilmHandler, film), port)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()
        if browser:
            import webbrowser

            webbrowser.open(self.address)

    @property
    def address(self) -> str:
        """Address of the page."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/view.html"

    def wait(self) -> None:
        """End the film, so that no frames are added, and serve it until Ctrl-C."""
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
        """Answer with `film.json` (the header), `frames?from=K&stride=S` (frames from number K on) or a page file."""
        host = self.headers.get("Host", "").rsplit(":", 1)[0]
        if host not in ("127.0.0.1", "localhost"):  # Other names may be mapped here by foreign sites.
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        address = urlsplit(self.path)
        if address.path == "/film.json":
            self._send_answer("application/json", json.dumps(self._film.header).encode(), {})
        elif address.path == "/frames":
            self._answer_frames(parse_qs(address.query))
        else:
            super().do_GET()

    def _answer_frames(self, query: dict[str, list[str]]) -> None:
        """Answer a request for frames; start again from 0 if the stride of the film has changed."""
        try:
            first, stride = (int(query.get(name, ["0"])[0]) for name in ("from", "stride"))
            if first < 0:
                raise ValueError
        except ValueError:
            self.send_error(HTTPStatus.BAD_REQUEST)
            return
        film = self._film
        ended = film.ended
        # Every second frame was dropped since the last request: send all frames again.
        if stride != film.stride:
            first = 0
        frames = film.frames(first)[:MAX_FRAMES_PER_ANSWER]
        is_complete = ended and first + len(frames) >= len(film)
        headers = {"X-First": str(first), "X-Stride": str(film.stride), "X-Ended": str(int(is_complete))}
        self._send_answer("application/octet-stream", frames.astype("<f4").tobytes(), headers)

    def _send_answer(self, kind: str, data: bytes, headers: dict[str, str]) -> None:
        """Send `data` of content type `kind` with additional headers."""
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)
