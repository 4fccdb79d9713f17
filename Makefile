# Every target works as the first command in a fresh clone: it makes the virtual environment that it needs.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
EXTRAS ?= dev
PYTEST := $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder
# The tests compile thousands of small programs, which takes longer than running them. So most tests do not optimise their
# programs; the fixture `optimised` makes exceptions. The test of the first hour, and the last step of .ci/run, compile as
# for users.
UNOPTIMISED := JAX_DISABLE_MOST_OPTIMIZATIONS=1
QUICK_COMPILATION := --xla_backend_optimization_level=1 --xla_cpu_use_fusion_emitters=false
export JAXFIT_REFERENCE
# Some machines set this variable. Every process of the tests would then compile all imported modules again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: install test extended release docs portable lint bench demo notebooks wheel clean
.DEFAULT_GOAL := help

help:
	@echo "make install    the package with its compiled kernels, in $(VENV)"
	@echo "make test       the test suite (under five minutes on two cores)"
	@echo "make extended   the slow tests, those that install packages in environments of their own, and the site"
	@echo "make release    before a release: all checks, with all notebooks, the first hour and all compilers"
	@echo "make docs       the documents as a site: open site/index.html, no network is needed"
	@echo "make portable   the kernels with every compiler that is installed, sanitizers and emulators"
	@echo "make lint       formatting, lint and types"
	@echo "make bench      benchmarks against the committed baseline"
	@echo "make demo       simulate a short scene, reconstruct it from its footage, show and export it"
	@echo "make notebooks  run the notebooks and store their output (half an hour)"
	@echo "make wheel      the source distribution and a tried wheel, in dist (ZIG=1: compiled by Zig, for older Linux)"
	@echo "make clean      remove the environment and everything built"

install: $(VENV)/installed

$(VENV)/installed: pyproject.toml $(wildcard kernels/*)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "jaxfit needs Python 3.11 or newer: make PYTHON=/path/to/python3.11 $(MAKECMDGOALS)"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	@$(BIN)/python -m pip uninstall -qq --yes jaxfit # the earlier name of this package, or other software
	CXX="$$($(BIN)/python kernels/compiler.py)" && export CXX && $(BIN)/python -m pip install --editable ".$(if $(EXTRAS),[$(EXTRAS)])"
	@touch $@

test: install
	$(UNOPTIMISED) XLA_FLAGS="$$XLA_FLAGS $(QUICK_COMPILATION)" $(PYTEST)

extended: install docs
	$(UNOPTIMISED) XLA_FLAGS="$$XLA_FLAGS $(QUICK_COMPILATION)" $(PYTEST) -m extended

release: lint test portable
	JAXFIT_RELEASE=1 $(MAKE) extended
	$(BIN)/python tests/support/unchanged.py

# The theme prints a notice about its own future otherwise.
docs: install
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

portable: install
	$(BIN)/python tests/support/portable.py

lint: install
	$(BIN)/ruff check jaxfit kernels tests notebooks .ci
	$(BIN)/ruff format --check jaxfit kernels tests notebooks .ci
	$(BIN)/pyright jaxfit

bench: install
	$(BIN)/python tests/benchmarks/run.py

demo: install
	$(BIN)/jaxfit demo

notebooks: install
	$(BIN)/python tests/support/notebook_runs.py

wheel:
	$(PYTHON) .ci/wheel.py $(if $(ZIG),--zig)

clean:
	rm -rf $(VENV) build dist demo site .pytest_cache .ruff_cache .hypothesis
