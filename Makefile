# Everything runs in .venv, which the first target makes once and keeps until a dependency changes. It takes the first of
# PYTHONS that can make one: PYTHONS=python3.11 make test.

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup demo test proofs long fuzz check docs wheel smoke bench claims clean

BIN := .venv/bin
STAMP := .venv/ready
LOG := .venv/setup.log
PYTHONS ?= python3.13 python3.12 python3.11 python3

help:  ## list the targets
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 14

setup: $(STAMP)  ## make the environment .venv (the others do it when it is needed)

demo: $(STAMP)  ## fit the built-in mass-spring-damper example
	@$(BIN)/orthaug demo

test: $(STAMP)  ## run the test suite but for what takes long, a file at a time on every core
	@$(BIN)/python -m pytest -q -n auto --dist loadfile --no-loadscope-reorder

proofs: $(STAMP)  ## run the slow tests and proofs, which the suite leaves out, and print what these measured
	@$(BIN)/python -m pytest -q -m "(proof or slow) and not long" -n auto --dist loadfile --no-loadscope-reorder

long: $(STAMP)  ## run the tests of 16 s or more, which CI leaves out, before a release
	@$(BIN)/python -m pytest -q -m long -o faulthandler_timeout=0 -n auto --dist loadfile --no-loadscope-reorder

fuzz: $(STAMP)  ## run 3,000 seeded hostile trials and print how many held, by area
	@$(BIN)/python benchmarks/fuzz.py

check: $(STAMP) docs  ## ruff, pyright, the architecture test, the page of messages and the site of the documents
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/pyright
	@$(BIN)/python -m pytest -q -m "" tests/test_architecture.py tests/test_messages.py

docs: $(STAMP)  ## build the documents as a site in build/site, to open from disk
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict

wheel: $(STAMP)  ## build sdist and wheel into dist
	@rm -rf dist && $(BIN)/python -m build --outdir dist . >$(LOG) 2>&1 || { tail -n 20 $(LOG) | sed 's|[a-z+]*://[^ ]*|...|g' >&2; exit 1; }
	@ls dist

# PYTHON=python3.13 is tried instead of the environment's, OLDEST=1 with the oldest dependencies that are allowed.
smoke: wheel  ## install the wheel into a bare environment and try it without a compiler
	@rm -rf build/smoke && $(or $(PYTHON),$(BIN)/python) -m venv build/smoke
	@build/smoke/bin/python -m pip install -q --disable-pip-version-check --only-binary :all: \
	    $(if $(OLDEST),-c packaging/oldest.txt) dist/*.whl 2>&1 | sed '/Looking in /d; s|[a-z+]*://[^ ]*|...|g' >&2
	@build/smoke/bin/python packaging/smoke.py dist/*.whl

bench: $(STAMP)  ## run the benchmarks, one after another
	@set -e; for file in $(filter-out benchmarks/claims.py,$(wildcard benchmarks/*.py)); do \
	    if grep -qs __main__ "$$file"; then echo "== $$file"; $(BIN)/python "$$file"; fi; \
	done

claims: $(STAMP)  ## recompute every measured number of the documents and compare
	@$(BIN)/python benchmarks/claims.py

clean:  ## remove the environment and everything that was built
	@rm -rf .venv build dist .pytest_cache .ruff_cache .hypothesis orthaug-out
	@find . -name .git -prune -o -type d \( -name __pycache__ -o -name '*.egg-info' \) -prune -exec rm -rf {} +

# A name on the path may be a stand-in that does not run, or a Python without venv: each one is tried.
# Messages of pip are shown without addresses; the log has them in full.
$(STAMP): pyproject.toml constraints.txt
	@if ! $(BIN)/python -c 'import pip' 2>/dev/null; then \
	    found=; \
	    for python in $(PYTHONS); do \
	        "$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 || continue; \
	        found="$$python"; \
	        "$$python" -c 'import ensurepip, venv' >/dev/null 2>&1 || continue; \
	        "$$python" -m venv --clear .venv >/dev/null 2>&1 && break; \
	    done; \
	    if [ -z "$$found" ]; then \
	        echo "orthaug needs Python 3.11 or newer; none of these is: $(PYTHONS). Install one and run make again." >&2; \
	        exit 1; \
	    elif ! $(BIN)/python -c 'import pip' 2>/dev/null; then \
	        echo "$$found cannot make a virtual environment. On Debian and Ubuntu: apt-get install python3-venv." >&2; \
	        exit 1; \
	    fi; \
	fi
	@echo "Setting up .venv (once, a minute or two) ..." >&2
	@if ! $(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e '.[dev]' >$(LOG) 2>&1; then \
	    sed '/Looking in /d; s|[a-z+]*://[^ ]*|...|g' $(LOG) | tail -n 20 >&2; \
	    echo "Installing the dependencies failed (all of the messages: $(LOG)). Is the package index in reach?" >&2; \
	    exit 1; \
	fi
	@$(BIN)/python -m compileall -q src  # with PYTHONDONTWRITEBYTECODE every command would do it anew, for a second
	@touch $@
