#!/bin/sh
# Create .venv-lerobot with the real lerobot 0.4.4, apart from our own environment: lerobot caps
# torch below the version we use and pulls hundreds of packages that loading a dataset never needs.
set -eu
cd "$(dirname "$0")/.."
python="${PYTHON:-python3}"
[ -x .venv-lerobot/bin/python ] || "$python" -m venv .venv-lerobot
pip=".venv-lerobot/bin/pip install --quiet"
$pip --no-deps torch==2.13.0 torchvision==0.28.0 lerobot==0.4.4
$pip -r requirements/lerobot-py311.txt
