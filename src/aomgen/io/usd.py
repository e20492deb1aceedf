"""OpenUSD: stages written as one file, and Gaussians as a prim `ParticleField3DGaussianSplat` (26.03).

USD stores what `Gaussians` holds: real scales (standard deviations) and opacities, and harmonics
by Gaussian with the coefficients in the order of the 3DGS files. Only quaternions differ: their
arrays lie in memory as xyzw.
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
# Radius of a Gaussian's extent in standard deviations, as the kernel's schema suggests.
REACH: Final = 3.0
SUFFIXES: Final = (".usda", ".usdc", ".usdz")


def new_stage(path: Path, meters_per_unit: float = 1.0) -> Any:
    """Create an empty stage in memory, Z up, of the format that the suffix of `path` names.

    Raises:
        ConfigError: A suffix other than .usda (text), .usdc (binary) and .usdz (packed).
    """
    from pxr import Usd, UsdGeom

    if path.suffix not in SUFFIXES:
        raise ConfigError(path, f"has suffix {path.suffix!r}", f"choose one of {', '.join(SUFFIXES)}")
    stage = Usd.Stage.CreateInMemory(f"stage{path.suffix.replace('z', 'c')}")
    UsdGeom.SetStageMetersPerUnit(stage, meters_per_unit)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    return stage


def export_stage(stage: Any, path: Path) -> None:
    """Write a stage's root layer as one file; readers see the old content or the new.

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
        # USD's messages are many lines long, with positions in its sources.
        why = error.strerror if isinstance(error, OSError) else "USD was refused by the disk"
        raise StorageError(
            path, f"cannot be written ({why})", "free space or choose another folder"
        ) from error
    write_bytes(path, content)


def write_gaussians(path: Path, gaussians: Gaussians, *, meters_per_unit: float = 1.0) -> None:
    """Write Gaussians as the default prim of a new USD file; exact in float32.

    Args:
        path: Ends in .usda (text), .usdc (binary) or .usdz (packed).
        gaussians: Their coordinates are not changed; Z is up.
        meters_per_unit: Length of their unit, [m].

    Raises:
        ConfigError: Another suffix.
        NonFiniteError: A value is NaN or infinite, or a quaternion is zero.
        StorageError: Writing to the disk failed.
    """
    check_readable(path, gaussians)
    stage = new_stage(path, meters_per_unit)
    stage.SetDefaultPrim(define_gaussians(stage, PRIM, gaussians))
    export_stage(stage, path)


def define_gaussians(stage: Any, prim_path: str, gaussians: Gaussians) -> Any:
    """Define Gaussians on a stage, in the frame of the parent prim, and return their prim.

    Colors stay sRGB, as in 3DGS files; the schema names no color space.
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
    # For renderers that read the coefficients as a primvar and do not look at the degree.
    coefficients.SetMetadata("elementSize", gaussians.sh.shape[1])
    coefficients.SetMetadata("interpolation", "vertex")
    field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent(gaussians)))
    field.CreateProjectionModeHintAttr("perspective")
    field.CreateSortingModeHintAttr("zDepth")
    return field.GetPrim()


def extent(gaussians: Gaussians) -> NDArray[np.float32]:
    """Corners (2, 3) of the smallest box that holds every Gaussian up to `REACH`; zeros for none."""
    if not len(gaussians):
        return np.zeros((2, 3), np.float32)
    rotations = matrix_from_quat(gaussians.quats)
    variances = np.einsum("nij,nj->ni", rotations**2, gaussians.scales.astype(np.float64) ** 2)
    reach = REACH * np.sqrt(variances)
    return np.stack([(gaussians.means - reach).min(0), (gaussians.means + reach).max(0)]).astype(np.float32)
