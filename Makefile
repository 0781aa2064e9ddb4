# Needs git, make and Python >= 3.11. Everything else is installed in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
SCENE ?= scenes/sysid/beam_twin.yaml
DEMO := scenes/sysid/beam_twin.yaml
SIZE ?= quick
MINUTES ?= inf

# Two tests run at a time, each on one thread unless the test itself asks for more.
PYTEST := NUMBA_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest
PARALLEL := -n 2 --dist loadfile

# These tests compile most kernels, whose code stays in the memory of their processes: they have processes of their own.
ENGINE := tests/engine
KERNELS := $(addprefix tests/,actuators benchmarks boundaries materials numerics)

.DEFAULT_GOAL := help
.PHONY: help setup lint types pytest test test-nojit test-slow test-rl test-render docs bench profile demo reproduce-figures clean-cache clean

help: ## list all targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-17s %s\n", $$1, $$2}'

setup: $(READY) ## create the environment in .venv, with the versions in constraints.txt

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo "$(PYTHON) is older than 3.11; name a newer one: make setup PYTHON=python3.12" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt hatchling
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable '.[dev]'
	@touch $@

lint: $(READY) ## run ruff
	$(BIN)/ruff check . && $(BIN)/ruff format --check .
	$(BIN)/ruff check --preview --select PLW1514 cqrun  # no encoding is left to the locale

types: $(READY) ## run mypy
	$(BIN)/mypy

test: lint types pytest ## run ruff, mypy and the fast tests

pytest: $(READY) ## run the fast tests alone
	status=0; \
	$(PYTEST) $(PARALLEL) $(ENGINE) || status=1; \
	$(PYTEST) $(PARALLEL) $(KERNELS) || status=1; \
	$(PYTEST) $(PARALLEL) $(addprefix --ignore=,$(ENGINE) $(KERNELS)) || status=1; \
	exit $$status

test-nojit: $(READY) ## run the fast tests without whole jobs in plain Python: slow, but index errors show
	NUMBA_DISABLE_JIT=1 $(PYTEST) $(PARALLEL) $(addprefix --ignore=tests/,jobs cli test_scenes.py benchmarks)

test-slow: $(READY) ## run the tests that take minutes
	$(PYTEST) $(PARALLEL) -m slow

test-rl: $(READY) ## test environments, PPO and autoencoders; installs the extra `rl` (plain torch is several GB: install its CPU build first)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable '.[rl]'
	$(PYTEST) -n0 -m rl

test-render: $(READY) ## test 3D pictures and films; installs the extras `viz3d` and `video`
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable '.[viz3d,video]'
	$(PYTEST) -n0 tests/figures/test_render.py

docs: $(READY) ## build the documentation -> build/docs/index.html, which needs no network
	$(BIN)/python -m docs.building

bench: $(READY) ## measure ns per particle and substep of each pass, and of installed peers -> benchmarks/measured
	$(BIN)/cqrun bench --output benchmarks/measured/bench.json
	$(BIN)/python -m benchmarks.peers

profile: $(READY) ## measure the time of each pass in a scene: make profile SCENE=path/to/scene.yaml
	$(BIN)/cqrun bench $(SCENE)

demo: $(READY) ## identify the material of a soft beam from its motion, in under five minutes
	$(BIN)/cqrun sysid $(DEMO) --fresh --out results
	@echo; echo "The result: $$(ls -td results/$(basename $(notdir $(DEMO)))/*/ | head -n 1)"

reproduce-figures: $(READY) ## rebuild both papers' figures, with verdicts -> results/figures/index.html; SIZE=paper takes days, MINUTES=n stops after n
	$(BIN)/python -m benchmarks.papers --size $(SIZE) --minutes $(MINUTES)

clean-cache: $(READY) ## delete the compiled kernels of all versions
	$(BIN)/python -c 'import platformdirs, shutil; shutil.rmtree(platformdirs.user_cache_dir("cqrun"), True)'

clean: ## delete the environment and the caches of tools; results stay
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
