# `make demo` and `make test` do all the set-up by themselves.
PYTHON ?= python3
# pyenv's shim of python3.X refuses to run unless that version is named.
export PYENV_VERSION := $(or $(PYENV_VERSION),$(patsubst python%,%,$(filter python3.%,$(PYTHON))))
VENV := .venv
# The ROS of the wheels: jazzy, or kilted, whose packages stand in a lock of their own.
ROS := jazzy
BIN := $(VENV)/bin
# Libraries of a ROS environment around this process must not leak into ours.  Bytecode is kept, whatever the shell says:
# pip compiles none here, and each process that a test or a graph starts would compile ROS, NumPy and SciPy again.
# Ninja would look for the job server of `make -j`, which recipes do not reach.
CLEAN := env -u MAKEFLAGS -u PYTHONDONTWRITEBYTECODE -u _ROS_WHEELS_BOOTSTRAP_COMPLETE -u LD_LIBRARY_PATH -u PYTHONPATH -u AMENT_PREFIX_PATH -u CMAKE_PREFIX_PATH
PIP := $(BIN)/python -m pip install --quiet --no-compile --no-deps --disable-pip-version-check
TEST := $(BIN)/python -m pytest --dist loadfile --no-loadscope-reorder
# Every process of a run of the tests has it: what others use of the machine makes a clock say "too slow here".
export DROCAP_TEST_RUN := $(or $(DROCAP_TEST_RUN),$(shell date +%s%N))
BENCHMARK = $(CLEAN) $(BIN)/python benchmarks
SOURCES := $(shell find drocap_ros msg srv config resource -type f -not -path '*/__pycache__/*') setup.py pyproject.toml CMakeLists.txt package.xml

.PHONY: help setup demo test compiled test-nodes test-computing lint site release bench bench-quick bench-flight clean
help:  ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/'

setup: $(VENV)/.package  ## virtual environment with ROS 2 Jazzy (`make ROS=kilted`: Kilted) and this package

# The lock names every package.  uv installs them in a fifth of pip's time; pip does where uv cannot reach a mirror that
# only pip's own settings name.
$(VENV)/.requirements: requirements.lock $(wildcard requirements-$(ROS).lock)
	@mkdir -p build
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 10) <= v <= (3, 13) else f"make setup: expected Python 3.10 to 3.13, found {v[0]}.{v[1]}; run: make PYTHON=python3.11 ...")'
	@echo "setup: virtual environment, ROS 2 $(ROS) and dependencies from PyPI (about a minute)"
	@{ [ $(ROS) = jazzy ] && cat requirements.lock || { grep -v '^ros-' requirements.lock; cat requirements-$(ROS).lock; }; } > build/requirements.txt
	@$(CLEAN) $(PYTHON) -m venv $(VENV)
	@$(CLEAN) $(PIP) "$$(grep '^uv==' build/requirements.txt)"
	@$(CLEAN) $(BIN)/uv pip install --quiet --no-deps --python $(BIN)/python -r build/requirements.txt || $(CLEAN) $(PIP) -r build/requirements.txt
	@$(CLEAN) $(BIN)/python -m pip check --disable-pip-version-check > build/requirements.log || { cat build/requirements.log; exit 1; }
	@touch $@

# The ROS wheels on PyPI lack tf2_msgs (TF) and hri_msgs (REP 155).
.SECONDEXPANSION:
$(VENV)/.tf2_msgs $(VENV)/.hri_msgs: $(VENV)/.%: $(VENV)/.requirements resource/cmake/ros_wheels.cmake $$(wildcard resource/$$*/*) $$(wildcard resource/$$*/msg/*)
	@PATH="$(CURDIR)/$(BIN):$$PATH" AMENT_PREFIX_PATH=$(CURDIR)/$(VENV) CMAKE_PREFIX_PATH=$(CURDIR)/$(VENV) $(BIN)/cmake -S resource/$* -B build/$* -G Ninja -DCMAKE_INSTALL_PREFIX=$(CURDIR)/$(VENV) -DPython3_EXECUTABLE=$(CURDIR)/$(BIN)/python -DBUILD_TESTING=OFF > build/$*.log
	@env -u MAKEFLAGS PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/cmake --build build/$* --target install >> build/$*.log
	@touch $@

$(VENV)/.package: $(VENV)/.requirements $(VENV)/.tf2_msgs $(VENV)/.hri_msgs $(SOURCES)
	@echo "setup: messages and package"
	@$(CLEAN) DROCAP_BUILD_DIR=$(CURDIR)/build/pip $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps --force-reinstall .
	@touch $@

demo: setup  ## a whole simulated capture, reconstructed and compared with its truth
	@$(CLEAN) $(BIN)/drocap demo --out demo_out

# All parts run in workers, which end with the run: an interpreter that held nodes may hang at its exit.
# Tests of nodes wait more than they compute: three at a time, then two.  Those that only compute take what is left of
# the processors beside them, and a quarter of what a busy program leaves.  Their outcome is printed when they end.
test: setup  ## the whole test suite: nodes and clocks (up to three times), and beside them what only computes
	@$(MAKE) --no-print-directory -j2 test-nodes test-computing

# Workers that start at once would compile the same modules, each for itself.
compiled: setup  ## bytecode of what the tests import, for the first `make test` of a clone
	@$(CLEAN) $(BIN)/python -m pytest --collect-only -m "not clock and not counting" > build/collected.log || { cat build/collected.log; exit 1; }

test-nodes: setup
	$(CLEAN) $(TEST) -m clock -n 3 --reruns 2 --rerun-show-tracebacks -r sR
	$(CLEAN) $(TEST) -m counting -n 2 --reruns 2 --rerun-show-tracebacks -r sR

test-computing: setup
	@$(CLEAN) OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 5 $(TEST) -m "not clock and not counting" -n 2 --timeout 1200 > build/test-computing.log 2>&1; \
	status=$$?; cat build/test-computing.log; exit $$status

lint: $(VENV)/.requirements  ## ruff and mypy
	$(CLEAN) $(BIN)/ruff check .
	$(CLEAN) $(BIN)/ruff format --check .
	$(CLEAN) $(BIN)/mypy

SITE := build/site_env
$(SITE)/.ready: docs/requirements.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if v >= (3, 11) else f"make site: expected Python 3.11 or newer, found {v[0]}.{v[1]}; run: make PYTHON=python3.12 site")'
	@$(CLEAN) $(PYTHON) -m venv $(SITE)
	@$(CLEAN) $(SITE)/bin/python -m pip install --quiet --disable-pip-version-check -r docs/requirements.txt
	@touch $@

site: $(SITE)/.ready  ## documentation site in build/site; its generator has an environment of its own
	@$(CLEAN) $(SITE)/bin/sphinx-build --quiet --fail-on-warning --keep-going -c docs -d build/site_pages . build/site
	@echo "open build/site/index.html in a browser"

release: setup  ## wheels without and with ROS in dist/, each tried in an empty environment
	@$(CLEAN) bash .ci/release

bench: demo  ## benchmarks (about two hours); they renew every page of docs/figures but those of flights
	$(BENCHMARK)/demo.py
	$(BENCHMARK)/accuracy.py
	$(BENCHMARK)/body.py
	$(BENCHMARK)/batch.py --recordings 200
	$(BENCHMARK)/export.py demo_out
	$(BENCHMARK)/reconstruction.py
	$(BENCHMARK)/perception.py
	$(BENCHMARK)/perception_people.py
	$(BENCHMARK)/recording.py --seconds 120 --kills 200 --mutations 1000 --flight 60
	$(BENCHMARK)/live.py

bench-quick: export DROCAP_FIGURES := $(CURDIR)/build/figures
bench-quick: setup  ## the same benchmarks, short (about ten minutes); pages in build/figures
	$(BENCHMARK)/demo.py --seeds 0 --seconds 8
	$(BENCHMARK)/accuracy.py --limit 1
	$(BENCHMARK)/reconstruction.py --frames 30 300 --threads 1 --repeat 1
	$(BENCHMARK)/perception.py --quick
	$(BENCHMARK)/recording.py --seconds 10 --kills 2 --mutations 20 --flight 10
	$(BENCHMARK)/live.py load kills --seconds 15 --rounds 1

bench-flight: setup  ## simulated faults, orbits by keypoints and by images, fuzzing (hours)
	$(BENCHMARK)/flight_faults.py
	$(BENCHMARK)/flight_faults.py processes
	$(BENCHMARK)/flight_orbits.py
	$(BENCHMARK)/flight_orbits.py quality
	$(BENCHMARK)/flight_orbits.py busy
	$(BENCHMARK)/flight_field.py
	$(BENCHMARK)/flight_kills.py
	$(BENCHMARK)/flight_kills.py pilot
	$(BENCHMARK)/flight_pixels.py
	$(BENCHMARK)/flight_fuzz.py

clean:  ## remove everything that was built
	rm -rf $(VENV) build dist install log
