# Every target makes the environment it needs: `make demo` and `make test` work in a fresh clone.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
INSTALL := $(BIN)/python -m pip install -qq --disable-pip-version-check --constraint constraints.txt
PARALLEL := -n auto --dist worksteal  # more processes than cores; long tests come first (tests/conftest.py)

unexport PYTHONDONTWRITEBYTECODE  # else each of the processes that tests start compiles every module anew

.PHONY: install demo test suite test-fast smoke check rules types faults fuzz kill format bench results site clean

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "dmbench needs Python 3.11: no '$(PYTHON)' on the PATH; name yours with 'make $(MAKECMDGOALS) PYTHON=...'."; exit 1; }
	@echo "making the environment $(VENV); this takes a minute or two"
	@$(PYTHON) -m venv $(VENV)
	@$(INSTALL) pip  # a new pip takes 60% of the time of the one that comes with Python 3.11
	@$(INSTALL) torch
	@$(INSTALL) --editable '.[dev]'
	@touch $(STAMP)

demo: install
	$(BIN)/dmbench demo

test: rules
	@$(MAKE) --no-print-directory --jobs 2 types suite  # types take a minute of one core

suite: install
	$(BIN)/python -m pytest $(PARALLEL)

test-fast: install
	$(BIN)/python -m pytest $(PARALLEL) -m 'not slow'

smoke: install
	$(BIN)/python -m tests.installed $(if $(SMOKE),--python $(SMOKE))

fuzz: install
	$(BIN)/python -m tests.fuzz --seconds 3600 --jobs 2

kill: install
	$(BIN)/python -m tests.kill --kills 200

faults: install
	$(BIN)/python -m tests.faults

check: rules types

rules: install
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports

types: install
	$(BIN)/mypy

format: install
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: install
	$(BIN)/dmbench bench

results: install
	$(BIN)/dmbench leaderboard results README.md docs/results.md docs/models/*.md --from docs/leaderboard
	$(BIN)/python tests/test_model_pages.py

site: install
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "open site/index.html"

clean:
	rm -rf $(VENV) build dist site .pytest_cache .mypy_cache .ruff_cache
