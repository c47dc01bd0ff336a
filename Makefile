# `make demo` and `make test` work in a fresh clone with Python 3.11-3.13, git and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
# A file per process at a time: its tests share fixtures, and a ROS domain of their own.
PYTEST := $(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile

.PHONY: demo test test-slow test-all bench docs clean

$(READY): setup.py setup.cfg package.xml
	$(PYTHON) -c 'import sys; assert (3, 11) <= sys.version_info < (3, 14), "imu_fusion needs Python 3.11 to 3.13 (the Jazzy wheels), this is " + sys.version.split()[0] + "; try make PYTHON=python3.12"'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[ros,report,peers,test]'
	touch $@

demo: $(READY)
	$(BIN)/imu_fusion demo --out demo_out

test: $(READY)
	$(PYTEST) -m "not slow"

test-slow: $(READY)
	$(PYTEST) -m slow

test-all: $(READY)
	$(PYTEST)

bench: $(READY)
	$(BIN)/python -m benchmarks

docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

clean:
	rm -rf $(VENV) demo_out site build install log
