"""Gaussians to OpenUSD: read back with the real library, equal, and valid by its own checks."""

import resource
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdValidation, UsdVol

from aomgen.core.gaussians import Gaussians, gaussians_of
from aomgen.core.transforms import matrix_from_quat
from aomgen.errors import ConfigError, StorageError
from aomgen.io.usd import write_gaussians


def make_gaussians(count: int = 40, degree: int = 2) -> Gaussians:
    rng = np.random.default_rng(5)
    quats = rng.normal(size=(count, 4))
    return gaussians_of(
        means=rng.normal(size=(count, 3)),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(rng.normal(-3, 1, (count, 3))),
        opacities=rng.uniform(0, 1, count),
        sh=rng.normal(size=(count, (degree + 1) ** 2, 3)),
    )


def opened(path: Path) -> tuple[Usd.Stage, UsdVol.ParticleField3DGaussianSplat]:
    stage = Usd.Stage.Open(str(path))
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    return stage, UsdVol.ParticleField3DGaussianSplat(prim)


def gaussians_in(prim: Usd.Prim) -> Gaussians:
    """By the published schema alone: names of attributes, `Gf.Quatf` by its members, the SH stride."""

    def value(name: str):
        return prim.GetAttribute(name).Get()

    quats = [(q.GetReal(), *q.GetImaginary()) for q in value("orientations")]
    degree = value("radiance:sphericalHarmonicsDegree")
    sh = np.array(value("radiance:sphericalHarmonicsCoefficients")).reshape(-1, (degree + 1) ** 2, 3)
    return gaussians_of(
        means=np.array(value("positions")).reshape(-1, 3),
        quats=np.array(quats).reshape(-1, 4),
        scales=np.array(value("scales")).reshape(-1, 3),
        opacities=np.array(value("opacities")),
        sh=sh,
    )


@pytest.mark.parametrize("suffix", [".usdc", ".usda"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip(tmp_path: Path, degree: int, suffix: str) -> None:
    want = make_gaussians(degree=degree)
    write_gaussians(tmp_path / f"a{suffix}", want)
    stage, splat = opened(tmp_path / f"a{suffix}")
    have = gaussians_in(splat.GetPrim())
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(have, name), getattr(want, name))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert list(tmp_path.iterdir()) == [tmp_path / f"a{suffix}"]


def test_valid_by_usd_itself(tmp_path: Path) -> None:
    """Every validator that comes with USD, and no attribute that the schema does not know by this type."""
    write_gaussians(tmp_path / "a.usdc", make_gaussians())
    stage, splat = opened(tmp_path / "a.usdc")
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in found] == []
    prim = splat.GetPrim()
    definition = prim.GetPrimDefinition()
    for attribute in prim.GetAuthoredAttributes():
        assert definition.GetSchemaAttributeSpec(attribute.GetName()).typeName == attribute.GetTypeName()
    assert {"ParticleFieldPositionBaseAPI", "ParticleFieldRadianceBaseAPI"} <= set(prim.GetAppliedSchemas())


def test_extent_holds_three_standard_deviations(tmp_path: Path) -> None:
    """Against the ellipsoids' surfaces, sampled densely: never outside, and touched on every side."""
    g = make_gaussians(30)
    write_gaussians(tmp_path / "a.usdc", g)
    _stage, splat = opened(tmp_path / "a.usdc")
    low, high = np.array(splat.GetExtentAttr().Get())
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turned = np.einsum("nij,nj,dj->ndi", matrix_from_quat(g.quats), g.scales, directions)
    points = g.means[:, None] + 3 * turned
    inner_low, inner_high = points.min((0, 1)), points.max((0, 1))
    size = high - low
    assert (low <= inner_low + 1e-6 * size).all()
    assert (high >= inner_high - 1e-6 * size).all()
    np.testing.assert_allclose(low, inner_low, atol=2e-3 * size.max())
    np.testing.assert_allclose(high, inner_high, atol=2e-3 * size.max())


def test_axis_and_unit(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.usda", make_gaussians(), meters_per_unit=0.01)
    stage, _ = opened(tmp_path / "a.usda")
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.01


def test_no_gaussians(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.usda", make_gaussians(0))
    _stage, splat = opened(tmp_path / "a.usda")
    assert len(gaussians_in(splat.GetPrim())) == 0


@pytest.mark.parametrize("name", ["a.usd", "a.ply"])
def test_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ConfigError):
        write_gaussians(tmp_path / name, make_gaussians())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_a_full_disk_is_one_sentence(tmp_path: Path, suffix: str) -> None:
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, usual[1]))
    try:
        with pytest.raises(StorageError) as caught:
            write_gaussians(tmp_path / f"a{suffix}", make_gaussians())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
    assert str(caught.value).endswith("(USD was refused by the disk); free space or choose another folder")
    assert not list(tmp_path.iterdir())


def test_disk_refuses(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(StorageError):
        write_gaussians(tmp_path / "file" / "a.usda", make_gaussians())
    with pytest.raises(StorageError):
        write_gaussians(Path("/proc/a.usda"), make_gaussians())
