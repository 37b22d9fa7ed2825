# Everything runs from .venv; `make setup` makes it. UV is used where it is installed, plain pip otherwise.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.hvt-setup
UV     := $(shell command -v uv 2>/dev/null)

# Containers often forbid bytecode; each start of a program would then compile all that it imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup demo test check arm lint type format docs bench bench-board bench-fleet bench-stills walks bench-compare bench-peers link soak kills failures fuzz training clean help

.PHONY: nightly nightly-tests

help:            ## list the targets
	@grep -E '^[a-z-]+: .*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/'

setup: $(STAMP)  ## put everything into .venv

$(STAMP): pyproject.toml
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
ifdef UV
	@uv pip install --quiet --python $(BIN)/python --editable '.[all]' --group dev
else
	@$(BIN)/python -m pip install --quiet --upgrade 'pip>=25.1'
	@$(BIN)/python -m pip install --quiet --editable '.[all]' --group dev
endif
	@touch $(STAMP)

demo: setup      ## three edges and one ground on the drawn scene: a table, demo.png, demo.rrd
	@$(BIN)/python deploy/demo.py

# Two workers more than there are processors, for a worker often waits for the programs that it started. At night, where
# flights in real time are most of it, as many. Nothing has a second chance. All tests of a file run in one process, so
# what a module flies is flown once; xdist 3.8 does not see its own groups with pytest 9.2. A worker that dies ends the
# run, which names its test: where xdist starts another, it may wait for ever.
CORES := $(shell getconf _NPROCESSORS_ONLN)
JOBS ?= $(shell expr $(CORES) + 2)
AT_ONCE = $(if $(CORE),--ignore=tests/extras) --numprocesses $(JOBS) --dist loadfile --no-loadscope-reorder --max-worker-restart 0

test: setup      ## all tests but the nightly ones, on real x265, Zenoh, ONNX models and recordings; JOBS= CORE=1
	@$(BIN)/python -m pytest $(AT_ONCE)

nightly: setup   ## an hour: the nightly tests, training, every scenario at full length, kills, fuzzers, parts taken away, soak; fails where a bar is missed; COUNT= RUNS= LASTS=
	@failed=; for part in nightly-tests training link 'kills COUNT=$(or $(COUNT),50)' 'fuzz RUNS=$(or $(RUNS),15000)' \
		failures 'soak LASTS=$(or $(LASTS),10min)'; do \
		$(MAKE) --no-print-directory COUNT= RUNS= LASTS= STRICT=1 $$part || failed="$$failed, $${part%% *}"; done; \
		test -z "$$failed" || { echo "failed$$failed"; exit 1; }

nightly-tests: JOBS := $(CORES)
nightly-tests: setup ## the tests that `make test` leaves out: JOBS at once, then alone those that a busy machine would spoil; flights whose threads sleep at random; other examples of properties
	@$(BIN)/python -m pytest --nightly -m 'nightly and not realtime' $(AT_ONCE); together=$$?; \
		$(BIN)/python -m pytest --nightly -m realtime; alone=$$?; \
		HVT_TEST_SLEEPS=0.0005 $(BIN)/python -m pytest tests/integration $(AT_ONCE); busy=$$?; \
		$(BIN)/python -m pytest -m hypothesis --hypothesis-profile=search $(AT_ONCE) && test $$together$$alone$$busy = 000

training: setup  ## the tests of training, in an environment of their own, for PyTorch is large; TORCH=
	@test -x build/training/bin/python || $(PYTHON) -m venv build/training
	@build/training/bin/python -m pip install --quiet --upgrade 'pip>=25.1'
	@build/training/bin/python -m pip install --quiet $(or $(TORCH),torch==2.13.0) --editable '.[study]' --group test
	@build/training/bin/python -m pytest tests/study/train

lint: setup
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/lint-imports

type: setup
	@$(BIN)/mypy
	@$(BIN)/mypy --config-file tests/mypy.ini tests lab bench

arm: setup       ## whether all that is needed comes as a ready wheel for 64-bit ARM
	@$(BIN)/python deploy/arm_wheels.py

check: lint type ## lint, format, import arrows, types; of the tests whether they call what is there

format: setup    ## write what `make check` wants to see
	@$(BIN)/ruff format
	@$(BIN)/ruff check --fix

bench: setup     ## memory, and speed as ratios against a peer or a floor; fails where a bar of bench/bars.py is missed
	@$(BIN)/python -m bench

bench-board: setup ## an edge with a quarter of two cores for a minute: no frame lost, boxes, the doctor's forecast; left out where nothing limits it
	@$(BIN)/python -m bench.board

bench-fleet: setup ## one ground with 1, 2, 4, 8 and 16 played edges: frames a second and core, delay, memory
	@$(BIN)/python -m bench.fleet

walks: setup ## the files that a frame and a still enter; fails where a walk is longer than its bound
	@$(BIN)/python -m lab.walks

bench-stills: setup ## still codecs on real crops: bytes at equal quality, time to encode and decode
	@$(BIN)/python -m bench.stills

bench-compare: setup ## what the ground sees at each bitrate, method by method, on a car park and on small objects
	@$(BIN)/python -m bench.compare

link: setup      ## edge and ground over bad links; STRICT=1 fails where a bar is missed; SCENARIO= CLIP= LENGTH=short LASTS=60min CARRIER=netns|tun SEED=
	@$(BIN)/python -m lab.link $(SCENARIO) $(if $(CLIP),--clip $(CLIP)) $(if $(LENGTH),--length $(LENGTH)) \
		$(if $(LASTS),--lasts $(LASTS)) $(if $(CARRIER),--carrier $(CARRIER)) $(if $(SEED),--seed $(SEED)) $(if $(STRICT),--strict)

soak: setup      ## an hour of fading link: memory, descriptors, threads, account; LASTS=60min CLIP=
	@$(BIN)/python -m lab.link drone-fade --name soak --lasts $(or $(LASTS),60min) $(if $(CLIP),--clip $(CLIP)) $(if $(STRICT),--strict)

kills: setup     ## kill -9 of edge or ground in the air: what is left is readable; COUNT=50 SEED=
	@$(BIN)/python -m lab.link.kills $(if $(COUNT),--count $(COUNT)) $(if $(SEED),--seed $(SEED)) $(if $(STRICT),--strict)

failures: setup  ## a flight of the demo scene loses disk, model, viewer and link, one after the other: watch it (the disk needs root)
	@$(BIN)/python -m lab.failures

fuzz: setup      ## coverage-guided fuzzing of all that comes from outside: RUNS=1000000 TARGET=NAME; needs atheris
	@$(BIN)/python -m lab.fuzz $(if $(RUNS),--runs $(RUNS)) $(if $(TARGET),--target $(TARGET))

bench-peers: setup ## the tracker beside roboflow trackers, which get an environment of their own (they are large)
	@test -x build/peers/bin/python || $(PYTHON) -m venv build/peers
	@build/peers/bin/python -m pip install --quiet numpy lapx trackers
	@PYTHONPATH=common:. build/peers/bin/python -m bench.tracker

docs: setup      ## write docs/options.md from the settings
	@$(BIN)/python docs/options.py

clean:
	rm -rf build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
