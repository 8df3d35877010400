# Everything runs in .venv. `make setup` makes it once; later it does nothing.
PYTHON ?= python3.11
UV_VERSION := 0.9.30
# What the committed records were made with.
PINNED := 'torch==2.13.0' 'mani-skill==3.0.1' 'sapien==3.0.3' 'numpy==1.26.4'
BIN := .venv/bin
# One thread per process: runs and tests use the cores by running several processes.
export OMP_NUM_THREADS := 1
export MKL_NUM_THREADS := 1

.PHONY: help setup demo test test-long test-slow lint requirements clean

help:
	@echo "make setup         create .venv with the pinned packages"
	@echo "make demo          the agents standard and equivariant in a broken world -> leaderboard, in minutes"
	@echo "make test          the default tests, minutes (the others: make test-long, make test-slow)"
	@echo "make lint          ruff, format check, types, import contracts"
	@echo "make requirements  compile requirements.txt from pyproject.toml"

setup: .venv/.complete

.venv/.complete: requirements.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null || \
	  { echo "the pinned packages need Python 3.11 (for others see docs/install.md): make PYTHON=/path/to/python3.11 $(MAKECMDGOALS)" >&2; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv==$(UV_VERSION)
	$(BIN)/uv pip install --quiet --compile-bytecode --python $(BIN)/python --no-deps -r requirements.txt
	$(BIN)/uv pip install --quiet --python $(BIN)/python --no-deps --no-build-isolation -e .
	@$(BIN)/symsteer doctor --quiet
	@touch $@

demo: setup
	$(BIN)/symsteer demo

test: setup
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not long and not slow and not gpu"

test-long: setup
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "long and not slow and not gpu"

test-slow: setup
	$(BIN)/python -m pytest -n 2 -m "slow"

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

requirements:
	printf '%s\n' $(PINNED) | $(BIN)/uv pip compile pyproject.toml - --extra dev --no-header \
	  --python-version 3.11 --no-emit-index-url --no-annotate --upgrade --output-file requirements.txt

clean:
	rm -rf .venv build *.egg-info
