"""Draw the animation of the README: the recording, its twin, and six generated episodes.

Run as `python scripts/draw_animation.py RUN FILE.webp`, where RUN is the folder of a finished run.
"""

import sys

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

import aomgen as ag
from aomgen.io.video import read_video

# Every sequence is stretched to this number of frames, so that all objects open together; and their rate, [1/s].
FRAMES, FPS = 48, 10
# Size of one sequence, height of the line of text above it, and gap between recording and episodes, [px].
WIDTH, HEIGHT, LINE, GAP = 240, 180, 22, 8
# Episodes in rows of three.
EPISODES, COLUMNS = 6, 3
# WebP quality at which the table's gradients show no blocks; the file has some 1.5 MB.
QUALITY = 60


def main(folder: str, file: str) -> None:
    """Write the animation of a run into a WebP file."""
    run = ag.Run.open(folder)
    video = read_video(run.capture.recording.cameras[0].video)
    path = run.demonstration
    times = np.linspace(path.times_s[0], path.times_s[-1], FRAMES)
    states = path.at(times)
    camera = run.cameras[run.capture.cameras[0]]
    twin = [
        run.twin.render(run.twin.state(joints=joints, gripper=gripper, theta=theta), camera)[0]
        for joints, gripper, theta in zip(states.joints, states.gripper, states.thetas, strict=True)
    ]
    recording = video.frames_srgb[np.abs(video.times_s[:, None] - times).argmin(0)]
    episodes = run.episodes
    # Spread over the assets, whose episodes have consecutive numbers.
    chosen = np.linspace(0, len(episodes) - 1, EPISODES).round().astype(int)
    generated = [stretch(read_video(next(iter(episodes[k].videos.values()))).frames_srgb) for k in chosen]
    frames = [compose(recording[k], twin[k], [sequence[k] for sequence in generated]) for k in range(FRAMES)]
    options = {"duration": 1000 // FPS, "loop": 0, "quality": QUALITY, "method": 6}
    frames[0].save(file, save_all=True, append_images=frames[1:], **options)


def stretch(frames: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Select `FRAMES` of the frames (T, H, W, 3), evenly."""
    return frames[np.linspace(0, len(frames) - 1, FRAMES).round().astype(int)]


def compose(
    recorded: NDArray[np.uint8], twin: NDArray[np.uint8], generated: list[NDArray[np.uint8]]
) -> Image.Image:
    """Place one frame of every sequence on a page; recording above twin, episodes to the right."""
    rows = EPISODES // COLUMNS
    page = Image.new("RGB", ((1 + COLUMNS) * WIDTH + GAP, rows * (HEIGHT + LINE)), "white")
    left = WIDTH + GAP
    tiles = [(recorded, 0, 0, "recorded"), (twin, 0, 1, "twin, replayed")]
    for number, image in enumerate(generated):
        text = "generated and verified: other objects, other poses" if number == 0 else ""
        tiles.append((image, left + number % COLUMNS * WIDTH, number // COLUMNS, text))
    draw = ImageDraw.Draw(page)
    for image, x, row, text in tiles:
        y = row * (HEIGHT + LINE) + LINE
        page.paste(Image.fromarray(image).resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS), (x, y))
        draw.text((x + 4, y - LINE + 4), text, "black", ImageFont.load_default(13))
    return page


if __name__ == "__main__":
    main(*sys.argv[1:])
