# The commands of the people who work on lavender; each is what .ci/run or the README does, run in `.venv`.
# `make` alone lists them.

PYTHON ?= .venv/bin/python
BIN := $(dir $(PYTHON))

.PHONY: help setup kernels test quick lint format types coverage docs wasm fingerprint ci release clean

help:  ## this list
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

setup:  ## a virtual environment with everything that development needs
	python3 -m venv .venv
	.venv/bin/pip install -q -e ".[dev,docs]"

kernels:  ## build what changed in lavender_ext/
	$(PYTHON) setup.py -q build_ext --inplace

test: kernels  ## every test
	$(PYTHON) -m pytest -q -n auto --dist worksteal

quick: kernels  ## tests but for the slow ones, first failure stops
	$(PYTHON) -m pytest -q -x -m "not slow"

lint:  ## ruff, import-linter, cython-lint
	$(BIN)ruff check .
	$(BIN)lint-imports
	PATH="$(abspath $(BIN)):$$PATH" cython-lint $$(git ls-files 'lavender_ext/*.pyx' 'lavender_ext/*.pxd')

format:  ## rewrite Python files in the format that CI expects
	$(BIN)ruff format .

types:  ## mypy
	$(BIN)mypy

coverage:  ## which lines of the Python files the tests reach, in build/coverage/index.html
	test -x $(PYTHON) || python3 -m venv .venv
	$(PYTHON) -m pip install -q -e ".[test]" "coverage>=7.10"
	$(PYTHON) -m coverage erase
	$(PYTHON) -m coverage run -m pytest -q -n auto --dist worksteal
	$(PYTHON) -m coverage combine -q
	$(PYTHON) -m coverage html -q -d build/coverage
	$(PYTHON) -m coverage report | tail -n 1

docs:  ## the documentation, in site/
	$(PYTHON) -m sphinx -W --keep-going -q -b html docs site

wasm:  ## the WebAssembly modules, in lavender/sim/web/
	$(BIN)lavender web build lavender/sim/web/lavender.wasm
	$(BIN)lavender web build lavender/sim/web/newton.wasm --part newton

fingerprint:  ## do solvers and engine still give the bits of the stored fingerprint?
	$(PYTHON) .ci/fingerprint --compare .ci/fingerprint.txt

ci:  ## what the continuous integration runs
	bash .ci/run

release:  ## what a release is made of, in dist/; stops where a person must act
	PYTHON=$(PYTHON) .ci/release dist

clean:  ## what builds leave behind
	rm -rf build site docs/generated
	find lavender_ext -name '*.so' -delete
