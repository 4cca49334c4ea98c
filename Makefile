PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN := $(BIN)/python -m bench

.PHONY: run test lint slow gallery clean

run: $(VENV)/.installed
	$(RUN) +experiment=stiffness_sweep

test: $(VENV)/.installed
	$(BIN)/python -m pytest

slow: $(VENV)/.installed
	$(BIN)/python -m pytest -m slow

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# All experiments again into results/ (what is stored is not repeated), then the README's gallery from them.
gallery: $(VENV)/.installed
	for file in conf/experiment/*.yaml; do $(RUN) +experiment=$$(basename $$file .yaml) || exit 1; done
	$(BIN)/python -m bench.report.gallery README.md results

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt torch==2.13.0
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,engines]'
	touch $@

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache
