#!/bin/sh
# Fine-tune OpenVLA:  sh RECIPES/openvla/finetune.sh DATA RUNS     in OpenVLA's folder; DATA holds the folder `opening`
# Never run: no weights, no GPU.
#
# From the paper: LoRA of rank 32, 50,000 steps. It does not say: batch size and rate (here OpenVLA's, for 80 GB), dropout,
# quantization, augmentation. No augmentation here, because deploy.py shows whole images: a policy that learned from crops
# would see another scale.
set -eu
export WANDB_MODE=offline
torchrun --standalone --nnodes 1 --nproc-per-node 1 "$(dirname "$0")/aomgen_oxe.py" vla-scripts/finetune.py \
  --vla_path openvla/openvla-7b \
  --data_root_dir "${1:?DATA}" \
  --dataset_name opening \
  --run_root_dir "${2:?RUNS}" \
  --adapter_tmp_dir "$2/adapters" \
  --use_lora True \
  --lora_rank 32 \
  --lora_dropout 0.0 \
  --max_steps 50000 \
  --batch_size 16 \
  --learning_rate 5e-4 \
  --image_aug False
