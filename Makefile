# `make demo` and `make test` set up everything they need in .venv.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: demo test quick coverage lint format bench clean
.DEFAULT_GOAL := test

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "splatseed needs Python 3.11 or newer; set PYTHON=/path/to/python")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade --constraint constraints.txt --editable '.[dev]'
	touch $@

demo: $(READY)
	$(BIN)/splatseed demo --output demo --overwrite

# A file's tests share what they make, so a file goes to one process.
test: $(READY)
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile

# The tests of the rooms that differ from BASE, without the slow ones: under 90 seconds.
BASE ?= HEAD
quick: $(READY)
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile -m 'not slow' \
	  $$($(BIN)/python tests/changed.py $(BASE))

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

clean:
	rm -rf $(VENV) demo .mypy_cache .pytest_cache .ruff_cache .hypothesis .coverage
