# Every verb sets up what it needs: .venv, the locked dependencies, the package itself.
PYTHON ?= python3
TORCH := 2.13.0
UV := 0.13.9

BIN := .venv/bin
READY := .venv/.ready
BROWSER_SOUGHT := .venv/.browser-sought
BENCH_READY := .venv/.bench-ready
COMPILE_READY := .venv-compile/.ready
UV_READY := .venv-lock/.ready-$(UV)
NEWEST ?= python3.12
TYPED := $(sort $(patsubst %/,%,$(dir $(wildcard kmn_jax/*.py configs/*.py experiments/*.py benchmarks/*.py))))
COMPILE := .venv-lock/bin/uv --no-config pip compile --quiet --generate-hashes --no-emit-index-url \
	--no-emit-find-links --custom-compile-command "make lock" $(LOCK)

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test check format bench load bench-env browser compile-env newest attack docs lock platforms clean

help: ## list these verbs
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-11s %s\n", $$1, $$2}' Makefile

demo: $(READY) ## find parts in the small test set beside two rivals, and write a report
	$(BIN)/python -m experiments.evaluate demo

test: $(READY) $(BROWSER_SOUGHT) ## run the tests
	$(BIN)/python -m pytest

check: $(READY) ## format, lint and types, changing nothing
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy $(TYPED)
	MYPYPATH=ros2/kmn_ros $(BIN)/mypy ros2/kmn_ros/kmn_ros

format: $(READY) ## format and apply the safe lint fixes
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(READY) ## whether anything is slower than it was, by ratios
	$(BIN)/python -m benchmarks.gate

attack: $(READY) ## read 20,000 damaged files of every format: a few minutes
	$(BIN)/python -m tests.attack --json outputs/attack.json

load: $(READY) ## send 1,000 scans from 8 clients to a server on this machine: about 20 minutes
	$(BIN)/python -m benchmarks.serve --scans 1000 --clients 8

bench-env: $(BENCH_READY) ## add PyTorch, for the benchmarks and the tests marked torch

browser: $(BROWSER_SOUGHT) ## look for a browser for the tests of the page of results, as make test does

compile-env: $(COMPILE_READY) ## add compilers for GPUs and TPUs that are not here (gigabytes), for benchmarks.compiled

newest: ## the tests of geometry, models and poses on Python 3.12 or later (NEWEST=python3.13) with the newest jax
	$(NEWEST) -m venv .venv-newest
	.venv-newest/bin/python -m pip install --quiet --upgrade --upgrade-strategy eager --editable . \
		beartype hypothesis optax pytest pytest-timeout pytest-xdist
	.venv-newest/bin/python -m pytest tests/geometry tests/models tests/pose

docs: $(READY) ## build the documentation into site/, and run the examples of README.md and docs/
	$(BIN)/mkdocs build --strict
	$(BIN)/python -m pytest tests/test_docs.py

lock: $(UV_READY) ## compile pyproject.toml into the two locks (LOCK=--upgrade for newer versions)
	$(COMPILE) --universal --fork-strategy fewest --extra dev pyproject.toml -o requirements.lock
	printf 'torch==$(TORCH)\n' | $(COMPILE) --constraints requirements.lock --no-emit-package torch \
		--no-annotate --python-version 3.11 --python-platform windows - -o requirements-bench.lock

platforms: $(UV_READY) ## see that requirements.lock has wheels for all platforms and versions of Python
	UV=.venv-lock/bin/uv .ci/platforms

clean: ## remove the environments and caches
	rm -rf .venv .venv-lock .venv-compile .venv-newest .cache .mypy_cache .ruff_cache .pytest_cache .hypothesis build dist site

$(READY): requirements.lock pyproject.toml .ci/environment
	PYTHON="$(PYTHON)" .ci/environment
	@touch $@

$(UV_READY):
	$(PYTHON) -m venv .venv-lock
	.venv-lock/bin/python -m pip install --quiet uv==$(UV)
	@touch $@

$(BROWSER_SOUGHT): $(READY)
	.ci/environment browser
	@touch $@

# PyTorch's wheel differs from machine to machine (CPU or CUDA build, often a local file), so it has a version and no
# hash; what it needs besides CUDA is hashed in requirements-bench.lock. The CUDA build does not import without its
# libraries: then, and only then, the gigabytes are fetched. Neither step can touch a version of requirements.lock.
$(BENCH_READY): $(READY) requirements-bench.lock
	$(BIN)/python -m pip install --quiet --require-hashes --only-binary=:all: -r requirements-bench.lock
	$(BIN)/python -m pip install --quiet --no-deps torch==$(TORCH)
	$(BIN)/python -c 'import torch' || $(BIN)/python -m pip install --quiet torch==$(TORCH)
	@touch $@

# Compilers alone: jax and all else come from .venv, whose versions they must match. They stay out of .venv, since jax
# would look for their devices at every start.
$(COMPILE_READY): $(READY)
	$(BIN)/python -m venv .venv-compile
	$(BIN)/python -c 'import site; print(site.getsitepackages()[0])' >$$(echo .venv-compile/lib/python*/site-packages)/shared.pth
	version=$$($(BIN)/python -c 'import jax; print(jax.__version__)') && .venv-compile/bin/python -m pip install \
		--quiet "jax-cuda12-plugin[with-cuda]==$$version" "jax[tpu]==$$version"
	@touch $@
