"""Generate many photoreal and physically verified demonstrations from one recorded demonstration.

>>> import aomgen as ag
>>> run = ag.Run.open("out")
>>> image, depth, labels = run.twin.render(run.twin.state(theta=0.5), run.cameras["front"])

The names in `__all__` are public and keep their meaning within a minor version; everything else may change.
`aomgen.splatting` is the rasterizer, which can be used separately. Names are imported when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from aomgen.errors import explain_missing_module
from aomgen.version import __version__ as __version__

if TYPE_CHECKING:
    from aomgen.api.asset import Asset as Asset
    from aomgen.api.asset import fit_asset as fit_asset
    from aomgen.api.capture import Capture as Capture
    from aomgen.api.episodes import build_scene as build_scene
    from aomgen.api.episodes import export as export
    from aomgen.api.episodes import generate as generate
    from aomgen.api.episodes import plan as plan
    from aomgen.api.episodes import verify as verify
    from aomgen.api.evaluation import evaluate as evaluate
    from aomgen.api.joint import JointFit as JointFit
    from aomgen.api.joint import estimate_joint as estimate_joint
    from aomgen.api.run import Run as Run
    from aomgen.api.run import reconstruct as reconstruct
    from aomgen.api.twin import Twin as Twin
    from aomgen.core.camera import Camera as Camera
    from aomgen.core.camera import look_at as look_at
    from aomgen.core.demonstration import Demonstration as Demonstration
    from aomgen.core.gaussians import Gaussians as Gaussians
    from aomgen.core.joint import Joint as Joint
    from aomgen.core.motion import MotionEstimate as MotionEstimate
    from aomgen.core.plan import EpisodePlan as Plan
    from aomgen.core.plan import FittedAsset as FittedAsset
    from aomgen.core.plan import Rejection as Rejection
    from aomgen.core.plan import Variation as Variation
    from aomgen.core.verdict import Verdict as Verdict
    from aomgen.episodes.variations import Ranges as Ranges
    from aomgen.errors import AomgenError as AomgenError
    from aomgen.errors import BackendError as BackendError
    from aomgen.errors import ConfigError as ConfigError
    from aomgen.errors import EstimationError as EstimationError
    from aomgen.errors import InputError as InputError
    from aomgen.errors import StorageError as StorageError
    from aomgen.errors import UnknownNameError as UnknownNameError
    from aomgen.io.episode_folder import CommittedEpisode as Episode
    from aomgen.robots.loading import load_robot as load_robot
    from aomgen.robots.robot import RobotModel as Robot
    from aomgen.simulation.scene import Scene as Scene
    from aomgen.twin.twin import TwinState as State


_HOMES = {
    "AomgenError": "errors:AomgenError",
    "Asset": "api.asset:Asset",
    "BackendError": "errors:BackendError",
    "Camera": "core.camera:Camera",
    "Capture": "api.capture:Capture",
    "ConfigError": "errors:ConfigError",
    "Demonstration": "core.demonstration:Demonstration",
    "Episode": "io.episode_folder:CommittedEpisode",
    "EstimationError": "errors:EstimationError",
    "FittedAsset": "core.plan:FittedAsset",
    "Gaussians": "core.gaussians:Gaussians",
    "InputError": "errors:InputError",
    "Joint": "core.joint:Joint",
    "JointFit": "api.joint:JointFit",
    "MotionEstimate": "core.motion:MotionEstimate",
    "Plan": "core.plan:EpisodePlan",
    "Ranges": "episodes.variations:Ranges",
    "Rejection": "core.plan:Rejection",
    "Robot": "robots.robot:RobotModel",
    "Run": "api.run:Run",
    "Scene": "simulation.scene:Scene",
    "State": "twin.twin:TwinState",
    "StorageError": "errors:StorageError",
    "Twin": "api.twin:Twin",
    "UnknownNameError": "errors:UnknownNameError",
    "Variation": "core.plan:Variation",
    "Verdict": "core.verdict:Verdict",
    "build_scene": "api.episodes:build_scene",
    "estimate_joint": "api.joint:estimate_joint",
    "evaluate": "api.evaluation:evaluate",
    "export": "api.episodes:export",
    "fit_asset": "api.asset:fit_asset",
    "generate": "api.episodes:generate",
    "load_robot": "robots.loading:load_robot",
    "look_at": "core.camera:look_at",
    "plan": "api.episodes:plan",
    "reconstruct": "api.run:reconstruct",
    "verify": "api.episodes:verify",
}
__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(_HOMES)}")
    module, _, attribute = _HOMES[name].partition(":")
    try:
        return getattr(import_module(f"{__name__}.{module}"), attribute)
    except ModuleNotFoundError as error:
        missing = explain_missing_module(error)
        if missing is None:
            raise
        raise missing from error


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
