# make demo    the whole loop on a stand-in cell, ends with the dashboard's address
# make test    all tests that need no device   make check   lint, types, import contracts
# make mutants changes one line of the code at a time: does a test near by notice? (20 min a core)
# make soak    kills, cuts, fuzzing, endurance at full size (minutes), smaller in make test
# make bench   benchmarks against named references; BENCH=record picks those of the recorder
# make sanitize  C++ under ASan and UBSan   make tidy  clang-tidy   make cross  C++ for aarch64
# make wheel-test  sdist and wheel, the wheel installed and its demo run outside the checkout
# Everything lives in .venv. make demo installs what the demo needs (3.0 GB); the others add the
# rest, torch among it, and say first how large it is. make test TORCH=no leaves torch out.

.DEFAULT_GOAL := help
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3; do \
	command -v $$p >/dev/null 2>&1 && $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' && echo $$p && break; done)
BIN := .venv/bin
TORCH ?= yes
DEMO_READY := .venv/.demo
WITHOUT := $(filter no,$(TORCH))
READY := .venv/.ready$(if $(WITHOUT),-no-torch)
PYTEST := $(if $(WITHOUT),PYTHONPATH=.ci )$(BIN)/python -m pytest $(if $(WITHOUT),-p no_torch )-q
NATIVE := $(wildcard bridge/*/native/* twin/*/native/* twin/*/*/native/*)
RUN ?= runs/demo
BENCH ?=
export OMP_WAIT_POLICY ?= passive
unexport PYTHONDONTWRITEBYTECODE # else every process a test starts would compile the packages again

.PHONY: help setup demo test soak mutants fast check format bench sanitize tidy cross wheel-test clean

help:
	@sed -n '1,9s/^# //p' Makefile

setup: $(READY)

$(DEMO_READY): pyproject.toml constraints.txt CMakeLists.txt .ci/install.py $(wildcard cmake/*) $(NATIVE)
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed: apt-get install python3.11 python3.11-venv" >&2; exit 1; }
	@.ci/system-packages $(PYTHON)
	@test -x $(BIN)/python || { echo "Making .venv with $(PYTHON)"; $(PYTHON) -m venv .venv; }
	@$(BIN)/python .ci/install.py demo
	@touch $@

$(READY): $(DEMO_READY)
	@$(BIN)/python .ci/install.py test $(if $(WITHOUT),no-torch)
	@touch $@

demo: $(DEMO_READY)
	@$(BIN)/robot-gst demo $(RUN) $(DEMO)

test: $(READY)
	@.ci/browser
	@$(PYTEST) -n 3 --max-worker-restart=0 --dist loadfile --no-loadscope-reorder -m "not gpu and not hardware and not network" $(TEST)

soak: $(READY)
	@GST_KILLS=100 GST_RECORDER_KILLS=12 GST_KILL_NUMBERS=1,2,3,5 GST_EPISODES=1000 GST_WARM_UP_S=15 \
		GST_SOAK_S=60 GST_FUZZ_S=30 GST_SLOW_KILLS=100 GST_MUTANTS=3000 GST_POSES=2000 \
		$(BIN)/python -m pytest -q -rA -m slow -o faulthandler_timeout=1800 \
		tests/bridge/episode/test_writer_killed.py \
		tests/bridge/episode/test_recover.py tests/bridge/episode/test_recover_damage.py tests/fuzz tests/twin/robot/test_arms_inverse.py \
		tests/bridge/record/faults/test_failing_disks.py \
		tests/bridge/record/faults/test_killed_recorders.py tests/bridge/record/faults/test_endurance.py

mutants: $(READY)
	@$(BIN)/python tests/mutants/mutants.py $(MUTANTS)

fast: $(READY)
	@$(PYTEST) -n 2 --max-worker-restart=0 --dist loadfile $(TEST)

check: $(READY)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports --no-cache

format: $(READY)
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

bench: $(READY)
	@for file in benchmarks/bench_$(BENCH)*.py; do $(BIN)/python $$file || exit 1; done
	@$(BIN)/python benchmarks/table.py $(BENCH)

sanitize tidy cross: $(READY)
	@PYTHON=$(BIN)/python .ci/$@
wheel-test: $(READY)
	@.ci/wheel

clean:
	rm -rf build .venv .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
