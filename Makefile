# undulog: every target does its own set-up. On a bare machine with Python 3.11:
#   make demo    simulate, record, analyse, report, replay file under out/demo/
#   make test    all tests but the slow ones
PYTHON ?= $(firstword $(shell command -v python3.11 python3 python 2>/dev/null))
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
# The lock is installed by uv, which takes seconds where pip takes minutes, or by pip if uv doesn't
# reach the registry, e.g. as only pip is told of one.
PIP    := $(BIN)/python -m pip install --quiet --disable-pip-version-check
DEMO   := out/demo

# The matrices are small: more threads of linear algebra only get in each other's way.
export OPENBLAS_NUM_THREADS ?= 1
# Every command is a process of its own: it shall load compiled modules, not compile them again.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo test slow night clock zoo rates campaign mutants delays study check format bench docs schemas pictures pages \
  pages-scripts pages-tables nightly golden lock release install-paths clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-13s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

$(READY): requirements.lock pyproject.toml
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11) and "undulog is set up on Python 3.11 (pybullet has wheels for it); found %d.%d. Use: make PYTHON=python3.11" % sys.version_info[:2])'
	@test -x $(BIN)/python || "$(PYTHON)" -m venv $(VENV)
	@echo "Installing the locked packages into $(VENV) (about a minute) ..."
	@awk '/^[a-z]/ {wanted = /^uv==/} wanted' requirements.lock >$(VENV)/uv.txt
	@$(PIP) --require-hashes -r $(VENV)/uv.txt
	@VIRTUAL_ENV=$(VENV) $(BIN)/uv pip install --quiet --system-certs --compile-bytecode --require-hashes -r requirements.lock \
	  || $(PIP) --require-hashes -r requirements.lock
	@$(PIP) --no-deps --no-build-isolation -e .
	@touch $@

define undulog
@echo '$$ undulog $(1)'
@$(BIN)/undulog $(1)
@echo

endef

demo: $(READY)  ## record 20 s of the 25-joint snake, analyse it, write page and replay
	@mkdir -p $(DEMO)
	$(call undulog,sim run weak-servo-pi3 --duration 20 -o $(DEMO)/session.mcap --force)
	$(call undulog,analyse $(DEMO)/session.mcap -o $(DEMO)/result.json --force)
	$(call undulog,report $(DEMO)/session.mcap -o $(DEMO)/report.html --force)
	$(call undulog,view $(DEMO)/session.mcap --save $(DEMO)/replay.rrd --force)
	@echo 'Where to look next:'
	@printf '  %-50s %s\n' \
	  '$(DEMO)/report.html' 'the answer on one page, in any browser' \
	  '$(BIN)/undulog view $(DEMO)/session.mcap' 'the motion, in Rerun' \
	  '$(BIN)/undulog log info $(DEMO)/session.mcap' 'what was recorded' \
	  '$(BIN)/undulog sim list' 'what else can be simulated'

# Four processes at once: two of tests that compute, and two of those of processes, time and pictures,
# which wait more than they compute. A file of one may lie in a folder of another: all four shall end
# at about the same time. None has a lower priority: beside other programs it would hardly run.
ANALYSIS = $(addprefix tests/replay/sweep/,test_cluster.py test_object_store.py test_standing.py) \
  tests/analysis tests/capture/sources tests/docs
COMPUTING = tests/house tests/zoo/test_error_control.py tests/zoo/test_zoo.py tests/replay/sweep \
  $(addprefix tests/capture/log/,file health) \
  $(addprefix tests/capture/,bus judgement robot) \
  $(addprefix tests/sim/,batch twin)
PYTEST = $(BIN)/python -m pytest --durations 20
WAITING = $(addprefix tests/analysis/,estimators experiment response) \
  $(addprefix tests/house/,test_package.py test_root_names.py) tests/replay tests/sim
# Some paths without what lies in them and is listed for another process.
part = $(addprefix --ignore=,$(filter $(addsuffix /%,$(1)),$(ANALYSIS) $(COMPUTING) $(WAITING))) $(1)
# JUnit files, with the seconds of each test, lie in out/tests/.
define tests
	@mkdir -p out/tests; logs=$$(mktemp -d); \
	$(PYTEST) -p no:cacheprovider -m $(2) --junitxml out/tests/$(1)-analysis.xml \
	  $(call part,$(ANALYSIS)) >$$logs/1 2>&1 & first=$$!; \
	$(PYTEST) -p no:cacheprovider -m $(2) --junitxml out/tests/$(1)-computing.xml \
	  $(call part,$(COMPUTING)) >$$logs/2 2>&1 & second=$$!; \
	$(PYTEST) -p no:cacheprovider -m $(2) --junitxml out/tests/$(1)-waiting.xml \
	  $(call part,$(WAITING)) >$$logs/3 2>&1 & third=$$!; \
	trap "kill $$first $$second $$third; rm -rf $$logs; exit 130" INT TERM; \
	$(PYTEST) -m $(2) --junitxml out/tests/$(1).xml \
	  $(addprefix --ignore=,$(ANALYSIS) $(COMPUTING) $(WAITING)); last=$$?; \
	wait $$first; first=$$?; wait $$second; second=$$?; wait $$third; third=$$?; \
	cat $$logs/*; rm -rf $$logs; exit $$((first + second + third + last))
endef

test: $(READY)  ## all tests but the slow ones and those of real time
	$(call tests,test,"not slow and not clock")

slow: $(READY)  ## the slow tests of what is promised
	$(call tests,slow,"slow and not clock")

night: export UNDULOG_NIGHTLY = 1
night: $(READY)  ## the tests that draw, simulate or repeat for long; golden pictures, studies
	$(call tests,night,"nightly and not clock")
	$(PYTEST) -m "nightly and clock" --junitxml out/tests/night-clock.xml

clock: $(READY)  ## the tests of real time, one after the other, beside a witness of how late it is
	@mkdir -p out/tests
	$(PYTEST) -m clock --junitxml out/tests/clock.xml

rates: $(READY)  ## how often the first sentence is right: sessions in memory, resumable (SEEDS=10 RATES="--recorded")
	PYTHONPATH=tests $(BIN)/python -m zoo.rates --seeds $(or $(SEEDS),100) $(RATES) \
	  -o out/rates/$(shell git rev-parse --short HEAD)

zoo: $(READY)  ## planted faults, 100 seeds each: is every output right? (SEEDS=10 for fewer)
	PYTHONPATH=tests $(BIN)/python -m zoo.run --seeds $(or $(SEEDS),100)

campaign: $(READY)  ## 50,000 attacks with new seeds, resumable (SEED=1 CASES=2000 for fewer)
	PYTHONPATH=tests:bench:. $(BIN)/python -m campaign.run $(and $(SEED),--seed $(SEED)) $(and $(CASES),--cases $(CASES))

mutants: $(READY)  ## 210 small faults in the product: do the fast tests find them? resumable (SEED=2 COUNT=20)
	PYTHONPATH=tests nice -n 5 $(BIN)/python -m mutants.run $(and $(SEED),--seed $(SEED)) $(and $(COUNT),--count $(COUNT))

delays: $(READY)  ## delays of twice the tolerance in the product: do the tests of real time find them? (COUNT=2)
	PYTHONPATH=tests $(BIN)/python -m mutants.delays $(and $(COUNT),--count $(COUNT))

study: $(READY)  ## what body couplings do to synchrony, short form (LONG=1 for all of it, hours, resumable)
	$(BIN)/python studies/study/study.py $(if $(LONG),,--quick)

check: $(READY)  ## lint, format, types, layers, how README and tutorials read
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/pyright
	$(BIN)/python tests/house/reading_ease.py

format: $(READY)  ## fix what lint and format can fix
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(READY)  ## speed, as ratios against named peers, onto one page (QUICK=1 for short runs)
	$(BIN)/python bench/all.py $(if $(QUICK),--quick)

docs: $(READY)  ## the manual, as HTML under docs/_build/html
	$(BIN)/sphinx-build -W -q -E -b html docs docs/_build/html

schemas: $(READY)  ## the JSON Schemas of the results, which ship with the package; the tree in CONTRIBUTING
	$(BIN)/python docs/reference_pages.py
	$(BIN)/python docs/tree.py

pictures: demo  ## the pictures of README and manual, from recorded sessions
	$(BIN)/python studies/pictures.py $(DEMO)
	$(BIN)/python studies/paper_figures.py out/paper
	$(BIN)/python studies/readme_figures.py

DATA ?= ../shared/data
pages: $(READY)  ## the long parts of the manual: real robots (DATA=FOLDER with recordings), tutorials, tables
	$(BIN)/python studies/real_robots.py $(DATA)
	$(MAKE) -j2 --output-sync=target pages-scripts pages-tables

# Nothing is skipped for want of a tool.
BUILDING = UNDULOG_BUILD_PAGES=1 UNDULOG_REQUIRE_ALL_TESTS=1

pages-scripts: $(READY)
	$(BUILDING) $(BIN)/python -m pytest -p no:cacheprovider -m built tests/docs \
	  --ignore=tests/docs/test_real_robots.py

pages-tables: $(READY)
	$(BUILDING) $(BIN)/python -m pytest -p no:cacheprovider -m built tests --ignore=tests/docs

nightly: $(READY)  ## all that takes long, in parts of an hour at most, resumable (PARTS="zoo pages" for some)
	$(BIN)/python .ci/nightly.py $(PARTS)

golden: $(READY)  ## the golden pictures that every view is held to, anew; look at each
	$(BIN)/python tests/support/golden_pictures.py

release: $(READY)  ## wheel, source archive, notes, bill of materials of the last commit, under dist/
	$(BIN)/python .ci/release.py dist

install-paths: $(READY)  ## every way to install, one line each: minutes, gigabytes (STEPS=base for fewer)
	$(BIN)/python .ci/install_paths.py $(STEPS)

lock: $(READY)  ## renew requirements.lock (needs uv on the path)
	uv pip compile --universal --python-version 3.11 --generate-hashes --no-header \
	  --all-extras --group dev pyproject.toml -o requirements.lock

clean:  ## remove what these targets made
	rm -rf $(VENV) out docs/_build .pytest_cache .ruff_cache
