# Fresh machine: Python 3.11 or newer and make. Everything else goes into .venv.
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DOCS := $(VENV)/.installed-docs
RECORDINGS := peg_probe point_probe_10_pushes
# Packages that the benchmarks measure beside bcppl; each gets an environment of its own.
PEERS := particles blackjax open3d chsel
# Test processes; each keeps to one thread. Bytecode is kept, for they begin many others.
JOBS ?= 2
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest

.PHONY: run test tests lint long docs notebooks peers check-links clean help
.DEFAULT_GOAL := help

help:
	@echo "make run          estimate the part's pose in the shipped recordings; beliefs and figures go to runs/"
	@echo "make test         style, types and the quick tests"
	@echo "make long         the other tests: seconds to minutes each"
	@echo "make docs         the documentation as a site, in build/docs: open build/docs/index.html"
	@echo "make notebooks    execute the notebooks in place; their outputs are kept (NOTEBOOKS=series for one)"
	@echo "make peers        environments of the packages that the benchmarks compare with, in benchmarks/.peers"
	@echo "make check-links  are bcppl/models and bcppl/inference symbolic links?"
	@echo "make clean        remove what was built, the virtual environment too"

run: $(STAMP)
	@for name in $(RECORDINGS); do $(BIN)/bcppl run models/recordings/$$name.h5 || exit 1; done

# The linter and the type checker run beside the tests.
test: $(STAMP)
	@$(MAKE) --no-print-directory -j2 lint tests

# Files in the order of their names: by size, those with few and long tests would be left to one process.
tests: $(STAMP)
	$(PYTEST) -n $(JOBS) --dist loadfile --no-loadscope-reorder

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

long: $(STAMP)
	$(PYTEST) -m long -n $(JOBS) --dist loadfile --no-loadscope-reorder

# Warnings are errors. Pages that have not changed are not made again.
docs: $(DOCS)
	$(BIN)/python -m sphinx -W --keep-going -q -b html -d build/doctrees docs build/docs
	$(BIN)/python docs/check_site.py build/docs

# All, or those that are named; some minutes. They are kept with their outputs, which the site shows.
notebooks: $(STAMP)
	$(BIN)/python notebooks/execute.py $(NOTEBOOKS)

$(DOCS): $(STAMP)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable ".[docs]"
	@touch $@

peers: $(PEERS:%=benchmarks/.peers/%/.installed)

benchmarks/.peers/%/.installed: benchmarks/peers/%.txt | $(STAMP)
	$(BIN)/python -m venv --clear $(@D)
	@torch=$$(grep '^torch==' $<); if [ -n "$$torch" ]; then $(@D)/bin/python -m pip install --quiet "$$torch"; fi
	$(@D)/bin/python -m pip install --quiet --requirement $<
	@touch $@

# torch goes first and alone: pip then takes the build of that version that the machine offers (a local CPU one,
# say), and the calls after it leave it as it is.
$(STAMP): pyproject.toml constraints.txt | check-links
	@if [ ! -x $(BIN)/python ]; then \
	    for python in python3.11 python3 python3.12 python3.13 python3.14; do \
	        if $$python -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
	            exec $$python -m venv $(VENV); \
	        fi; \
	    done; \
	    echo "No Python 3.11 or newer with its venv module was found; install it (Debian: apt install python3.11-venv)." >&2; \
	    exit 1; \
	fi
	$(BIN)/python -m pip install --quiet "$$(grep '^torch==' constraints.txt)"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt setuptools
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable ".[dev]"
	@# What runs on a GPU is tested by a stand-in, whose kernels Warp runs; without it those tests are skipped.
	-@$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable ".[warp]"
	@touch $@

check-links:
	@for name in models inference; do \
	    if [ ! -L bcppl/$$name ] || [ ! -d bcppl/$$name ]; then \
	        echo "bcppl/$$name is not a symbolic link to ../$$name, so this checkout cannot be imported." >&2; \
	        echo "Mend it with:  git config core.symlinks true && git checkout -- bcppl/$$name" >&2; \
	        echo "or by hand:    rm -rf bcppl/$$name && ln -s ../$$name bcppl/$$name" >&2; \
	        echo "(Windows: switch developer mode on first, or work in WSL.)" >&2; \
	        exit 1; \
	    fi; \
	done

clean:
	rm -rf $(VENV) benchmarks/.peers build docs/generated dist runs *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find bcppl models inference tests notebooks benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
