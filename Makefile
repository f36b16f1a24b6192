# make demo   a robot localises itself over ROS 2 topics: table at the end, pictures in out/
# make test   the whole test suite (ARGS='-k name' to choose)
# make lint   style and types
# make setup  only the virtual environment (.venv), once per change of the requirement files
# make clean  removes what the others made: .venv, and out with all that is in it
#
# PYTHON=/usr/bin/python3.12 chooses the interpreter, 3.10 to 3.12.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.PHONY: help setup demo test lint clean

VENV := .venv
RUN := $(VENV)/bin/python
ARGS ?=

# A sourced Jazzy brings its own rclpy, for its own Python; then the wheels must stay away.
ifeq ($(ROS_DISTRO),jazzy)
PYTHON ?= $(shell command -v python3)
ROS := $(shell '$(PYTHON)' -c 'import rclpy' 2>/dev/null && echo installed)
endif
ifeq ($(ROS),)
PYTHON ?= $(firstword $(foreach p,python3.12 python3.11 python3.10 python3,$(shell $(p) -c \
	'import sys, venv, ensurepip; (3, 10) <= sys.version_info < (3, 13) and print(sys.executable)' \
	2>/dev/null)))
ROS := $(if $(filter Linux-x86_64,$(shell uname -sm | tr ' ' '-')),wheels,none)
# What another ROS, or an activated environment with these wheels, left in the shell would be
# loaded in place of our own.
unexport AMENT_PREFIX_PATH PYTHONPATH RMW_IMPLEMENTATION ROS_DISTRO
ifneq ($(ROS_DISTRO)$(_ROS_WHEELS_BOOTSTRAP_COMPLETE),)
unexport LD_LIBRARY_PATH
endif
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
endif
unexport PYTHONHOME VIRTUAL_ENV

export ROS_LOG_DIR ?= $(CURDIR)/out/log
READY := $(VENV)/ready-$(ROS)

REQUIREMENTS_installed := requirements.txt requirements-test.txt
REQUIREMENTS_wheels := requirements.txt requirements-ros.txt requirements-test.txt
REQUIREMENTS_none := requirements.txt requirements-test.txt

NO_NODE := There is no rclpy for $(shell uname -sm) on PyPI, and no ROS 2 Jazzy is sourced: \
the node cannot run here, everything else can.

help:
	@sed -n 's/^# //p' Makefile | head -n 6

setup: $(READY)

$(READY): $(REQUIREMENTS_$(ROS)) setup.py
	@if [ -z '$(PYTHON)' ]; then \
		echo 'No Python 3.10 to 3.12 with venv was found (Debian, Ubuntu: apt install' \
			'python3-venv); name one with PYTHON=/path/to/python3.' >&2; exit 1; fi
	@echo 'Setting up $(VENV) with $(PYTHON); ROS: $(ROS) (once; a few minutes with a cold cache)'
	@$(PYTHON) -m venv --clear $(if $(filter installed,$(ROS)),--system-site-packages) $(VENV)
ifeq ($(ROS),installed)
	@# apt's numpy, scipy and OpenCV stay: what pip adds has to fit them, and OpenCV is there.
	@$(RUN) -c 'import cv2, numpy, scipy; print(f"numpy=={numpy.__version__}\nscipy=={scipy.__version__}")' \
		> $(VENV)/constraints.txt
	@cat $(REQUIREMENTS_$(ROS)) | grep -v '^opencv' > $(VENV)/requirements.txt
	@$(RUN) -m pip install --quiet -c $(VENV)/constraints.txt -r $(VENV)/requirements.txt
else
	@$(RUN) -m pip install --quiet $(addprefix -r ,$(REQUIREMENTS_$(ROS)))
endif
	@$(RUN) -m pip install --quiet --no-deps --editable .
	@touch $@

demo: $(READY)
ifeq ($(ROS),none)
	@echo '$(NO_NODE) The same bag offline:'
	@$(VENV)/bin/nccs-pose replay bags/room --rig config/room_rig.yaml --map config/room_map.yaml \
		--params config/room.yaml --output out/room.tum --plots out
else
	@$(RUN) -m nccs_pose.ros.demo $(ARGS)
endif

test: $(READY)
ifeq ($(ROS),none)
	@echo '$(NO_NODE) Its tests are skipped.'
endif
	@$(RUN) -m pytest $(ARGS)

lint: $(READY)
	@$(RUN) -m ruff check .
	@$(RUN) -m mypy

clean:
	@rm -rf $(VENV) out build *.egg-info .pytest_cache .hypothesis .mypy_cache .ruff_cache
	@find nccs_pose test launch -name __pycache__ -prune -exec rm -rf {} +
