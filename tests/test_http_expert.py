"""Experts behind HTTP, good and bad, on this machine's own network."""

import json
import socket
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
import torch
from conftest import GAIN, QUICK, TOY

import fdtasil
from fdtasil.errors import ExpertError, SettingError
from fdtasil.experts import http_expert

pytestmark = pytest.mark.usefixtures("no_pictures")


@pytest.fixture
def rows():
    return np.random.default_rng(0).standard_normal((150, 5)).astype(np.float32)


@pytest.fixture
def few_pauses(monkeypatch):
    monkeypatch.setattr(http_expert, "_PAUSES", (0.01, 0.02))


class Served:
    """What a server has seen, and how it answers: by bytes, or by a status with bytes."""

    def __init__(self, answer: Callable[[np.ndarray], object]) -> None:
        self.answer, self.requests, self.connections = answer, [], []
        self.address = ""


def linear(observations):
    return {"actions": (observations @ GAIN.T).tolist()}


@contextmanager
def serving(answer=linear, port=0):
    """Serve in a thread; the address is `served.address`."""
    served = Served(answer)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def setup(self):
            super().setup()
            served.connections.append(self.connection)

        def do_POST(self):
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            observations = np.array(body["observations"], np.float32)
            served.requests.append((self.path, dict(self.headers), observations))
            said = served.answer(observations)
            status, headers, data = said if isinstance(said, tuple) else (200, {}, said)
            data = data if isinstance(data, bytes) else json.dumps(data).encode()
            self.send_response(status)
            for name, value in ({"Content-Length": len(data)} | headers).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, *arguments):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    server.handle_error = lambda *arguments: None
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    served.address = f"http://127.0.0.1:{server.server_port}/act"
    try:
        yield served
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def hang_up(served):
    """Close every connection, as a process does that ends."""
    for connection in served.connections:
        connection.shutdown(socket.SHUT_RDWR)
    served.connections.clear()


def error_of(expert, rows):
    start = time.monotonic()
    with pytest.raises(ExpertError) as caught:
        expert.ask(rows, "act")
    assert time.monotonic() - start < 10
    assert len(str(caught.value).splitlines()) <= 6
    return str(caught.value)


# --- as it should be


@pytest.mark.parametrize("options", [{}, {"workers": 3}, {"workers": 2, "threads": True}])
def test_the_bytes_of_the_function_arrive(options, rows):
    seen = []

    def answer(observations):
        seen.append(observations)
        return {"actions": np.float32(observations @ GAIN.T).tolist()}

    with serving(answer) as served:
        expert = fdtasil.load_expert(served.address, 5, 2, **options)
        answers = expert.ask(rows, "act")
        again = expert.ask(rows, "act")
    assert np.array_equal(answers, again)
    assert np.array_equal(answers, fdtasil.load_expert(lambda x: x @ GAIN.T, batch=64).ask(rows, "act"))  # fmt: skip  # noqa: E501
    assert sorted(map(len, seen)) == [22, 22, 64, 64, 64, 64]
    assert set(np.concatenate(seen).ravel()) == set(rows.ravel())
    assert len(served.connections) <= max(1, options.get("workers", 1))
    path, headers, _ = served.requests[0]
    assert (path, headers["Content-Type"]) == ("/act", "application/json")


def test_a_run_is_the_same_over_http(linear):
    with serving() as served:
        far = fdtasil.distill(served.address, TOY, 3, **QUICK)
    near = fdtasil.distill(fdtasil.load_expert(linear, batch=64), TOY, 3, **QUICK)
    assert far.queries == near.queries
    for name, value in near.student.state_dict().items():
        assert torch.equal(far.student.state_dict()[name], value)


def test_proxies_of_the_environment_are_not_asked(rows, monkeypatch):
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    with serving() as served:
        assert fdtasil.load_expert(served.address).ask(rows, "act").shape == (150, 2)


def test_an_answer_without_a_length_is_read_to_its_end(rows):
    with serving(lambda o: (200, {"Connection": "close"}, linear(o))) as served:
        expert = fdtasil.load_expert(served.address, 5, 2)
        assert np.array_equal(expert.ask(rows, "act"), expert.ask(rows, "act"))


# --- servers come and go


@pytest.mark.usefixtures("few_pauses")
@pytest.mark.parametrize("status", [429, 502, 503, 504])
def test_a_busy_server_is_asked_three_times(status, rows):
    said = [(status, {}, b"busy")] * 2
    with serving(lambda o: said.pop() if said else linear(o)) as served:
        expert = fdtasil.load_expert(served.address, 5, 2)
        assert expert.ask(rows[:3], "act").shape == (3, 2)
        assert expert.queries == {"act": 3}
        said += [(status, {}, b"busy")] * 3
        assert f"does not answer, 3 tries: {status} " in error_of(expert, rows[:3])
    assert len(served.requests) == 6


@pytest.mark.parametrize("status", [400, 404, 500])
def test_other_errors_are_asked_once_and_shown(status, rows):
    with serving(lambda o: (status, {}, b"no\x1b[31m such\n policy" + b"!" * 10**4)) as served:
        found = error_of(fdtasil.load_expert(served.address), rows)
    assert f"answered {status} " in found
    assert "no?[31m such policy!!!" in found
    assert len(found) < 600
    assert len(served.requests) == 1


def test_a_redirect_is_not_followed(rows):
    with serving() as other, serving(lambda o: (307, {"Location": other.address}, b"")) as served:
        assert f"to {other.address}" in error_of(fdtasil.load_expert(served.address), rows)
    assert not other.requests


def test_nobody_there(rows):
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"http://127.0.0.1:{free.getsockname()[1]}/act"
    found = error_of(fdtasil.load_expert(address), rows)  # with the true pauses
    assert "does not answer, 3 tries: ConnectionRefusedError" in found
    assert "next step: start it" in found
    # No name ends in .invalid.
    assert "can't be asked" in error_of(fdtasil.load_expert("http://expert.invalid/act"), rows)


@pytest.mark.usefixtures("few_pauses")
def test_a_server_that_dies_in_the_middle(rows):
    with serving() as served:
        expert = fdtasil.load_expert(served.address)
        expert.ask(rows, "act")
    hang_up(served)
    assert "does not answer, 3 tries: ConnectionRefusedError" in error_of(expert, rows)
    with serving(port=int(served.address.split(":")[2].removesuffix("/act"))):
        assert expert.ask(rows, "act").shape == (150, 2)


@pytest.mark.usefixtures("few_pauses")
def test_a_connection_that_was_closed_while_idle_costs_no_try(rows):
    with serving() as served:
        expert = fdtasil.load_expert(served.address)
        expert.ask(rows[:1], "act")
        served.connections[0].shutdown(socket.SHUT_RDWR)
        served.answer = lambda o: (503, {}, b"") if len(served.requests) < 4 else linear(o)
        assert expert.ask(rows[:1], "act").shape == (1, 2)


@pytest.mark.usefixtures("few_pauses")
def test_a_server_that_dies_in_its_answer(rows):
    short = {"Content-Length": 10**4, "Connection": "close"}
    with serving(lambda o: (200, short, b'{"actions": [[1')) as served:
        found = error_of(fdtasil.load_expert(served.address), rows)
    assert "does not answer, 3 tries: IncompleteRead" in found
    assert len(served.requests) == 3


@pytest.mark.parametrize("options", [{}, {"workers": 2}])
def test_a_slow_server(options, rows):
    release = threading.Event()
    with serving(lambda o: (release.wait(10), linear(o))[1]) as served:
        found = error_of(fdtasil.load_expert(served.address, timeout=0.3, **options), rows)
        release.set()
    assert "gave no answer within 0.3 s" in found
    assert len(served.requests) <= 3  # one for each batch: a slow expert is not asked again


def test_a_server_that_never_ends_its_answer(rows):
    """Each byte comes in time, the whole does not."""

    def trickle(server):
        connection, _ = server.accept()
        with connection:
            connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 9999\r\n\r\n")
            for _ in range(100):
                time.sleep(0.05)
                try:
                    connection.sendall(b" ")
                except OSError:
                    return

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=trickle, args=(server,))
        thread.start()
        address = f"http://127.0.0.1:{server.getsockname()[1]}"
        found = error_of(fdtasil.load_expert(address, timeout=0.4), rows)
        thread.join()
    assert "gave no answer within 0.4 s" in found


# --- rubbish


@pytest.mark.parametrize(
    ("said", "found"),
    [
        (b"<html>Welcome</html>", "answered <html>Welcome</html>"),
        (b"", "answered nothing"),
        (b"\xff\xfe\x00", "expected: {"),
        (b"[" * 10**5, "expected: {"),
        ([[0.0, 1.0]], "answered [[0.0, 1.0]]"),
        ({"action": [[0, 0]]}, 'answered {"action": [[0, 0]]}'),
        ({"actions": None}, 'answered {"actions": null}'),
        ({"actions": [["1", "2"]]}, 'answered {"actions": [["1", "2"]]}'),
        ({"actions": [[1, 2], [3]]}, 'answered {"actions": [[1, 2], [3]]}'),
        ({"actions": [[1, 2], [3, 4]]}, "answered (3, 5) observations with shape (2, 2)"),
        ({"actions": [[1], [2], [3]]}, "answered (3, 5) observations with shape (3, 1)"),
        ({"actions": [[1, float("nan")]] * 3}, "is not finite on 3 of 3 observations"),
        ({"actions": [[1, 1e300]] * 3}, "is not finite on 3 of 3 observations"),
        (b'{"actions": [[' + b"1, " * 10**5, "answered with more than"),
        ((200, {"Content-Length": 10**12}, b"{"), "answered with more than"),
    ],
)
@pytest.mark.filterwarnings("ignore:overflow")
def test_rubbish_is_shown(said, found, rows):
    with serving(lambda o: said) as served:
        assert found in error_of(fdtasil.load_expert(served.address, 5, 2), rows[:3])
    assert len(served.requests) == 1


def test_a_server_that_does_not_speak_http(rows):
    def talk(server):
        connection, _ = server.accept()
        with connection:
            connection.sendall(b"SSH-2.0-OpenSSH\r\n")
            connection.recv(10**6)

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=talk, args=(server,))
        thread.start()
        address = f"http://127.0.0.1:{server.getsockname()[1]}"
        assert "can't be asked: BadStatusLine" in error_of(fdtasil.load_expert(address), rows)
        thread.join()


def test_https_is_not_taken_from_a_server_without(rows):
    with serving() as served:
        secure = served.address.replace("http:", "https:")
        assert "can't be asked: SSLError" in error_of(fdtasil.load_expert(secure), rows)


@pytest.mark.parametrize("address", ["http://", "http://host:port/", "http://[::1", "http://a b/"])
def test_addresses_that_are_none(address):
    with pytest.raises(ExpertError, match="is no address"):
        fdtasil.load_expert(address)


@pytest.mark.fault(305)
@pytest.mark.parametrize(
    ("address", "step"),
    [
        ("https://huggingface.co/org/repo/blob/main/a/walker.onnx", "write hf://org/repo/a/walk"),
        ("https://hf.co/org/repo/resolve/v1/ppo.zip?download=true", "ppo.zip@v1"),
    ],
)
def test_the_address_of_a_file_is_no_server(address, step):
    fdtasil.load_expert("http://127.0.0.1:8000/models/walker.onnx")  # may be one that answers
    with pytest.raises(ExpertError, match="the address of a file") as caught:
        fdtasil.load_expert(address)
    assert step in str(caught.value)


def test_a_password_is_refused_and_not_shown():
    with pytest.raises(ExpertError, match="holds a password") as caught:
        fdtasil.load_expert("http://me:secret@127.0.0.1/act")
    assert "secret" not in str(caught.value)
    assert fdtasil.load_expert("http://127.0.0.1/act?key=secret").name == "http://127.0.0.1/act"


def test_a_timeout_is_a_number_of_seconds():
    with pytest.raises(SettingError, match="timeout=-1"):
        fdtasil.load_expert("http://127.0.0.1/act", timeout=-1)


@pytest.mark.fault(206)
@pytest.mark.parametrize("null", [None, [None, None], [1.0, None]], ids=str)
def test_null_is_no_answer(null, rows):
    def answer(observations):
        return {"actions": [[0.5, 0.25], null, [0.0, 1.0]]}

    with serving(answer) as served:
        expert = fdtasil.load_expert(served.address, 5, 2)
        answers = expert.ask(rows[:3], "probe")
    assert np.isnan(answers[1]).all()
    assert answers[[0, 2]].tolist() == [[0.5, 0.25], [0.0, 1.0]]
    assert expert.silence.rows == {"probe": 1}
