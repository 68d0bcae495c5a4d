# SPDX-License-Identifier: MIT
# The two commands of a new user: `make demo` and `make test`. `make help` lists the rest.
PYTHON ?= python3.11
VENV ?= .venv
OUT ?= demo-output
WORKERS ?= 2
ONLY ?= tests
# Processes of pytest: one more than two cores, since many tests wait. Each takes up to 5 GB.
JOBS ?= 3
# Idle OpenMP threads sleep, since they would spin on cores that other processes need. Bytecode is kept even where
# the environment forbids it (containers), since the tests start hundreds of processes.
PYTEST = OMP_WAIT_POLICY=PASSIVE PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -q -n $(JOBS) --dist loadfile --no-loadscope-reorder
FAST := $(addprefix tests/,test_architecture.py mitsuba_plugins/test_variant.py \
  datagen/test_formats.py datagen/test_package.py datagen/test_library.py datagen/test_importers_gltf.py \
  datagen/test_importers_material_folder.py datagen/test_assembly_random.py datagen/test_assembly_materials.py \
  model/test_checkpoint.py model/test_confidence.py model/test_networks.py model/test_reconstruction_captures_formats.py)
export VENV

BIN := $(VENV)/bin
PIP := $(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt

.DEFAULT_GOAL := help
.PHONY: help setup setup-dev demo test test-fast test-slow lint format docs docs-serve library extension packages three clean

help: ## List the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F':.*## ' '{printf "  make %-12s %s\n", $$1, $$2}'

$(BIN)/pip:
	@.ci/ensure_venv.sh $(PYTHON) $(VENV)

$(VENV)/.base: pyproject.toml setup.py constraints.txt | $(BIN)/pip
	@echo "installing the project into $(VENV)"
	@$(PIP) -e .
	@.ci/ensure_system.sh llvm
	@touch $@

$(VENV)/.dev: pyproject.toml setup.py constraints.txt $(VENV)/.base
	@echo "installing what the tests need into $(VENV)"
	@$(PIP) -e '.[train,heic,raw,gltf,usd,export,blender,dev,docs]'
	@.ci/ensure_system.sh blender
	@.ci/ensure_system.sh tests
	@touch $@

setup: $(VENV)/.base ## Create the environment that runs `datagen`
setup-dev: $(VENV)/.dev ## Create the environment with everything for development

demo: setup ## Generate a small dataset from the bundled library, and the page that shows it
	@$(BIN)/datagen doctor
	@$(BIN)/datagen run scenes/recipes/demo.yaml --out $(OUT) --workers $(WORKERS)
	@$(BIN)/datagen verify $(OUT)
	@$(BIN)/datagen report $(OUT)
	@printf '\nOpen in a browser:  file://%s\n' '$(abspath $(OUT))/report/index.html'
	@printf 'Rooms as pictures:  %s\n' $(abspath $(OUT))/sheets/*.png
	@printf 'Next:               docs/tutorials/first-dataset.md\n'

test: setup-dev ## Run the tests; ONLY=path runs those of a file or folder
	@$(PYTEST) $(ONLY)

test-fast: setup-dev ## Run what needs no rendering, training or Blender: formats, importers, assembly, architecture
	@$(BIN)/python -m pytest -q $(FAST)

test-slow: setup-dev ## Run the long tests too
	@$(PYTEST) -m "slow or not slow"

lint: setup-dev ## Check style, format and types
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/mypy --strict -p datagen.foundation -p datagen.formats

format: setup-dev ## Format the code
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

docs: setup-dev ## Build the documentation site; open site/index.html
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --site-dir site

docs-serve: setup-dev ## Show the documentation at http://127.0.0.1:8000 and follow changes
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs serve

library: setup-dev ## Rebuild the bundled library from its sources
	@$(BIN)/python -m scenes.sources build --out scenes/library

extension: setup-dev ## Build and validate the Blender extension into dist/
	@$(BIN)/python .ci/build_extension.py dist

packages: setup-dev ## Build the sdist and the wheel into dist/, and try each in a new environment
	@$(BIN)/python .ci/try_packages.py constraints.txt

three: ## Rebuild the 3D page's three.js from npm, at the version that .ci/three pins
	@cd .ci/three && npm ci --silent --ignore-scripts --no-audit --no-fund && npm run --silent build && rm -rf node_modules

clean: ## Remove the environment and caches
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache build dist *.egg-info
