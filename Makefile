# `make demo` and `make test` set up what they need in .venv.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
# Python compiles what it imports when it imports it: compiling all that is installed takes longer.
PIP := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check --constraint constraints.txt
# What upsampling needs; what training needs besides; what tests need besides.
BASE := $(VENV)/.base
TRAIN := $(VENV)/.train
READY := $(VENV)/.ready

# Hundreds of processes import the same libraries. With byte code, tests are collected in 9 seconds,
# without it in 21.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo demo-points test quick coverage lint format bench site clean
.DEFAULT_GOAL := test

$(BASE): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "splatseed needs Python 3.11 or newer; set PYTHON=/path/to/python")'
	$(PYTHON) -m venv $(VENV)
	@echo "Installing splatseed in $(VENV) ..."
	@$(PIP) --editable .
	@touch $@

# The requirements without splatseed itself, which may be running meanwhile.
$(TRAIN): $(BASE)
	@echo "Installing PyTorch in $(VENV) ..."
	@$(PIP) $$($(BIN)/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["train"])')
	@touch $@

$(READY): $(BASE)
	$(PIP) --upgrade --editable '.[dev]'
	@touch $@ $(TRAIN)

# PyTorch is installed while the first pictures are made.
demo: $(BASE)
	@$(MAKE) --no-print-directory --jobs 2 $(TRAIN) demo-points
	$(BIN)/splatseed demo --output demo --training only

demo-points: $(BASE)
	$(BIN)/splatseed demo --output demo --overwrite --training later

# A file's tests share what they make, so a file goes to one process. There is a process more than
# there are cores: tests wait a fifth of their time, for browsers, clusters and processes.
test: $(READY)
	$(BIN)/python -m pytest --numprocesses $$($(BIN)/python -c 'import os; print(1 + os.cpu_count())') --dist loadfile

# The tests of the rooms that differ from SINCE, without the slow ones: under 90 seconds.
SINCE ?= HEAD
quick: $(READY)
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile -m 'not slow' \
	  $$($(BIN)/python tests/changed.py $(SINCE))

coverage: $(READY)
	$(BIN)/python -m pytest --cov --cov-report=term

lint: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(READY)
	$(BIN)/python -m benchmarks.upsampling.speed
	$(BIN)/python -m benchmarks.upsampling.geometry
	$(BIN)/python -m benchmarks.rendering.render
	$(BIN)/python -m benchmarks.rendering.train_step

# The pages of docs in the folder site.
site: $(BASE)
	@$(PIP) mkdocs-material
	$(BIN)/python -m mkdocs build --strict

clean:
	rm -rf $(VENV) demo site .mypy_cache .pytest_cache .ruff_cache .hypothesis .coverage
