# make env       the environment in .venv, from requirements.lock
# make race      fly a policy where the dynamics hide an effect, name it, train for it, fly again
# make gpu       speed, a short training and the CPU's outcomes on this machine's GPU: docs/results/gpu.md
# make test      lint, types and tests
# make extended  further cases of the tests, which make test leaves out
# make lint      ruff, pyrefly, and docs/reference against the code
# make docs      the pages of docs/ as a site in site/, links checked
# make lock      requirements.lock from what is installed in .venv
# make clean     remove caches and build products (runs/ and .venv stay)

VENV ?= .venv
OUT ?= runs/race
JOBS ?= 2
PY := $(VENV)/bin/python
STAMP := $(VENV)/.made-from-lock
USABLE := import sys; raise SystemExit(not (3, 11) <= sys.version_info[:2] < (3, 14))

export PIP_DISABLE_PIP_VERSION_CHECK = 1

.PHONY: env race gpu test tests extended lint style types docs lock clean

env: $(STAMP)

$(STAMP): requirements.lock pyproject.toml setup.py
	@set -e; found=; \
	for python in $(PYTHON) $(PY) python3 python3.11 python3.12 python3.13; do \
		if "$$python" -c '$(USABLE)' >/dev/null 2>&1; then found=$$python; break; fi; \
	done; \
	if [ -z "$$found" ]; then \
		echo "Python 3.11, 3.12 or 3.13 is needed; name one with make PYTHON=/path/to/python" >&2; \
		exit 1; \
	fi; \
	if [ ! -x $(PY) ]; then echo "making $(VENV) with $$found"; "$$found" -m venv $(VENV); fi
	$(PY) -m pip install --quiet --requirement requirements.lock
	$(PY) -m pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $(STAMP)

race: $(STAMP)
	$(VENV)/bin/suite loop --hidden-vehicle examples/hidden.toml --policy race-paper --no-delta --workers $(JOBS) --out $(OUT)

gpu: $(STAMP)
	$(VENV)/bin/suite reproduce gpu --seconds 100 --out docs/results

lint: style types

style: $(STAMP)
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) tools/reference.py --check
	$(PY) tools/words.py

types: $(STAMP)
	$(PY) -m pyrefly check --python-interpreter-path $(PY) --output-format min-text

# Tests start dozens of programs, each of which would compile the modules anew.
tests extended: export PYTHONDONTWRITEBYTECODE =
PYTEST := $(PY) -m pytest -n $(JOBS) --dist loadgroup --no-loadscope-reorder
tests: $(STAMP)
	$(PYTEST)

extended: $(STAMP)
	$(PYTEST) -m "extended and not slow"

# The types are checked on one core, beside the tests.
test: style
	@$(MAKE) --no-print-directory --jobs 2 types tests

docs: $(STAMP)
	$(PY) -m mkdocs build --quiet --clean --strict
	@echo "open site/index.html"

lock:
	$(PY) tools/lock.py > requirements.lock.new
	mv requirements.lock.new requirements.lock

clean:
	rm -rf build dist site .cache .pytest_cache .hypothesis .ruff_cache *.egg-info
	find . -path ./$(VENV) -prune -o -name __pycache__ -type d -exec rm -rf {} +
