"""Training of the finder of `handle_act`: `python -m lerobot_policy_aomgen.train_finder IMAGES... OUT --validation IMAGES...`.

The same command continues an interrupted training. `OUT/finder.safetensors` contains the finder and its errors on the
validation images.
"""

import argparse
import sys
import time
from collections import deque
from functools import reduce
from operator import add
from pathlib import Path

import torch

from aomgen.errors import AomgenError
from aomgen.evaluation.finder_errors import format_errors
from lerobot_policy_aomgen.finder import FinderSettings, save_finder
from lerobot_policy_aomgen.finder_errors import make_table, measure_errors
from lerobot_policy_aomgen.finder_images import read_images
from lerobot_policy_aomgen.finder_training import train_finder

# Number of steps between two lines of progress.
REPORT_EVERY = 50


def main(arguments: list[str] | None = None) -> int:
    """Train a finder, print its errors and return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m lerobot_policy_aomgen.train_finder",
        description="Train a finder on labelled images and print its errors on others.",
    )
    parser.add_argument("images", type=Path, nargs="+", help="folder of `aomgen export --format images`")
    parser.add_argument("out", type=Path, help="gets finder.safetensors")
    parser.add_argument(
        "--validation", type=Path, nargs="+", required=True, metavar="IMAGES", help="images of other objects"
    )
    parser.add_argument("--steps", type=int, default=3000, help="number of steps of 32 images (3000)")
    parser.add_argument("--seed", type=int, default=0, help="seed of weights and samples (0)")
    parser.add_argument("--threads", type=int, default=1, help="number of threads of PyTorch (1)")
    crops = FinderSettings.crops_px
    parser.add_argument(
        "--crop",
        type=int,
        nargs="*",
        default=crops,
        help="sides of the crops of the further looks, [px] (96)",
    )
    parser.add_argument("--from-scratch", action="store_true", help="ablation: without pretrained weights")
    given = parser.parse_args(arguments)
    torch.set_num_threads(given.threads)
    settings = FinderSettings(pretrained=not given.from_scratch, crops_px=tuple(given.crop))
    losses, times_s = (deque[float](maxlen=REPORT_EVERY) for _ in range(2))

    def report(step: int, loss: float) -> None:
        losses.append(loss)
        times_s.append(time.monotonic())
        if step % REPORT_EVERY == 0 or step == given.steps:
            left_s = (times_s[-1] - times_s[0]) / max(len(times_s) - 1, 1) * (given.steps - step)
            mean = sum(losses) / len(losses)
            sys.stdout.write(f"step {step} of {given.steps}, loss {mean:.4f}, {left_s / 60:.1f} min left\n")
            sys.stdout.flush()

    try:
        images, others = (
            reduce(add, map(read_images, folders)) for folders in (given.images, given.validation)
        )
        finder = train_finder(images, settings, given.steps, given.seed, given.out, report)
        errors = measure_errors(finder, others)
        save_finder(given.out / "finder.safetensors", finder, errors)
    except AomgenError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    sys.stdout.write(format_errors(make_table(errors, others), "lateral error") + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
