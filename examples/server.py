"""An expert behind HTTP: the address is all that is known of it."""

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np

import fdtasil


class Controller(BaseHTTPRequestHandler):
    """Answers {"observations": [[...], ...]} with {"actions": [[...], ...]}."""

    def do_POST(self):
        rows = json.loads(self.rfile.read(int(self.headers["Content-Length"])))["observations"]
        cosine, sine, speed = np.array(rows).T
        actions = np.clip(-8 * np.arctan2(sine, cosine) - 2 * speed, -2, 2)[:, None]
        body = json.dumps({"actions": actions.tolist()}).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass


if __name__ == "__main__":
    server = ThreadingHTTPServer(("127.0.0.1", 0), Controller)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}/act"
    result = fdtasil.distill(address, "Pendulum-v1", probes=5, episodes=2, horizon=100)
    print(result.evaluation)
    print(result.queries)  # what it cost the server
    server.shutdown()
