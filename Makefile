# `make` sets up and runs the sample shot; `make test` sets up and checks everything.
# Both need python3 (3.11 or later) and nothing else; a C compiler makes it faster.

PYTHON ?= python3
BIN := .venv/bin
COMPILED := $(wildcard shadowtool/*/_*.c shadowtool/*/_*.h)

.DEFAULT_GOAL := sample
.PHONY: sample test bench bench-speed soak format readme clean

sample: .venv/installed
	$(MAKE) -C sample_data PATH="$(abspath $(BIN)):$$PATH"

test: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest

# Rendered scenes with known truth (four minutes each, once), and how near we come to it.
bench: .venv/installed-bench
	$(BIN)/python -m tests.benchmarks.footage
	$(BIN)/python -m tests.benchmarks.plates
	$(BIN)/python -m tests.benchmarks.matting
	$(BIN)/python -m tests.benchmarks.warp
	$(BIN)/python -m tests.benchmarks.composite

# How fast the commands are beside OpenEXR alone and beside oiiotool; half an hour on two cores.
bench-speed: .venv/installed-dev
	$(BIN)/python -m compileall -q shadowtool
	$(BIN)/python -m tests.benchmarks.speed

# Two hundred kills and more, at random moments of every step.
soak: .venv/installed-dev
	$(BIN)/python -m tests.soak

format: .venv/installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

.venv/installed-bench: pyproject.toml $(COMPILED) | .venv/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[dev,sample,bench]"
	touch $@ .venv/installed-dev .venv/installed

# The README's reference of the commands, from their own --help.
readme: .venv/installed-dev
	$(BIN)/python -m tests.cli.reference

clean:
	$(MAKE) -C sample_data clean
	rm -rf .venv

.venv/bin/python:
	$(PYTHON) -m venv .venv

# Compiled once, for accounts that may not write here.
.venv/installed: pyproject.toml $(COMPILED) | .venv/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	$(BIN)/python -m compileall -q shadowtool
	touch $@

.venv/installed-dev: pyproject.toml $(COMPILED) | .venv/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[dev]"
	$(BIN)/python -m compileall -q shadowtool
	touch $@ .venv/installed
