#!/bin/sh
# Environments with the libraries that people train with, and Blender, each apart from our own: they cap versions that we
# use newer, and ask for hundreds of packages that they do not need here.
#   .venv-policy        lerobot 0.4.4 with our package and plug-ins; unchanged `lerobot-train` and `lerobot-eval`
#   .venv-lerobot-v21   lerobot 0.3.3, which reads format v2.1; torch and the rest are those of .venv-policy
#   .venv-tfds          TensorFlow Datasets, as OpenVLA reads with
#   .venv-robomimic     robomimic; torch and h5py are those of .venv
#   .venv-judges        programs of others that check what we write: lerobot-doctor, and splat-transform of PlayCanvas (npm)
#   .venv-blender       Blender as a Python package, run as a program of its own: traces the rooms of `python -m benchmarks replace`
set -eu
cd "$(dirname "$0")/.."
python="${PYTHON:-python3}"

packages() {
  "$1/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))'
}

# Create an environment that also sees the packages of another one.
create() {
  [ -x "$1/bin/python" ] || "$python" -m venv "$1"
  [ -z "${2:-}" ] || packages "$2" >"$(packages "$1")/shared.pth"
}

# Without what a package says it needs.
alone="install --quiet --no-deps"

for name in "$@"; do
  venv=".venv-$name"
  case "$name" in
  policy)
    create $venv
    $venv/bin/pip $alone torch==2.13.0 torchvision==0.28.0 lerobot==0.4.4
    $venv/bin/pip install --quiet -r requirements/policy-py311.txt -e '.[env,reconstruct]'
    $venv/bin/pip $alone -e plugins/lerobot_env_aomgen -e plugins/lerobot_policy_aomgen
    cp requirements/torchvision_operators.py "$(packages $venv)"
    echo "import torchvision_operators" >"$(packages $venv)/torchvision_operators.pth"
    ;;
  lerobot-v21)
    create $venv .venv-policy
    $venv/bin/pip $alone lerobot==0.3.3
    # Newer versions of `datasets` no longer read format v2.1 with it.
    $venv/bin/pip install --quiet --ignore-installed datasets==3.6.0 'numpy<2.3' 'huggingface-hub<0.36'
    echo "import torchvision_operators" >>"$(packages $venv)/shared.pth"
    ;;
  tfds)
    create $venv
    $venv/bin/pip install --quiet tensorflow-cpu==2.21.0 tensorflow-datasets==4.9.10 pillow
    ;;
  robomimic)
    create $venv .venv
    $venv/bin/pip $alone robomimic==0.3.0 termcolor tqdm
    ;;
  judges)
    create $venv .venv
    $venv/bin/pip $alone lerobot-doctor==0.2.0
    npm install --silent --no-audit --no-fund --ignore-scripts --prefix $venv @playcanvas/splat-transform@3.7.0
    ;;
  blender)
    create $venv
    $venv/bin/pip install --quiet bpy==4.2.0
    ;;
  *)
    echo "unknown environment $name" >&2
    exit 1
    ;;
  esac
done
