"""Articulated assets: loading, making, checking, and fitting them to a recorded motion."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from aomgen.api.arguments import require_count
from aomgen.api.run import Run
from aomgen.assets.choice import load_asset, make_asset, require_usable, resolve_asset
from aomgen.assets.doctor import Finding, examine
from aomgen.assets.import_model import import_model
from aomgen.assets.usd_read import SUFFIXES
from aomgen.assets.usd_write import write_usd
from aomgen.core.asset import ArticulatedAsset
from aomgen.core.joint import Joint
from aomgen.core.plan import FittedAsset, Rejection
from aomgen.errors import ConfigError, EstimationError
from aomgen.replacement.stage import fit_to_recording


@dataclass(frozen=True, slots=True)
class Asset:
    """An articulated object with meshes, colliders, masses, one joint and a handle.

    Attributes:
        model: Content of the asset, asset frame: front towards -y, support plane z = 0.
        source: Name of the asset in projects: `category:seed` for a parametric asset, FILE or FILE#JOINT for an unchanged
            USD file; otherwise empty.

    Example:
        >>> asset = ag.Asset.make("drawer", seed=3)
        >>> asset.joint.type, asset.source
        ('prismatic', 'drawer:3')
    """

    model: ArticulatedAsset
    source: str = ""

    @classmethod
    def load(
        cls,
        file: str | Path,
        *,
        joint: str = "",
        scale: float = 1.0,
        category: str = "",
        limits: Sequence[float] = (),
        handle: Sequence[float] = (),
    ) -> "Asset":
        """Read a USD, URDF, MJCF or OBJ model.

        Args:
            file: The model; OBJ needs an `articulation.json`, see `docs/assets.md`.
            joint: Name of the joint that opens, if the file has several.
            scale: Factor on all lengths; `limits` and `handle` refer to the unscaled file.
            category: Category, for example "microwave"; if empty, the one in the file.
            limits: Lower and upper joint limit relative to the pose in the file, [rad] or [m]; they replace the limits in
                the file.
            handle: Corners x0, y0, z0, x1, y1, z1 of a box around the handle, in the pose of the file, [m], z up.

        Raises:
            InputError: The file cannot be used; the subclass indicates the reason.
            SeveralJointsError: The file has several joints; its `joints` lists them.

        Example:
            >>> ag.Asset.make("toolbox", seed=1).save("toolbox.usda")
            >>> asset = ag.Asset.load("toolbox.usda")
            >>> asset.joint.type
            'revolute'
        """
        path = Path(file)
        read = import_model(path, joint=joint, scale=scale, category=category, limits=limits, handle=handle)
        as_is = scale == 1.0 and not (category or limits or handle) and path.suffix.lower() in SUFFIXES
        name = f"{path.resolve()}#{joint}" if joint else str(path.resolve())
        return cls(read, name if as_is else "")

    @classmethod
    def make(cls, category: str, seed: int = 1) -> "Asset":
        """Make a textured asset with random sizes and style; the same seed gives the same asset.

        Args:
            category: "cabinet", "drawer", "laptop", "microwave" or "toolbox"; or "dresser", which makes an object of the
                category "drawer" that has several fronts.
            seed: Random seed of style, sizes, colors and the side of the hinge.

        Raises:
            ConfigError: The category is unknown, or the seed is negative.

        Example:
            >>> ag.Asset.make("microwave", seed=1).model.category
            'microwave'
        """
        return cls(make_asset(category, require_count("seed", seed, 0)), f"{category}:{seed}")

    @property
    def name(self) -> str:
        """Name of the asset, by which episodes identify it."""
        return self.model.name

    @property
    def joint(self) -> Joint:
        """The joint, asset frame; value 0 is closed."""
        return self.model.joint

    def check(self) -> list[Finding]:
        """Check joint, size, handle, colliders, mass and textures.

        Returns:
            Findings; the asset can be simulated and opened if none of them has a `problem`.

        Example:
            >>> [item.problem for item in ag.Asset.make("laptop", seed=2).check() if item.problem]
            []
        """
        return examine(self.model)

    def save(self, file: str | Path) -> None:
        """Write the asset as USD with colliders, masses, joint and friction; its name becomes that of the file.

        Example:
            >>> ag.Asset.make("cabinet", seed=1).save("cabinet.usda")
        """
        path = Path(file)
        write_usd(replace(self.model, name=path.stem), path)


def fit_asset(asset: Asset, run: Run) -> FittedAsset:
    """Place an asset at the pose of the recorded object and transfer the recorded motion to its joint.

    Args:
        asset: See `Asset`.
        run: A run that has finished stage "replacement".

    Returns:
        The asset with its pose, contact point and joint values over the motion.

    Raises:
        AssetError: The asset cannot be simulated and grasped.
        EstimationError: The recorded motion does not fit the asset.

    Example:
        >>> run = ag.Run.open("out")
        >>> fit = ag.fit_asset(ag.Asset.make("microwave", seed=4), run)
        >>> fit.mode, fit.scale
        ('trajectory', 1.0)
    """
    run.require_stage("replacement")
    found = fit_to_recording(run.results, require_usable(asset.model))
    if isinstance(found, Rejection):
        raise EstimationError(
            asset.name,
            f"does not fit the recorded motion: {found.detail}",
            "choose an asset with a similar motion",
        )
    return found


def asset_source(asset: "Asset | str | Path") -> str:
    """Return the name of an asset in a project, with an absolute path.

    Raises:
        ConfigError: The asset is neither parametric nor a USD file.
    """
    if isinstance(asset, Asset):
        if not asset.source:
            raise ConfigError(asset.name, "is not stored in a file", "save it as USD and load that file")
        return asset.source
    spec = str(asset)
    load_asset(spec)
    return resolve_asset(spec)
