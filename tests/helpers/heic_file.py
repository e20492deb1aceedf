"""HEIC files for tests: HEVC of FFmpeg in the boxes of ISO/IEC 23008-12."""

import io
import struct

import av
import numpy as np


def heic_bytes(image: np.ndarray, *, quarter_turns: int = 0) -> bytes:
    """Encode an image (H, W, 3) uint8 as a HEIC file that viewers rotate counterclockwise."""
    config, data = _encode(image)
    height, width = image.shape[:2]
    hdlr = _full("hdlr", 0, 0, struct.pack(">I4s12xB", 0, b"pict", 0))
    pitm = _full("pitm", 0, 0, struct.pack(">H", 1))
    infe = _full("infe", 2, 0, struct.pack(">HH4sB", 1, 0, b"hvc1", 0))
    iinf = _full("iinf", 0, 0, struct.pack(">H", 1) + infe)
    ispe = _full("ispe", 0, 0, struct.pack(">II", width, height))
    # Limited range, matrix of BT.601, as FFmpeg converts.
    colr = _box("colr", b"nclx" + struct.pack(">HHHB", 1, 13, 6, 0))
    irot = _box("irot", struct.pack(">B", quarter_turns))
    ipco = _box("ipco", _box("hvcC", config) + ispe + colr + irot)
    ipma = _full("ipma", 0, 0, struct.pack(">IHB4B", 1, 1, 4, 0x81, 2, 3, 0x84))
    iprp = _box("iprp", ipco + ipma)
    ftyp = _box("ftyp", b"heic" + struct.pack(">I", 0) + b"mif1heic")

    def meta(offset: int) -> bytes:
        iloc = struct.pack(">BBHHHHII", 0x44, 0, 1, 1, 0, 1, offset, len(data))
        return _full("meta", 0, 0, hdlr + pitm + _full("iloc", 0, 0, iloc) + iinf + iprp)

    offset = len(ftyp) + len(meta(0)) + 8
    return ftyp + meta(offset) + _box("mdat", data)


def _encode(image: np.ndarray) -> tuple[bytes, bytes]:
    """Encode one HEVC frame; return the decoder configuration and the frame."""
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream("libx265", rate=1)
        stream.height, stream.width = image.shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.options = {
            "crf": "8",
            "x265-params": "log-level=none:bframes=0:keyint=1:rc-lookahead=0:frame-threads=1:pools=1",
        }
        frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format="yuv420p")
        frame.pts = 0
        packets = [*stream.encode(frame), *stream.encode(None)]
        container.mux([packet for packet in packets if packet.size])
    buffer.seek(0)
    with av.open(buffer) as container:
        stream = container.streams.video[0]
        packet = next(packet for packet in container.demux(stream) if packet.size)
        return bytes(stream.codec_context.extradata), bytes(packet)


def _box(kind: str, content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(content), kind.encode()) + content


def _full(kind: str, version: int, flags: int, content: bytes) -> bytes:
    return _box(kind, struct.pack(">I", version << 24 | flags) + content)
