"""A COLMAP model, binary or text, with its images."""

from pathlib import Path

from aomgen.errors import MissingFileError
from aomgen.importers.scan_source import ScanImage, ScanSource, name_images
from aomgen.io.colmap_binary import read_cameras_bin, read_images_bin
from aomgen.io.colmap_text import read_cameras_txt, read_images_txt
from aomgen.io.paths import resolve_inside

# Folders in the source that may contain a model, in the order of preference.
MODEL_FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0")


def find_model(source: Path) -> Path | None:
    """Return the folder of the model in a source; None if there is none."""
    for name in MODEL_FOLDERS:
        for suffix in ("bin", "txt"):
            if all((source / name / f"{kind}.{suffix}").is_file() for kind in ("cameras", "images")):
                return source / name
    return None


def read_colmap_scan(source: Path) -> ScanSource:
    """Read the registered images of a COLMAP model; its points are ignored, because they are triangulated again later.

    Raises:
        MissingFileError: There is no model, or an image is missing.
        InputError: See `read_cameras_bin` and `read_images_bin`.
    """
    model = find_model(source)
    if model is None:
        raise MissingFileError(source, "holds no cameras and images of COLMAP", "give the folder of a model")
    if (model / "images.bin").is_file():
        file = model / "images.bin"
        registered = read_images_bin(file, read_cameras_bin(model / "cameras.bin"))
    else:
        file = model / "images.txt"
        registered = read_images_txt(file, read_cameras_txt(model / "cameras.txt"))
    registered.sort(key=lambda image: image.name)
    folder = _find_images(source, model, registered[0].name)
    names = name_images([image.name for image in registered], file)
    images = [
        ScanImage(
            name=name,
            path=resolve_inside(folder, image.name, named_by=file),
            camera=image.camera,
            T_scan_cam=image.T_recon_cam,
        )
        for name, image in zip(names, registered, strict=True)
    ]
    return ScanSource(kind="COLMAP model", images=tuple(images))


def _find_images(source: Path, model: Path, first: str) -> Path:
    """Return the folder that image names are relative to: the one that contains the first image, else `images`."""
    # For a model in sparse/0, the images are next to sparse.
    roots = dict.fromkeys([source, model, model.resolve().parent, model.resolve().parent.parent])
    folders = [folder for root in roots for folder in (root / "images", root)]
    found = [folder for folder in folders if (folder / first).is_file()]
    return found[0] if found else source / "images"
