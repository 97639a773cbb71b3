# make demo    the whole loop on a stand-in cell, ends with the dashboard's address
# make test    all tests that need no device   make check   lint, types, import contracts
# make soak    kills, cuts, fuzzing, endurance at full size (minutes), smaller in make test
# make bench   benchmarks against named references; BENCH=record picks those of the recorder
# make sanitize  C++ under ASan and UBSan   make tidy  clang-tidy   make cross  C++ for aarch64
# Everything lives in .venv; the first target run makes it (about 5 GB, a few minutes).

.DEFAULT_GOAL := help
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3; do \
	command -v $$p >/dev/null 2>&1 && $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' && echo $$p && break; done)
BIN := .venv/bin
READY := .venv/.ready
NATIVE := $(wildcard twin/scene/native/* bridge/media/native/* bridge/episode/native/* twin/physics/native/* twin/replay/native/*)
RUN ?= runs/demo
BENCH ?=
export OMP_WAIT_POLICY ?= passive
unexport PYTHONDONTWRITEBYTECODE # else every process a test starts would compile the rooms again

.PHONY: help setup demo test soak fast check format bench sanitize tidy cross clean

help:
	@sed -n '1,7s/^# //p' Makefile

setup: $(READY)

$(READY): pyproject.toml constraints.txt CMakeLists.txt $(wildcard cmake/*) $(NATIVE)
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed: apt-get install python3.11 python3.11-venv" >&2; exit 1; }
	@.ci/system-packages $(PYTHON)
	@test -x $(BIN)/python || { echo "Making .venv with $(PYTHON)"; $(PYTHON) -m venv .venv; }
	@echo "Installing packages into .venv (about 5 GB the first time)"
	@$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check \
		-c constraints.txt "scikit-build-core>=1.0" nanobind cmake ninja torch==2.13.0
	@$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check \
		-c constraints.txt --no-build-isolation -e '.[all,dev]'
	@# pip compiles 28000 files on one core; a few of them are templates and do not compile
	@$(BIN)/python -W ignore -m compileall -qq -j 0 .venv/lib || true
	@touch $@

demo: $(READY)
	@$(BIN)/robot-gst demo $(RUN) $(DEMO)

test: $(READY)
	@.ci/browser
	@$(BIN)/python -m pytest -q -n 2 --max-worker-restart=1 --dist loadfile --no-loadscope-reorder -m "not gpu and not hardware and not network" $(TEST)

soak: $(READY)
	@GST_KILLS=100 GST_RECORDER_KILLS=12 GST_KILL_NUMBERS=1,2,3,5 GST_EPISODES=1000 GST_WARM_UP_S=15 \
		GST_SOAK_S=60 GST_LISTED=10000 GST_CUT_MESSAGES=12 GST_FUZZ_S=30 \
		$(BIN)/python -m pytest -q -rA -m slow -o faulthandler_timeout=1800 \
		tests/bridge/episode/test_writer_killed.py tests/bridge/episode/test_catalogue_at_scale.py \
		tests/bridge/episode/test_recover.py tests/fuzz \
		tests/bridge/record/faults/test_killed_recorders.py tests/bridge/record/faults/test_endurance.py

fast: $(READY)
	@$(BIN)/python -m pytest -q -n 2 --max-worker-restart=1 --dist loadfile $(TEST)

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

clean:
	rm -rf build .venv .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
