"""Experts behind HTTP: one POST for a batch, its observations and its actions as JSON."""

import http.client
import json
import socket
import ssl
import threading
import time
from http import HTTPStatus
from typing import TypeGuard
from urllib.parse import SplitResult, urlsplit

import numpy as np

from fdtasil.errors import ExpertError
from fdtasil.experts.expert import Expert

__all__ = ["is_http_url", "open_http"]

_CHUNK = 64  # rows a request: a slow expert has to answer them within the timeout
_TIMEOUT = 10.0  # seconds
_PAUSES = (0.5, 2.0)  # seconds before the second and the third try
_BUSY = (429, 502, 503, 504)  # worth another try; everything else would be answered again
_REQUEST = 'POST {"observations": [[...], ...]}'
_REPLY = '{"actions": [[...], ...]}, a row of numbers for each row of observations'
# What an answer may take: generous for a number in JSON, and for the text of an error.
_NUMBER_BYTES, _TEXT_BYTES = 64, 65536
_MOST_ACTIONS = 1024  # where the number of actions is not known


def is_http_url(source: object) -> TypeGuard[str]:
    """Whether a source of experts is the address of a server."""
    return isinstance(source, str) and source.lower().startswith(("http://", "https://"))


def open_http(url: str, action_size: int | None = None, timeout: float | None = None) -> Expert:
    """Ask an expert behind HTTP; nothing is sent before the first query.

    A batch is one `POST {"observations": [[...], ...]}`, answered by `{"actions": [[...], ...]}`;
    float32 numbers survive JSON exactly. Each thread keeps a connection of its own. Connections
    that are refused or break, and the answers 429, 502, 503 and 504, are tried three times in
    2.5 seconds. Redirects are not followed, and neither proxies nor the environment are looked at.

    Args:
        url: `http://host:port/path` or `https://...`.
        action_size: m, where it is known; limits the size of an answer.
        timeout: Seconds that a request may take, 10 if None.

    Returns:
        The expert, 64 rows a request.

    Raises:
        ExpertError: If it is no address that can be asked.

    Example:
        >>> open_http("http://127.0.0.1:8000/act").name
        'http://127.0.0.1:8000/act'
    """
    client = _Client(_parse(url), action_size, _TIMEOUT if timeout is None else timeout)
    return Expert(client, client.name, chunk=_CHUNK)


def _parse(url: str) -> SplitResult:
    try:
        parts = urlsplit(url)
        usable = bool(parts.hostname) and parts.port != 0 and url.isascii() and " " not in url
    except ValueError as error:  # a port that is no number, half an IPv6 address
        raise _no_address(url, str(error)) from error
    if not usable:
        raise _no_address(url, "no host, or characters that have to be quoted")
    if parts.username is not None or parts.password is not None:
        # Said without the address: it would print the password.
        raise ExpertError(
            f"the address of an expert at {parts.hostname} holds a password",
            "an address without: it is written into reports",
            "wrap the request in a function of your own",
        )
    return parts


def _no_address(url: str, reason: str) -> ExpertError:
    return ExpertError(
        f"{url!r} is no address: {reason}",
        "http://host:port/path",
        "write it like http://127.0.0.1:8000/act",
    )


class _Client:
    """The function that asks the server; it may be called by several threads at once."""

    def __init__(self, parts: SplitResult, action_size: int | None, timeout: float) -> None:
        self.name = parts._replace(query="", fragment="").geturl()
        self._parts, self._action_size, self._timeout = parts, action_size, timeout
        self._target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        self._local = threading.local()

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        body = json.dumps({"observations": rows.tolist()}, allow_nan=False).encode()
        limit = _TEXT_BYTES + _NUMBER_BYTES * len(rows) * (self._action_size or _MOST_ACTIONS)
        problem = ""
        for pause in (0.0, *_PAUSES):
            time.sleep(pause)
            try:
                response, data = self._post(body, limit)
            except ExpertError:
                raise
            except (ConnectionError, http.client.IncompleteRead) as error:
                problem = f"{type(error).__name__}: {error}"
                continue
            except (OSError, http.client.HTTPException) as error:
                raise self._unreachable(error) from error
            if response.status not in _BUSY:
                return self._actions(response, data)
            problem = _status(response)
        raise ExpertError(
            f"{self.name} does not answer, {len(_PAUSES) + 1} tries: {problem}",
            f"a server that answers {_REQUEST}",
            "start it, or see why it stopped, and check host and port",
        )

    def _post(self, body: bytes, limit: int) -> tuple[http.client.HTTPResponse, bytes]:
        connection = self._connection()
        used = connection.sock is not None
        end = time.monotonic() + self._timeout
        try:
            try:
                response = self._request(connection, body)
            except ConnectionError:
                if not used:
                    raise
                # The server has closed a connection that was idle, as it may at any time.
                connection.close()
                response = self._request(connection, body)
            with response:
                data = self._read(response, limit, end)
        except BaseException:  # whatever is still to come would be taken for the next answer
            connection.close()
            raise
        return response, data

    def _connection(self) -> http.client.HTTPConnection:
        """Return this thread's connection; it opens itself again once it is closed."""
        if not hasattr(self._local, "connection"):
            host, port = self._parts.hostname or "", self._parts.port
            self._local.connection = (
                http.client.HTTPSConnection(
                    host, port, timeout=self._timeout, context=ssl.create_default_context()
                )
                if self._parts.scheme == "https"
                else http.client.HTTPConnection(host, port, timeout=self._timeout)
            )
        return self._local.connection

    def _request(
        self, connection: http.client.HTTPConnection, body: bytes
    ) -> http.client.HTTPResponse:
        headers = {"Content-Type": "application/json", "Accept": "application/json"}
        connection.request("POST", self._target, body, headers)
        if hasattr(socket, "TCP_QUICKACK"):
            # Plain servers send headers and body apart, and the body only once the headers are
            # acknowledged: by default 40 ms later. Linux forgets the wish, so each request has it.
            connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        return connection.getresponse()

    def _read(self, response: http.client.HTTPResponse, limit: int, end: float) -> bytes:
        """Read the answer, not more than `limit` bytes and not after `end`."""
        announced, data = response.length, bytearray()
        while announced is None or len(data) < announced:
            if max(len(data), announced or 0) > limit:
                raise ExpertError(
                    f"{self.name} answered with more than {limit:,} bytes",
                    _REPLY,
                    "answer the observations that were asked, and nothing else",
                )
            part = response.read1(65536)
            if not part:
                break
            data += part
            if time.monotonic() > end:
                raise TimeoutError("the answer did not end in time")
        if announced is not None and len(data) < announced:
            raise http.client.IncompleteRead(bytes(data), announced - len(data))
        return bytes(data)

    def _unreachable(self, error: Exception) -> ExpertError:
        if isinstance(error, TimeoutError):
            return ExpertError(
                f"{self.name} gave no answer within {self._timeout:g} s",
                f"a server that answers {_REQUEST}",
                "pass load_expert(..., timeout=60), or a smaller batch=",
            )
        return ExpertError(
            f"{self.name} can't be asked: {type(error).__name__}: {error}",
            f"a server that answers {_REQUEST}",
            "check the address, and whether it speaks http or https",
        )

    def _actions(self, response: http.client.HTTPResponse, data: bytes) -> np.ndarray:
        if 300 <= response.status < 400:
            raise ExpertError(
                f"{self.name} answered {_status(response)}, "
                f"to {_line(response.headers.get('Location', 'nowhere'))}",
                "an answer of the host that was named: redirects are not followed",
                "name the address that it points to, if you trust it",
            )
        if response.status != HTTPStatus.OK:
            raise ExpertError(
                f"{self.name} answered {_status(response)}: {_line(data) or 'no text'}",
                f"200 OK and {_REPLY}",
                f"check that this path takes {_REQUEST}, and what the server has logged",
            )
        try:
            actions = np.asarray(json.loads(data)["actions"])
        except (ValueError, LookupError, TypeError, RecursionError):
            actions = None
        if actions is None or actions.dtype.kind not in "iuf":
            raise ExpertError(
                f"{self.name} answered {_line(data) or 'nothing'}",
                _REPLY,
                "mend what the server answers",
            )
        return actions


def _status(response: http.client.HTTPResponse) -> str:
    return f"{response.status} {_line(response.reason)}".strip()


def _line(text: str | bytes) -> str:
    """Return the beginning of what a server said as one line that a terminal can show."""
    plain = text.decode("utf-8", "replace") if isinstance(text, bytes) else text
    shown = "".join(c if c.isprintable() else " " for c in plain[:1000])
    words = " ".join(shown.split())
    return words if len(words) <= 120 else f"{words[:120]} ..."
