# A fresh machine needs Python 3.11 or newer, make, gcc and a package index.
PYTHON ?= python3
VENV ?= .venv
# The index serves CUDA builds to whoever asks for the newest torch; a machine with its own torch keeps it.
TORCH ?= torch==2.13.0
PYTEST_ARGS ?= -m "not slow"
# test files are dealt out to this many processes
WORKERS ?= 2

.PHONY: install demo test lint lock
install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -c "import torch" 2>/dev/null || $(VENV)/bin/python -m pip install --progress-bar off "$(TORCH)"
	$(VENV)/bin/python -m pip install --progress-bar off -e ".[dev]"
	touch $@

demo: install
	$(VENV)/bin/python train.py

test: install
	$(VENV)/bin/python -m pytest -n $(WORKERS) --dist worksteal --durations=20 --durations-min=10 $(PYTEST_ARGS)

lint: install
	$(VENV)/bin/python -m ruff check .
	$(VENV)/bin/python -m ruff format --check .
	$(VENV)/bin/python -m mypy

# requirements.lock holds what the package needs, requirements-dev.lock also what its tests need, which can ask for older
# releases: it comes first. Releases that are in the files stay where they still fit; without the files the newest are taken.
LOCK = echo "$(TORCH)" | $(VENV)/bin/uv --config-file .ci/lock.toml pip compile --quiet pyproject.toml -
lock: install
	$(VENV)/bin/python -m pip install --progress-bar off "uv>=0.13"
	$(LOCK) --extra dev --extra sd15 --extra fleet --output-file requirements-dev.lock
	$(LOCK) --constraints requirements-dev.lock --output-file requirements.lock
