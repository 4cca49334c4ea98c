PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN := $(BIN)/python -m bench

.PHONY: run test lint slow slow-all docs site gallery clean

run: $(VENV)/.installed
	$(RUN) +experiment=stiffness_sweep

test: $(VENV)/.installed
	$(BIN)/python -m pytest

slow: $(VENV)/.installed
	$(BIN)/python -m pytest -m 'slow and not full' --dist worksteal

# The slow tests with full crossings of scenes, laws and backends instead of a design of them.
slow-all: $(VENV)/.installed
	$(BIN)/python -m pytest -m 'slow or full' --dist worksteal

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy -n 2
	$(BIN)/python validation/size.py

# The generated parts of the documents: answers, columns and marked figures.
docs: $(VENV)/.installed
	$(BIN)/python -m docs.build

# The site as HTML, from the documents and the stored results: build/site/html/index.html.
site: $(VENV)/.installed
	$(BIN)/python -m docs.build site

# Run the missing cells of all experiments into results/standard, then write answers and figures into the documents.
gallery: $(VENV)/.installed
	for name in $$(cd conf/experiment && find * -name '*.yaml' | sed 's/\.yaml$$//' | sort); do \
	  $(RUN) +experiment=$$name results_dir=results/standard || exit 1; done
	for name in $$(cd examples/cost_of_error/experiment && find * -name '*.yaml' | sed 's/\.yaml$$//' | sort); do \
	  $(RUN) +experiment=$$name plugins=examples/cost_of_error results_dir=results/standard || exit 1; done
	$(BIN)/python -m docs.build results figures

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt torch==2.13.0
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[all,dev]'
	touch $@

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache
