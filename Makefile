# Development commands, as .ci/run and the README run them, in `.venv`. `make` without a target lists them.

PYTHON ?= .venv/bin/python
BIN := $(dir $(PYTHON))

.PHONY: help setup kernels gates test quick lint format types coverage kernel-coverage docs wasm fingerprint ci nightly release clean

help:  ## list the commands
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 18

setup:  ## create a virtual environment with all development dependencies
	python3 -m venv .venv
	.venv/bin/pip install -q -e ".[dev,docs]"

kernels:  ## build the changed modules of lavender_ext/
	$(PYTHON) setup.py -q build_ext --inplace

test: kernels  ## run all tests
	$(PYTHON) -m pytest -q -n auto --dist worksteal

gates:  ## format, run linters, spelling, layers, the table of calls, contracts of changed solvers (under a minute)
	.ci/gates

quick: kernels  ## run all tests except slow ones, stop at the first failure
	$(PYTHON) -m pytest -q -x -m "not slow"

lint:  ## run ruff, codespell, import-linter and cython-lint
	$(BIN)ruff check .
	$(BIN)codespell
	$(BIN)lint-imports
	PATH="$(abspath $(BIN)):$$PATH" cython-lint $$(git ls-files 'lavender_ext/*.pyx' 'lavender_ext/*.pxd')

format:  ## format Python files as CI requires
	$(BIN)ruff format .

types:  ## run mypy
	$(BIN)mypy
	$(BIN)mypy --config-file .ci/mypy_scripts.ini

pyright:  ## install pyright, which needs npm's package registry, and run it
	$(PYTHON) -m pip install -q "pyright[nodejs]>=1.1.400"
	$(PYTHON) .ci/pyright

coverage:  ## measure the tests' line coverage of the Python files, in build/coverage/index.html
	test -x $(PYTHON) || python3 -m venv .venv
	$(PYTHON) -m pip install -q -e ".[test]" "coverage>=7.10"
	$(PYTHON) -m coverage erase
	$(PYTHON) -m coverage run -m pytest -q -n auto --dist worksteal
	$(PYTHON) -m coverage combine -q
	$(PYTHON) -m coverage html -q -d build/coverage
	$(PYTHON) -m coverage report | tail -n 1

kernel-coverage:  ## list the lines of kernels and C headers that no test runs, in build/coverage/kernels.txt
	$(PYTHON) .ci/kernel_coverage

docs:  ## build the documentation, in site/
	$(PYTHON) -m sphinx -W --keep-going -q -b html docs site

wasm:  ## build the WebAssembly modules, in lavender/sim/web/
	$(BIN)lavender web build lavender/sim/web/lavender.wasm
	$(BIN)lavender web build lavender/sim/web/newton.wasm --part newton

fingerprint:  ## compare the bits of solvers and engine with the stored fingerprint
	$(PYTHON) .ci/fingerprint --compare .ci/fingerprint.txt

ci:  ## run the continuous integration of a change
	bash .ci/run

nightly:  ## run everything that the continuous integration checks at night
	bash .ci/run --all

release:  ## build the files of a release, in dist/; stops if a manual step is required
	PYTHON=$(PYTHON) .ci/release dist

clean:  ## delete the outputs of builds
	rm -rf build site docs/generated
	find lavender_ext -name '*.so' -delete
