# `make demo` and `make test` need nothing but Python 3.10-3.13 with venv; they fetch uv into .uv/ themselves.
PYTHON ?= $(firstword $(foreach v,python3 python3.13 python3.12 python3.11 python3.10,$(shell command -v $(v) 2>/dev/null)))
UV := .uv/bin/uv
# The interpreter itself: a shim (pyenv) would have uv make the environment anew each time.
export UV_PYTHON := $(or $(UV_PYTHON),$(and $(PYTHON),$(shell $(PYTHON) -c 'import sys; print(sys.executable)')))
export UV_PYTHON_DOWNLOADS ?= never
# Networks with certificates of their own work as they do for every other program of the machine.
export UV_SYSTEM_CERTS ?= true
# A start without compiled modules takes 0.9 s more of a processor, and the tests start a thousand processes.
unexport PYTHONDONTWRITEBYTECODE
export UV_COMPILE_BYTECODE := 1
RUN := $(UV) run --locked
ARGS ?=
SEED ?= 1
MINUTES ?= 3
HOURS ?= 1
MUTANT ?=
SEEDS ?= 50
MINIMISE ?=

.PHONY: demo screenshots docs release-check test test-realtime test-system test-all test-socketcan soak soak-registry soak-relocation
.PHONY: chaos chaos-locks chaos-robots siege explore mutants
.PHONY: fuzz check audit-deps sbom bench bench-compare bench-page clean
.DEFAULT_GOAL := help

help: ## show the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' Makefile | expand -t 16

$(UV):
	@$(or $(PYTHON),$(error no python3 found; install Python 3.10-3.13 (Debian: apt-get install python3 python3-venv))) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 14))' \
	  || { echo "$(PYTHON) is $$($(PYTHON) -V); TRADE needs Python 3.10-3.13: make PYTHON=/path/to/python3.12 $(MAKECMDGOALS)" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null \
	  || { echo "$(PYTHON) has no ensurepip; on Debian or Ubuntu: apt-get install python3-venv" >&2; exit 1; }
	@echo "fetching uv into .uv/ (once)"
	@$(PYTHON) -m venv .uv && .uv/bin/python -m pip install --quiet --disable-pip-version-check 'uv==0.13.8'

demo: $(UV) ## a simulated robot looks, walks and grips for behaviours beyond a gateway (ARGS=--stay keeps it up)
	@$(RUN) --no-dev --group demo python examples/demo.py $(ARGS)

# Three tiers of tests, by what a test may use: tests/support/tiers.py. In the last two, what failed runs again at the end, alone.
# Those of ALONE judge a bus by the 0.2 s that safety allows it, or keep both cores busy themselves: two at a time, a file each.
# QUIET has nothing beside it: it compiles for minutes, and compares real-time threads with ordinary ones.
ALONE := tests/system/peers/test_conformance.py $(foreach name,commissioning demo recording siege teleop transcript tutorials upgrade,tests/system/test_$(name).py)
QUIET := tests/system/peers/test_rust.py tests/bench/test_jitter.py
SYSTEM := $(RUN) pytest --rerun --durations=10 -m system

test: $(UV) ## what decides whether a change lands: code, containers and zenoh within a process; 5 minutes on two cores
	@$(RUN) pytest --durations=10 -n 4 --dist worksteal --hypothesis-profile ci -m "not realtime and not system" $(ARGS)

test-realtime: $(UV) ## simulators on real clocks, child processes, programs of other people; 22 minutes
	@$(RUN) pytest --rerun --real-time --durations=10 -n 4 --dist worksteal -m "realtime and not system" $(ARGS)

test-system: $(UV) ## whole systems: network namespaces, a browser, Rust, the demo; 25 minutes (root)
	@failed=; part() { code=0; "$$@" $(ARGS) || code=$$?; case $$code in 0|5) ;; *) failed=1 ;; esac; }; \
	part $(SYSTEM) -n 4 --dist worksteal tests $(patsubst %,--ignore %,$(ALONE) $(QUIET)); \
	part $(SYSTEM) -n 2 --dist loadfile $(ALONE); part $(SYSTEM) $(QUIET); test -z "$$failed"

test-all: ## the three tiers in a row
	@failed=; for tier in test test-realtime test-system; do $(MAKE) --no-print-directory $$tier || failed="$$failed $$tier"; done; \
	test -z "$$failed" || { echo "failed:$$failed"; exit 1; }

test-socketcan: $(UV) ## the CAN suites on kernel interfaces; where the kernel has none, inside User-Mode Linux
	@$(RUN) tests/system/socketcan/run pytest tests/system/socketcan $(ARGS)

chaos: chaos-locks siege ## the whole proof: the next two, one after the other (SEED=.. MINUTES=.. of each)

chaos-locks: $(UV) ## locks under kill -9, freezes, cuts and delays; 240 clients (SEED=.. MINUTES=..; exits 1 on a violation)
	@$(RUN) python -m tests.endurance.chaos --seed $(SEED) --minutes $(MINUTES) --clients 8 --threads 30 --drivers 3 $(ARGS)

siege: export SIEGE_MINUTES := $(MINUTES)
siege: export SIEGE_MUTANT := $(MUTANT)
siege: export SEED := $(SEED)
siege: $(UV) ## robots, gateways, clients under every trouble (SEED=.. MINUTES=.. MUTANT=.. MINIMISE=1; root, iproute2)
	@$(RUN) pytest -s -n 0 tests/system/test_siege.py $(ARGS) || { \
	  test -z "$(MINIMISE)" || $(RUN) python -m tests.system.siege_minimised; exit 1; }

chaos-robots: $(UV) ## a lock over two robots while a driver is killed and started again, 50 times
	@CHAOS_ROUNDS=50 $(RUN) pytest tests/system/test_two_robots.py $(ARGS)

explore: $(UV) ## stories of robots and a gateway under drawn troubles, on virtual time (SEEDS=..; ARGS="--first 17 --only 0,2")
	@$(RUN) python -m tests.endurance.explore --seeds $(SEEDS) $(ARGS)

mutants: $(UV) ## break the product in each known way; a test has to detect each (root, iproute2 for the siege's)
	@$(RUN) pytest -m mutant -p tests.support.mutant_table tests tests/endurance/siege_mutants.py $(ARGS)

fuzz: $(UV) ## every reader of bytes, guided by coverage where Atheris has a wheel (MINUTES=..; exits 1 if something breaks)
	@$(RUN) --group fuzz python -m tests.endurance.fuzz --minutes $(MINUTES) $(ARGS)

soak: $(UV) ## a robot, a gateway, a page and planners for hours; nothing may grow or fail (HOURS=..; leaves build/soak.svg)
	@$(RUN) python -m tests.endurance.soak --hours $(HOURS) $(ARGS)

soak-registry: $(UV) ## three containers on two hosts register at the same moment, 200 times (root, iproute2)
	@SOAK_ROUNDS=200 $(RUN) pytest tests/system/test_namespaces.py -k same_moment $(ARGS)

soak-relocation: $(UV) ## a host is lost 100 times, with random trouble between; never two (SEED=..; root, iproute2; 45 min)
	@SOAK_ROUNDS=100 SEED=$(SEED) $(RUN) pytest -s tests/system/test_relocation.py -k never_two $(ARGS)

check: $(UV) ## lint, formatting, types, import rules, spelling, plain English, isolated install of the core
	@$(RUN) ruff check
	@$(RUN) ruff format --check
	@$(RUN) basedpyright
	@$(RUN) lint-imports
	@$(RUN) codespell
	@$(RUN) python -m tests.docs.plain_english
	@$(UV) run --isolated --no-project --directory docs --with $(CURDIR) python -W error -c 'import trade, sys; \
	  foreign = {"serial", "cryptography", "dynamixel_sdk", "typer", "trade_drivers", "opentelemetry"} & set(sys.modules); \
	  sys.exit(f"the core alone imports {foreign}" if foreign else 0)'

audit-deps: $(UV) ## known vulnerabilities of all that is locked, from OSV (needs a network; fails if there is one)
	@$(UV) audit --locked --preview-features audit $(ARGS)

sbom: $(UV) ## dist/trade.cdx.json: what the packages need to run, in CycloneDX 1.5, from the lock
	@mkdir -p dist
	@$(UV) export --quiet --locked --no-dev --group robot --preview-features sbom-export --format cyclonedx1.5 --output-file dist/trade.cdx.json
	@echo dist/trade.cdx.json

screenshots: $(UV) ## the pictures of README and docs, of a simulated robot in a browser (needs chromium)
	@$(RUN) python docs/pictures/take.py

bench: $(UV) ## speed as ratios against peers in the same run, and all targets; leaves build/bench.json and .html
	@$(RUN) python -m tests.bench --json build/bench.json --html build/bench.html $(ARGS)

bench-compare: $(UV) ## what differs from an older run by more than noise (BASE=old.json; ARGS=new.json)
	@$(RUN) python -m tests.bench.compare $(or $(BASE),$(error BASE=old.json is missing)) $(or $(ARGS),build/bench.json)

bench-page: $(UV) ## docs/performance.md and its pictures, of docs/performance.json (made by make bench ARGS="--full --json docs/performance.json")
	@$(RUN) python -m tests.bench.page $(ARGS)

build/viam/bin/python: $(UV)
	@$(UV) venv -q $(@D)/..
	@$(UV) pip install -q --python $@ 'viam-sdk==0.85.1'

docs: $(UV) ## the site of README.md and docs/ in site/; a warning, a dead link is an error
	@NO_MKDOCS_2_WARNING=1 $(RUN) mkdocs build --strict --quiet $(ARGS)
	@echo "site/index.html is the first page; with search, at http://127.0.0.1:8000: python3 -m http.server -b 127.0.0.1 -d site"

release-check: $(UV) ## wheels built twice and compared, installed and tried on each Python of this machine, licences (ARGS=--whole)
	@$(RUN) python -m tests.release $(ARGS)

clean: ## remove environments and caches
	rm -rf .uv .venv .pytest_cache .ruff_cache .hypothesis build dist site
