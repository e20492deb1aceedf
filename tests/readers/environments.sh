#!/bin/sh
# Environments with the libraries that people read datasets with, each apart from our own: they cap versions
# that we use newer, and pull hundreds of packages that reading a dataset never needs.
#   .venv-lerobot       lerobot 0.4.4, format v3.0
#   .venv-lerobot-v21   lerobot 0.3.3, format v2.1; torch and the rest are those of .venv-lerobot
#   .venv-tfds          TensorFlow Datasets, as OpenVLA reads with
#   .venv-robomimic     robomimic; torch and h5py are those of .venv
set -eu
cd "$(dirname "$0")/../.."
python="${PYTHON:-python3}"

# Create an environment that also sees the packages of another one.
create() {
  [ -x "$1/bin/python" ] || "$python" -m venv "$1"
  if [ -n "${2:-}" ]; then
    here=$("$1/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
    "$2/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))' >"$here/shared.pth"
  fi
}

for name in "$@"; do
  case "$name" in
  lerobot)
    create .venv-lerobot
    .venv-lerobot/bin/pip install --quiet --no-deps torch==2.13.0 torchvision==0.28.0 lerobot==0.4.4
    .venv-lerobot/bin/pip install --quiet -r requirements/lerobot-py311.txt
    ;;
  lerobot-v21)
    create .venv-lerobot-v21 .venv-lerobot
    .venv-lerobot-v21/bin/pip install --quiet --no-deps lerobot==0.3.3
    # Newer versions of `datasets` no longer read format v2.1 with it.
    .venv-lerobot-v21/bin/pip install --quiet --ignore-installed datasets==3.6.0 'numpy<2.3' 'huggingface-hub<0.36'
    ;;
  tfds)
    create .venv-tfds
    .venv-tfds/bin/pip install --quiet tensorflow-cpu==2.21.0 tensorflow-datasets==4.9.10
    ;;
  robomimic)
    create .venv-robomimic .venv
    .venv-robomimic/bin/pip install --quiet --no-deps robomimic==0.3.0 termcolor tqdm
    ;;
  *)
    echo "unknown environment $name" >&2
    exit 1
    ;;
  esac
done
