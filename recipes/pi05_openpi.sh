#!/bin/sh
# Fine-tune pi0.5 with openpi: statistics, then 30,000 steps. In openpi's folder:  HF_LEROBOT_HOME=DATA sh RECIPES/pi05_openpi.sh
# DATA/aomgen/opening is made by:  aomgen export OUT DATA/aomgen/opening --format lerobot-v2.1
set -eu
: "${HF_LEROBOT_HOME:?the folder that holds aomgen/opening}"
recipe="$(dirname "$0")/pi05_openpi.py"
# LoRA wants 22.5 GB by openpi's account; JAX takes three quarters of a GPU unless told otherwise.
export XLA_PYTHON_CLIENT_MEM_FRACTION=0.9
uv run "$recipe" scripts/compute_norm_stats.py --config-name pi05_aomgen
uv run "$recipe" scripts/train.py pi05_aomgen --exp-name opening
