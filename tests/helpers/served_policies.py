"""Policy servers on this computer with the protocols of openpi and OpenVLA, written from their public descriptions.

Nothing of the clients is used: arrays are written and read here as `openpi_client.msgpack_numpy` 0.1.2 and `json_numpy`
2.1.1 do. A server keeps what it was asked in `asked`.
"""

import base64
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Event, Thread
from typing import Any

import msgpack
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import serve

OPENPI = {"action_space": "joint", "cameras": ["front"]}


@dataclass
class Served:
    """A running server: HOST:PORT, the received requests, and whether a client has disconnected."""

    address: str = ""
    asked: list[Any] = field(default_factory=list)
    left: Event = field(default_factory=Event)


def msgpack_array(array: np.ndarray) -> dict[bytes, Any]:
    return {
        b"__ndarray__": True,
        b"data": array.tobytes(),
        b"dtype": array.dtype.str,
        b"shape": list(array.shape),
    }


def json_array(array: np.ndarray) -> dict[str, Any]:
    data = base64.b64encode(array.tobytes()).decode()
    return {"__numpy__": data, "dtype": array.dtype.str, "shape": list(array.shape)}


def read_map(content: dict[Any, Any]) -> Any:
    """Decode arrays of either kind; return other values unchanged."""
    if b"__ndarray__" in content:
        return np.frombuffer(content[b"data"], content[b"dtype"]).reshape(content[b"shape"])
    if "__numpy__" in content:
        data = base64.b64decode(content["__numpy__"])
        return np.frombuffer(data, content["dtype"]).reshape(content["shape"])
    return content


@contextmanager
def _serving(server: Any) -> Iterator[None]:
    """Serve on a thread while the block runs."""
    thread = Thread(target=server.serve_forever)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        thread.join()


@contextmanager
def openpi_server(answer: Callable[[dict[str, Any]], Any], metadata: Any = None) -> Iterator[Served]:
    """Serve packed replies, except for bytes (sent unchanged), a str (sent as traceback; it closes) and None (it closes)."""
    served = Served()

    def handle(connection: Any) -> None:
        first = OPENPI if metadata is None else metadata
        connection.send(first if isinstance(first, bytes) else msgpack.packb(first))
        try:
            for message in connection:
                served.asked.append(msgpack.unpackb(message, object_hook=read_map))
                said = answer(served.asked[-1])
                if said is None:
                    return
                connection.send(said if isinstance(said, bytes | str) else msgpack.packb(said))
                if isinstance(said, str):
                    return
        except ConnectionClosed:
            pass
        finally:
            served.left.set()

    with serve(handle, "127.0.0.1", 0, compression=None, max_size=None) as server:
        served.address = f"127.0.0.1:{server.socket.getsockname()[1]}"
        with _serving(server):
            yield served


@contextmanager
def openvla_server(answer: Callable[[dict[str, Any]], Any]) -> Iterator[Served]:
    """Serve replies as JSON, except for bytes (sent unchanged) and integers (a status without content)."""
    served = Served()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            served.asked.append(json.loads(body, object_hook=read_map))
            said = answer(served.asked[-1]) if self.path == "/act" else 404
            status = said if isinstance(said, int) else 200
            content = said if isinstance(said, bytes) else json.dumps(said).encode()
            self.send_response(status)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: Any) -> None: ...

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        served.address = f"127.0.0.1:{server.server_address[1]}"
        with _serving(server):
            yield served
