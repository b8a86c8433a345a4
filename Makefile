# Everything a fresh machine needs: each target sets up its own environment in .venv first, once.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DOCS_READY := $(VENV)/.docs-ready
WHEEL_READY := $(VENV)/.wheel-ready

.DEFAULT_GOAL := help
.PHONY: help demo test test-portable sanitize fuzz extremes lint docs wheel bench targets clean
.DELETE_ON_ERROR:

help:
	@echo "make demo     captures with and without masks, and what is made of them: outputs/reconstruction.png, demo.png"
	@echo "              make demo IMAGE=photo.png DEPTH=depth.png ARGS='--depth-scale 0.001' draws your own scene"
	@echo "make test     the tests, a process for each core; ARGS='-k camera' runs some of them, ARGS='-n0' in one process"
	@echo "make test-portable  the tests as on other machines: vector widths, compilers, none, threads; up to 30 minutes;"
	@echo "              ARGS='--list' shows them, ARGS='--only aten' runs some, ARGS=--quick a share of each"
	@echo "make sanitize the C sources under address and undefined-behaviour sanitizers: minutes, ARGS='--shapes 100' less"
	@echo "make extremes   how exact captures are at the extremes, as docs/record/extremes.md: minutes; ARGS=--quick a part of it"
	@echo "make fuzz     damaged files through every reading function: 2000, or ARGS='--count 100000 --seed 1 --guided'"
	@echo "make lint     style, spelling and types"
	@echo "make docs     the site of the documentation, in outputs/site: minutes at first, for the examples of its gallery;"
	@echo "              ARGS=--no-gallery runs none of them, ARGS=--linkcheck also asks the addresses of external links"
	@echo "make wheel    a wheel in dist/ that needs no compiler: with the C sources compiled for each level of processors"
	@echo "make bench    the benchmarks on tiny pictures, as outputs/benchmarks.json and .md;"
	@echo "              KORNIA_TIDY_BENCH_SIZE=1024 make bench ARGS='-k capture' takes larger ones"
	@echo "make targets  the figures that rendering is judged by, on a real scene: minutes, on an idle machine"
	@echo "make clean    removes .venv, outputs and caches"
	@echo
	@echo "PYTHON=python3.12 chooses the interpreter (3.11 or newer) for the environment in $(VENV)."

demo: $(READY)
	@$(BIN)/kornia-tidy demo $(if $(IMAGE),--image '$(IMAGE)') $(if $(DEPTH),--depth '$(DEPTH)') $(ARGS)

test: $(READY)
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses=auto --maxprocesses=8 --dist=loadfile $(ARGS)

test-portable: $(READY)
	@$(BIN)/python -m tests.portable $(ARGS)

sanitize: $(READY)
	@$(BIN)/python -m tests.kernels.sanitize $(ARGS)

extremes: $(READY)
	@OMP_NUM_THREADS=1 $(BIN)/python -m tests.extremes $(ARGS)

# What fails is kept in outputs/mutations.
fuzz: $(READY)
	@OMP_NUM_THREADS=1 $(BIN)/python -m tests.mutations.reading $(or $(ARGS),--count 2000)

lint: $(READY)
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/codespell
	@$(BIN)/ty check
	@$(BIN)/lint-imports --no-cache
	@$(BIN)/python docs/make_architecture.py --check

docs: $(DOCS_READY)
	@$(BIN)/python docs/site/make_site.py $(ARGS)

# auditwheel names the wheel after the oldest Linux that it runs on.
wheel: $(WHEEL_READY)
	@rm -rf build/libraries build/wheel
	@$(BIN)/python -m kornia_tidy.kernels.make_libraries build/libraries
	@KORNIA_TIDY_LIBRARIES=build/libraries $(BIN)/python -m build --wheel --no-isolation --outdir build/wheel
	@PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m auditwheel repair --wheel-dir dist build/wheel/*.whl

# The usual options of pytest leave the benchmarks out.
bench: $(READY)
	@mkdir -p outputs
	@$(BIN)/python -m pytest -q --override-ini addopts= tests/benchmarks \
		--benchmark-quiet --benchmark-json=outputs/benchmarks.json $(ARGS)
	@$(BIN)/python -m tests.benchmarks.table outputs/benchmarks.json | tee outputs/benchmarks.md

# Memory that the C library gives back to the system is dear to fetch again, for every method alike: let it keep it.
targets: $(READY)
	@MALLOC_TRIM_THRESHOLD_=2000000000 MALLOC_MMAP_THRESHOLD_=2000000000 $(BIN)/python -m tests.benchmarks.targets

clean:
	rm -rf $(VENV) outputs build dist .pytest_cache .ruff_cache .hypothesis .benchmarks
	find kornia_tidy tests -name __pycache__ -prune -exec rm -rf {} +

$(DOCS_READY): $(READY)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	@touch $@

$(WHEEL_READY): $(READY)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[wheel]'
	@touch $@

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed, $(PYTHON) is not: make PYTHON=/path/to/python3.11"; exit 1; }
	@echo "Setting up $(VENV): some minutes and up to a few gigabytes (PyTorch), once ..."
	@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@
