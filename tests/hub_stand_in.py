"""A hub on this machine: as much of the Hugging Face hub as fetching and sending files takes."""

import base64
import hashlib
import json
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit


@dataclass
class Repository:
    """Commits and the branches that name them; `access` is "public", "gated" or "private".

    Who has the owner's token sees a private one, and may write.
    """

    access: str = "public"
    owner: str | None = None
    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    branches: dict[str, str] = field(default_factory=dict)

    def commit(self, files, branch="main"):
        """Add a commit with these files, and let a branch name it."""
        sha = hashlib.sha1(repr((branch, len(self.commits), sorted(files))).encode()).hexdigest()
        self.commits[sha], self.branches[branch] = dict(files), sha
        return sha

    def find(self, revision):
        """Return the commit that a branch, a commit or the start of one names, or None."""
        named = self.branches.get(revision, revision)
        return next((sha for sha in self.commits if sha.startswith(named)), None)


@dataclass
class Request:
    """What somebody asked for, where, with which token, and at what time."""

    server: str
    path: str
    token: str | None
    at: float


class StandIn:
    """A hub with a store for large files, which it redirects to as the real one does.

    Attributes:
        large: Size from which on a file lies in the store.
        silent: Paths that hold this text get no answer.
        broken: Paths that hold this text are answered with this status.
        spoilt: Whether something on the way replaces what files hold.
        writers: Tokens that may make repositories.
    """

    def __init__(self):
        self.repositories, self.requests = {}, []
        self.large, self.silent, self.broken, self.spoilt = 10**6, None, (None, 0), False
        self.writers: set[str] = set()
        self.closing = threading.Event()
        self._servers = [self._serve("hub"), self._serve("store")]
        self.endpoint, self.store = (f"http://127.0.0.1:{s.server_port}" for s in self._servers)

    def asked(self, server="hub"):
        """Return the paths that were asked for, in order."""
        return [request.path for request in self.requests if request.server == server]

    def close(self):
        """Stop both servers."""
        self.closing.set()
        for server in self._servers:
            server.shutdown()
            server.server_close()

    def _serve(self, name):
        handler = type("Named", (Handler,), {"stand_in": self, "name": name})
        server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        server.daemon_threads = True
        server.block_on_close = False
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        return server


class Handler(BaseHTTPRequestHandler):
    """Answers as the real hub does; the codes are those that huggingface_hub looks for."""

    stand_in: StandIn
    name: str
    protocol_version = "HTTP/1.1"

    def log_message(self, format, *arguments):
        """Be silent."""

    def do_HEAD(self):
        self.do_GET()

    def do_GET(self):
        path = urlsplit(self.path).path
        if self._in_trouble(path):
            return
        if self.name == "store":
            self._send(200, self._stored(path.removeprefix("/")))
        elif path.startswith("/api/models/"):
            repo, _, revision = path.removeprefix("/api/models/").partition("/revision/")
            self._describe(repo, unquote(revision) or "main")
        else:
            repo, _, rest = path.removeprefix("/").partition("/resolve/")
            revision, _, file = rest.partition("/")
            self._resolve(repo, unquote(revision), unquote(file))

    def do_POST(self):
        hub, path = self.stand_in, urlsplit(self.path).path
        body = self.rfile.read(int(self.headers["Content-Length"]))
        if self._in_trouble(path):
            return
        token = (self.headers.get("Authorization") or "").removeprefix("Bearer ")
        if path == "/api/validate-yaml":
            self._answer({"errors": [], "warnings": []})
        elif path == "/api/repos/create":
            asked = json.loads(body)
            name = f"{asked['organization']}/{asked['name']}"
            if token not in hub.writers:
                self._refuse(403)
                return
            hidden = asked.get("visibility") == "private" or asked.get("private")
            hub.repositories[name] = Repository("private" if hidden else "public", token)
            self._answer({"url": f"{hub.endpoint}/{name}"})
        else:
            name, _, step = (
                path.removeprefix("/api/models/").rpartition("/main")[0].rpartition("/")
            )
            if hub.repositories[name].owner != token:
                self._refuse(403)
                return
            self._take(name, step, body)

    def _take(self, name, step, body):
        """Say that every file comes in the commit itself, or take that commit."""
        if step == "preupload":
            files = [file["path"] for file in json.loads(body)["files"]]
            modes = {"uploadMode": "regular", "shouldIgnore": False}
            self._answer({"files": [{"path": path, **modes} for path in files]})
            return
        lines = [json.loads(line) for line in body.splitlines()]
        files = {
            line["value"]["path"]: base64.b64decode(line["value"]["content"])
            for line in lines
            if line["key"] == "file"
        }
        gone = {line["value"]["path"] for line in lines if line["key"] == "deletedFile"}
        repository = self.stand_in.repositories[name]
        before = repository.commits.get(repository.branches.get("main"), {})
        kept = {path: data for path, data in before.items() if path not in gone}
        sha = repository.commit({**kept, **files})
        self._answer({"commitUrl": f"{self.stand_in.endpoint}/{name}", "commitOid": sha})

    def _in_trouble(self, path):
        """Note a request, and whether nothing but trouble comes of it."""
        hub, token = self.stand_in, self.headers.get("Authorization")
        hub.requests.append(Request(self.name, unquote(path), token, time.monotonic()))
        if hub.silent is not None and hub.silent in path:
            hub.closing.wait(60)
            self.close_connection = True
            return True
        if hub.broken[0] is not None and hub.broken[0] in path:
            self._refuse(hub.broken[1])
            return True
        return False

    def _answer(self, said):
        self._send(200, json.dumps(said).encode())

    def _describe(self, name, revision):
        repository = self._open(name)
        if repository is None:
            return
        sha = repository.find(revision)
        if sha is None:
            self._refuse(404, "RevisionNotFound")
            return
        siblings = [self._sibling(*item) for item in sorted(repository.commits[sha].items())]
        answer = {"id": name, "modelId": name, "sha": sha, "siblings": siblings}
        answer["private"] = repository.access == "private"
        self._send(200, json.dumps(answer).encode())

    def _sibling(self, name, data):
        blob = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
        described = {"rfilename": name, "size": len(data), "blobId": blob}
        if len(data) < self.stand_in.large:
            return described
        digest = hashlib.sha256(data).hexdigest()
        return described | {"lfs": {"sha256": digest, "size": len(data), "pointerSize": 130}}

    def _resolve(self, name, revision, file):
        repository = self._open(name)
        if repository is None:
            return
        if repository.access == "gated" and not self.headers.get("Authorization"):
            self._refuse(401, "GatedRepo")
            return
        if repository.access == "gated":
            self._refuse(403, "GatedRepo")
            return
        sha = repository.find(revision)
        if sha is None:
            self._refuse(404, "RevisionNotFound")
            return
        if file not in repository.commits[sha]:
            self._refuse(404, "EntryNotFound", {"X-Repo-Commit": sha})
            return
        data = repository.commits[sha][file]
        if self.stand_in.spoilt:
            data = b"<html>log in to the airport</html>"
        if len(data) < self.stand_in.large:
            blob = self._sibling(file, data)["blobId"]
            self._send(200, data, {"X-Repo-Commit": sha, "ETag": f'"{blob}"'})
            return
        digest = hashlib.sha256(data).hexdigest()
        headers = {"X-Repo-Commit": sha, "X-Linked-Etag": f'"{digest}"'}
        headers |= {"X-Linked-Size": str(len(data))}
        self._send(302, b"", {**headers, "Location": f"{self.stand_in.store}/{digest}"})

    def _open(self, name):
        """Return a repository that may be listed; who has no token learns no more than that."""
        repository = self.stand_in.repositories.get(name)
        token = (self.headers.get("Authorization") or "").removeprefix("Bearer ")
        if repository is not None and (
            repository.access != "private" or repository.owner == token
        ):
            return repository
        if self.headers.get("Authorization"):
            self._refuse(404, "RepoNotFound")
        else:
            self._refuse(401)
        return None

    def _stored(self, digest):
        everything = (
            data
            for repository in self.stand_in.repositories.values()
            for files in repository.commits.values()
            for data in files.values()
        )
        return next(d for d in everything if hashlib.sha256(d).hexdigest() == digest)

    def _refuse(self, status, code=None, headers=()):
        named = {"X-Error-Code": code} if code else {}
        self._send(status, b'{"error": "refused"}', {**named, **dict(headers)})

    def _send(self, status, data, headers=()):
        self.send_response(status)
        for name, value in dict(headers).items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)


@contextmanager
def stand_in():
    """Run a hub for the length of a block."""
    hub = StandIn()
    try:
        yield hub
    finally:
        hub.close()
