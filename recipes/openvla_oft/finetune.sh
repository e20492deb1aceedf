#!/bin/sh
# Fine-tune OpenVLA-OFT:  sh RECIPES/openvla_oft/finetune.sh DATA RUNS    in its folder; DATA holds the folder `opening`
# Never run: no weights, no GPU. The paper has no OFT: only rank and steps are its OpenVLA's, the rest is OFT's own.
#
# OFT takes its constants from the words of the command line, anywhere in it: `libero` before `aloha` before `bridge`, and
# libero without any. Ours are libero's: 8 actions at once, 7 numbers each, a state of 8. The note below says the word, so that
# a folder called bridge changes nothing; it becomes part of the checkpoint's name, and so deploy.py finds the word, too.
set -eu
export WANDB_MODE=offline
torchrun --standalone --nnodes 1 --nproc-per-node 1 "$(dirname "$0")/../openvla/aomgen_oxe.py" vla-scripts/finetune.py \
  --vla_path openvla/openvla-7b \
  --data_root_dir "${1:?DATA}" \
  --dataset_name opening \
  --run_root_dir "${2:?RUNS}" \
  --run_id_note libero_constants \
  --use_l1_regression True \
  --use_diffusion False \
  --use_film False \
  --num_images_in_input 1 \
  --use_proprio True \
  --lora_rank 32 \
  --max_steps 50000 \
  --batch_size 8 \
  --learning_rate 5e-4 \
  --image_aug True
