"""Damaged joint logs are refused with a typed error, or read; nothing else escapes."""

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from aomgen.capture.joint_log import read_joint_log
from aomgen.errors import AomgenError

ROWS = "".join(f"{0.02 * k:.3f},{np.sin(k / 20):.5f},{k / 60:.4f}\n" for k in range(60))
# Pieces that other programs leave in tables.
PIECES = (
    b'"',
    b",",
    b";",
    b"\n",
    b"\r",
    b"\t",
    b"#",
    b"nan",
    b"1e999",
    b"\xff\xfe",
    b"\x00",
    b"time_s",
    b"2026-11-26",
    b"-",
)


@pytest.mark.parametrize("seed", range(20))
def test_damaged_logs(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = tmp_path / "joints.csv"
    for _ in range(100):
        data = bytearray(f"time_s,elbow,gripper\n{ROWS}".encode())
        for _ in range(rng.integers(1, 6)):
            at = int(rng.integers(0, len(data)))
            data[at : at + int(rng.integers(0, 40))] = PIECES[rng.integers(len(PIECES))] * int(
                rng.integers(1, 4)
            )
        path.write_bytes(data)
        with suppress(AomgenError):
            log, _ = read_joint_log(path, ["elbow"], "gripper")
            assert (np.diff(log.times_s) > 0).all()
            assert np.isfinite(log.joints).all()
            assert ((log.gripper >= 0) & (log.gripper <= 1)).all()
