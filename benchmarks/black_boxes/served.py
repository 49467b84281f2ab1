"""A shipped expert behind HTTP, on this machine."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import numpy as np

from fdtasil.experts.expert import Expert

from .visits import shipped_expert


@contextmanager
def make_http(folder: Path, environment: str = "Walker2d-v5") -> Iterator[str]:
    """Serve a shipped expert for as long as the context lasts, on a free port of the loopback.

    Args:
        folder: Not used.
        environment: Which shipped expert.

    Yields:
        The URL, which answers `POST {"observations": [[...]]}` with `{"actions": [[...]]}`.
    """
    server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(shipped_expert(environment)))
    server.daemon_threads = True  # a client that keeps its connection must not hold the end up
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/act"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _handler(expert: Expert) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"  # a connection serves all of a run's requests
        # Headers and body leave together: apart, each answer waits for an acknowledgement.
        wbufsize = -1

        def do_POST(self) -> None:
            if self.path != "/act":
                self.send_error(404)
                return
            try:
                asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                rows = np.array(asked["observations"], np.float32, ndmin=2)
                reply = {"actions": expert.ask(rows, "act").tolist()}
            except (TypeError, ValueError, KeyError) as error:
                self.send_error(400, f"{type(error).__name__} in the request")
                return
            body = json.dumps(reply).encode()
            self.send_response(200)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *arguments: object) -> None:
            """Say nothing: a run makes thousands of requests."""

    return Handler
