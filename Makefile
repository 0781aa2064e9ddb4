# Needs git, make and Python >= 3.11; everything else goes into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
SCENE ?= scenes/sysid/beam_twin.yaml
DEMO := scenes/sysid/beam_twin.yaml
SIZE ?= quick
MINUTES ?= inf

# Tests run two at a time, each on one thread, unless a test asks for more itself.
PYTEST := NUMBA_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest
PARALLEL := -n 2 --dist loadfile

.DEFAULT_GOAL := help
.PHONY: help setup lint types pytest test test-nojit test-slow test-rl test-render bench profile demo reproduce-figures clean-cache clean

help: ## list these targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-17s %s\n", $$1, $$2}'

setup: $(READY) ## make the environment in .venv, from constraints.txt

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo "$(PYTHON) is older than 3.11; name a newer one: make setup PYTHON=python3.12" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt hatchling
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable '.[dev]'
	@touch $@

lint: $(READY) ## ruff
	$(BIN)/ruff check . && $(BIN)/ruff format --check .

types: $(READY) ## mypy
	$(BIN)/mypy

test: lint types pytest ## ruff, mypy, then the fast tests

pytest: $(READY) ## the fast tests alone
	$(PYTEST) $(PARALLEL)

test-nojit: $(READY) ## the fast tests without whole jobs, in plain Python: slow kernels, but index errors show
	NUMBA_DISABLE_JIT=1 $(PYTEST) $(PARALLEL) $(addprefix --ignore=tests/,jobs cli test_scenes.py benchmarks)

test-slow: $(READY) ## the tests that take minutes
	$(PYTEST) $(PARALLEL) -m slow

test-rl: $(READY) ## scenes as environments, PPO, autoencoders; installs the extra `rl` (plain torch: several GB; install a CPU build first)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable '.[rl]'
	$(PYTEST) -n0 -m rl

test-render: $(READY) ## pictures in 3D and films; installs the extras `viz3d` and `video`
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable '.[viz3d,video]'
	$(PYTEST) -n0 tests/figures/test_render.py

bench: $(READY) ## ns per particle and substep, pass by pass, and beside the peers that are installed -> benchmarks/measured
	$(BIN)/cqrun bench --output benchmarks/measured/bench.json
	$(BIN)/python -m benchmarks.peers

profile: $(READY) ## where a run's time goes, pass by pass: make profile SCENE=path/to/scene.yaml
	$(BIN)/cqrun bench $(SCENE)

demo: $(READY) ## recover the material of a soft beam from its motion, in under five minutes
	$(BIN)/cqrun sysid $(DEMO) --fresh
	@echo; echo "The result: $$(ls -td results/$(basename $(notdir $(DEMO)))/*/ | head -n 1)"

reproduce-figures: $(READY) ## both papers' figures with a verdict each -> results/figures/index.html; SIZE=paper takes days, MINUTES=n stops after n
	$(BIN)/python -m benchmarks.papers --size $(SIZE) --minutes $(MINUTES)

clean-cache: $(READY) ## forget the compiled kernels of every version
	$(BIN)/python -c 'import platformdirs, shutil; shutil.rmtree(platformdirs.user_cache_dir("cqrun"), True)'

clean: ## remove the environment and the tools' caches; results stay
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
