# Vibrissa. `make demo` and `make test` need Python 3.11 or later, make and git; nothing else.

VENV ?= .venv
DURATION ?= 30
BENCHES ?= live replay faults
BIN := $(VENV)/bin

.DEFAULT_GOAL := help
.PHONY: help demo test bench docs clean

help:
	@echo "make demo    live run on the simulated rig, verified re-run, a picture (DURATION=$(DURATION))"
	@echo "make test    ruff, mypy and pytest"
	@echo "make bench   benchmarks into runs/bench (BENCHES=\"$(BENCHES)\")"
	@echo "make docs    rewrite the generated tables in docs/"
	@echo "make clean   remove $(VENV) and what tools left behind; runs/ stays"

demo: $(VENV)/installed
	@sh tools/demo.sh $(BIN) $(DURATION)

test: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -n auto --dist loadfile -m "not live"
	$(BIN)/python -m pytest -m live

bench: $(VENV)/installed
	@for name in $(BENCHES); do $(BIN)/vibrissa bench $$name --out runs/bench || exit 1; done

docs: $(VENV)/installed
	$(BIN)/python -m vibrissa.tools.docs --write

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/installed: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(VENV)/installed-dev: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@ $(VENV)/installed

$(BIN)/python:
	@python=$$(sh tools/find_python.sh) && echo "making $(VENV) with $$python" && $$python -m venv $(VENV)
