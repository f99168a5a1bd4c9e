# SPDX-License-Identifier: GPL-3.0-or-later
# Every target runs one or two commands that a person could type. `setup/environment` makes the virtual environments:
# .venv has all packages, on the newer Python of this machine; .venv-4.5 and .venv-5.2 have one Blender LTS line each,
# without the trainer's packages; .venv-core has what the core needs; .venv-farm has Snakemake.

.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory
PYTHON_4.5 = 3.11
PYTHON_5.2 = 3.13
OTHER_LINE = $$(.venv/bin/python -c 'import sys; print("4.5" if sys.version_info >= (3, 13) else "5.2")')

# One process per core, at most four. Each runs whole files, as a process can hold one Blender.
IN_PARALLEL = -n auto --maxprocesses 4 --dist loadfile
NOT_SLOW = -m "not slow"

# The Python with torch. The add-on starts it for trainings, also from an environment that has no torch.
export FDDA_TRAINER_PYTHON ?= $(CURDIR)/.venv/bin/python

help:  ## show this list
	@sed -n 's/^\([a-z-]*\):.*  ## /\1\t/p' $(MAKEFILE_LIST) | while IFS='	' read -r name text; do printf '  make %-14s %s\n' "$$name" "$$text"; done
	@echo '  PYTHON=/path/to/python3.13 (or 3.11) is the Python for the environments; without it, setup/environment searches for one.'

.venv:
	@setup/environment .venv everything

# The core and its checks need neither Blender nor torch.
CORE = $(if $(wildcard .venv/bin),.venv,.venv-core)

.venv-core:
	@setup/environment .venv-core core

demo: .venv  ## record, train, bind and play the arm, into out/demo
	.venv/bin/python benchmarks/demo.py out/demo

test: test-core test-trainer test-blender  ## run the core, trainer and Blender tests on one Blender LTS line, without the slow ones

test-core: $(CORE)  ## run the tests that need no Blender and take seconds
	$(CORE)/bin/python -m pytest $(IN_PARALLEL) tests/core tests/contract

test-trainer: .venv  ## run the tests of the training, export and report
	.venv/bin/python -m pytest $(IN_PARALLEL) tests/trainer $(NOT_SLOW)

test-blender: .venv  ## run the tests that need Blender
	.venv/bin/python -m pytest $(IN_PARALLEL) tests/blender $(NOT_SLOW)

test-slow: .venv  ## run the tests that make test leaves out: whole trainings, simulations, most characters
	.venv/bin/python -m pytest $(IN_PARALLEL) -m slow tests/trainer tests/blender

test-examples: .venv  ## run the tests of the examples in docs/formats.md, in Python and in Chromium (CHROMIUM=/path/to/chromium)
	.venv/bin/python -m pytest tests/examples

farm: .venv .venv-farm  ## record, train, evaluate and bind the characters of a plan, see docs/farm.md (PLAN=characters.yaml, OPTIONS="--cores 2")
	.venv-farm/bin/snakemake --snakefile farm/Snakefile --configfile $(or $(PLAN),$(error PLAN=characters.yaml names the characters, see docs/farm.md)) $(or $(OPTIONS),--cores all)

.venv-farm:
	@setup/environment .venv-farm farm

test-farm: .venv .venv-farm  ## run the tests of the farm: on this machine, on a stand-in for a cluster, and as jobs of OpenJD and Flamenco
	.venv-farm/bin/python -m pytest tests/farm

test-gui: package  ## press the buttons of the sidebar in a Blender with a window, into out/gui (BLENDER=/path/to/blender)
	.venv/bin/python tests/gui/run.py out/gui $(BLENDER)

test-windows: .venv  ## run the tests in Python for Windows under Wine, as root on Debian (LINE=5.2: only that LTS line; 40 minutes)
	setup/windows/setup $(PYTHON_$(LINE))
	.venv/bin/python setup/package.py windows-x64
	.venv/bin/python tests/windows/run.py $(LINE)

test-all: test test-slow test-examples test-farm  ## run all tests on one LTS line, those that depend on Blender on the other, then soak and test-gui; not test-windows
	@$(MAKE) test-line LINE=$(OTHER_LINE) MARKS=
	@$(MAKE) soak
	@$(MAKE) test-gui

# Select the tests that depend on the Blender version; an empty MARKS selects all.
test-line: MARKS = -m "not slow and not one_blender_version"
test-line: .venv-line .venv  ## run the core tests and the Blender tests that depend on the Blender version, on LINE=4.5 or LINE=5.2
	.venv-$(LINE)/bin/python -m pytest $(IN_PARALLEL) tests/core tests/contract
	.venv-$(LINE)/bin/python -m pytest $(IN_PARALLEL) $(MARKS) tests/blender

.venv-line:
	@setup/environment .venv-$(LINE) blender $(or $(PYTHON_$(LINE)),$(error LINE is 4.5 or 5.2))

bench: .venv  ## time the arm at three mesh densities and other rigs, into out/bench (RIGS="a.blend b.blend")
	.venv/bin/python benchmarks/bench.py out/bench $(addprefix --rig ,$(RIGS))

soak: .venv  ## test damaged files, kills and full disks, into out/soak (10 minutes at most)
	.venv/bin/python benchmarks/soak.py out/soak $(OPTIONS)

study: .venv  ## compare sizes and activations of the networks, into out/study (an hour)
	.venv/bin/python benchmarks/study.py out/study

simulation: .venv  ## learn a simulated deformation, for docs/simulations.md, into out/simulation (20 minutes)
	.venv/bin/python benchmarks/simulation.py out/simulation

characters: .venv  ## record, train, bind and compare every kind of character on both LTS lines, for docs/characters.md
	@$(MAKE) .venv-line LINE=$(OTHER_LINE)
	.venv/bin/python benchmarks/characters.py out/characters
	.venv-$(OTHER_LINE)/bin/python benchmarks/characters.py out/characters

pictures: demo  ## render the README's pictures again from the demo's files
	.venv/bin/python docs/pictures/make_pictures.py out/demo

films: demo  ## render the films of the demo: rig beside model, and their errors, into out/films
	.venv/bin/python docs/pictures/make_films.py out/demo out/films

map: .venv  ## draw the diagrams of the code's layers and of a character's states for docs/development.md again
	.venv/bin/python docs/pictures/make_diagrams.py docs/development.md

third-party: .venv  ## take characters that others made through the whole path, into out/third_party (FOLDER=/path/to/characters HEAVY=/path/to/clothed.blend; an hour)
	.venv/bin/python benchmarks/third_party.py out/third_party $(FOLDER)
	.venv/bin/python benchmarks/heavy_character.py out/heavy_character $(HEAVY)

fixtures:  ## build the rigs in blend_fixtures again, with the oldest Blender under test
	@$(MAKE) .venv-line LINE=4.5
	.venv-4.5/bin/python blend_fixtures/make_fixtures.py

lint: $(CORE)  ## check the code with ruff, and code and documents for retired words
	$(CORE)/bin/ruff check
	$(CORE)/bin/ruff format --check
	$(CORE)/bin/python setup/retired_words.py

package: .venv  ## build dist/fdda_addon-VERSION.zip, to install in Blender (PLATFORM=all: all platforms)
	.venv/bin/python setup/package.py $(PLATFORM)

release: .venv  ## build the zips of VERSION for all platforms, and a repository that any web server can offer, into dist/repository (WEBSITE=https://…)
	.venv/bin/python setup/release.py $(or $(VERSION),$(error VERSION=0.2.0 names the version, as in blender_manifest.toml)) $(if $(WEBSITE),--website '$(WEBSITE)')

requirements: .venv  ## pin the packages that pyproject.toml names, and their dependencies, in requirements/
	for version in 3.11 3.13 3.14; do .venv/bin/uv pip compile --quiet --no-annotate \
		--python-version $$version --python-platform x86_64-manylinux_2_28 --custom-compile-command 'make requirements' \
		--group blender --group trainer --group core --group test --group farm --group lint --group setup \
		--output-file requirements/python-$$version.txt || exit; done

clean:  ## remove all built files and the environments
	rm -rf .venv .venv-* .venv.lock out dist .pytest_cache .ruff_cache examples/web/node_modules examples/web/dist

.PHONY: help .venv .venv-core .venv-line .venv-farm demo farm test-farm test test-core test-trainer test-blender test-slow test-examples test-gui test-windows test-all test-line bench soak study simulation characters pictures films map third-party fixtures lint package release requirements clean
