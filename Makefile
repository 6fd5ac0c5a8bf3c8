# terrabound: every target sets up what it needs; the second call is quick.
# Needs Python 3.11 (with venv), make and git.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: help demo test lint prove bench clean

help:
	@echo "make demo    emulated robot over stairs, map with bounds, remote copy, picture (no hardware)"
	@echo "make test    all tests"
	@echo "make lint    style, types, import contracts"
	@echo "make prove   the long soundness runs"
	@echo "make bench   measure, and rewrite bench/RESULTS.md"
	@echo "make clean   remove the virtual environment and caches"

$(READY): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "terrabound needs Python 3.11 or newer; none was found on PATH" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "terrabound needs Python 3.11 or newer; $(PYTHON) is older. Try: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
		echo "$(PYTHON) cannot make virtual environments. On Debian: apt install python3-venv" >&2; exit 1; }
	@echo "setting up $(VENV) (once; about a minute)"
	@$(PYTHON) -m venv $(VENV)
	@PIP_CONSTRAINT=constraints.txt $(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[plots,dev]'
	@touch $(READY)

demo: $(READY)
	$(BIN)/terrabound demo

test: $(READY)
	$(BIN)/pytest -n auto --dist loadfile

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

prove: $(READY)
	$(BIN)/python -m bench.prove_parsers
	$(BIN)/python -m bench.prove_poses --page
	$(BIN)/python -m bench.prove_poses --set ellipsoid --steps 100000 --seeds 40
	$(BIN)/python -m bench.prove_robots --page
	$(BIN)/python -m bench.prove_mounts --page
	$(BIN)/python -m bench.prove_boxes
	$(BIN)/python -m bench.prove

bench: $(READY)
	$(BIN)/python -m bench.run

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache demo-output
