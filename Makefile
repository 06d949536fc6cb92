# articugen: from a category's name to a verified data set. `make` lists the targets.

PYTHON ?= python3
VENV   ?= .venv
SOURCE ?= procedural
OUT    ?= data
RUNS   ?= runs

# Called by make, articugen says what comes next in make's words.
articugen := ARTICUGEN_CALLED_BY=make $(VENV)/bin/articugen
pinned    := $(VENV)/bin/python -m pip install -qq --disable-pip-version-check -c constraints.txt

# All that the generator imports, named one by one: yourdfpy asks for whatever trimesh can make use of,
# a third of the environment and of the time to install it. Other extras bring it.
generators := annotated-doc annotated-types h5py llvmlite lxml manifold3d markdown-it-py mdurl numba numpy \
    pillow platformdirs pycollada pydantic pydantic-core pygments python-dateutil pyyaml rich shellingham \
    six trimesh typer typing-extensions typing-inspection yourdfpy

# Python compiles what is imported anyhow, and most of what is installed never is: half of the time,
# and 100 MB. (PIP_NO_COMPILE=1 would say the contrary.)
export PIP_COMPILE := 0

# Stamps: an environment is made once, and again when what it is made from changes.
generator := $(VENV)/.installed
testing   := $(VENV)/.installed-test
dev       := $(VENV)/.installed-dev
backends  := $(VENV)/.installed-backends
learner   := $(VENV)/.installed-ppd
readers   := $(VENV)/.installed-readers
viewer    := $(VENV)/.installed-view
clusters  := $(VENV)/.installed-cluster
site      := $(VENV)/.installed-docs

# What the pictures and reports of the site are made by.
gallery   := build/gallery/.made
makes     := $(shell find articugen recipes docs/site/gallery.py -name '*.py' -o -name '*.yaml' -o -name '*.css' -o -name '*.js')

options = $(foreach pair,RECIPE:recipe OBJECTS:objects IDS:ids EXCLUDE:exclude JOINTS:joints \
    MOVABLE:movable CANONICAL:canonical STATES:states MAX_REJECTED:max-rejected JOBS:jobs SEED:seed,\
    $(call option,$(word 1,$(subst :, ,$(pair))),$(word 2,$(subst :, ,$(pair)))))
settings = $(foreach setting,$(SET),--set '$(setting)')
replace = $(if $(REPLACE),--replace)
option = $(if $($(1)),--$(2) "$($(1))")

.DEFAULT_GOAL := help
.PHONY: help dataset inspect report site view verify train depth evaluate comparison ablation test check format bench accuracy bench-reading bench-train paris soundness fuzz chaos docs site-tools backends cluster learner exporters viewer clean

help:  ## list the targets
	@echo "make dataset CATEGORY=laptop [SOURCE= RECIPE= OBJECTS= STATES= JOBS= OUT= SEED= REPLACE=1"
	@echo "     IDS= EXCLUDE= JOINTS= MOVABLE= CANONICAL= MAX_REJECTED= SET=]; CATEGORY=laptop,oven or all for several"
	@echo "make train CATEGORY=laptop [RECIPE=ppd_quick SET= SEED= SEEDS= OUT= RUNS=]; make evaluate CATEGORY=laptop"
	@echo
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  \1\t\2/p' $(MAKEFILE_LIST) | expand -t 14
	@echo
	@echo "SET='views.count=50 sampling.grids=[16,32]' changes keys of the recipe."
	@echo "Without CATEGORY, 'make dataset' lists the categories. RECIPE=quick takes under a minute."

dataset: $(generator)  ## make a data set: articulate, render, fuse, sample, write shards
ifdef CATEGORY
	@$(articugen) generate --category "$(CATEGORY)" --source "$(SOURCE)" --out "$(OUT)" $(options) $(settings) $(replace)
else
	@$(articugen) sources
	@echo "Choose one: make dataset CATEGORY=laptop"
endif

inspect: $(generator)  ## show what CATEGORY= holds and draw its contact sheet
ifdef CATEGORY
	@$(articugen) inspect "$(OUT)/$(CATEGORY)" --image "$(OUT)/$(CATEGORY)/sheet.png"
else
	@echo "Choose one: make inspect CATEGORY=laptop" >&2; exit 2
endif

report: $(generator)  ## write all about CATEGORY= into one HTML file that opens offline
ifdef CATEGORY
	@$(articugen) inspect "$(OUT)/$(CATEGORY)" --html "$(OUT)/$(CATEGORY)/report.html"
else
	@echo "Choose one: make report CATEGORY=laptop" >&2; exit 2
endif

site: $(generator)  ## write pages of all objects of CATEGORY= into a folder for any host
ifdef CATEGORY
	@$(articugen) site "$(OUT)/$(CATEGORY)" --out "site/$(CATEGORY)"
else
	@echo "Choose one: make site CATEGORY=laptop" >&2; exit 2
endif

view: $(viewer)  ## look at CATEGORY= in the browser, or at WHAT=model.urdf; Ctrl-C ends it
ifneq ($(CATEGORY)$(WHAT),)
	@$(articugen) view "$(or $(WHAT),$(OUT)/$(CATEGORY))" $(call option,PORT,port)
else
	@echo "Choose one: make view CATEGORY=laptop" >&2; exit 2
endif

verify: $(generator)  ## check every byte and the geometry of OUT (or of CATEGORY= alone); REPAIR=1 mends
	@$(articugen) verify "$(OUT)$(if $(CATEGORY),/$(CATEGORY))" $(if $(REPAIR),--repair)

train: $(learner)  ## train PPD on CATEGORY= (RECIPE=ppd_quick, ppd_hour, ppd_real, ppd_plain, ppd_paper or ppd_release)
ifdef CATEGORY
	@$(articugen) train --category "$(CATEGORY)" --data "$(OUT)/$(CATEGORY)" --runs "$(RUNS)" --recipe "$(or $(RECIPE),ppd_quick)" $(settings) $(if $(SEED),--seed "$(SEED)") $(if $(SEEDS),--seeds "$(SEEDS)")
else
	@echo "Choose one: make train CATEGORY=laptop" >&2; exit 2
endif

depth: $(learner)  ## train an encoder for depth input beside the newest run (the third stage; RECIPE=ppd_depth takes longer)
ifdef CATEGORY
	@$(articugen) train-depth "$(RUNS)/$(CATEGORY)" --data "$(OUT)/$(CATEGORY)" --runs "$(RUNS)-depth" $(if $(RECIPE),--recipe "$(RECIPE)") $(settings)
else
	@echo "Choose one: make depth CATEGORY=laptop" >&2; exit 2
endif

evaluate: $(learner)  ## evaluate the newest run of CATEGORY= on its test objects (PROTOCOL=release STATES=0 RUNS=runs-depth)
ifdef CATEGORY
	@$(articugen) evaluate "$(RUNS)/$(CATEGORY)" --data "$(OUT)/$(CATEGORY)" $(if $(PROTOCOL),--protocol "$(PROTOCOL)") $(if $(STATES),--states "$(STATES)")
else
	@echo "Choose one: make evaluate CATEGORY=laptop" >&2; exit 2
endif

comparison: $(learner)  ## train every method on CATEGORY= for BUDGET=10 minutes each; tables and a picture (SEEDS=1)
	$(compare)

ablation: $(learner)  ## the same with one thing left out at a time, of PPD in the paper's preset and in ours
	$(compare)

# Makes the data set first, if there is none.
define compare
@test -n "$(CATEGORY)" || { echo "Choose one: make $@ CATEGORY=laptop" >&2; exit 2; }
@test -f "$(OUT)/$(CATEGORY)/manifest.json" || $(articugen) generate --category "$(CATEGORY)" --source "$(SOURCE)" --out "$(OUT)" $(options) $(settings) || test $$? = 3
@$(articugen) train-all "$(OUT)/$(CATEGORY)" --list $@ --budget "$(or $(BUDGET),10)" $(if $(SEEDS),--seeds "$(SEEDS)") $(if $(DEVICE),--device "$(DEVICE)")
endef

# Processes of one thread each, as many as tests/conftest.py says. What ARGS says counts (-n 0 --pdb).
pytest := OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest -n auto --maxprocesses 16 --dist worksteal

test: $(testing)  ## run the tests, the same each time; those of absent optional backends are skipped
	@$(pytest) $(ARGS)

chaos: $(testing)  ## kill runs and fail disks at every moment; a table of what survived (ARGS=--quick)
	@$(VENV)/bin/python -m tests.chaos $(ARGS)

check: $(dev)  ## lint, formatting and types
	@$(VENV)/bin/ruff check
	@$(VENV)/bin/ruff format --check
	@$(VENV)/bin/pyright --pythonpath $(VENV)/bin/python

format: $(dev)  ## put the code in order
	@$(VENV)/bin/ruff check --fix
	@$(VENV)/bin/ruff format

bench: $(testing)  ## measure speed, exactness and memory beside other tools (ARGS=--quick)
	-@$(pinned) --editable '.[bench]'
	@$(VENV)/bin/python -m tests.benchmarks $(ARGS)

accuracy: $(testing)  ## measure how exact instances are against exact solids (ARGS=--quick)
	@$(VENV)/bin/python -m tests.benchmarks.accuracy $(ARGS)

bench-reading: $(testing)  ## measure what reading a shard costs, beside .npz files
	@$(VENV)/bin/python -m tests.benchmarks.reading $(ARGS)

bench-train: $(testing) $(learner)  ## measure PPD's training: rate, shares, memory (ARGS=--iterations 20)
	@$(VENV)/bin/python -m tests.benchmarks.training $(ARGS)

paris: $(testing)  ## find the axes of PARIS's ten objects in SOURCE=, models of PartNet-Mobility (ARGS=--all: of all)
	@$(VENV)/bin/python -m tests.benchmarks.paris "$(SOURCE)" $(ARGS)

soundness: $(testing)  ## make 3,000 bundled objects of each kind: none fails, collides or floats (ARGS=--quick)
	@$(VENV)/bin/python -m tests.benchmarks.objects $(ARGS)

fuzz: $(testing)  ## draw anew: tests of properties, then files that mean harm (ARGS="--target urdf")
	@$(if $(findstring --target,$(ARGS)),true,$(pytest) -m hypothesis --hypothesis-profile=chance); \
	    status=$$?; $(VENV)/bin/python -m tests.fuzz $(ARGS) && exit $$status

docs: $(site) $(gallery)  ## build the documentation site, with gallery and reports, into build/site
	@NO_MKDOCS_2_WARNING=1 $(VENV)/bin/python -m mkdocs build --quiet
	@echo "build/site/index.html"

site-tools: $(site)  ## install what the documentation site is built with

backends: $(backends)  ## install the optional renderers: open3d, pyrender, sapien

exporters: $(readers)  ## install what exports are written with, and what tests read them back with

viewer: $(viewer)  ## install viser, which `make view` shows objects with

cluster: $(clusters)  ## install Dask, submitit and obstore, which other machines and object stores need, and their tests

learner: $(learner)  ## install torch, which train and evaluate need

clean:  ## remove caches and build files; keep data and the environment
	@rm -rf build dist .pytest_cache .ruff_cache .hypothesis
	@find articugen tests -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/bin/python:
	@echo "Making $(VENV) ..."
	@$(PYTHON) -c 'import sys; sys.exit("articugen needs Python 3.10 or newer, this is " + sys.version.split()[0] + "; run: make PYTHON=python3.11 ...") if sys.version_info < (3, 10) else None'
	@$(PYTHON) -m venv $(VENV)

$(generator): pyproject.toml constraints.txt | $(VENV)/bin/python
	@echo "Installing the generator and its pinned libraries into $(VENV) ..."
	@$(pinned) --no-deps $(generators) --editable .
	@touch $@

$(testing): $(generator)
	@echo "Installing the test tools ..."
	@$(pinned) --editable '.[test]'
	@echo "Compiling the kernels ..."
	@$(VENV)/bin/python -c 'from articugen.core.compiling import compile_all; compile_all()'
	@touch $@

$(learner): $(generator)
	@echo "Installing torch ..."
	@$(pinned) --editable '.[ppd,tensorboard]'
	@touch $@

$(readers): $(generator)
	@echo "Installing what exports are written and read with ..."
	@$(pinned) --editable '.[readers]'
	@touch $@

$(viewer): $(generator)
	@echo "Installing the viewer ..."
	@$(pinned) --editable '.[view]'
	@touch $@

$(clusters): $(generator)
	@echo "Installing what clusters and object stores need ..."
	@$(pinned) --editable '.[test-cluster]'
	@touch $@

$(site): $(generator)
	@$(VENV)/bin/python -c 'import sys; sys.exit("the site is built with Python 3.11 or newer, this is " + sys.version.split()[0]) if sys.version_info < (3, 11) else None'
	@echo "Installing what the documentation is built with ..."
	@$(pinned) --editable '.[docs]'
	@touch $@

$(gallery): $(makes) | $(generator)
	@$(VENV)/bin/python docs/site/gallery.py build/gallery
	@touch $@

$(dev): $(testing)
	@echo "Installing the developer tools ..."
	@$(pinned) --editable '.[dev]'
	@touch $@

$(backends): $(generator)
	@echo "Installing the optional renderers ..."
	@$(pinned) --editable '.[backends]'
	@touch $@
