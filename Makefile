# `make demo` and `make test` work in a fresh clone with Python 3.11-3.13, git and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
# A file per process at a time: its tests share fixtures, and a ROS domain of their own.
PYTEST := $(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile

# Docstrings: no imperative mood, Google sections without underlines, first sentences of two lines,
# shapes in parentheses, indented examples.
PEP257 := --add-ignore D205 D208 D402 D209 D213 D400 D401 D403 D406 D407 D413 D415 D417

.PHONY: demo test test-slow test-all coverage lint bench docs clean kernels

$(READY): setup.py setup.cfg package.xml
	$(PYTHON) -c 'import sys; assert (3, 11) <= sys.version_info < (3, 14), "imu_fusion needs Python 3.11 to 3.13 (the Jazzy wheels), this is " + sys.version.split()[0] + "; try make PYTHON=python3.12"'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[ros,report,peers,test]'
	touch $@

# What git pull has changed is compiled before several processes want it at once.
kernels: $(READY)
	$(BIN)/imu_fusion compile

demo: kernels
	$(BIN)/imu_fusion demo --out demo_out

test: kernels
	$(PYTEST) -m "not slow"

test-slow: kernels
	$(PYTEST) -m slow

test-all: kernels
	$(PYTEST)

# Compiled code cannot be traced: the kernels run in plain Python here, but for those of the
# smoother, which are too slow that way.
coverage: kernels
	$(PYTEST) -m "not slow" --cov=imu_fusion.estimation --cov-report= test/estimation
	NUMBA_DISABLE_JIT=1 $(PYTEST) --cov=imu_fusion.estimation --cov-append \
	    --cov-report=term test/estimation/test_properties.py -k "not smoother"

# The ament linters are Debian packages: python3-ament-flake8, -pep257, -xmllint.
# ament_copyright is not run: the licence is in LICENSE and package.xml, once.
lint: $(READY)
	$(BIN)/ruff check
	$(BIN)/mypy
	@if command -v ament_flake8 > /dev/null; then set -e -x; ament_flake8 --config setup.cfg imu_fusion launch test; \
	ament_pep257 imu_fusion launch $(PEP257); ament_xmllint package.xml; \
	else echo "ament linters: not installed here, left out"; fi

bench: $(READY)
	$(BIN)/python -m benchmarks

docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

clean:
	rm -rf $(VENV) demo_out site build install log
