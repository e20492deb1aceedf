#!/bin/sh
# Create .venv-policy with the real lerobot 0.4.4, our own package and our plug-ins: it reads our datasets, and its
# unchanged `lerobot-train` and `lerobot-eval` train and evaluate policies. Apart from our own environment, because
# lerobot caps torch and numpy below the versions that we use and asks for hundreds of packages that it does not need.
set -eu
cd "$(dirname "$0")/.."
python="${PYTHON:-python3}"
[ -x .venv-policy/bin/python ] || "$python" -m venv .venv-policy
pip=".venv-policy/bin/pip install --quiet"
$pip --no-deps torch==2.13.0 torchvision==0.28.0 lerobot==0.4.4
$pip -r requirements/policy-py311.txt
$pip -r requirements/policy-py311.txt -e .
$pip --no-deps -e plugins/lerobot_policy_aomgen
packages="$(.venv-policy/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"
cp requirements/torchvision_operators.py "$packages"
echo "import torchvision_operators" > "$packages/torchvision_operators.pth"
