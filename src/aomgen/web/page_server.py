"""Pages on 127.0.0.1 for one person: each path has a function that turns a request into a response."""

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
# Longest request that is read, [bytes]: some hundred prompts of some hundred points.
MAX_REQUEST: Final = 4_000_000
# A person looks at edges of parts, which a lower quality blurs.
JPEG_QUALITY: Final = 92
TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
}


class RequestFields(BaseModel):
    """Base class of what a page sends; unknown fields are refused."""

    model_config = ConfigDict(extra="forbid")


Fields = TypeVar("Fields", bound=RequestFields)


@dataclass(frozen=True, slots=True)
class Response:
    """Content of a response and its media type."""

    kind: str
    content: bytes


@dataclass(frozen=True, slots=True)
class PageRequest:
    """PageRequest of a page.

    Attributes:
        query: Values of the address, `?name=value`.
        body: JSON of a POST request; empty for GET.
    """

    query: Mapping[str, str]
    body: bytes

    def parse(self, kind: type[Fields]) -> Fields:
        """Check the body of a POST request, or the query of a GET request.

        Raises:
            ValidationError: A field is unknown, missing, or has another type.
        """
        return kind.model_validate_json(self.body) if self.body else kind.model_validate(self.query)


Route = Callable[[PageRequest], Response]


class PageServer(ThreadingHTTPServer):
    """Serves routes until `stop`; use as a context manager.

    An error of a route, for example a file that has vanished, becomes one sentence, `{"error": ...}`; the other routes
    stay up.
    """

    daemon_threads = True

    def __init__(self, routes: Mapping[str, Route], port: int) -> None:
        """Bind to 127.0.0.1.

        Args:
            routes: Functions by method and path, for example "GET /api/state".
            port: 0 takes a free one.

        Raises:
            ConfigError: The port is taken.
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
        """Address of the first page."""
        return f"http://{HOST}:{self.server_port}/"

    def stop(self) -> None:
        """End `serve_forever`; a route may call it."""
        # In another thread, because the one that serves would wait for itself.
        threading.Thread(target=self.shutdown).start()


def send_json(value: Mapping[str, Any]) -> Response:
    """Make a JSON response; NaN and infinite numbers are refused."""
    return Response("application/json", json.dumps(value, allow_nan=False).encode())


def send_jpeg(image_srgb: NDArray[np.uint8], quality: int = JPEG_QUALITY) -> Response:
    """Make a response of an image (H, W, 3), sRGB."""
    return Response("image/jpeg", encode_jpeg(image_srgb, quality, halve_colors=False))


def send_file(package: str, name: str) -> Route:
    """Make a route that sends a file of a package, for example a page."""
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
        """Print nothing: the terminal shows what the person needs."""

    def _answer(self) -> None:
        """Send what a route produces, or its error as one sentence."""
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
        # A page of another site may resolve its host name to this server, but cannot send this host name.
        host = self.headers.get("Host", "")
        origin = self.headers.get("Origin", f"http://{host}")
        if host.rpartition(":")[0] not in (HOST, "localhost") or origin != f"http://{host}":
            raise _RefusedError(HTTPStatus.FORBIDDEN, f"open {self.server.url}")
        address = urlsplit(self.path)
        route = self.server.routes.get(f"{self.command} {address.path}")
        if route is None:
            raise _RefusedError(HTTPStatus.NOT_FOUND, "there is no such page")
        # A form of another site cannot send this type without asking first.
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
    """A request that no route sees."""

    def __init__(self, status: HTTPStatus, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status
