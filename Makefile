# A fresh machine needs Python 3.11 or newer, make, gcc and a package index.
PYTHON ?= python3
VENV ?= .venv
# The index serves CUDA builds to whoever asks for the newest torch; a machine with its own torch keeps it.
TORCH ?= torch==2.13.0
PYTEST_ARGS ?= -m "not slow"
# test files are dealt out to this many processes
WORKERS ?= 2

# Where Python may not keep what it compiled, and nothing was compiled at installation, each of a hundred processes
# compiles all that it imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install demo test lint lock
install: $(VENV)/.installed

# Python compiles what is imported when it is first imported; of all that is installed that is a small part.
define in_venv
test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
$(VENV)/bin/python -c "import torch" 2>/dev/null || $(PIP) "$(TORCH)"
$(PIP) -e ".[$(1)]"
endef
PIP = $(VENV)/bin/python -m pip install --progress-bar off --no-compile

$(VENV)/.installed: pyproject.toml
	$(call in_venv,dev)
	touch $@ $(VENV)/.installed-for-use

# without what tests need, which takes longer than all else
USE = video,view
$(VENV)/.installed-for-use: pyproject.toml
	$(call in_venv,$(USE))
	touch $@

demo: $(VENV)/.installed-for-use
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
