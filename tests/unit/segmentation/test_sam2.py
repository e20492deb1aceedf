"""SAM 2 through transformers: a small network of the real architecture with random weights."""

import hashlib
import json
import shutil
import sys

import numpy as np
import pytest

from aomgen.conventions import MOVING, STATIC
from aomgen.core.progress import silent
from aomgen.core.recording import Prompt
from aomgen.errors import BackendError, InputError
from aomgen.segmentation.interface import clean, masks_of_logits
from aomgen.segmentation.sam2 import (
    Sam2,
    carry_prompts,
    input_points,
    input_prompt,
    load_pretrained,
    load_tracker,
    pixel_values,
)
from aomgen.segmentation.sam2_weights import find_sam2, install_sam2, list_installed, main
from aomgen.segmentation.segmenter import MasksOnDisk, choose_segmenter

SIDE = 64


def digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def network():
    """A small network that follows parts, with random weights."""
    pytest.importorskip("transformers")
    import torch
    from transformers.models.sam2_video import Sam2VideoConfig, Sam2VideoModel

    sizes = [[SIDE // step, SIDE // step] for step in (4, 8, 16)]
    backbone = {
        "model_type": "sam2_hiera_det_model", "hidden_size": 8, "image_size": [SIDE, SIDE],
        "blocks_per_stage": [1, 1, 2, 1], "embed_dim_per_stage": [8, 16, 32, 64],
        "num_attention_heads_per_stage": [1, 1, 2, 2], "window_size_per_stage": [8, 4, 4, 2],
        "global_attention_blocks": [3], "window_positional_embedding_background_size": [4, 4],
    }  # fmt: skip
    vision = {
        "model_type": "sam2_vision_model", "backbone_config": backbone, "fpn_hidden_size": 128,
        "backbone_channel_list": [64, 32, 16, 8], "backbone_feature_sizes": sizes,
    }  # fmt: skip
    decoder = {"hidden_size": 128, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 32}
    # Pointers to parts are split over the memory's 64 channels, so the rest needs more of them.
    config = Sam2VideoConfig(
        vision_config=vision, prompt_encoder_config={"hidden_size": 128, "image_size": SIDE},
        mask_decoder_config=decoder, image_size=SIDE, memory_attention_hidden_size=128,
        memory_attention_num_layers=1, memory_attention_feed_forward_hidden_size=32,
        memory_attention_rope_feat_sizes=sizes[2], memory_encoder_hidden_size=128,
        memory_encoder_output_channels=64, mask_downsampler_embed_dim=128, memory_fuser_embed_dim=128,
        memory_fuser_intermediate_dim=32, memory_fuser_num_layers=1,
    )  # fmt: skip
    torch.manual_seed(0)
    return Sam2VideoModel(config)


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """The network as a publisher offers it."""
    folder = tmp_path_factory.mktemp("published")
    network().save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def weights(published, tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    install_sam2(published, "tiny", digest(published / "model.safetensors"), folder)
    return folder


def images(count):
    rng = np.random.default_rng(3)
    return {f"{index}.png": rng.integers(0, 255, (40, 50, 3), dtype=np.uint8) for index in range(count)}


def plain_weights(folder):
    """Files that look like weights, for what only concerns files."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps({"model_type": "sam2"}))
    (folder / "model.safetensors").write_bytes(b"weights")
    return folder


def test_weights_are_installed_under_a_name(tmp_path, capsys, monkeypatch):
    source = plain_weights(tmp_path / "source")
    monkeypatch.setenv("AOMGEN_WEIGHTS", str(tmp_path / "weights"))
    given = digest(source / "model.safetensors").upper()
    assert main([str(source), "--name", "one", "--sha256", given]) == 0
    assert list_installed() == ("one",)
    assert (find_sam2("one") / "model.safetensors").read_bytes() == b"weights"
    assert main([str(source), "--name", "two", "--sha256", "0" * 64]) == BackendError.exit_code
    assert "is not the file whose SHA-256 was given" in capsys.readouterr().err
    assert list_installed() == ("one",)


def test_unknown_weights_list_the_known_ones(tmp_path):
    with pytest.raises(BackendError, match=r"\(known: none\)"):
        find_sam2("one", tmp_path)
    source = plain_weights(tmp_path / "source")
    install_sam2(source, "one", digest(source / "model.safetensors"), tmp_path)
    with pytest.raises(BackendError, match=r"\(known: one\).*sam2_weights --help"):
        find_sam2("two", tmp_path)


@pytest.mark.parametrize("file", ["config.json", "model.safetensors"])
def test_changed_or_lost_weights_are_refused(tmp_path, file):
    source = plain_weights(tmp_path / "source")
    installed = install_sam2(source, "one", digest(source / "model.safetensors"), tmp_path)
    (installed / file).write_bytes(b"others")
    with pytest.raises(BackendError, match="is not the file whose SHA-256 was given"):
        find_sam2("one", tmp_path)
    (installed / file).unlink()
    with pytest.raises(BackendError, match="is missing"):
        find_sam2("one", tmp_path)


@pytest.mark.parametrize("name", ["", "..", "a/b", "../a", ".hidden", "a" * 65])
def test_a_name_stays_inside_the_folder(tmp_path, name):
    source = plain_weights(tmp_path / "source")
    with pytest.raises(BackendError, match="is not a valid name for weights"):
        install_sam2(source, name, digest(source / "model.safetensors"), tmp_path)


def test_only_safetensors_are_installed(tmp_path):
    source = plain_weights(tmp_path / "source")
    (source / "model.safetensors").rename(source / "pytorch_model.bin")
    with pytest.raises(BackendError, match=r"model\.safetensors: is missing"):
        install_sam2(source, "one", "0" * 64, tmp_path)


def test_without_transformers_the_extra_is_named(tmp_path, monkeypatch):
    source = plain_weights(tmp_path / "source")
    install_sam2(source, "one", digest(source / "model.safetensors"), tmp_path)
    monkeypatch.setitem(sys.modules, "transformers.models.sam2", None)
    with pytest.raises(BackendError, match=r'pip install "aomgen\[sam2\]"'):
        Sam2("one", tmp_path)


def test_the_chosen_segmenter_is_used_or_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("AOMGEN_WEIGHTS", str(tmp_path))
    assert isinstance(choose_segmenter({"mine": tmp_path}), MasksOnDisk)
    # Neither masks nor other weights stand in for the network that was asked for.
    for folders in ({}, {"mine": tmp_path}):
        with pytest.raises(BackendError, match="no SAM 2 weights of this name"):
            choose_segmenter(folders, "sam2.1-hiera-tiny")
        with pytest.raises(BackendError, match="weights are missing"):
            choose_segmenter(folders, "mobile_sam")


def test_pixels_are_normalised():
    image = np.full((20, 30, 3), (124, 116, 104), np.uint8)
    values = pixel_values(image, 16)
    assert values.shape == (3, 16, 16)
    assert np.abs(values).max() < 0.02
    assert pixel_values(np.full((4, 4, 3), 255, np.uint8), 4)[0, 0, 0] == pytest.approx(0.515 / 0.229)


def test_pixel_centres_stay_pixel_centres():
    # The middle of the first of 50 columns is the middle of a 50th of the network's image.
    points = input_points([[0.5, 0.5], [49.5, 39.5]], (40, 50), 100)
    assert np.allclose(points, [[0.5, 0.75], [98.5, 98.25]])
    coordinates, labels = input_prompt([5, 4, 25, 20], [[10, 10, 0]], (40, 50), 100)
    assert labels.tolist() == [2, 3, 0]
    assert np.allclose(coordinates[:2], [[9.5, 9.5], [49.5, 49.5]])
    assert input_prompt([], [[10, 10, 1]], (40, 50), 100)[1].tolist() == [1]


def test_a_box_is_answered_as_by_the_library(weights):
    import torch

    segmenter = Sam2("tiny", weights)
    image = images(1)["0.png"]
    box = np.array([10.0, 6, 40, 30])
    mask = segmenter.prepare("0.png", image).mask("moving", box, np.zeros((0, 3)))
    network = load_pretrained("sam2", "Sam2Model", find_sam2("tiny", weights))
    scaled = box * np.array([SIDE / 50, SIDE / 40, SIDE / 50, SIDE / 40]) - 0.5
    with torch.inference_mode():
        answer = network(
            pixel_values=torch.from_numpy(pixel_values(image, SIDE)[None]),
            input_boxes=torch.from_numpy(scaled[None, None].astype(np.float32)),
            multimask_output=False,
        )
    expected = masks_of_logits([answer.pred_masks[0, 0, 0].numpy()], [1.0], (40, 50)).masks[0]
    assert mask.shape == (40, 50)
    assert np.array_equal(mask, clean(expected))


def test_points_are_answered_alone_as_together(weights):
    image = Sam2("tiny", weights).prepare("0.png", images(1)["0.png"])
    points = np.random.default_rng(0).uniform(0, 40, (19, 2))
    together = image.at_points(points)
    assert together.masks.shape == (57, 40, 50)
    alone = image.at_points(points[17:18])
    assert np.array_equal(together.masks[51:54], alone.masks)
    assert np.allclose(together.quality[51:54], alone.quality, atol=1e-5)
    assert image.at_points(np.zeros((0, 2))).masks.shape == (0, 40, 50)


def test_weights_without_memory_cannot_follow(published, tmp_path):
    pytest.importorskip("transformers")
    from transformers.models.sam2 import Sam2Model

    single, _ = Sam2Model.from_pretrained(published, output_loading_info=True)
    single.save_pretrained(tmp_path / "single")
    file = tmp_path / "single" / "model.safetensors"
    files = install_sam2(tmp_path / "single", "single", digest(file), tmp_path)
    with pytest.raises(BackendError, match=r"lacks .* weights of a Sam2VideoModel"):
        load_tracker(files)


def test_damaged_weights_are_refused(published, tmp_path):
    source = tmp_path / "cut"
    shutil.copytree(published, source)
    file = source / "model.safetensors"
    file.write_bytes(file.read_bytes()[:-1000])
    install_sam2(source, "cut", digest(file), tmp_path)
    with pytest.raises(BackendError, match="does not hold a Sam2Model"):
        Sam2("cut", tmp_path)


def prompt(part, image, box):
    return Prompt(part=part, image=image, points=np.zeros((0, 3)), box=np.array(box, np.float64))


@pytest.mark.slow
def test_prompts_are_carried_as_by_the_library(weights):
    import torch
    from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

    tracker = load_tracker(find_sam2("tiny", weights))
    frames = images(5)
    boxes = {STATIC: [4.0, 4, 46, 36], MOVING: [10.0, 10, 30, 30]}
    asked = [prompt("static", "2.png", boxes[STATIC]), prompt("moving", "2.png", boxes[MOVING])]
    found = list(carry_prompts(tracker, list(frames), frames.__getitem__, asked, silent))
    assert [name for name, _ in found] == ["2.png", "3.png", "4.png", "1.png", "0.png"]
    video = torch.stack([torch.from_numpy(pixel_values(image, SIDE)) for image in frames.values()])
    session = Sam2VideoInferenceSession(video=video, dtype=torch.float32)
    with torch.inference_mode():
        for value, box in boxes.items():
            points, labels = input_prompt(box, [], (40, 50), SIDE)
            inputs = {
                "point_coords": torch.from_numpy(points)[None, None],
                "point_labels": torch.from_numpy(labels)[None, None].int(),
            }
            session.add_point_inputs(session.obj_id_to_idx(value), 2, inputs)
        session.obj_with_new_inputs = [STATIC, MOVING]
        tracker(session, frame_idx=2)
        masks = {}
        for reverse in (True, False):
            for item in tracker.propagate_in_video_iterator(session, 2, reverse=reverse):
                masks[item.frame_idx] = item.pred_masks[:, 0].numpy()
    for name, labels in found:
        static, moving = masks_of_logits(list(masks[int(name[0])]), [1, 1], (40, 50)).masks
        expected = np.where(clean(moving), MOVING, np.where(clean(static), STATIC, 0))
        assert np.mean(labels == expected) > 0.99


def test_carried_prompts_may_start_at_different_images(weights):
    tracker = load_tracker(find_sam2("tiny", weights))
    frames = images(4)
    box = [10.0, 10, 30, 30]
    asked = [
        prompt("static", "3.png", box),
        prompt("static", "1.png", box),
        prompt("moving", "2.png", box),
        prompt("robot", "0.png", box),
    ]
    found = dict(carry_prompts(tracker, list(frames), frames.__getitem__, asked, silent))
    assert sorted(found) == sorted(frames)
    assert all(labels.shape == (40, 50) for labels in found.values())
    with pytest.raises(InputError, match="none is on an image of the sequence"):
        next(carry_prompts(tracker, ["9.png"], frames.__getitem__, asked, silent))
