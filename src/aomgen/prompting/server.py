"""A page on 127.0.0.1 on which a person marks the parts of a capture."""

import base64
import importlib.resources
import json
import threading
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final

from pydantic import BaseModel, ConfigDict, ValidationError

from aomgen.capture.capture_schema import Four, PromptSection
from aomgen.errors import AomgenError, ConfigError
from aomgen.io.images import encode_jpeg, encode_png
from aomgen.prompting.session import PromptSession, box_of_mask, find_missing

HOST: Final = "127.0.0.1"
# Longest request that is read, [bytes]: some hundred prompts of some hundred points.
MAX_REQUEST = 4_000_000
# A person looks at edges of parts, which a lower quality blurs.
JPEG_QUALITY = 92


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid")


class MaskRequest(_Request):
    """Points and box of the prompt whose mask is requested."""

    image: int
    part: str
    points: list[list[float]] = []
    box: Four | None = None


class SaveRequest(_Request):
    """All prompts of a capture, and what a person states about it."""

    prompts: list[PromptSection]
    category: str
    instruction: str


class PromptServer(ThreadingHTTPServer):
    """Serves one session until a person presses "Done"; use as a context manager."""

    daemon_threads = True

    def __init__(self, session: PromptSession, port: int) -> None:
        """Bind to 127.0.0.1; port 0 takes a free one.

        Raises:
            ConfigError: The port is taken.
        """
        self.session = session
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            raise ConfigError(
                "--port", f"{port} cannot be used ({error.strerror})", "choose another port"
            ) from error

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self.server_port}/"


class _Handler(BaseHTTPRequestHandler):
    server: PromptServer

    def do_GET(self) -> None:
        routes: dict[str, Callable[[], tuple[str, bytes]]] = {
            "/": self._get_page,
            "/api/state": self._get_state,
        }
        if self.path.startswith("/api/image/"):
            self._answer(self._get_image)
        elif self.path in routes:
            self._answer(routes[self.path])
        else:
            self._send(HTTPStatus.NOT_FOUND, *_to_json({"error": "there is no such page"}))

    def do_POST(self) -> None:
        routes = {"/api/mask": self._post_mask, "/api/save": self._post_save, "/api/done": self._post_done}
        if self.path not in routes:
            self._send(HTTPStatus.NOT_FOUND, *_to_json({"error": "there is no such page"}))
        # A form of another site cannot send this type without asking first.
        elif self.headers.get_content_type() != "application/json":
            self._send(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, *_to_json({"error": "the request is not JSON"}))
        else:
            self._answer(routes[self.path])

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing: the terminal shows what the person needs."""

    def _answer(self, produce: Callable[[], tuple[str, bytes]]) -> None:
        """Send what a route produces, or its error as one sentence."""
        # A page of another site may resolve its host name to this server, but cannot send this host name.
        if self.headers.get("Host", "").rpartition(":")[0] not in (HOST, "localhost"):
            self._send(HTTPStatus.FORBIDDEN, *_to_json({"error": f"open {self.server.url}"}))
            return
        try:
            self._send(HTTPStatus.OK, *produce())
        except AomgenError as error:
            self._send(HTTPStatus.BAD_REQUEST, *_to_json({"error": str(error)}))
        except (ValidationError, ValueError, IndexError) as error:
            first = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
            self._send(HTTPStatus.BAD_REQUEST, *_to_json({"error": f"the request is invalid: {first}"}))
        except OSError as error:
            problem = {"error": f"{error.filename}: {error.strerror}"}
            self._send(HTTPStatus.INTERNAL_SERVER_ERROR, *_to_json(problem))

    def _send(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)

    def _read(self) -> bytes:
        length = int(self.headers.get("Content-Length", 0))
        if not 0 < length <= MAX_REQUEST:
            raise ValueError(f"it has {length} bytes, want 1 to {MAX_REQUEST}")
        return self.rfile.read(length)

    def _get_page(self) -> tuple[str, bytes]:
        page = importlib.resources.files("aomgen.prompting") / "page.html"
        return "text/html; charset=utf-8", page.read_bytes()

    def _get_state(self) -> tuple[str, bytes]:
        return _to_json(self.server.session.describe())

    def _get_image(self) -> tuple[str, bytes]:
        index = _check_index(int(self.path.rpartition("/")[2]), self.server.session)
        return "image/jpeg", encode_jpeg(
            self.server.session.images.read(index), JPEG_QUALITY, halve_colors=False
        )

    def _post_mask(self) -> tuple[str, bytes]:
        request = MaskRequest.model_validate_json(self._read())
        session = self.server.session
        index = _check_index(request.image, session)
        mask = session.segment(index, request.part, request.points, request.box or [])
        if mask is None:
            return _to_json({"mask": "", "box": []})
        png = base64.b64encode(encode_png(mask.astype("uint8") * 255)).decode()
        return _to_json({"mask": png, "box": box_of_mask(mask)})

    def _post_save(self) -> tuple[str, bytes]:
        request = SaveRequest.model_validate_json(self._read())
        self.server.session.save(request.prompts, request.model_dump(include={"category", "instruction"}))
        return _to_json({"missing": find_missing(request.prompts)})

    def _post_done(self) -> tuple[str, bytes]:
        # Not here, where it would wait for this very request.
        threading.Thread(target=self.server.shutdown).start()
        return _to_json({})


def _to_json(value: dict[str, Any]) -> tuple[str, bytes]:
    return "application/json", json.dumps(value).encode()


def _check_index(index: int, session: PromptSession) -> int:
    if not 0 <= index < len(session.images.names):
        raise IndexError(f"the scan has no image {index}")
    return index
