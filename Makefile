# make demo and make test do all of their own set-up; the tool is then .venv/bin/bilprov.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.ready
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
# Writes requirements.lock.
LOCKER := uv==0.13.9
SOURCES := analyzer benchmarks captures conformance docs examples spec src tests
# Without its cache of compiled files each start of Python would take two seconds, not a half.
export PYTHONDONTWRITEBYTECODE :=
PYTEST_ARGS ?= -n 4 --dist worksteal
# A browser for the pages, compilers and emulators for the firmware, other people's serial programs,
# a reader of exported traffic, a terminal for the screen, a drawer of graphs.
PACKAGES := chromium make gcc libc6-dev gcc-avr avr-libc simavr avrdude arduino-core-avr libmodbus-dev \
	ser2net socat tshark tmux graphviz

# Another reader of captures, in JavaScript; npm brings it, where there is one.
MCAP_JS := @mcap/core@2.2.2 @mcap/support@1.1.0

.PHONY: help setup lock packages demo test quick whole slow transcripts verdicts pairs mutants check format lint types bench noise fuzz torture pictures clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(STAMP) ## set up .venv with the packages of requirements.lock

$(STAMP): pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "bilprov needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version). Try: make $(MAKECMDGOALS) PYTHON=python3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || \
	  { echo "this Python has no venv. Run: apt-get install python3-venv" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(PIP) --require-hashes -r requirements.lock
	$(PIP) --no-deps --no-build-isolation -e .
	@touch $@

lock: ## write requirements.lock anew for pyproject.toml; LOCK_ARGS=--upgrade takes the newest versions
	$(PYTHON) -m venv build/lock
	build/lock/bin/python -m pip install --quiet --disable-pip-version-check $(LOCKER)
	build/lock/bin/uv pip compile --quiet --universal --python-version 3.11 --all-extras --generate-hashes \
	  --no-annotate --no-emit-index-url --custom-compile-command 'make lock' $(LOCK_ARGS) \
	  --output-file requirements.lock pyproject.toml

demo: setup ## simulator, sniff, conform and replay, end to end
	@$(BIN)/python -m examples.demo

packages: ## what the tests run beside Python, installed where that is allowed
	@dpkg -s $(PACKAGES) >/dev/null 2>&1 || { [ "$$(id -u)" = 0 ] && apt-get update && \
	  apt-get install -y --no-install-recommends $(PACKAGES); } || \
	  echo "some tests will be skipped. They need: apt-get install $(PACKAGES)" >&2
	@[ -d build/npm/node_modules/@mcap/support ] || ! command -v npm >/dev/null || \
	  npm install --silent --no-save --no-package-lock --prefix build/npm $(MCAP_JS) || \
	  echo "one test will be skipped. It needs: npm install --prefix build/npm $(MCAP_JS)" >&2

test: setup packages ## the whole test suite
	$(BIN)/python -m pytest $(PYTEST_ARGS)

quick: setup ## what needs no real time and no other program: under a minute, before every commit
	$(BIN)/ruff check -q $(SOURCES)
	$(BIN)/ruff format -q --check $(SOURCES)
	$(BIN)/python -m pytest --quick -m "not slow and not waits" -n 2 --dist worksteal

whole: setup packages ## every row of the tests of which make test runs a seeded sample, and new random inputs
	$(BIN)/python -m pytest $(PYTEST_ARGS) --whole

slow: setup packages ## make test, and the slowest 20 tests of it
	$(BIN)/python -m pytest $(PYTEST_ARGS) --durations=20

transcripts: setup ## write what commands print now into tests/transcripts; read the diff
	$(BIN)/python -m pytest -n 0 --whole --rewrite-transcripts tests/test_transcripts.py

verdicts: setup ## write the verdict of every fault and variant; half an hour of one core
	mkdir -p build
	$(BIN)/python -m tests.conformance.mutation.test_verdicts > build/verdicts.txt
	mv build/verdicts.txt tests/conformance/mutation/verdicts.txt

pairs: setup ## no device of two legal readings fails: every pair at smoke, some 3 minutes of one core
	$(BIN)/python -m pytest $(PYTEST_ARGS) --whole tests/conformance/mutation/test_pairs.py

mutants: setup ## seeded mutations of the kit's own code, each against the tests of its room
	$(BIN)/python -m benchmarks.mutants

check: setup format lint types test ## format, lint, strict types and tests

format: setup
	$(BIN)/ruff format --check $(SOURCES)

lint: setup
	$(BIN)/ruff check $(SOURCES)

types: setup
	$(BIN)/mypy

noise: setup ## no false fail and no wrong pass over a bad line: 100 seeded runs
	$(BIN)/python -m benchmarks.torture noise --runs 50

fuzz: setup ## 30 times as many random inputs for each property as in make test, and damaged captures
	$(BIN)/python -m pytest $(PYTEST_ARGS) -m hypothesis --whole --examples 1200 --timeout 1200
	$(BIN)/python -m benchmarks.torture changes damage --runs 10000

torture: setup ## all the long harms, some hours; renews docs/RELIABILITY.md; TORTURE_ARGS="HARM --runs N"
	$(BIN)/python -m benchmarks.torture --page $(TORTURE_ARGS)

bench: setup ## how fast each work is beside construct, mcap and C, 10 minutes; renews docs/performance.md
	$(BIN)/python -m benchmarks.bench --publish $(BENCH_ARGS)

pictures: setup ## draw the pictures anew: the architecture, and those of README and docs
	$(BIN)/python -m docs.architecture docs
	$(BIN)/python -m docs.pictures docs

clean: ## remove what was made
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
