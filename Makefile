# make demo   the whole road, photons to a sharper picture   (runs/demo/report.html)
# make test   everything the project promises, checked
# Each makes its own .venv and installs all it needs; only package registries are used, and only then.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
# torch first and pinned: on a machine with a CPU build at hand pip takes that one.
DEPS := $(VENV)/.deps-$(shell cat pyproject.toml constraints.txt 2>/dev/null | cksum | tr -d ' ')

.PHONY: demo test check install unit lint types contracts doctest wheel clean

demo: install
	$(BIN)/spikerig demo --force

test: check unit doctest wheel

check: lint contracts types

install: $(DEPS)
	@echo "building spikerig"
	@$(PIP) install -q --no-deps --no-build-isolation .

$(DEPS):
	@PYTHON=$(PYTHON) ./preflight.sh
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing what spikerig needs into $(VENV) (a few minutes the first time)"
	@$(PIP) install -q "pip>=25.1"
	@$(PIP) install -q -c constraints.txt torch==2.13.0
	@$(PIP) install -q -c constraints.txt --group build --group test
	@$(BIN)/python -c "import tomllib; p = tomllib.load(open('pyproject.toml', 'rb'))['project']; \
	  e = p['optional-dependencies']; \
	  print('\n'.join(p['dependencies'] + e['plot'] + e['video'] + e['mitsuba'] + e['cluster']))" > $(VENV)/needs.txt
	@$(PIP) install -q -c constraints.txt -r $(VENV)/needs.txt
	@$(BIN)/pyright --version > /dev/null 2>&1 || true  # fetches its node package now, not at test time
	@rm -f $(VENV)/.deps-* && touch $@

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

contracts: install
	$(BIN)/lint-imports --no-cache

types: install
	@rm -rf .typing && mkdir -p .typing/spikerig
	@for f in dataset calib rigctl train; do ln -s ../../$$f .typing/spikerig/$$f; done
	@cp $$($(BIN)/python -c "from spikerig import _native; import pathlib; \
	  print(pathlib.Path(_native.__file__).parent / '_native.pyi')") .typing/spikerig/
	$(BIN)/pyright --pythonpath $(BIN)/python

# A process a core, whole files each: what a file sets up once stays set up once. torch gets one thread in each.
unit: install
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest tests -n logical --maxprocesses 4 --dist loadfile

doctest: install
	$(BIN)/python -m pytest -q -p no:cacheprovider --doctest-modules --pyargs \
	  spikerig.dataset spikerig.calib spikerig.rigctl spikerig.train; s=$$?; test $$s -eq 0 -o $$s -eq 5

wheel: install
	@rm -rf build/wheel && mkdir -p build/wheel
	@$(PIP) wheel -q --no-deps --no-build-isolation -w build/wheel .
	$(BIN)/python tests/walk/wheel.py build/wheel/*.whl

clean:
	rm -rf $(VENV) .typing build dist
