# Two commands do everything on a fresh Debian or Ubuntu with Python 3.11 and make:
#   make demo   installs into .venv and runs the whole way on the simulated station
#   make test   installs into .venv and runs the tests

PYTHON ?= python3
VENV := .venv
STAMP := $(VENV)/.installed

# A GPU build of torch is gigabytes. Where there is no NVIDIA driver and pip would find only that one, name the CPU build:
# make demo TORCH="torch==2.13.0 --index-url ..." with the address that PyTorch's install page gives.
TORCH ?= $(shell command -v nvidia-smi >/dev/null 2>&1 && echo "torch" || echo "torch==2.13.0")

.PHONY: demo test lint docs gpu clean
.DELETE_ON_ERROR:

$(STAMP): pyproject.toml
	$(PYTHON) -c "import sys; sys.exit(0 if sys.version_info >= (3, 11) else 'tofcapture needs Python 3.11 or newer')"
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --upgrade pip
	$(VENV)/bin/python -m pip install --quiet $(TORCH)
	$(VENV)/bin/python -m pip install --quiet -e ".[all]" --group dev --group docs
	touch $(STAMP)

demo: $(STAMP)
	$(VENV)/bin/tofcapture demo --out demo-out

test: $(STAMP)
	$(VENV)/bin/python -m pytest -n 2

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

clean:
	rm -rf $(VENV)
