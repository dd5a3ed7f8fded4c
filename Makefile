# `make` alone lists the targets; each one works as the first command after a fresh clone.

PYTHON ?= python3
PYTEST_ARGS ?= -q
BIN := .venv/bin
STAMP := .venv/.installed

.DEFAULT_GOAL := help
.PHONY: help install test scale demo check docs bench

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "  make %-8s  %s\n", $$1, $$2}' $(MAKEFILE_LIST)

install: $(STAMP)  ## create .venv with .venv/bin/lommel, redone when pyproject.toml changes

$(STAMP): pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install -qq --disable-pip-version-check -e '.[dev]'
	touch $(STAMP)

test: $(STAMP)  ## run the tests, and every example in docstrings, README and docs
	$(BIN)/python -m pytest $(PYTEST_ARGS)

scale: $(STAMP)  ## run the tests of large scenes and of SLURM: an hour or two, 8 GB, 40 GB of disk
	$(BIN)/python -m pytest $(PYTEST_ARGS) -m scale

demo: $(STAMP)  ## simulate an orbit strip, map and refine it, write demo/report.html
	$(BIN)/lommel demo --output demo --overwrite

check: $(STAMP)  ## lint, formatting, types, and who may import whom
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: demo  ## draw the README's pictures from the demo, run the examples in README and docs
	$(BIN)/python docs/pictures.py demo
	$(BIN)/python -m pytest $(PYTEST_ARGS) README.md docs

bench: $(STAMP)  ## measure time, memory and accuracy of the solvers
	$(BIN)/python -m benchmarks
