# SPDX-License-Identifier: GPL-3.0-or-later
# Every target is a line or two that a person could type; `setup/environment` is what they have in common.
# .venv holds everything on the newer Python that runs, .venv-4.5 and .venv-5.2 one Blender LTS line without the trainer.

.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory
PYTHON_4.5 = 3.11
PYTHON_5.2 = 3.13
OTHER_LINE = $$(.venv/bin/python -c 'import sys; print("4.5" if sys.version_info >= (3, 13) else "5.2")')

# A process for each core, of which each runs whole files: there is one Blender to a process.
SIDE_BY_SIDE = -n auto --maxprocesses 4 --dist loadfile
FAST = -m "not slow"

# Where torch is. Blender's Python, or a line's environment, starts this one for training.
export FDDA_TRAINER_PYTHON ?= $(CURDIR)/.venv/bin/python

help:  ## show this list
	@sed -n 's/^\([a-z-]*\):.*  ## /\1\t/p' $(MAKEFILE_LIST) | while IFS='	' read -r name text; do printf '  make %-14s %s\n' "$$name" "$$text"; done
	@echo '  PYTHON=/path/to/python3.13 or 3.11 names the Python to use; otherwise one that runs is looked for.'

.venv:
	@setup/environment .venv everything

demo: .venv  ## the arm from rig to playback, into out/demo
	.venv/bin/python benchmarks/demo.py out/demo

test: test-core test-trainer test-blender  ## all three tiers of tests, on one Blender LTS line

test-core: .venv  ## the tests that need no Blender and take seconds
	.venv/bin/python -m pytest $(SIDE_BY_SIDE) tests/core tests/contract

test-trainer: .venv  ## the tests of the training, export and report
	.venv/bin/python -m pytest $(SIDE_BY_SIDE) tests/trainer $(FAST)

test-blender: .venv  ## the tests that run in Blender
	.venv/bin/python -m pytest $(SIDE_BY_SIDE) tests/blender $(FAST)

test-slow: .venv  ## the tests that make test leaves out: whole trainings, simulations, most characters, a short soak
	.venv/bin/python -m pytest $(SIDE_BY_SIDE) -m slow tests/trainer tests/blender

test-examples: .venv  ## the examples of docs/formats.md, in Python and in Chromium (CHROMIUM=/path/to/chromium)
	.venv/bin/python -m pytest tests/examples

farm: .venv-farm  ## what characters.toml says, on this machine or a cluster (PLAN=characters.toml, OPTIONS="--workers 2")
	.venv-farm/bin/python -m fdda_addon farm $(or $(PLAN),$(error PLAN=characters.toml names the characters, see docs/farm.md)) $(OPTIONS)

.venv-farm:
	@setup/environment .venv-farm farm

test-farm: .venv-farm  ## the tests of the farm: its graph on a cluster, and what render farms take
	.venv-farm/bin/python -m pytest tests/farm

test-gui: package  ## press the buttons of the sidebar in a Blender with a window (BLENDER=/path/to/blender), into out/gui
	.venv/bin/python tests/gui/run.py out/gui $(BLENDER)

test-windows: .venv  ## the tests in Python for Windows under Wine, as root on Debian (LINE=5.2: on one LTS line; 40 minutes)
	setup/windows/setup $(PYTHON_$(LINE))
	.venv/bin/python setup/package.py windows-x64
	.venv/bin/python tests/windows/run.py $(LINE)

test-all: test test-slow test-examples test-farm  ## every test on both LTS lines, the soak, and the window last
	@$(MAKE) test-line LINE=$(OTHER_LINE) MARKS=
	@$(MAKE) soak
	@$(MAKE) test-gui

# What differs between versions of Blender; empty for all tests.
test-line: MARKS = -m "not slow and not one_blender_version"
test-line: .venv-line .venv  ## the core tier, and of the Blender tier what differs between versions, on LINE=4.5 or LINE=5.2
	.venv-$(LINE)/bin/python -m pytest $(SIDE_BY_SIDE) tests/core tests/contract
	.venv-$(LINE)/bin/python -m pytest $(SIDE_BY_SIDE) $(MARKS) tests/blender

.venv-line:
	@setup/environment .venv-$(LINE) blender $(or $(PYTHON_$(LINE)),$(error LINE is 4.5 or 5.2))

bench: .venv  ## time the arm at three densities, and other rigs: RIGS="a.blend b.blend"; into out/bench
	.venv/bin/python benchmarks/bench.py out/bench $(addprefix --rig ,$(RIGS))

sampling: .venv  ## compare ways to choose poses, into out/sampling (20 minutes)
	.venv/bin/python benchmarks/sampling.py out/sampling

soak: .venv  ## hostile files, kills, full disks, frames, undo: what held and what fell short, into out/soak (20 minutes at most)
	.venv/bin/python benchmarks/soak.py out/soak $(OPTIONS)

faults: .venv  ## seed faults into a copy of the code and say which tests catch them, into out/faults (OPTIONS="--only ID"; 30 minutes)
	.venv/bin/python benchmarks/faults.py out/faults $(OPTIONS)

study: .venv  ## compare sizes and activations of the networks, into out/study (30 minutes)
	.venv/bin/python benchmarks/study.py out/study

simulation: .venv  ## learn flesh that Blender simulates, for docs/simulations.md, into out/simulation (20 minutes)
	.venv/bin/python benchmarks/simulation.py out/simulation

characters: .venv  ## record, train, bind and compare every kind of character on both LTS lines, for docs/characters.md
	@$(MAKE) .venv-line LINE=$(OTHER_LINE)
	.venv/bin/python benchmarks/characters.py out/characters
	.venv-$(OTHER_LINE)/bin/python benchmarks/characters.py out/characters

pictures: demo  ## make the README's pictures again, from those of the demo
	.venv/bin/python docs/pictures/make_pictures.py out/demo/pictures

map: .venv  ## draw the layers of the code again, for docs/development.md
	.venv/bin/python docs/pictures/make_map.py docs/pictures/map.svg

fixtures:  ## build the rigs in blend_fixtures again, with the oldest Blender under test
	@$(MAKE) .venv-line LINE=4.5
	.venv-4.5/bin/python blend_fixtures/make_fixtures.py

lint: .venv  ## ruff's checks and formatting, and words that the field does not use
	.venv/bin/ruff check
	.venv/bin/ruff format --check
	.venv/bin/python setup/retired_words.py

package: .venv  ## dist/fdda_addon-VERSION.zip, to install in Blender (PLATFORM=all: all platforms)
	.venv/bin/python setup/package.py $(PLATFORM)

requirements: .venv  ## pin again in requirements/ what pyproject.toml asks for
	for version in 3.11 3.13 3.14; do .venv/bin/uv pip compile --quiet --no-annotate \
		--python-version $$version --python-platform x86_64-manylinux_2_28 --custom-compile-command 'make requirements' \
		--group blender --group trainer --group test --group farm --group lint --group setup \
		--output-file requirements/python-$$version.txt || exit; done

clean:  ## remove what was built and the environments
	rm -rf .venv .venv-* .venv.lock out dist .pytest_cache .ruff_cache examples/web/node_modules examples/web/dist

.PHONY: help .venv .venv-line .venv-farm demo farm test-farm test test-core test-trainer test-blender test-examples test-gui test-windows test-all test-line bench sampling soak faults study simulation characters pictures map fixtures lint package requirements clean
