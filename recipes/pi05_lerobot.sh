#!/bin/sh
# Fine-tune pi0.5 with lerobot 0.4.4:  sh RECIPES/pi05_lerobot.sh DATASET RUNS
# DATASET is a run's own (OUT/dataset, LeRobot v3.0). Never run: no weights, no GPU.
#
# What the paper does not say: LoRA's rank and layers (here all of both language models, and the projections as a whole, as
# openpi does; of one rank), weight decay (here lerobot's), the rate at the end (a tenth). lerobot learns joint targets as they
# are, openpi's recipe their differences from the state. Cameras: the first is base_0_rgb, then left_ and right_wrist_0_rgb.
set -eu
lerobot-train \
  --policy.path=lerobot/pi05_base \
  --dataset.repo_id=aomgen/opening \
  --dataset.root="${1:?DATASET}" \
  --output_dir="${2:?RUNS}/pi05_aomgen" \
  --rename_map='{"observation.images.front": "observation.images.base_0_rgb"}' \
  --peft.method_type=LORA \
  --peft.r=16 \
  --peft.target_modules='.*(language_model|gemma_expert).*\.(q|k|v|o|gate|up|down)_proj' \
  --peft.full_training_modules='["action_in_proj", "action_out_proj", "time_mlp_in", "time_mlp_out"]' \
  --policy.dtype=bfloat16 \
  --policy.chunk_size=5 \
  --policy.n_action_steps=5 \
  --policy.optimizer_lr=5e-5 \
  --policy.optimizer_grad_clip_norm=1.0 \
  --policy.scheduler_warmup_steps=10000 \
  --policy.scheduler_decay_steps=30000 \
  --policy.scheduler_decay_lr=5e-6 \
  --policy.push_to_hub=false \
  --batch_size=16 \
  --steps=30000
