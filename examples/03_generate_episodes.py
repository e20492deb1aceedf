"""From a finished run to rendered states, new episodes and a dataset: python examples/03_generate_episodes.py RUN FOLDER"""

import sys

from PIL import Image

import aomgen as ag

run = ag.Run.open(sys.argv[1])
image, depth, labels = run.twin.render(run.twin.state(theta=0.6), run.cameras["front"])
Image.fromarray(image).save("half_open.png")
episodes = list(ag.generate(run, ["microwave:1"], n=3, ranges=ag.Ranges(yaw_deg=(-20, 20))))
print([round(episode.episode.verdict["margin"], 3) for episode in episodes])
dataset = ag.export(episodes, sys.argv[2], "lerobot-v3")
print(f"{len(dataset.train)} episodes, {dataset.frames} frames")
