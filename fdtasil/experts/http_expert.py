"""Experts behind HTTP: one POST for a batch, its observations and its actions as JSON."""

import http.client
import json
import socket
import ssl
import threading
import time
from contextlib import suppress
from http import HTTPStatus
from types import TracebackType
from typing import Any, TypeGuard
from urllib.parse import SplitResult, urlsplit

import numpy as np

from fdtasil.errors import ExpertError, first_line, shown, without_secrets
from fdtasil.experts.expert import Expert
from fdtasil.experts.hub.uri import uri_of_page

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
    except ValueError:  # a port that is no number, half an IPv6 address
        # Without the cause, whose text may be a part of a password.
        raise _no_address(url, "its host or port can't be read") from None
    if not usable:
        raise _no_address(url, "no host, or characters that have to be quoted")
    if uri := uri_of_page(url):
        raise ExpertError(
            f"{without_secrets(url)} is the address of a file",
            "the address of a server that answers with actions",
            f"write {uri}",
        )
    if parts.username is not None or parts.password is not None:
        # Said without the address: it would print the password.
        raise ExpertError(
            f"the address of an expert at {shown(parts.hostname)} holds a password",
            "an address without: it is written into reports",
            "wrap the request in a function of your own",
        )
    return parts


def _no_address(url: str, reason: str) -> ExpertError:
    return ExpertError(
        f"{shown(without_secrets(url))!r} is no address: {reason}",
        "http://host:port/path",
        "write it like http://127.0.0.1:8000/act",
    )


class _Client:
    """The function that asks the server; it may be called by several threads at once."""

    def __init__(self, parts: SplitResult, action_size: int | None, timeout: float) -> None:
        self.name = without_secrets(parts.geturl())
        self._arguments = parts, action_size, timeout
        self._parts, self._action_size, self._timeout = parts, action_size, timeout
        self._target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        self._local = threading.local()

    def __reduce__(self) -> tuple[type["_Client"], tuple[SplitResult, int | None, float]]:
        return _Client, self._arguments  # with connections of its own, wherever it is sent

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        body = json.dumps({"observations": rows.tolist()}, allow_nan=False).encode()
        limit = _TEXT_BYTES + _NUMBER_BYTES * len(rows) * (self._action_size or _MOST_ACTIONS)
        problem, broken = "", None
        for pause in (0.0, *_PAUSES):
            time.sleep(pause)
            try:
                response, data = self._post(body, limit)
            except ExpertError:
                raise
            except (ConnectionError, http.client.IncompleteRead) as error:
                problem, broken = f"{type(error).__name__}: {first_line(error)}", error
                continue
            except (OSError, http.client.HTTPException) as error:
                raise self._unreachable(error) from error
            if response.status not in _BUSY:
                return self._actions(response, data)
            problem, broken = _status(response), None
        raise ExpertError(
            f"{self.name} does not answer, {len(_PAUSES) + 1} tries: {problem}",
            f"a server that answers {_REQUEST}",
            "start it, or see why it stopped, and check host and port",
        ) from broken

    def _post(self, body: bytes, limit: int) -> tuple[http.client.HTTPResponse, bytes]:
        connection = self._connection()
        end = time.monotonic() + self._timeout
        try:
            used = connection.sock is not None and self._is_quiet(connection)
            with _Deadline(connection, end) as deadline:
                try:
                    response = self._request(connection, body, deadline)
                except ConnectionError:
                    if not used or deadline.over:
                        raise
                    # The server has closed a connection that was idle, as it may at any time.
                    connection.close()
                    response = self._request(connection, body, deadline)
                with response:
                    data = self._read(response, limit)
        except BaseException:  # whatever is still to come would be taken for the next answer
            connection.close()
            raise
        return response, data

    def _is_quiet(self, connection: http.client.HTTPConnection) -> bool:
        """Whether nothing came after the last answer; a connection that was ended is closed.

        Raises:
            ExpertError: If something came: then the last answer may not have been the last
                request's.
        """
        connection.sock.setblocking(False)
        try:
            came = connection.sock.recv(1)
        except (BlockingIOError, ssl.SSLWantReadError):
            return True
        except OSError:
            came = b""
        if came:
            raise self._too_much()
        connection.close()
        return False

    def _too_much(self) -> ExpertError:
        return ExpertError(
            f"{self.name} sent more than one answer to one request",
            f"{_REPLY}, once",
            "mend the server: which answer belongs to which observations can't be known",
        )

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
        self, connection: http.client.HTTPConnection, body: bytes, deadline: "_Deadline"
    ) -> http.client.HTTPResponse:
        headers = {"Content-Type": "application/json", "Accept": "application/json"}
        if connection.sock is None:
            connection.timeout = deadline.left()
            connection.connect()
        line: socket.socket = getattr(connection, "sock")  # noqa: B009 (for the type checker)
        deadline.line = line  # the connection forgets it where the server will close it
        line.settimeout(deadline.left())
        connection.request("POST", self._target, body, headers)
        if hasattr(socket, "TCP_QUICKACK"):
            # Plain servers send headers and body apart, and the body only once the headers are
            # acknowledged: by default 40 ms later. Linux forgets the wish, so each request has it.
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        return connection.getresponse()

    def _read(self, response: http.client.HTTPResponse, limit: int) -> bytes:
        """Read the answer, not more than `limit` bytes."""
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
        if announced is not None and len(data) < announced:
            raise http.client.IncompleteRead(bytes(data), announced - len(data))
        if announced is not None and _is_followed(response):
            raise self._too_much()
        return bytes(data)

    def _unreachable(self, error: Exception) -> ExpertError:
        if isinstance(error, TimeoutError):
            return ExpertError(
                f"{self.name} gave no answer within {self._timeout:g} s",
                f"a server that answers {_REQUEST}",
                "pass load_expert(..., timeout=60), or a smaller batch=",
            )
        return ExpertError(
            f"{self.name} can't be asked: {type(error).__name__}: {first_line(error)}",
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
            said = json.loads(data)["actions"]
            actions = np.asarray(_without_null(said) if b"null" in data else said)
        except (ValueError, LookupError, TypeError, RecursionError):
            actions = None
        if actions is None or actions.dtype.kind not in "iuf":
            raise ExpertError(
                f"{self.name} answered {_line(data) or 'nothing'}",
                _REPLY,
                "mend what the server answers",
            )
        return actions


def _without_null(actions: Any) -> Any:
    """Return rows of numbers with NaN in the place of null, which is no answer."""
    if not isinstance(actions, list):
        return actions
    size = max((len(row) for row in actions if isinstance(row, list)), default=1)
    rows = ([None] * size if row is None else row for row in actions)
    return [
        [float("nan") if number is None else number for number in row]
        if isinstance(row, list)
        else row
        for row in rows
    ]


def _status(response: http.client.HTTPResponse) -> str:
    return f"{response.status} {_line(response.reason)}".strip()


def _is_followed(response: http.client.HTTPResponse) -> bool:
    """Whether more than a whole answer was read from the connection."""
    # The reader's buffer; the attribute is public in all but its type stubs.
    reader = getattr(response, "fp", None)
    left = getattr(reader, "peek", None)
    if reader is None or left is None:
        return False
    raw = getattr(getattr(reader, "raw", None), "_sock", None)
    if raw is None:
        return False
    raw.setblocking(False)  # a peek into an empty buffer would wait for the server
    try:
        return bool(left(1))
    except OSError:
        return False


class _Deadline:
    """The end of an exchange: at its time the connection is cut, whatever is waited for.

    A timeout of a socket begins anew with every byte that comes.

    Attributes:
        line: The socket that is cut; None for the connection's.
        over: Whether it was.
    """

    line: socket.socket | None

    def __init__(self, connection: http.client.HTTPConnection, end: float) -> None:
        self._connection, self._end, self.line = connection, end, None
        self._clock = threading.Timer(max(end - time.monotonic(), 0), self._cut)
        self._clock.daemon = True
        self.over = False

    def left(self) -> float:
        """Return the seconds that are left.

        Raises:
            TimeoutError: If none are.
        """
        seconds = self._end - time.monotonic()
        if seconds <= 0:
            raise TimeoutError("the exchange did not end in time")
        return seconds

    def __enter__(self) -> "_Deadline":
        self._clock.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._clock.cancel()
        if self.over and not isinstance(error, ExpertError):
            raise TimeoutError("the exchange did not end in time") from error

    def _cut(self) -> None:
        self.over, line = True, self.line or self._connection.sock
        if line is not None:
            with suppress(OSError):
                line.shutdown(socket.SHUT_RDWR)


def _line(text: str | bytes) -> str:
    """Return the beginning of what a server said as one line that a terminal can show."""
    plain = text[:4000].decode("utf-8", "replace") if isinstance(text, bytes) else text[:4000]
    words = shown(" ".join(plain.split()))
    return words if len(words) <= 120 else f"{words[:120]} ..."
