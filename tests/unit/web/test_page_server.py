import json
import threading
import urllib.request
from collections.abc import Iterator
from urllib.error import HTTPError

import numpy as np
import pytest

from aomgen.errors import ConfigError, MissingFileError
from aomgen.web.page_server import PageRequest, PageServer, RequestFields, Response, send_jpeg, send_json


class Number(RequestFields):
    """A request with one number."""

    number: int


def double(request: PageRequest) -> Response:
    return send_json({"double": 2 * request.parse(Number).number})


def miss(request: PageRequest) -> Response:
    raise MissingFileError("run", "has vanished", "make it again")


def break_off(request: PageRequest) -> Response:
    raise KeyError("unexpected")


def read_vanished(request: PageRequest) -> Response:
    raise FileNotFoundError(2, "No such file or directory", "episode.npz")


def stay_grey(request: PageRequest) -> Response:
    return send_jpeg(np.full((4, 6, 3), 128, np.uint8))


@pytest.fixture
def server() -> Iterator[PageServer]:
    routes = {
        "GET /double": double,
        "POST /double": double,
        "GET /miss": miss,
        "GET /break": break_off,
        "GET /vanished": read_vanished,
        "GET /grey": stay_grey,
    }
    with PageServer(routes, 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.stop()
        thread.join()


def ask(server, path, body=None, **headers):
    data = None if body is None else json.dumps(body).encode()
    headers = ({"Content-Type": "application/json"} if body is not None else {}) | headers
    with urllib.request.urlopen(urllib.request.Request(server.url + path, data, headers)) as answer:
        return answer.read()


def refuse(server, path, body=None, **headers):
    with pytest.raises(HTTPError) as caught:
        ask(server, path, body, **headers)
    return caught.value.code, json.loads(caught.value.read())["error"]


def test_query_and_body_are_parsed_alike(server):
    assert json.loads(ask(server, "double?number=4")) == {"double": 8}
    assert json.loads(ask(server, "double", {"number": 4})) == {"double": 8}
    assert refuse(server, "double?number=four")[0] == 400
    assert refuse(server, "double?number=4&file=x")[0] == 400
    assert ask(server, "grey").startswith(b"\xff\xd8")


def test_foreign_pages_are_refused(server):
    assert refuse(server, "grey", Host="evil.example:80")[0] == 403
    assert refuse(server, "double", {"number": 4}, Origin="http://evil.example")[0] == 403
    assert refuse(server, "double", {"number": 4}, **{"Content-Type": "text/plain"})[0] == 415
    assert refuse(server, "../../../etc/passwd")[0] == 404
    assert ask(server, "double", {"number": 4}, Origin=server.url.rstrip("/"))


def test_an_error_is_one_sentence_and_the_server_stays_up(server, monkeypatch):
    reported = threading.Event()
    monkeypatch.setattr(server, "handle_error", lambda *_: reported.set())
    assert refuse(server, "miss") == (400, "run: has vanished; make it again")
    assert refuse(server, "vanished") == (500, "episode.npz: No such file or directory")
    assert "bug" in refuse(server, "break")[1]
    assert reported.wait(5)
    assert ask(server, "double?number=1")


def test_taken_port_is_named(server):
    with pytest.raises(ConfigError, match=str(server.server_port)):
        PageServer({}, server.server_port)
