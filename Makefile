# Everything runs in .venv, which is made here with nothing but Python's own venv and pip.
PYTHON ?= python3
BIN := .venv/bin
PYTEST := $(BIN)/python -m pytest
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
SOURCES := $(wildcard src tests benchmarks)

.DELETE_ON_ERROR:
.PHONY: help demo test lint format bench docs wheel clean distclean

help:
	@echo "make demo       simulate a Rasnik, analyse the images, show where the mask was"
	@echo "make test       run the tests            (ARGS='-k mask' for some of them)"
	@echo "make lint       ruff and mypy            (make format mends the layout)"
	@echo "make bench      run the benchmarks"
	@echo "make docs       the pages as a site, in site/"
	@echo "make wheel      build the package and try it"
	@echo "make clean      remove what was made     (make distclean: the environment too)"

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "$(PYTHON) is older than 3.11; name a newer one: make PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv .venv

# The stamps are written last, so that an interrupted installation is taken up again.
.venv/.package: pyproject.toml | $(BIN)/python
	$(PIP) install --editable .
	@touch $@

.venv/.dev: pyproject.toml | $(BIN)/python
	$(PIP) install --editable '.[dev]'
	@touch $@ .venv/.package

# Cameras: what Debian's Aravis is used through. It is compiled here, if what it needs is there.
.venv/.camera: .venv/.dev
	@pkg-config --exists gobject-introspection-1.0 cairo 2>/dev/null || \
	  { echo "GigE and USB3 Vision cameras are left out: docs/cameras.md names the Debian packages"; exit 0; }; \
	$(PIP) install --editable '.[camera]' && touch $@ || echo "PyGObject does not install; cameras are left out"

# Packages to compare with; where they do not install, the benchmarks go without them and say so.
.venv/.bench: .venv/.dev
	$(PIP) install --editable '.[bench]' && touch $@ || echo "the packages to compare with do not install"

demo: .venv/.package
	$(BIN)/rasnik demo $(ARGS)

# Most tests run beside each other, then those of what happens in time (status 5: none chosen).
test: .venv/.dev .venv/.camera
	@status=0; \
	$(PYTEST) -n auto --dist loadfile -m "not timed" $(ARGS) || [ $$? -eq 5 ] || status=1; \
	$(PYTEST) -m timed $(ARGS) || [ $$? -eq 5 ] || status=1; \
	exit $$status

lint: .venv/.dev
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/mypy

format: .venv/.dev
	$(BIN)/ruff check --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

bench: .venv/.dev .venv/.bench
	@set -e; for file in $(sort $(wildcard benchmarks/[!_]*.py)); do echo "== $$file"; $(BIN)/python "$$file" $(ARGS); done

.venv/.docs: pyproject.toml | $(BIN)/python
	$(PIP) install --editable '.[docs]'
	@touch $@

# Warnings are errors; the variable spares the build advertisements.
docs: .venv/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build
	@echo "open site/index.html"

# What is shipped must work without the checkout: systems and type marker included.
wheel: .venv/.dev
	rm -rf build/wheel dist
	$(PIP) wheel --no-deps --wheel-dir dist .
	$(PIP) install --no-deps --target build/wheel dist/rasnik-*.whl
	cd build && PYTHONPATH=wheel ../$(BIN)/python -c "import rasnik, pathlib as p; \
	  here = p.Path(rasnik.__file__).parent; assert here.parent.name == 'wheel', here; \
	  assert (here / 'py.typed').exists(); \
	  print('wheel has', *[rasnik.load_system(n).name for n in rasnik.system_names()])"

clean:
	rm -rf build dist demo site .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find $(SOURCES) -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean
	rm -rf .venv
