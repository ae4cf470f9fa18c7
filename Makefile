# Two commands do all on a fresh Debian 12 with git, make and Python 3.11: `make demo` and `make test`.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
JOBS ?= 2
# One thread per process for linear algebra: small matrices, and the same sums in the same order everywhere.
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
export MPLBACKEND := Agg

.PHONY: help setup demo test check format lock bench sweep campaign replay refs docs debian-packages clean

help:
	@echo "make demo      set up, fly missions/cement_store.yaml in the emulated store, show the result"
	@echo "make test      set up, install what the tests need (mosquitto, Chromium), run them"
	@echo "make check     lint, format, types, layers (under a minute)"
	@echo "make bench     registration side by side with its peers"
	@echo "make sweep     the paper's 60 flights"
	@echo "make campaign  seeds and worlds beyond the tests"
	@echo "make replay    fly the recordings of missions/replays again, compare with what is expected"
	@echo "make refs      rewrite what is expected of them and print what changed"
	@echo "make docs      rewrite the generated parts of docs/"
	@echo "make lock      lock the versions again"

setup: $(STAMP)

$(STAMP): requirements.lock pyproject.toml
	@command -v $(PYTHON) >/dev/null || { echo "make: $(PYTHON) is needed (apt-get install python3.11 python3.11-venv), or say make PYTHON=python3.12" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

demo: setup
	$(BIN)/stockpilot run missions/cement_store.yaml --out runs/demo

debian-packages:
	@missing=""; command -v mosquitto >/dev/null || test -x /usr/sbin/mosquitto || missing="$$missing mosquitto"; \
	command -v chromium >/dev/null || missing="$$missing chromium"; \
	if [ -n "$$missing" ]; then \
	  if [ "$$(id -u)" = 0 ]; then SUDO=""; else SUDO="sudo"; fi; \
	  echo "installing$$missing"; $$SUDO apt-get update -qq && DEBIAN_FRONTEND=noninteractive $$SUDO apt-get install -y -qq --no-install-recommends $$missing >/dev/null; \
	fi

test: setup debian-packages
	$(BIN)/python -m pytest -n $(JOBS) --dist loadgroup

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

lock:
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --all-extras --no-emit-index-url --no-header -o requirements.lock pyproject.toml
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --extra build -c requirements.lock --no-emit-index-url --no-header -o requirements-flight.lock pyproject.toml

bench: setup
	$(BIN)/python -m benchmarks.registration

sweep: setup
	$(BIN)/stockpilot sweep missions/paper_sweep.yaml --docs docs/results.md

campaign: setup
	for sweep in acceptance worlds starts others noise dust walls wind vibration attitude mount packets interval; do \
	  $(BIN)/stockpilot sweep missions/sweeps/$$sweep.yaml --docs docs/results.md || true; done

replay: setup
	$(BIN)/python -m stockpilot.replay_check

refs: setup
	$(BIN)/python -m stockpilot.replay_check --write

docs: setup
	$(BIN)/python -m stockpilot.dataflow

clean:
	rm -rf $(VENV) build *.egg-info
