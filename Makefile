# Every target sets up .venv by itself; only Python >= 3.10, git and make are needed.
PYTHON ?= python3
# LOCKED=1 installs the very versions that the suite last passed with (constraints.txt).
LOCKED ?=
VENV := .venv
BIN := $(VENV)/bin
LOCK := $(if $(LOCKED),constraints.txt)
# What users need, and what tests, checks and pages need beside it: a browser's driver, node, linters.
STAMP := $(VENV)/.ready$(if $(LOCKED),-locked)
TOOLS := $(VENV)/.tools$(if $(LOCKED),-locked)
# setuptools warns of any editable install that is no plain link to a folder; errors are still shown.
EDIT := PYTHONWARNINGS='ignore:Editable installation' \
	$(BIN)/python -m pip install $(addprefix --constraint ,$(LOCK)) --editable
WHEEL := build/wheel-check

.PHONY: setup demo test ptx debug hostile endurance bench docs lint format figures \
        gpu scanned constraints clean

setup: $(STAMP)

$(STAMP): setup.cfg pyproject.toml gamba_warp/versions.py $(LOCK) | starter/data
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
		{ echo "Python >= 3.10 is needed; set PYTHON=..." >&2; exit 1; }
	@# Some systems ship Python without ensurepip: virtualenv, from pip, then serves.
	@echo "Making the environment $(VENV), with the newest pip."
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) || \
		{ rm -rf $(VENV); $(PYTHON) -m pip install --user virtualenv && \
		  $(PYTHON) -m virtualenv $(VENV); }
	@$(BIN)/python -m pip install --upgrade pip
	@echo "Installing gamba into $(VENV) once: pip fetches 3.7 GB (torch with its CUDA libraries), 7.8 GB on disk."
	@$(EDIT) '.[all]'
	@rm -f $(VENV)/.ready* $(VENV)/.tools*
	@touch $@

$(TOOLS): $(STAMP)
	@echo "Adding to $(VENV) once what tests, checks and pages need, 0.5 GB on disk."
	@$(EDIT) '.[test]'
	@touch $@

# The starter set's images are a thousand files, which the repository keeps as one.
starter/data: starter/data.tar
	@echo "Unpacking $<."
	@tar -xf $< -C starter && touch $@

demo: $(STAMP)
	@echo "Reconstructing 12 images and evaluating 4 objects with the shipped model."
	$(BIN)/gamba demo

# Two processes share the tests, a file each at a time, in the order of their names: by the number of
# its tests the demo, the longest file, would come last, and one process would wait for it. Each
# computes with the threads that a user's would, so waiting threads must let go of the core
# (docs/reconstruct.md, "Shared cores"). Python is started some hundred times, so it keeps bytecode,
# also where it is told not to. The slowest are listed with their seconds.
test: $(TOOLS)
	PYTHONDONTWRITEBYTECODE= GOMP_SPINCOUNT=1000 $(BIN)/python -m pytest tests -n 2 \
		--dist loadfile --no-loadscope-reorder --durations 40 --durations-min 3

# The operators' own tests on their CUDA path, executed from PTX (tests/ptx), in the order that SEED
# draws (0: none), large shapes, and gamba stress for some MINUTES. APPROXIMATE=1 has ex2, rcp and
# sqrt err to one side in these tests, 2, 3, … as drawn from it; CONTRACT='.*' has products join
# sums in kernels of these names, as ptxas may.
APPROXIMATE ?= 0
CONTRACT ?=
ptx: $(TOOLS)
	GAMBA_PTX_SEED=$(SEED) GAMBA_PTX_APPROXIMATE=$(APPROXIMATE) GAMBA_PTX_CONTRACT='$(CONTRACT)' \
		PYTHONPATH=tests $(BIN)/python -m pytest -p ptx.plugin tests/ops/causal_conv1d \
		tests/ops/selective_scan tests/ops/rasterize tests/ptx/large.py
	PYTHONPATH=tests $(BIN)/python -m ptx stress scan --minutes $(MINUTES) --out out/ptx-scan
	PYTHONPATH=tests $(BIN)/python -m ptx stress raster --minutes $(MINUTES) --out out/ptx-raster

# The operators' own tests in Warp's debug mode on the CPU: indices into Warp arrays are checked,
# pointers in C++ are not (tests/ops/debug_mode.py). What an assertion says comes from C, past what
# Python prints, and must not be lost with the process.
debug: $(TOOLS)
	PYTHONPATH=tests $(BIN)/python -m pytest --capture=sys -p ops.debug_mode \
		tests/ops/causal_conv1d tests/ops/rasterize tests/ops/runtime tests/ops/selective_scan \
		tests/ops/ssim

# Hostile files for every reader, or for READERS='shape or image', as SEED draws them.
MINUTES ?= 10
READERS ?=
hostile: $(TOOLS)
	GAMBA_HOSTILE_MINUTES=$(MINUTES) GAMBA_HOSTILE_SEED=$(SEED) \
		$(BIN)/python -m pytest -s tests/hostile -k 'test_hostile_files $(if $(READERS),and ($(READERS)))'

# Every writing command killed at random moments (training five times as often), and on a full disk.
KILLS ?= 20
FULL ?= 10
SEED ?= 1
endurance: $(TOOLS)
	GAMBA_ENDURANCE_KILLS=$(KILLS) GAMBA_ENDURANCE_FULL=$(FULL) GAMBA_ENDURANCE_SEED=$(SEED) \
		$(BIN)/python -m pytest -s tests/endurance

bench: $(STAMP)
	$(BIN)/gamba bench --peers --out out/bench

# The site, in site/: a broken link, anchor or docstring is an error.
docs: $(TOOLS)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "to read it (its search needs a server): $(BIN)/python -m http.server --bind 127.0.0.1 --directory site"

# pyright and lint-imports read what users get: the wheel, unpacked. (build/ goes first: setuptools would take
# files from it that are gone from the checkout.)
lint: $(TOOLS)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python tests/project/kernel_lint.py
	git ls-files -z '*.h' '*.cuh' '*.cpp' | xargs -0r $(BIN)/clang-format --dry-run --Werror
	@rm -rf build
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir build .
	$(BIN)/python -m zipfile --extract build/*.whl $(WHEEL)
	$(BIN)/pyright
	cd $(WHEEL) && $(CURDIR)/$(BIN)/lint-imports --no-logo --no-cache $(CURDIR)/pyproject.toml

format: $(TOOLS)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	git ls-files -z '*.h' '*.cuh' '*.cpp' | xargs -0r $(BIN)/clang-format -i

# Tables and images of the pages from results that are kept; REPORTS="--views out/eval/report.json"
# puts an evaluation of the shipped model into its card first.
figures: $(TOOLS)
	PYTHONPATH=docs $(BIN)/python -m lab.figures $(REPORTS)

# The table of scanned objects in docs/model-card.md: renders the meshes of a folder and evaluates the shipped model on them.
# make scanned MESHES=FOLDER OPTIONS="--lpips off --limit 8"
scanned: $(TOOLS)
	PYTHONPATH=docs $(BIN)/python -m lab.scanned $(MESHES) $(OPTIONS)

# After a green `make test`: constraints.txt from what is installed. Versions without the local
# part that some wheels carry (torch's +cu130), which no index has; nothing installed from a folder.
constraints: $(TOOLS)
	@{ echo "# The environment that the suite last passed in: make setup LOCKED=1 installs it."; \
	   echo "# Made by make constraints on $$($(BIN)/python -VV | cut -d' ' -f1,2), $$(uname -sm)."; \
	   $(BIN)/python -m pip freeze --exclude-editable | sed -n 's/^\([^ @]*==[^+]*\).*/\1/p'; } \
		> constraints.txt.new
	@mv constraints.txt.new constraints.txt

# On a machine with a GPU and torch, numpy, warp-lang and pytest; nothing is installed. Only files with
# tests of a GPU are collected, because others import more packages.
gpu:
	$(PYTHON) -m pytest -m gpu $$(grep -rl '@pytest.mark.gpu' tests/gpu tests/ops tests/ptx); \
		tests=$$?; $(PYTHON) -m gamba_warp.measure && exit $$tests

clean:
	rm -rf $(VENV) out build dist site *.egg-info
