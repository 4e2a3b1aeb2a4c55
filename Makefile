# Each target does all the set-up it needs, in the project's own .venv (Python 3.11 and make are enough).
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PYTEST = $(BIN)/pytest -n auto --dist loadfile --no-loadscope-reorder
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
# The tests start processes by the hundred, and each would compile all sources anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup demo docs pictures lint test test-safety test-all test-slow coverage mutants audit bench clean

help:  ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 14

setup: $(STAMP)  ## install hil and its pinned dependencies into .venv

$(STAMP): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "no python3.11 or python3 found: install Python 3.11, or name one: make setup PYTHON=..."; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	# Where Python may write no bytecode, each start would otherwise compile all sources, a second of it.
	$(BIN)/python -m compileall -q drivers hil identification planner sim_fixtures
	touch $(STAMP)

demo: $(STAMP)  ## the whole way on the simulated NS 16; leaves runs/demo/report.html
	$(BIN)/hil demo --output runs/demo --force

docs: $(STAMP)  ## build the documentation; leaves build/docs/index.html, which opens offline
	$(BIN)/sphinx-build --quiet --fail-on-warning --jobs auto docs build/docs

pictures: $(STAMP) demo  ## draw the pictures of the documentation: examples, screen and report
	for script in examples/0*.py; do $(BIN)/python $$script || exit 1; done
	cp runs/examples/*.png examples/pictures/
	$(BIN)/python docs/screen_picture.py
	$(BIN)/python docs/report_picture.py

lint: $(STAMP)  ## form, types, floors and declared dependencies
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/deptry .

test: $(STAMP)  ## the quick tests, for every change
	$(PYTEST) -m "not slow and not safety and not long"

test-safety: $(STAMP)  ## what drives an arm, and what breaks it: for any change on the way to the controller
	$(PYTEST) -m "safety and not slow"

test-all: $(STAMP)  ## every test but those that take minutes
	$(PYTEST)

test-slow: $(STAMP)  ## the tests that take minutes
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev,fuzz]'
	$(BIN)/pytest -m slow

coverage: $(STAMP)  ## lines and branches of drivers, planner and identification that tests reach
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt coverage==7.17.3
	rm -rf build/coverage && mkdir -p build/coverage
	COVERAGE_FILE="$(CURDIR)/build/coverage/data" $(BIN)/coverage run -m pytest -n auto --dist loadfile --no-loadscope-reorder \
	  tests/drivers tests/planner tests/identification tests/sim_fixtures tests/hil tests/test_*.py
	COVERAGE_FILE="$(CURDIR)/build/coverage/data" $(BIN)/coverage combine --quiet
	COVERAGE_FILE="$(CURDIR)/build/coverage/data" $(BIN)/coverage json --quiet -o build/coverage/data.json
	COVERAGE_FILE="$(CURDIR)/build/coverage/data" $(BIN)/coverage report
	$(BIN)/python -m tests.coverage_figures build/coverage/data.json drivers planner identification

mutants: $(STAMP)  ## changes to what decides a reply, one by one, that no test finds; MODULES=drivers/guard.py for one file
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt mutmut==3.8.1
	$(BIN)/python -m tests.mutants $(MODULES)

audit: $(STAMP)  ## known vulnerabilities of every pinned dependency (asks the Python Package Index)
	$(BIN)/python -m pip check
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt pip-audit==2.10.1
	$(BIN)/pip-audit --requirement constraints.txt --no-deps --disable-pip --strict

bench: $(STAMP)  ## list the benchmarks, and what each measures
	@$(BIN)/python -m benchmarks

clean:  ## remove .venv, runs, mutants and caches
	rm -rf $(VENV) runs build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
