"""The parts of a finished run found anew with affinity features, timed step by step."""

import time
from pathlib import Path

import numpy as np

from aomgen.alignment.stage import load_alignment
from aomgen.core.progress import silent
from aomgen.core.recording import Capture
from aomgen.motion.stage import load_motion
from aomgen.paper.affinity_features import AffinityParams
from aomgen.paper.affinity_parts import affinity_evidence
from aomgen.paper.automatic_masks import MASKS_FOLDER, segment_views
from aomgen.parts.label import SEED, find_parts, part_evidence, segment_scan
from aomgen.parts.prompted_images import segment_prompts
from aomgen.parts.robot_labels import label_robot
from aomgen.parts.stage import scan_views
from aomgen.pipeline.stages import STAGES
from aomgen.pipeline.twin_stages import posture_of, scanned_twin, scanned_world
from aomgen.segmentation.segmenter import choose_segmenter
from aomgen.structure.stage import load_structure
from aomgen.twin.twin import Twin

FOLDER = "saga"


def saga_twin(out: Path, capture: Capture) -> tuple[Twin, dict[str, float]]:
    """A twin of a finished run with the parts of method "saga", and seconds of masks and features.

    Automatic masks are kept in the run's folder `saga`; when they are found there again the seconds
    of the masks are those of reading them.

    Args:
        out: Folder of the run, finished up to its twin.
        capture: What the run works on, see `working_capture`.
    """
    folders = {stage.name: out / stage.folder for stage in STAGES}
    S_world_recon = load_alignment(folders["alignment"]).S_world_recon
    world = scanned_world(folders)
    posture = posture_of(capture)
    images = {path.name: path for path in capture.scan_images}
    views = scan_views(load_structure(folders["structure"]), S_world_recon, images, posture)
    segmenter = choose_segmenter(capture.mask_folders)
    params, rng = AffinityParams(), np.random.default_rng(SEED)
    prompted = segment_prompts(views, capture.prompts, segmenter)
    started = time.monotonic()
    folder = out / FOLDER / MASKS_FOLDER
    masks = segment_views(world, views, prompted, segmenter, silent, params.views, folder)
    masked = time.monotonic()
    given = affinity_evidence(world, views, masks, prompted, silent, params, rng)
    scan = segment_scan(world, views, label_robot(world, views, posture, rng), prompted, given)
    parts = find_parts(scan, part_evidence(scan))
    seconds = {"masks": masked - started, "features": time.monotonic() - masked}
    twin = scanned_twin(world, parts, load_motion(folders["motion"]).joint, posture)
    return twin, {step: round(value, 1) for step, value in seconds.items()}
