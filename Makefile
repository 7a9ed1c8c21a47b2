# make demo | test | lint | coverage | clean. Needs Python 3.10 … 3.13 with venv, nothing else.

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/ready
SUITABLE := import sys, venv, ensurepip; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11 python3.10; do \
	$$p -c '$(SUITABLE)' 2> /dev/null && echo $$p && break; done)
PYTEST_ARGS ?=

# The environment brings its own ROS 2: another one that is sourced would mix with it.
unexport PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH COLCON_PREFIX_PATH CMAKE_PREFIX_PATH
unexport LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE RMW_IMPLEMENTATION
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help demo test lint coverage clean

help:
	@echo 'make demo      sample video through the live nodes; results in out/'
	@echo 'make test      all tests'
	@echo 'make lint      ruff and mypy'
	@echo 'make coverage  tests with line coverage of core/ and ros/'
	@echo 'make clean     remove the environment and everything that was made'

$(READY): setup.py setup.cfg requirements/constraints.txt
	@test -n '$(PYTHON)' || { echo 'Python 3.10 … 3.13 with venv is needed' \
		'(Debian, Ubuntu: apt install python3 python3-venv)' >&2; exit 1; }
	@test "$$(uname -m)" = x86_64 || { echo "ROS 2 wheels exist for x86_64 only, this is" \
		"$$(uname -m): build with colcon on apt's ROS 2 Jazzy (see README.md)" >&2; exit 1; }
	@echo '== environment: $(VENV) ($(PYTHON)), about a minute, only this once'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --progress-bar off -c requirements/constraints.txt \
		-e '.[ros,scenes,plots,report,test,dev]'
	@touch $@

demo: $(READY)
	@$(BIN)/python -m sphstereo_ros.bench.demo bags/street.mcap --out out

test: $(READY)
	@echo '== tests'
	@$(BIN)/python -m pytest $(PYTEST_ARGS)

lint: $(READY)
	@echo '== ruff'
	@$(BIN)/ruff check .
	@echo '== mypy'
	@$(BIN)/mypy

coverage: $(READY)
	@echo '== tests with coverage'
	@$(BIN)/python -m pytest --cov --cov-report=term-missing:skip-covered $(PYTEST_ARGS)

clean:
	rm -rf $(VENV) build install log out dist *.egg-info .coverage .coverage.* htmlcov \
		.pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
