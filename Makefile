# ccatp: `make run` surveys a simulated mirror, `make test` checks everything. Needs python3 (3.11 or later) and make.
#   make run ARGS="--mirror fyst-m2 --seed 2"     make test PYTEST_ARGS="-k danger"     make run PYTHON=python3.12

PYTHON ?= python3
VENV ?= .venv
NEWEST_VENV ?= .venv-newest
AUDIT_VENV ?= .venv-audit
RUN_VENV ?= .venv-run
ARGS ?=
PYTEST_ARGS ?=
WORKERS ?= 2
SHARE ?= 1
SIGNALS ?= 2000

# Small matrices: threads of the linear algebra would only fight each other for the cores.
export OPENBLAS_NUM_THREADS := 1
# Some containers forbid it; every process of every test would compile every module again.
unexport PYTHONDONTWRITEBYTECODE

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet --no-input
# One more than there are cores: tests of real processes wait for most of their time.
PYTEST := $(BIN)/python -m pytest -n $$(($(WORKERS) + 1)) --dist loadgroup --no-loadscope-reorder

.PHONY: help run test tests test-newest newest run-newest strict-run environment test-slow slow-tests new-examples sweep tried-in faults docs man onboard-wheel beacon-onboard-wheel metrics lint format
.PHONY: kills mutants golden golden-quick lock audit look clean
.DELETE_ON_ERROR:
.SUFFIXES:

help:
	@echo "make run [ARGS=...]   survey a simulated mirror: ccatp run --sim"
	@echo "make test             lint, types, import contract, tests"
	@echo "make run-newest       a small survey on the newest Python installed, without development tools, warnings as errors, in $(RUN_VENV)"
	@echo "make test-newest      the same, and unit tests of loops and estimation, in $(NEWEST_VENV): before a release"
	@echo "make test-slow        the tests that take minutes, new random examples, and a tenth of the sweep"
	@echo "make sweep            drives over every centimetre of every rim; continues where it was stopped [SHARE=0.1 ARGS='--seed 2']"
	@echo "make kills            random kills of processes over whole missions; continues where it was stopped [SIGNALS=2000]"
	@echo "make mutants          small changes of the safety code that the tests noticed before: do they still? [TARGETS=...]"
	@echo "make faults           docs/fault_table.md from what the last test runs showed and measured"
	@echo "make docs             build/docs/index.html, and the parts of docs/ that are made from the code"
	@echo "make man            the manual page, build/man/ccatp.1"
	@echo "make onboard-wheel    the small package for the robot's own computer, build/ccatp_onboard-*.whl"
	@echo "make beacon-onboard-wheel  the same for a robot among beacons, build/ccatp_beacon_onboard-*.whl"
	@echo "make golden           this tree against a base commit, both run here, bit for bit; make golden-quick: a few cases"
	@echo "make metrics          size of the code base, calls and files per frame; ARGS=--names lists them"
	@echo "make lint             lint, types, import contract"
	@echo "make format           format the code"
	@echo "make lock             pin the dependencies again (needs uv)"
	@echo "make audit            are there known holes in a pinned package? Needs a package index; CI: once a week"
	@echo "make clean            remove the environment and every cache; runs/ stays"
	@echo
	@echo "Programs that are started by hand, in $(VENV)/bin; --help and the first lines of each file say more:"
	@echo "python -m tools.gap_campaign             is the estimate consistent in gaps of the samples; hours [--seeds 20]"
	@echo "python -m tools.network_campaign         errors and intervals of synthetic laser networks; minutes [--networks 1000] [--workers 2]"
	@echo "python -m tools.compare_campaign         are adjustments of panels verified rightly by points of two surveys; minutes [--pairs 100]"
	@echo "python -m tools.network_surveys          the same of whole simulated surveys; an hour [--surveys 20]"
	@echo "python -m tools.network_picture          docs/network.png"
	@echo "python -m tools.night FOLDER             a night with six faults, and docs/night.md of it"
	@echo "python -m tools.notebook                 docs/analysis.ipynb, of the code in docs/python.md"
	@echo "python -m tools.onboard_reactions        reaction times of the robot's own program [--trials 20]"
	@echo "python -m tools.page_cost [SECONDS [ROUNDS]]  what open pages cost the dashboard and the main loop"
	@echo "python -m tools.page_load [HOURS [SECONDS]]   memory of the page and of the dashboard in a long mission"
	@echo "python -m tools.metrics.frame_profile    where the CPU time of a frame goes, by process"
	@echo "python -m tools.screenshots dashboard [FOLDER]  pictures of the page for docs/; report RUN_DIR: of a report"
	@echo "python -m tools.physics_picture          docs/measurements/physics.png; needs MUJOCO_GL=egl"

run: $(VENV)/.installed
	@$(BIN)/ccatp run --sim $(ARGS)

# Side by side: what lint takes fills the time in which tests wait, and so does what is made AFTER_LINT (CI: docs).
AFTER_LINT ?=
test: $(VENV)/.installed-dev tried-in
	@$(MAKE) --no-print-directory -j2 tests lint $(AFTER_LINT)

tests: $(VENV)/.compiled
	$(PYTEST) $(PYTEST_ARGS)

# All modules are compiled once, while lint begins: each of the workers of the tests would compile all of them. An error
# of the collection is shown by the tests.
$(VENV)/.compiled: $(VENV)/.installed-dev
	@$(BIN)/python -m pytest --collect-only -q >/dev/null 2>&1 || true
	@touch $@

# The page is tried in a real browser and the completions in their shells, where there are these.
TRIED_IN := chromium zsh fish
tried-in:
	@wanted=; for tool in $(TRIED_IN); do command -v $$tool >/dev/null || wanted="$$wanted $$tool"; done; test -z "$$wanted" || \
		{ test "$$(id -u)" = 0 && command -v apt-get >/dev/null && echo "ccatp: installing$$wanted" && \
		{ apt-get install -y -qq $$wanted || { apt-get update -qq && apt-get install -y -qq $$wanted; }; } >/dev/null 2>&1; } || \
		echo "ccatp: without$$wanted, so what is tried in them is skipped; on Debian: apt install$$wanted"

# In environments of their own; the oldest Python is that of `make test` in CI.
ON_NEWEST = pythons=$$(.ci/pythons | tail -n 2); newest=$${pythons\#\#*[[:space:]]}; if test "$$pythons" = "$$newest"; then \
	echo "ccatp: $${newest:-no python3.11 to 3.14} is the only supported Python here; nothing else to test on"; else \
	$(MAKE) --no-print-directory PYTHON="$$newest"

test-newest: run-newest
	@$(ON_NEWEST) VENV=$(NEWEST_VENV) newest; fi

newest: $(VENV)/.installed-dev
	$(PYTEST) $(addprefix tests/unit/,control daemon estimation filters) tests/oracle $(PYTEST_ARGS)

run-newest:
	@$(ON_NEWEST) VENV=$(RUN_VENV) strict-run; fi

# What needs a development tool fails. A warning is an error in every process; one that was restarted after it left a
# warning in the log.
strict-run: $(VENV)/.installed
	rm -rf build/strict && PYTHONWARNINGS=error $(BIN)/ccatp run --sim --panels 2 --run-dir build/strict
	! grep '"level": "warning"' build/strict/log.jsonl
	test -s build/strict/report.html

# What fails in one part does not keep the others from being run. A tenth of the sweep, chosen at random.
test-slow:
	@$(MAKE) --no-print-directory --keep-going slow-tests new-examples sweep SHARE=0.1

slow-tests: $(VENV)/.installed-dev
	$(PYTEST) -m slow $(PYTEST_ARGS)

new-examples: $(VENV)/.installed-dev
	$(PYTEST) tests/property tests/oracle --hypothesis-profile=explore

sweep: $(VENV)/.installed-dev
	$(BIN)/python -m tools.edge_sweep build/sweep --workers $(WORKERS) --share $(SHARE) $(ARGS)

kills: $(VENV)/.installed-dev
	@mkdir -p build
	$(BIN)/python -m tools.kill_campaign build/kills.jsonl --workers $(WORKERS) --signals $(SIGNALS) $(ARGS)

mutants: $(VENV)/.installed-dev
	nice -n 19 $(BIN)/python -m tools.mutation $(TARGETS)

faults: $(VENV)/.installed-dev
	$(BIN)/python -m tests.faults.table

docs: $(VENV)/.installed-dev
	$(BIN)/python -m tools.generated_docs
	$(BIN)/python -m sphinx -W -q -b html docs build/docs
	@echo "ccatp: build/docs/index.html"

man: $(VENV)/.installed-dev
	$(BIN)/python -m tools.generated_docs
	$(BIN)/python -m sphinx -W -q -b man docs build/man
	@echo "ccatp: build/man/ccatp.1"

# Both run on this machine: linear algebra rounds differently on another one. ARGS=--list shows the cases.
RADIO_DATA ?= ../shared/data/radio
GOLDEN_CACHE ?= build/golden
GOLDEN = --data $(RADIO_DATA) --cache $(GOLDEN_CACHE)

golden: $(VENV)/.installed-dev
	@$(BIN)/python -m tools.golden $(GOLDEN) $(ARGS)

golden-quick: $(VENV)/.installed-dev
	@$(BIN)/python -m tools.golden $(GOLDEN) --quick --reuse-base $(ARGS)

onboard-wheel: $(VENV)/.installed-dev
	@mkdir -p build
	@$(PIP) wheel --no-deps --no-build-isolation --wheel-dir build packaging/onboard
	@echo "ccatp: $$(ls -t build/ccatp_onboard-*.whl | head -n 1)"

beacon-onboard-wheel: $(VENV)/.installed-dev
	@mkdir -p build
	@$(PIP) wheel --no-deps --no-build-isolation --wheel-dir build packaging/beacon_onboard
	@echo "ccatp: $$(ls -t build/ccatp_beacon_onboard-*.whl | head -n 1)"

metrics: $(VENV)/.installed-dev
	@$(BIN)/python -m tools.metrics $(ARGS)

environment: $(VENV)/.installed-dev

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy --strict --cache-dir .mypy_cache/$(VENV)
	$(BIN)/lint-imports

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

# The environment. Each stamp is younger than what it was made from; the package itself is installed editable, without
# its dependencies, by the build backend out of the same lock file: nothing unpinned is downloaded. Of the development
# tools only what is used is compiled, at its first import: to compile all takes half of the time of the installation.
$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || { echo "ccatp: no $(PYTHON); install Python 3.11 or later, or name one: make PYTHON=/path/to/python3" >&2; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "ccatp: $(PYTHON) is $$($(PYTHON) -V 2>&1); Python 3.11 or later is needed, name one: make PYTHON=python3.12" >&2; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "ccatp: $(PYTHON) cannot make virtual environments; on Debian: apt install python3-venv" >&2; exit 2; }
	@echo "ccatp: making $(VENV)"
	@$(PYTHON) -m venv --clear $(VENV)

$(VENV)/.installed: requirements.lock pyproject.toml | $(BIN)/python
	@echo "ccatp: installing the pinned dependencies into $(VENV)"
	@$(PIP) install --require-hashes --no-deps --prefer-binary -r requirements.lock
	@$(PIP) install --no-deps --no-build-isolation --editable .
	@touch $@

$(VENV)/.installed-dev: requirements-dev.lock $(VENV)/.installed
	@echo "ccatp: installing the pinned development tools into $(VENV)"
	@$(PIP) install --no-compile --require-hashes --no-deps --prefer-binary -r requirements-dev.lock
	@touch $@

# `make lock` keeps the versions that still fit; `make lock LOCK_ARGS=--upgrade` takes the newest. One version of each
# package for all Pythons (--fork-strategy fewest), so that types are checked against and numbers come from the same numpy.
UV ?= uv
LOCK_ARGS ?=
UV_COMPILE_ONE = $(UV) pip compile --quiet --universal --generate-hashes --no-emit-index-url --no-emit-find-links \
	--fork-strategy fewest --python-version 3.11 --custom-compile-command "make lock" $(LOCK_ARGS)
UV_COMPILE = $(UV_COMPILE_ONE) --group build pyproject.toml

lock:
	$(UV_COMPILE) --output-file requirements.lock
	$(UV_COMPILE) --group dev --all-extras --constraint requirements.lock --output-file requirements-dev.lock
	$(UV_COMPILE_ONE) --group pyproject.toml:audit --constraint requirements-dev.lock --output-file requirements-audit.lock

# In an environment of its own. A package that the index does not know is a failure (--strict): it was not looked at.
audit:
	@$(MAKE) --no-print-directory VENV=$(AUDIT_VENV) look

look: $(VENV)/.installed-audit
	@for lock in requirements-dev.lock requirements-audit.lock; do echo "ccatp: looking for known holes in $$lock"; \
		$(BIN)/pip-audit --strict --disable-pip --require-hashes --progress-spinner off --requirement $$lock || exit 1; done

$(VENV)/.installed-audit: requirements-audit.lock | $(BIN)/python
	@$(PIP) install --no-compile --require-hashes --no-deps --prefer-binary -r requirements-audit.lock
	@touch $@

clean:
	rm -rf $(VENV) $(NEWEST_VENV) $(RUN_VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find ccatp tests tools -name __pycache__ -type d -prune -exec rm -rf {} +
