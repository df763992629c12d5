# The commands of this repository; `make help` lists them.

PYTHON ?= python3.11
# make build TORCH=cuda: no word about the gigabytes of PyTorch's CUDA build.
# The distribution of ROS 2: kilted in .venv and ros2_ws; jazzy in .venv-jazzy and ros2_ws/jazzy, where the tests are those
# that start ROS programs.
ROS ?= kilted
# For example: make test TESTS=tests/estimator PYTEST_ARGS="-k organ -x"; make demo DEMO_ARGS=--help.
TESTS ?= $(if $(filter kilted,$(ROS)),tests,tests/integration)
NUMPY1_TESTS := $(if $(filter command line environment,$(origin TESTS)),$(TESTS),tests/estimator tests/node tests/integration/test_colcon.py)
PYTEST_ARGS ?=
DEMO_ARGS ?=
# make demo VIEW=1: with a live page at http://127.0.0.1:8080, until Ctrl-C.
VIEW ?=
# make bench QUICK=1: at most five minutes; BENCH_ARGS=--help.
QUICK ?=
BENCH_ARGS ?=
PAIRS ?= 200
# make soak MINUTES=1; SOAK_ARGS=--help.
MINUTES ?= 10
RATE ?= 3
SOAK_ARGS ?=
# make fuzz COUNT=10000 SEED=1 KIND=meshes; REPLAY=out/fuzz/FILE: one input that was not borne.
COUNT ?= 100000
SEED ?= 0
KIND ?=
REPLAY ?=

export SOFTTISSUE_ROS := $(ROS)
ifeq ($(wildcard requirements-$(ROS).lock)$(filter kilted,$(ROS)),)
$(error expected ROS=kilted or ROS=jazzy, got ROS=$(ROS))
endif

VENV_STAMP := .venv/.installed
ROS_STAMP := $(if $(filter kilted,$(ROS)),.venv,.venv-$(ROS))/.installed
BUILD_STAMP := ros2_ws/$(if $(filter kilted,$(ROS)),,$(ROS)/)install/.built

VENV_INPUTS := constraints.txt requirements.txt requirements-dev.txt requirements-docs.txt requirements-ros.txt \
	requirements-viewer.txt \
	$(wildcard training/pyproject.toml training/setup.py) \
	scripts/check_tools scripts/check_torch scripts/patch_ros_wheels.py scripts/setup_venv scripts/free_gmsh_of_window.py
# Python modules are linked into the workspace, so that editing them needs no build. Folders are listed beside their
# files: their time changes when a file comes or goes.
BUILD_INPUTS := scripts/build_workspace scripts/env.sh \
	$(wildcard $(addprefix softtissue_estimator/,package.xml pyproject.toml setup.py setup.cfg)) \
	$(shell find softtissue_msgs -not -name '.*' -not -path '*/test/*') \
	$(shell find $(addprefix softtissue_estimator/,bags config launch organs rviz weights) \
		-not -name '.*' -not -name '*.pyc' -not -name __pycache__ 2>/dev/null)

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: bench bench-gpu build clean demo distclean docs format fuzz help lint signals soak test test-numpy1 venv verify

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "make %-11s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

venv: $(VENV_STAMP) ## create .venv with everything pinned in constraints.txt

build: $(BUILD_STAMP) ## set up .venv and build the ROS 2 workspace

demo: $(BUILD_STAMP) ## the main job on the bundled phantom: table; report.json, phantom.png, overlay.png in out/demo; VIEW=1: a live page
	@scripts/demo $(if $(filter-out 0,$(VIEW)),--view) $(DEMO_ARGS)

bench: $(BUILD_STAMP) ## time of everything up to the whole path, out/bench/bench.json; QUICK=1: at most five minutes
	@scripts/bench $(if $(filter-out 0,$(QUICK)),--quick) $(BENCH_ARGS)

bench-gpu: $(BUILD_STAMP) ## the same on an NVIDIA GPU, out/bench_gpu/bench.json
	@scripts/bench --device cuda --out out/bench_gpu $(if $(filter-out 0,$(QUICK)),--quick) $(BENCH_ARGS)

test: $(BUILD_STAMP) ## all tests, in the built workspace; ROS=jazzy: tests/integration with ROS 2 Jazzy
	@echo "==> Running the tests"
	@# As an installation does: hundreds of programs start, also where Python may write no bytecode itself.
	@.venv/bin/python -m compileall -q softtissue_estimator/softtissue_estimator training/softtissue_training
	@scripts/run python -m pytest -ra -n auto --dist worksteal $(PYTEST_ARGS) $(TESTS)

test-numpy1: $(BUILD_STAMP) .venv-numpy1/.installed ## core and node with numpy 1.26; TESTS and PYTEST_ARGS as above
	@echo "==> Running the tests with numpy 1.26"
	@scripts/run bash -c 'PATH="$$PWD/.venv-numpy1/bin:$$PATH" exec python -m pytest -ra -n auto --dist worksteal $(PYTEST_ARGS) $(NUMPY1_TESTS)'

signals: $(BUILD_STAMP) ## pairs of signals to the node at random moments, about 8 s each; PAIRS=200
	@scripts/run python tests/integration/signal_pairs.py $(PAIRS)

soak: $(BUILD_STAMP) ## the bundled bag at RATE times its rate, another organ every 20 s, out/soak/soak.json; MINUTES=10 RATE=3
	@scripts/run python tests/integration/soak.py --minutes $(MINUTES) --rate $(RATE) $(SOAK_ARGS)

fuzz: $(BUILD_STAMP) ## damaged files and messages by seed, what was begun goes on; COUNT=100000 SEED=0 KIND= REPLAY=FILE
	@scripts/run --alone python tests/fuzz/campaign.py --count $(COUNT) --seed $(SEED) $(KIND:%=--kind %) $(REPLAY:%=--replay %)

verify: $(VENV_STAMP) ## the physics alone: tests/verification; needs no built workspace
	@echo "==> Verifying the simulations"
	@.venv/bin/python -m pytest -ra $(PYTEST_ARGS) tests/verification

lint: $(VENV_STAMP) ## every check of .pre-commit-config.yaml (ruff, mypy --strict, ...); needs no built workspace
	@.venv/bin/pre-commit run --all-files --color=auto

docs: $(VENV_STAMP) ## the site of the documents, out/site; whatever is not in order fails
	@echo "==> Making the site of the documents"
	@.venv/bin/python scripts/draw_rooms.py
	@.venv/bin/python scripts/site_pages.py
	@NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --strict

format: $(VENV_STAMP) ## let ruff format the sources and mend what it can
	@.venv/bin/ruff check --fix .
	@.venv/bin/ruff format .

clean: ## remove what was built and written: all of ros2_ws but src, out, caches
	rm -rf ros2_ws/build ros2_ws/install ros2_ws/log ros2_ws/jazzy softtissue_estimator/build training/build out .mypy_cache .ruff_cache .pytest_cache .hypothesis

distclean: clean ## and .venv, .venv-jazzy, .venv-numpy1
	rm -rf .venv .venv-jazzy .venv-numpy1 .build.lock softtissue_estimator/*.egg-info training/*.egg-info

$(VENV_STAMP): $(VENV_INPUTS)
	@scripts/setup_venv $(PYTHON)

.venv-jazzy/.installed: requirements-jazzy.lock
.venv-numpy1/.installed: requirements-numpy1.txt
.venv-%/.installed: scripts/setup_beside scripts/patch_ros_wheels.py | $(VENV_STAMP)
	@scripts/setup_beside $*

$(BUILD_STAMP): $(ROS_STAMP) $(BUILD_INPUTS)
	@scripts/build_workspace
