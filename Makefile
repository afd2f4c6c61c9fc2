# PbARL Studio: `make help` lists what can be done.
SHELL := /bin/bash
.DEFAULT_GOAL := help

TORCH ?= cpu
TORCH_VERSION := 2.13.0
TORCH_CPU_INDEX := https://download.pytorch.org/whl/cpu
VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip --disable-pip-version-check --quiet

.PHONY: help run link demo rehearse test lint types contracts pytest pytest-postgresql pytest-s3 test-long validate browser postgresql migrate reset-password benchmark clean

help: ## List the commands
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-16s %s\n", $$1, $$2}'

run: $(VENV)/run.stamp ## Install what is missing, then start web server and worker (Ctrl-C stops both)
	@exec $(PY) -m app up

link: $(VENV)/run.stamp ## Add a participant to the newest study and print the personal link
	@$(PY) -m app link

demo: $(VENV)/run.stamp ## Make a demo study of a task and print a participant link (TASK=drinking)
	@$(PY) -m app demo $(if $(TASK),--task $(TASK))

rehearse: $(VENV)/run.stamp ## Run scripted participants through the real pages to downloaded bundles (ARGS="--help")
	@$(PY) -m worker rehearse $(ARGS)

reset-password: $(VENV)/run.stamp ## Print a new one-time password for the experimenter
	@$(PY) -m app reset-password

migrate: $(VENV)/run.stamp ## Bring the database to the newest schema
	@$(PY) -m app migrate

test: lint types contracts pytest pytest-postgresql pytest-s3 ## Everything that continuous integration runs

lint: $(VENV)/dev.stamp ## Style of Python and templates, schema of the compose file
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/djlint --lint --quiet templates
	$(VENV)/bin/check-jsonschema --builtin-schema vendor.compose-spec docker-compose.yml

types: $(VENV)/dev.stamp ## Static types, strict
	$(VENV)/bin/mypy

contracts: $(VENV)/dev.stamp ## Who may import whom
	$(VENV)/bin/lint-imports

# Compiled modules are kept, whatever this machine usually does: the tests start hundreds of programs.
pytest pytest-postgresql pytest-s3 test-long validate: export PYTHONDONTWRITEBYTECODE :=

# One thread each: processes whose libraries take every core spend their time waiting for each other.
pytest: $(VENV)/dev.stamp browser ## The test suite
	OMP_NUM_THREADS=1 $(PY) -m pytest -n 4 --dist loadfile --no-loadscope-reorder

pytest-postgresql: $(VENV)/dev.stamp postgresql ## Tests that use a database, on PostgreSQL (ARGS="tests/app -n 2": others)
	OMP_NUM_THREADS=1 $(PY) -m tests.on_postgresql $(ARGS)

pytest-s3: $(VENV)/dev.stamp ## Tests of stored files, on an S3-compatible server (ARGS="tests/app -n 2": others)
	OMP_NUM_THREADS=1 $(PY) -m tests.on_s3 $(ARGS)

test-long: $(VENV)/dev.stamp ## Tests that are too long for continuous integration
	OMP_NUM_THREADS=1 $(PY) -m pytest -n 2 --dist loadfile -m long

validate: $(VENV)/dev.stamp browser ## Run the suite and write build/validation.html: what is promised, and what was shown
	@mkdir -p build
	-OMP_NUM_THREADS=1 $(PY) -m pytest -n 3 --dist loadfile --no-loadscope-reorder -m "" --junitxml=build/validation.xml
	$(PY) -m tests.validation build/validation.xml build/validation.html

postgresql: ## PostgreSQL for the tests (Debian package)
	@command -v initdb >/dev/null || ls /usr/lib/postgresql/*/bin/initdb >/dev/null 2>&1 || { \
	  [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get update -qq && apt-get install -y -qq postgresql; } || { \
	  echo "The tests on PostgreSQL need its server: install your system's package 'postgresql'."; exit 1; }

browser: ## Chromium for the browser tests (Debian package)
	@command -v chromium-headless-shell >/dev/null || { \
	  [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get update -qq && apt-get install -y -qq chromium-headless-shell; } || \
	  command -v chromium >/dev/null || { \
	  echo "The browser tests need Chromium: install your system's package 'chromium-headless-shell'."; exit 1; }

benchmark: $(VENV)/dev.stamp ## Print speed and quality figures (minutes; see tests/benchmarks)
	@OMP_NUM_THREADS=1 $(PY) -m tests.benchmarks.sim_speed
	@OMP_NUM_THREADS=1 $(PY) -m tests.benchmarks.render_speed

clean: ## Remove the virtual environment and caches; the data directory stays
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .import_linter_cache

# --- the virtual environment -------------------------------------------------------------------------------------

# PYTHON=/path/to/python chooses one; without any that fits, uv fetches one.
$(VENV)/bin/python:
	@PYTHON="$(PYTHON)" install/environment.sh $(VENV)

# torch comes first and by itself: the default build on Linux would bring gigabytes of CUDA.
$(VENV)/torch.stamp: $(VENV)/bin/python
	@echo "Installing torch $(TORCH_VERSION) ($(TORCH)) ..."
	@if [ "$(TORCH)" = cpu ]; then \
	  $(PIP) install --no-deps "torch==$(TORCH_VERSION)+cpu" 2>/dev/null \
	  || $(PIP) install --no-deps --index-url $(TORCH_CPU_INDEX) "torch==$(TORCH_VERSION)"; \
	else $(PIP) install "torch==$(TORCH_VERSION)"; fi
	@touch $@

$(VENV)/run.stamp: requirements.lock pyproject.toml $(VENV)/torch.stamp
	@install/engine.sh $(VENV)
	@echo "Installing pinned dependencies ..."
	@$(PIP) install --no-deps --require-hashes -r requirements.lock
	@$(PIP) install --no-deps --no-build-isolation -e .
	@touch $@

$(VENV)/dev.stamp: requirements-dev.lock $(VENV)/run.stamp
	@echo "Installing pinned development tools ..."
	@$(PIP) install --no-deps --require-hashes -r requirements-dev.lock
	@touch $@
