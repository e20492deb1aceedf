"""HTTP server on 127.0.0.1 for a single user, in which a function computes the response to the requests of each path."""

import importlib.resources
import json
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final, TypeVar
from urllib.parse import parse_qsl, urlsplit

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from aomgen.errors import AomgenError, ConfigError
from aomgen.io.images import encode_jpeg

HOST: Final = "127.0.0.1"
# Longest request that is read, [bytes]; it suffices for hundreds of prompts with hundreds of points.
MAX_REQUEST: Final = 4_000_000
# JPEG quality of images in which users inspect the edges of parts, which a lower quality would blur.
JPEG_QUALITY: Final = 92
TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
}


class RequestFields(BaseModel):
    """Base class of the fields of a request; unknown fields are refused."""

    model_config = ConfigDict(extra="forbid")


Fields = TypeVar("Fields", bound=RequestFields)


@dataclass(frozen=True, slots=True)
class Response:
    """Response to a request.

    Attributes:
        kind: Media type.
        content: Body.
    """

    kind: str
    content: bytes


@dataclass(frozen=True, slots=True)
class PageRequest:
    """Request of a page.

    Attributes:
        query: Parameters of the URL, `?name=value`.
        body: JSON of a POST request; empty for GET.
    """

    query: Mapping[str, str]
    body: bytes

    def parse(self, kind: type[Fields]) -> Fields:
        """Parse and validate the body of a POST request, or the query of a GET request.

        Raises:
            ValidationError: A field is unknown, missing, or has another type.
        """
        return kind.model_validate_json(self.body) if self.body else kind.model_validate(self.query)


Route = Callable[[PageRequest], Response]


class PageServer(ThreadingHTTPServer):
    """HTTP server for routes, which is used as a context manager and ended by `stop`.

    An error of a route, for example a missing file, results in a response `{"error": ...}` with one sentence; the server
    continues to run.
    """

    daemon_threads = True

    def __init__(self, routes: Mapping[str, Route], port: int) -> None:
        """Bind the server to 127.0.0.1.

        Args:
            routes: Functions by method and path, for example "GET /api/state".
            port: Port number; 0 selects a free port.

        Raises:
            ConfigError: The port cannot be used, for example because another program uses it.
        """
        self.routes = dict(routes)
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            raise ConfigError(
                "--port", f"{port} cannot be used ({error.strerror})", "choose another port"
            ) from error

    @property
    def url(self) -> str:
        """URL of the root page."""
        return f"http://{HOST}:{self.server_port}/"

    def stop(self) -> None:
        """End `serve_forever`; routes may call this method."""
        # The serving thread would wait for itself, so another thread ends it.
        threading.Thread(target=self.shutdown).start()


def send_json(value: Mapping[str, Any]) -> Response:
    """Create a JSON response.

    Raises:
        ValueError: A number is NaN or infinite.
    """
    return Response("application/json", json.dumps(value, allow_nan=False).encode())


def send_jpeg(image_srgb: NDArray[np.uint8]) -> Response:
    """Create a JPEG response from an image (H, W, 3) uint8, sRGB."""
    return Response("image/jpeg", encode_jpeg(image_srgb, JPEG_QUALITY, halve_colors=False))


def send_file(package: str, name: str) -> Route:
    """Create a route that sends a file of a Python package, for example a page."""
    file = importlib.resources.files(package) / name
    kind = TYPES[name[name.rindex(".") :]]
    return lambda request: Response(kind, file.read_bytes())


class _Handler(BaseHTTPRequestHandler):
    server: PageServer

    def do_GET(self) -> None:
        self._answer()

    def do_POST(self) -> None:
        self._answer()

    def log_message(self, format: str, *args: Any) -> None:
        """Suppress the log of requests, so that the terminal shows only messages for the user."""

    def _answer(self) -> None:
        """Send the response of a route, or its error as one sentence."""
        try:
            self._send(HTTPStatus.OK, self._produce())
        except ConnectionError:
            # The page has dropped the request because a later one replaced it.
            self.close_connection = True
        except _RefusedError as error:
            self._send_error(error.status, str(error))
        except AomgenError as error:
            self._send_error(HTTPStatus.BAD_REQUEST, str(error))
        except (ValidationError, ValueError, IndexError) as error:
            first = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
            self._send_error(HTTPStatus.BAD_REQUEST, f"the request is invalid: {first}")
        except OSError as error:
            self._send_error(HTTPStatus.INTERNAL_SERVER_ERROR, f"{error.filename}: {error.strerror}")
        except Exception:
            sentence = "this is a bug of AOMGen; the terminal shows where it happened"
            self._send_error(HTTPStatus.INTERNAL_SERVER_ERROR, sentence)
            raise

    def _send_error(self, status: HTTPStatus, sentence: str) -> None:
        self._send(status, send_json({"error": sentence}))

    def _send(self, status: HTTPStatus, response: Response) -> None:
        self.send_response(status)
        self.send_header("Content-Type", response.kind)
        self.send_header("Content-Length", str(len(response.content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(response.content)

    def _produce(self) -> Response:
        # Another site may let its host name resolve to this server (DNS rebinding); its requests then contain that host name.
        host = self.headers.get("Host", "")
        origin = self.headers.get("Origin", f"http://{host}")
        if host.rpartition(":")[0] not in (HOST, "localhost") or origin != f"http://{host}":
            raise _RefusedError(HTTPStatus.FORBIDDEN, f"open {self.server.url}")
        address = urlsplit(self.path)
        route = self.server.routes.get(f"{self.command} {address.path}")
        if route is None:
            raise _RefusedError(HTTPStatus.NOT_FOUND, "there is no such page")
        # A page of another site cannot send this content type without a preflight request, which this server refuses.
        if self.command == "POST" and self.headers.get_content_type() != "application/json":
            raise _RefusedError(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "the request is not JSON")
        body = self._read() if self.command == "POST" else b""
        return route(PageRequest(dict(parse_qsl(address.query)), body))

    def _read(self) -> bytes:
        length = int(self.headers.get("Content-Length", 0))
        if not 0 < length <= MAX_REQUEST:
            raise ValueError(f"it has {length} bytes, expected 1 to {MAX_REQUEST}")
        return self.rfile.read(length)


class _RefusedError(Exception):
    """A request is refused before it reaches a route."""

    def __init__(self, status: HTTPStatus, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status
