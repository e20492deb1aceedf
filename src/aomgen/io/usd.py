"""Writing of OpenUSD stages as one file, and of Gaussians as a `ParticleField3DGaussianSplat` prim (OpenUSD 26.03).

USD stores the same values as `Gaussians`: scales (standard deviations), opacities, and spherical harmonics by Gaussian,
with the coefficients in the order of 3DGS files. Only quaternions differ: their arrays have the order xyzw in memory.
"""

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from aomgen.conventions import xyzw_from_wxyz
from aomgen.core.gaussians import Gaussians
from aomgen.core.transforms import matrix_from_quat
from aomgen.errors import ConfigError, StorageError
from aomgen.io.atomic import scratch_folder, write_bytes
from aomgen.io.ply import check_readable

PRIM: Final = "/Gaussians"
# Radius of a Gaussian's extent, in standard deviations; the schema of the kernel recommends this value.
REACH: Final = 3.0
SUFFIXES: Final = (".usda", ".usdc", ".usdz")


def new_stage(path: Path, meters_per_unit: float = 1.0) -> Any:
    """Create an empty stage in memory, with z up.

    Args:
        path: Future file; its suffix, .usda (text), .usdc (binary) or .usdz (packed), selects the format.
        meters_per_unit: Length of the stage's unit, [m].

    Returns:
        The stage, a `pxr.Usd.Stage`.

    Raises:
        ConfigError: The suffix is a different one.
    """
    from pxr import Usd, UsdGeom

    if path.suffix not in SUFFIXES:
        raise ConfigError(path, f"has suffix {path.suffix!r}", f"choose one of {', '.join(SUFFIXES)}")
    stage = Usd.Stage.CreateInMemory(f"stage{path.suffix.replace('z', 'c')}")
    UsdGeom.SetStageMetersPerUnit(stage, meters_per_unit)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    return stage


def export_stage(stage: Any, path: Path) -> None:
    """Write a stage's root layer as one file; readers get the complete old or the complete new content.

    Raises:
        StorageError: Writing to the disk failed.
    """
    from pxr import Sdf, Tf

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with scratch_folder(path.parent) as folder:
            file = folder / path.name.replace(".usdz", ".usdc")
            stage.GetRootLayer().Export(str(file))
            if path.suffix == ".usdz":
                layer, file = file, folder / path.name
                with Sdf.ZipFileWriter.CreateNew(str(file)) as package:
                    package.AddFile(str(layer), layer.name)
            content = file.read_bytes()
    except (OSError, Tf.ErrorException) as error:
        # Messages of USD are many lines long and contain locations in its source code, so they are not shown.
        why = error.strerror if isinstance(error, OSError) else "USD was refused by the disk"
        raise StorageError(
            path, f"cannot be written ({why})", "free space or choose another folder"
        ) from error
    write_bytes(path, content)


def write_gaussians(path: Path, gaussians: Gaussians, *, meters_per_unit: float = 1.0) -> None:
    """Write Gaussians as the default prim of a new USD file, as float32 without loss.

    Args:
        path: File to write; its suffix, .usda (text), .usdc (binary) or .usdz (packed), selects the format.
        gaussians: Gaussians in a frame with z up; their coordinates are not changed.
        meters_per_unit: Length of the unit of their coordinates, [m].

    Raises:
        ConfigError: The suffix is a different one.
        NonFiniteError: A value is NaN or infinite, or a quaternion is zero.
        StorageError: Writing to the disk failed.
    """
    check_readable(path, gaussians)
    stage = new_stage(path, meters_per_unit)
    stage.SetDefaultPrim(define_gaussians(stage, PRIM, gaussians))
    export_stage(stage, path)


def define_gaussians(stage: Any, prim_path: str, gaussians: Gaussians) -> Any:
    """Define a prim of Gaussians on a stage, in the frame of its parent prim, and return it.

    Colors remain sRGB, as in 3DGS files; the schema does not specify a color space.
    """
    from pxr import UsdVol, Vt

    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, prim_path)
    field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(gaussians.means))
    quats_xyzw = np.ascontiguousarray(xyzw_from_wxyz(gaussians.quats.astype(np.float64)), np.float32)
    field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(quats_xyzw))
    field.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(gaussians.scales))
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(gaussians.opacities))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(gaussians.sh_degree)
    coefficients = field.CreateRadianceSphericalHarmonicsCoefficientsAttr(
        Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(gaussians.sh.reshape(-1, 3)))
    )
    # These metadata serve renderers that read the coefficients as a primvar and ignore the degree.
    coefficients.SetMetadata("elementSize", gaussians.sh.shape[1])
    coefficients.SetMetadata("interpolation", "vertex")
    field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent(gaussians)))
    field.CreateProjectionModeHintAttr("perspective")
    field.CreateSortingModeHintAttr("zDepth")
    return field.GetPrim()


def extent(gaussians: Gaussians) -> NDArray[np.float32]:
    """Compute the corners (2, 3) of the smallest axis-aligned box that contains the Gaussians.

    Each Gaussian extends to `REACH` standard deviations. Without Gaussians, the corners are zero.
    """
    if not len(gaussians):
        return np.zeros((2, 3), np.float32)
    rotations = matrix_from_quat(gaussians.quats)
    variances = np.einsum("nij,nj->ni", rotations**2, gaussians.scales.astype(np.float64) ** 2)
    reach = REACH * np.sqrt(variances)
    return np.stack([(gaussians.means - reach).min(0), (gaussians.means + reach).max(0)]).astype(np.float32)
