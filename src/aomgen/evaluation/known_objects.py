"""Known objects of a planner: an unknown object is assumed to resemble one of them."""

from dataclasses import dataclass, replace
from functools import partial

from aomgen.assets.choice import is_made, make_asset
from aomgen.core.plan import FittedAsset, Rejection
from aomgen.episodes.factory import EpisodeFactory
from aomgen.episodes.grasps import Grasp
from aomgen.errors import ConfigError
from aomgen.evaluation.suite import twin_digest
from aomgen.io.artifact import load_artifact, save_artifact
from aomgen.io.reuse import reuse
from aomgen.replacement.stage import fit_to_recording
from aomgen.results import Results

# Folder of the known objects in the folder of a run, by their number, and name of their file.
FOLDER, FILE = "known_objects", "objects"
# Usual number of parametric objects, and seed of the first one; projects usually use smaller seeds.
KNOWN, FIRST_SEED = 60, 101


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownObjects:
    """Objects of a run's category, and the grasp that suits most of them.

    Attributes:
        twin: Digest of the run's twin, see `twin_digest`.
        fitted: The objects, fitted to the recorded motion, without meshes.
        usual_grasp: Their usual grasp; None if no grasp is feasible.
    """

    twin: str
    fitted: tuple[FittedAsset, ...]
    usual_grasp: Grasp | None


def open_known_objects(results: Results, made: int) -> KnownObjects:
    """Return the assets of a run and some parametric objects of the recorded category.

    They are chosen once, which takes minutes, and stored in the folder of the run.

    Args:
        results: Results of a run up to the stage "replacement".
        made: Number of parametric objects, of which those are omitted to which the recorded motion does not fit.

    Raises:
        ConfigError: The run demonstrates a closing; the keypoints of an unknown object are located while it is closed.
        StorageError: The folder of the run cannot be written.
    """
    if results.motion.direction == "closing":
        raise ConfigError(results.out, "demonstrates a closing", "name a run of an opening")
    home, twin = results.out / FOLDER / str(made), twin_digest(results)
    known = reuse(home / f"{FILE}.json", partial(load_artifact, home, FILE, KnownObjects))
    if known is None or known.twin != twin:
        known = _choose(results, made, twin)
        save_artifact(home, FILE, known)
    return known


def _choose(results: Results, made: int, twin: str) -> KnownObjects:
    category = results.recorded.category
    seeds = range(FIRST_SEED, FIRST_SEED + made) if is_made(category) else ()
    fits = [fit_to_recording(results, make_asset(category, seed)) for seed in seeds]
    own = [fitted for fitted in results.fitted_assets if fitted.asset.category == category]
    fitted = [_omit_meshes(item) for item in (*own, *fits) if not isinstance(item, Rejection)]
    factory = EpisodeFactory(results, results.out / FOLDER, fitted=fitted)
    return KnownObjects(twin=twin, fitted=tuple(fitted), usual_grasp=factory.usual_grasp(category).usual)


def _omit_meshes(fitted: FittedAsset) -> FittedAsset:
    """Return an object of which only colliders, joint and handle are known, which suffices for planning."""
    static, moving = (replace(link, meshes=()) for link in (fitted.asset.static, fitted.asset.moving))
    return replace(fitted, asset=replace(fitted.asset, static=static, moving=moving))
