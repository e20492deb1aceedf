"""Diffusion pipelines that diffusers has saved in a folder: nothing is downloaded in a run."""

import importlib
from pathlib import Path
from typing import Any, Final

from aomgen.errors import BackendError

EXTRA: Final = "pip install 'aomgen[diffusion]'"


def load_pipeline(folder: Path, kind: str) -> Any:
    """A saved pipeline of a class of diffusers, on the GPU where there is one.

    Raises:
        BackendError: The extra is not installed, or the folder holds no such pipeline.
    """
    try:
        pipelines = getattr(importlib.import_module("diffusers"), kind)
        torch = importlib.import_module("torch")
        damaged = importlib.import_module("safetensors").SafetensorError
    except ImportError as error:
        raise BackendError("diffusers", f"cannot be loaded ({error})", EXTRA) from error
    on_gpu = torch.cuda.is_available()
    try:
        pipeline = pipelines.from_pretrained(
            str(folder),
            dtype=torch.float16 if on_gpu else torch.float32,
            local_files_only=True,
            use_safetensors=True,
        )
    except (OSError, ValueError, TypeError, RuntimeError, damaged) as error:
        raise BackendError(
            folder, f"holds no {kind} ({error})", "save one there, see docs/replacement.md"
        ) from error
    pipeline.set_progress_bar_config(disable=True)
    return pipeline.to("cuda" if on_gpu else "cpu")


def picture_side(pipeline: Any) -> int:
    """Side of the square pictures that it was trained on, [px]."""
    return int(pipeline.unet.config.sample_size * pipeline.vae_scale_factor)


def noise(seed: int) -> Any:
    """Where sampling starts: drawn on the processor, so that every machine starts from the same."""
    return importlib.import_module("torch").Generator("cpu").manual_seed(seed)
