# Two commands do everything on a fresh Debian or Ubuntu with Python 3.11 to 3.13 and make:
#   make demo   installs into .venv and runs the whole way on the simulated station
#   make test   installs into .venv and runs the tests

PYTHON ?= python3
VENV := .venv
STAMP := $(VENV)/.installed

# torch: pip brings the build for CUDA on most systems, 5 GB with its libraries. Where there is no GPU, name the CPU build:
# make demo TORCH="torch==2.13.0 --index-url ..." with the address that PyTorch's install page gives.
TORCH ?= $(shell command -v nvidia-smi >/dev/null 2>&1 && echo "torch" || echo "torch==2.13.0")

# The Pythons of `make pythons`.
PYTHONS ?= python3.11 python3.12 python3.13

.PHONY: demo test lint docs gpu pythons clean
.DELETE_ON_ERROR:

# What pip cannot find is said in the first line, its own words after it.
PIP = $(VENV)/bin/python -m pip install --quiet
LOG := $(VENV)/install.log
SYSTEM = $$($(PYTHON) -c "import platform as p; print('Python', p.python_version(), 'on', p.machine(), *p.libc_ver())")
MISSING = { sed -n "s/.*No matching distribution found for \(.*\)/no wheel of \1 for $(SYSTEM)/p" $(LOG) | head -1; cat $(LOG); exit 1; }

$(STAMP): pyproject.toml
	@$(PYTHON) -c "import sys; sys.exit(0 if sys.version_info >= (3, 11) else 'tofcapture needs Python 3.11 or newer: make PYTHON=python3.13')"
	@$(PYTHON) -c "import ensurepip" 2>/dev/null || { echo "this Python has no venv: apt-get install python3-venv"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(PIP) --upgrade pip
	$(PIP) $(TORCH) >$(LOG) 2>&1 || $(MISSING)
	$(PIP) -e ".[all]" --group dev --group docs >$(LOG) 2>&1 || $(MISSING)
	@$(PIP) --only-binary ur-rtde -e ".[ur]" 2>/dev/null || echo "left out: ur-rtde has no wheel for $(SYSTEM); tests of the UR arm skip (docs/ur.md)"
	touch $(STAMP)

demo: $(STAMP)
	$(VENV)/bin/tofcapture demo --out demo-out

test: $(STAMP)
	$(VENV)/bin/python -m pytest -n 3 --dist worksteal

lint: $(STAMP)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports

docs: $(STAMP)
	$(VENV)/bin/python -m tofcapture.files.layout > docs/formats.md
	$(VENV)/bin/python -m tofcapture.record.daemon.app > docs/openapi.json
	$(VENV)/bin/python -m sphinx -q -W --keep-going -b html docs build/docs

# What needs an NVIDIA GPU: its tests, and the times that no other machine can tell.
gpu: $(STAMP)
	$(VENV)/bin/python -m pytest -m gpu
	$(VENV)/bin/python benchmarks/chamfer.py --device cuda
	$(VENV)/bin/python benchmarks/predict.py --device cuda

# Demo and tests of the last commit on each of them, from a fresh clone in build/.
pythons:
	for python in $(PYTHONS); do \
		clone=build/$$(basename $$python); rm -rf $$clone; git clone -q . $$clone || exit 1; \
		$(MAKE) -C $$clone PYTHON=$$python demo test || exit 1; \
	done

clean:
	rm -rf $(VENV)
