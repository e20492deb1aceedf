"""Clients of the policy servers of openpi and OpenVLA, with checks of the replies.

openpi's `scripts/serve_policy.py` is a websocket server. It sends the metadata of its policy, then a response to every
observation. Messages are msgpack; an array is a map of its bytes, dtype and shape. OpenVLA's and OpenVLA-OFT's
`vla-scripts/deploy.py` responds to POST /act. Messages are JSON; an array is an object with its bytes in base64
(json-numpy).

Source: the files named, of openpi 15a9616, openvla c8f03f4 and openvla-oft 213c5ff.
"""

import base64
import http.client
import json
import math
import weakref
from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.errors import BackendError, PolicyServerError
from aomgen.ray_cluster import CONNECT_S

# Time limit of a response, [s]; a server compiles its model before the first one.
ANSWER_S: Final = 300.0
# Largest accepted message, [bytes]; a chunk of actions takes some kilobytes.
MAX_ANSWER: Final = 1 << 20
# Kinds of numeric dtypes.
NUMBERS: Final = "fiub"


def read_array(data: Any, dtype: Any, shape: Any) -> NDArray[Any]:
    """Decode a numeric array from its bytes.

    Raises:
        ValueError: The data are not numeric, or their size differs from that of the shape.
        TypeError: An argument is of another type.
    """
    kind = np.dtype(dtype)
    if kind.kind not in NUMBERS:
        raise ValueError(f"an array of {kind} is not numeric")
    if math.prod(shape) * kind.itemsize != len(data):
        raise ValueError(f"an array of shape {tuple(shape)} and {kind} has {len(data)} bytes")
    return np.frombuffer(data, kind).reshape(shape)


class OpenpiServer:
    """Connection to openpi's server.

    Args:
        address: HOST:PORT.

    Attributes:
        metadata: Metadata of the server, `policy_metadata` in the training config.

    Raises:
        BackendError: The libraries are not installed.
        PolicyServerError: The server is unreachable, or is not an openpi server.
    """

    def __init__(self, address: str) -> None:
        try:
            import msgpack
            from websockets.exceptions import WebSocketException
            from websockets.sync.client import connect
        except ImportError as error:
            raise BackendError(
                f"openpi://{address}", f"{error.name} is not installed", "pip install 'aomgen[remote]'"
            ) from error
        self._where, self._msgpack, self._failures = (
            f"openpi://{address}",
            msgpack,
            (WebSocketException, OSError),
        )
        stack = ExitStack()
        # Otherwise the thread of the connection keeps it open.
        weakref.finalize(self, stack.close)
        try:
            # During inference the server does not respond to pings.
            self._connection = stack.enter_context(
                connect(
                    f"ws://{address}",
                    compression=None,
                    open_timeout=CONNECT_S,
                    ping_interval=None,
                    max_size=MAX_ANSWER,
                    proxy=None,
                )
            )
        except self._failures as error:
            raise _away(self._where, error) from error
        self.metadata = self._receive()

    def infer(self, observation: Mapping[str, Any]) -> dict[Any, Any]:
        """Return the response to an observation, whose arrays may be nested.

        Raises:
            PolicyServerError: The server is unreachable, failed, or sent an invalid reply.
        """
        try:
            self._connection.send(self._msgpack.packb(observation, default=_pack))
        except self._failures as error:
            raise _away(self._where, error) from error
        return self._receive()

    def _receive(self) -> dict[Any, Any]:
        try:
            message = self._connection.recv(timeout=ANSWER_S)
        except self._failures as error:
            raise _away(self._where, error) from error
        if isinstance(message, str):
            raise PolicyServerError(self._where, f"failed: {_last_line(message)}", "see its log")
        try:
            content = self._msgpack.unpackb(message, object_hook=_unpack)
        except (ValueError, TypeError, KeyError, self._msgpack.UnpackException) as error:
            raise _no_answer(self._where, "msgpack", error) from error
        if not isinstance(content, dict):
            raise _no_answer(self._where, "a map", TypeError(type(content).__name__))
        return content


def _pack(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _unpack(content: dict[Any, Any]) -> Any:
    if b"__ndarray__" in content:
        return read_array(content[b"data"], content[b"dtype"], content[b"shape"])
    return content[b"data"] if b"__npgeneric__" in content else content


class OpenvlaServer:
    """Client of OpenVLA's server.

    Args:
        address: HOST:PORT.

    Raises:
        PolicyServerError: The server is unreachable.
    """

    def __init__(self, address: str) -> None:
        self._where, self._address = f"openvla://{address}", address
        connection = http.client.HTTPConnection(address, timeout=CONNECT_S)
        try:
            connection.connect()
        except OSError as error:
            raise _away(self._where, error) from error
        finally:
            connection.close()

    def act(self, payload: Mapping[str, Any]) -> Any:
        """Return the response to a payload: arrays, numbers and lists of them.

        Raises:
            PolicyServerError: The server is unreachable, failed, or sent an invalid reply.
        """
        connection = http.client.HTTPConnection(self._address, timeout=ANSWER_S)
        try:
            body = json.dumps(payload, default=_encode)
            connection.request("POST", "/act", body, {"Content-Type": "application/json"})
            answer = connection.getresponse()
            status, text = answer.status, answer.read(MAX_ANSWER)
        except (OSError, http.client.HTTPException) as error:
            raise _away(self._where, error) from error
        finally:
            connection.close()
        if status != http.client.OK:
            raise PolicyServerError(
                self._where, f"replied with HTTP {status} to POST /act", "start deploy.py there"
            )
        try:
            content = json.loads(text, object_hook=_decode)
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise _no_answer(self._where, "JSON", error) from error
        if isinstance(content, str):
            raise PolicyServerError(
                self._where, f"failed with the message '{_last_line(content)}'", "see its log"
            )
        return content


def _encode(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        data = base64.b64encode(value.tobytes()).decode()
        return {"__numpy__": data, "dtype": value.dtype.str, "shape": value.shape}
    raise TypeError(f"{type(value).__name__} cannot be sent")


def _decode(content: dict[str, Any]) -> Any:
    if "__numpy__" in content:
        data = base64.b64decode(content["__numpy__"], validate=True)
        return read_array(data, content["dtype"], content["shape"])
    return content


def _away(where: str, error: Exception) -> PolicyServerError:
    reason = _last_line(str(error)) or type(error).__name__
    return PolicyServerError(where, f"does not reply ({reason})", "start the server, see docs/vla.md")


def _no_answer(where: str, want: str, error: Exception) -> PolicyServerError:
    reason = _last_line(str(error)) or type(error).__name__
    return PolicyServerError(where, f"sent a reply that is not {want} ({reason})", "is it another server?")


def _last_line(text: str) -> str:
    """Return the last line of a traceback, which names the error."""
    return (text.strip().splitlines() or [""])[-1][:200]
