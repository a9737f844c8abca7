# make demo   install, run a real scene, and say where its USD file and picture are
# make test   install and run the tests on the CPU
# make slow   the long checks too
# make verify the verification suite, which writes docs/accuracy.md
# make bench  the benchmarks beside other codes, which write docs/performance.md
# make trade  the studies of speed against accuracy, which write docs/trade.md, in about an hour on one core
# make tuning settings that are found beside the best of sweeps, which write docs/tuning.md
# make docs   the documentation, in docs/_build
# make gallery the pictures of the documentation, from the shipped scenes
# make lint   style and types

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
PARALLEL := --numprocesses auto --dist loadfile # tests of a file share kernels

.PHONY: demo test slow verify bench trade tuning docs gallery lint clean

$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[test]'
	touch $@

# What the demo and some tests like to have but can do without: a failure is no obstacle, and is tried again.
$(VENV)/extras: $(VENV)/installed
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[plot,mesh,progress,bench,solvers,cluster]'
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[tet]' && touch $@ || true

demo: $(VENV)/extras
	$(BIN)/warpfem run scenes/bear.py --out output/bear.usdc --overwrite
	-$(BIN)/warpfem preview output/bear.usdc --out output/bear.png
	@echo
	@echo "The animation: $(CURDIR)/output/bear.usdc (open it in Blender with File > Import > Universal Scene Description)"
	@if [ -f output/bear.png ]; then echo "A picture:     $(CURDIR)/output/bear.png"; fi

test: $(VENV)/extras
	$(BIN)/python -m pytest $(PARALLEL)

slow: $(VENV)/extras
	$(BIN)/python -m pytest $(PARALLEL) -m 'slow or not slow'

verify: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[bench,solvers]'
	$(BIN)/python benchmarks/verification --out docs/accuracy.md

bench: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[bench,plot,solvers]'
	$(BIN)/python benchmarks/performance --install --peers .peers --out docs/performance.md

trade: $(VENV)/extras
	$(BIN)/python benchmarks/trade.py --out docs/trade.md

tuning: $(VENV)/installed
	$(BIN)/python benchmarks/tuning.py --out docs/tuning.md

docs: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[docs]'
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build
	@echo "The documentation: $(CURDIR)/docs/_build/index.html"

gallery: $(VENV)/extras
	$(BIN)/python docs/gallery.py

lint: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy warpfem

clean:
	rm -rf $(VENV) .peers output docs/_build
