"""Both rasterizers on a machine with an NVIDIA GPU: the parity suite, then their times side by side.

    python -m benchmarks.gsplat_parity
    python -m benchmarks.gsplat_parity --wheels wheels --gaussians 20000,100000,300000 --size 640x480

It uses its own Python if the torch of that finds the GPU; otherwise it makes an environment and installs
torch from the registries. Other missing packages, such as gsplat, are installed into the same folder only.
gsplat compiles its kernels at the first run (minutes), with nvcc; the engine is built if it is missing.
"""

import argparse
import os
import shutil
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("numpy", "scipy", "pytest", "jaxtyping", "rich", "ninja", "packaging", "gsplat")
GSPLAT = "gsplat>=1.5.3,<2"
ENGINE = ROOT / "src/aomgen/splatting/libaomgen_splatting.so"
DEVICE = "import torch; print(*torch.cuda.get_device_capability(), sep='.')"


def main() -> None:
    parser = argparse.ArgumentParser(description="Parity and times of both rasterizers on an NVIDIA GPU.")
    parser.add_argument("--folder", type=Path, default=ROOT / "out/gpu", help="what is installed and built")
    parser.add_argument("--wheels", type=Path, help="folder with wheels to install, without a network")
    parser.add_argument("--gaussians", default="20000,100000,300000")
    parser.add_argument("--size", default="640x480")
    arguments = parser.parse_args()
    folder = arguments.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    python = _python_with_gpu(folder)
    site = folder / "site"
    environment = _environment(python, folder, site)
    _install_missing(python, site, environment, arguments.wheels)
    if not ENGINE.exists():
        build = str(folder / "native")
        subprocess.run(["cmake", "-S", str(ROOT), "-B", build, "-DCMAKE_BUILD_TYPE=Release"], check=True)
        subprocess.run(["cmake", "--build", build], check=True)
    suite = [python, "-m", "pytest", "-ra", "-p", "no:cacheprovider", "tests/parity/test_gsplat_parity.py"]
    passed = subprocess.run(suite, cwd=ROOT, env=environment).returncode == 0
    times = [python, str(ROOT / "benchmarks/gsplat_times.py"), arguments.gaussians, arguments.size]
    timed = subprocess.run(times, cwd=ROOT, env=environment).returncode == 0
    sys.exit(0 if passed and timed else 1)


def _python_with_gpu(folder: Path) -> str:
    """Return this Python, or one of an environment in the folder with torch from the registries."""
    if _capability(sys.executable):
        return sys.executable
    if shutil.which("nvidia-smi") is None and not Path("/dev/nvidia0").exists():
        sys.exit("no NVIDIA GPU is found here: neither nvidia-smi nor /dev/nvidia0")
    python = str(folder / "venv/bin/python")
    if not Path(python).exists():
        venv.create(folder / "venv", with_pip=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", "torch>=2.4"], check=True)
    if not _capability(python):
        sys.exit(
            "torch from the registries finds no NVIDIA GPU; does nvidia-smi work, is the driver new enough?"
        )
    return python


def _capability(python: str) -> str:
    """Return the compute capability such as 9.0, empty where torch or the GPU is missing."""
    found = subprocess.run([python, "-c", DEVICE], capture_output=True, text=True)
    return found.stdout.strip() if found.returncode == 0 else ""


def _environment(python: str, folder: Path, site: Path) -> dict[str, str]:
    """Return the environment variables: package and source paths, kernels for this GPU alone."""
    paths = [str(site / "bin"), str(Path(python).parent), os.environ["PATH"], "/usr/local/cuda/bin"]
    return {
        **os.environ,
        "PATH": os.pathsep.join(paths),
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "src"), str(site)]),
        "TORCH_EXTENSIONS_DIR": str(folder / "extensions"),
        "TORCH_CUDA_ARCH_LIST": _capability(python),
        "MAX_JOBS": str(os.cpu_count()),
    }


def _install_missing(python: str, site: Path, environment: dict[str, str], wheels: Path | None) -> None:
    test = f"import importlib.util as u; print(*(n for n in {PACKAGES!r} if not u.find_spec(n)))"
    found = subprocess.run([python, "-c", test], capture_output=True, text=True, check=True, env=environment)
    missing = found.stdout.split()
    pip = [python, "-m", "pip", "install", "--quiet", "--target", str(site)]
    if wheels is not None:
        files = [str(file) for file in sorted(wheels.glob("*.whl"))]
        subprocess.run([*pip, "--upgrade", "--no-index", "--no-deps", *files], check=True)
        return
    others = [name for name in missing if name != "gsplat"]
    if others:
        subprocess.run([*pip, *others], check=True)
    if "gsplat" in missing:
        subprocess.run([*pip, "--no-deps", GSPLAT], check=True)  # its torch is there


if __name__ == "__main__":
    main()
