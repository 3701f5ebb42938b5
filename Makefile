# Every verb sets up what it needs: .venv, the locked dependencies, the package itself.
PYTHON ?= python3
TORCH := 2.13.0
UV := 0.13.9

BIN := .venv/bin
READY := .venv/.ready
BENCH_READY := .venv/.bench-ready
TYPED := $(sort $(patsubst %/,%,$(dir $(wildcard kmn_jax/*.py configs/*.py experiments/*.py benchmarks/*.py))))
COMPILE := .venv-lock/bin/uv --no-config pip compile --quiet --generate-hashes --no-emit-index-url \
	--no-emit-find-links --custom-compile-command "make lock" $(LOCK)

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test check format bench bench-env attack docs lock clean

help: ## list these verbs
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' Makefile

demo: $(READY) ## find parts in the small test set beside two rivals, and write a report
	$(BIN)/python -m experiments.evaluate demo

test: $(READY) ## run the tests
	$(BIN)/python -m pytest

check: $(READY) ## format, lint and types, changing nothing
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy $(TYPED)

format: $(READY) ## format and apply the safe lint fixes
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(READY) ## whether anything is slower than it was, by ratios
	$(BIN)/python -m benchmarks.gate

attack: $(READY) ## read 20,000 damaged files of every format: about 20 minutes
	$(BIN)/python -m tests.attack --json outputs/attack.json

bench-env: $(BENCH_READY) ## add PyTorch, for the benchmarks and the tests marked torch

docs: $(READY) ## build the documentation into site/, and run the examples of README.md and docs/
	$(BIN)/mkdocs build --strict
	$(BIN)/python -m pytest tests/test_docs.py

lock: ## compile pyproject.toml into the two locks (LOCK=--upgrade for newer versions)
	$(PYTHON) -m venv .venv-lock
	.venv-lock/bin/python -m pip install --quiet uv==$(UV)
	$(COMPILE) --universal --fork-strategy fewest --extra dev pyproject.toml -o requirements.lock
	printf 'torch==$(TORCH)\n' | $(COMPILE) --constraints requirements.lock --no-emit-package torch \
		--no-annotate --python-version 3.11 --python-platform windows - -o requirements-bench.lock

clean: ## remove the environments and caches
	rm -rf .venv .venv-lock .cache .mypy_cache .ruff_cache .pytest_cache .hypothesis build dist site

$(READY): requirements.lock pyproject.toml .ci/environment
	PYTHON="$(PYTHON)" .ci/environment
	@touch $@

# PyTorch's wheel differs from machine to machine (CPU or CUDA build, often a local file), so it has a version and no
# hash; what it needs besides CUDA is hashed in requirements-bench.lock. The CUDA build does not import without its
# libraries: then, and only then, the gigabytes are fetched. Neither step can touch a version of requirements.lock.
$(BENCH_READY): $(READY) requirements-bench.lock
	$(BIN)/python -m pip install --quiet --require-hashes --only-binary=:all: -r requirements-bench.lock
	$(BIN)/python -m pip install --quiet --no-deps torch==$(TORCH)
	$(BIN)/python -c 'import torch' || $(BIN)/python -m pip install --quiet torch==$(TORCH)
	@touch $@
