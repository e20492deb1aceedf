"""`aomgen import scan`: convert a scan of a phone or another program to the scan of a capture."""

from pathlib import Path
from typing import Annotated

import typer


def scan(
    source: Annotated[
        Path,
        typer.Argument(
            help="A folder of photos (JPEG, PNG, HEIC), a video, a COLMAP model, a transforms.json of nerfstudio or "
            "instant-ngp, or an export of Polycam (raw) or Record3D. The type is detected from the content."
        ),
    ],
    capture: Annotated[
        Path, typer.Argument(help="Folder of the capture; it is created if it does not exist.")
    ],
    long_side: Annotated[
        int,
        typer.Option(
            min=0, max=16_384, help="Reduce larger images to this long side [px]; 0 keeps their size."
        ),
    ] = 1600,
) -> None:
    """Convert an existing scan to the scan of a capture.

    The command writes the folder scan and describes it in capture.toml. Images are written upright and without lens
    distortion. Poses in the source initialize structure from motion, which checks them. No file is written unless the
    whole scan is usable.
    """
    from aomgen.core.progress import silent
    from aomgen.core.recording import CAPTURE_FILE
    from aomgen.importers.scan_import import import_scan

    kind, written, is_new = import_scan(source, capture, long_side, silent)
    lens = f", lens distortion removed from {written.resampled}" if written.resampled else ""
    print(f"{kind}: {len(written.names)} images, {written.width} x {written.height}{lens}")
    if written.poses:
        unit = " in meters" if written.poses.metric else ""
        print(f"  {len(written.poses.Ts_scan_cam)} poses{unit}, to be checked by structure from motion")
    if written.intrinsics is None:
        print("  no intrinsics: the focal length will be estimated")
    for sentence in written.warnings:
        print(f"  warning: {sentence}")
    print(f"wrote {capture / 'scan'}")
    if is_new:
        print(f"next: complete {capture / CAPTURE_FILE} (docs/capture.md), then aomgen check {capture}")
