# Needs Python >= 3.11 and a package registry; .venv is made on first use.
#   PYTHON=python3.12   another interpreter        ARGS="..."   options for crkr demo or pytest
.DEFAULT_GOAL := help
.PHONY: help setup demo test lint format lock docs campaign compose-test clean

BIN := .venv/bin
ROOTS := protocol learner client server sim_worker dashboard experiments
TYPED := $(ROOTS) tests $(wildcard examples)
COMPOSE ?=
export PYTHON

help: ## show this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 22

setup: ## make .venv from the lock; quick when it is complete
	@scripts/setup

demo: setup ## learn table tennis from nothing, on this machine; ARGS="--trials 200 --json"
	@$(BIN)/crkr demo $(ARGS)

test: lint ## run ruff, mypy and pytest, in up to eight processes; ARGS="-k name"
	@OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n auto --dist worksteal $(ARGS)

lint: setup ## run ruff and mypy only
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check . || { echo "run make format to fix this" >&2; exit 1; }
	@$(BIN)/mypy $(TYPED)

format: setup ## fix and format the sources by ruff
	@$(BIN)/ruff check --fix-only --quiet .
	@$(BIN)/ruff format .

lock: setup ## regenerate requirements/*.lock; UPGRADE=1 takes the newest versions
	@UPGRADE=$(UPGRADE) scripts/lock

docs: setup ## build the documents as a site in build/site; warnings are errors
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict
	@echo "build/site/index.html"

campaign: setup ## run the long tests, before a release
	@$(BIN)/pytest -m campaign --timeout=3600 $(ARGS)

compose-test: setup ## run a server and two workers in containers
	@$(BIN)/python tests/system/compose_check.py $(if $(COMPOSE),--compose "$(COMPOSE)")

clean: ## remove .venv, caches and build output; never data
	@rm -rf .venv .setup.lock .mypy_cache .pytest_cache .ruff_cache .hypothesis build dist
	@find $(TYPED) -name __pycache__ -type d -prune -exec rm -rf {} +
