"""What every USD writer does in the same way."""

from pathlib import Path
from typing import Any, Final

from aomgen.errors import ConfigError, StorageError
from aomgen.io.atomic import scratch_folder, write_bytes

SUFFIXES: Final = (".usda", ".usdc")


def new_stage(path: Path, *, up_axis: str = "Z", meters_per_unit: float = 1.0) -> Any:
    """An empty stage in memory, of the format that the suffix of `path` names.

    Raises:
        ConfigError: A suffix other than .usda (text) and .usdc (binary), or an up axis that USD
            does not know.
    """
    from pxr import Usd, UsdGeom

    if path.suffix not in SUFFIXES:
        raise ConfigError(path, f"has suffix {path.suffix!r}", f"choose one of {', '.join(SUFFIXES)}")
    if up_axis not in ("Y", "Z"):
        raise ConfigError(path, f"cannot have up axis {up_axis!r}", "choose Y or Z")
    stage = Usd.Stage.CreateInMemory(f"stage{path.suffix}")
    UsdGeom.SetStageMetersPerUnit(stage, meters_per_unit)
    UsdGeom.SetStageUpAxis(stage, up_axis)
    return stage


def export_stage(stage: Any, path: Path) -> None:
    """Write a stage's root layer as one file; readers see the old content or the new.

    Raises:
        StorageError: The disk refuses.
    """
    from pxr import Tf

    try:
        with scratch_folder(path.parent) as folder:
            stage.GetRootLayer().Export(str(folder / path.name))
            content = (folder / path.name).read_bytes()
    except (OSError, Tf.ErrorException) as error:
        raise StorageError(
            path, f"cannot be written ({error})", "free space or choose another folder"
        ) from error
    write_bytes(path, content)
