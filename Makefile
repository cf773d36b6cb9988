# make paper   solve and replay the paper's maneuver: figures and table in results/paper
# make docs    bring generated parts of the pages up to date, build the documentation in results/docs
# make test    lint, import contracts, types, tests; with CI set also the slow tests, the quick benchmarks (but
#              stability, whose cases are slow tests), and the tests of the extras agents, jax, ray and search (skipped
#              otherwise: PyTorch is a download of gigabytes)
# make clean   remove the virtual environment and the results

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
COMMA := ,
BENCHMARKS := work-precision solvers scene-cost throughput rendering
TEST := test$(if $(CI),$(COMMA)agents$(COMMA)jax$(COMMA)ray$(COMMA)search)

.PHONY: paper docs test lint lock clean
.NOTPARALLEL: # all goals install into one environment

paper: $(VENV)/installed-plots
	$(BIN)/python scripts/reproduce_paper.py

docs: $(VENV)/installed-docs
	$(BIN)/python docs/write_generated.py
	$(BIN)/sphinx-build -q -W -n --keep-going -b html docs results/docs

test: $(VENV)/installed-$(TEST) lint
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist worksteal $(if $(CI),-m "not endurance")
	$(if $(CI),printf '%s\n' $(BENCHMARKS) | xargs -P 2 -I NAME \
		$(BIN)/python -m scripts.benchmarks --quick --out results/benchmarks/NAME NAME)

lint: $(VENV)/installed-$(TEST)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo --no-cache
	$(BIN)/mypy
	$(BIN)/mypy scripts

IS_NEW_ENOUGH := import sys; sys.exit(sys.version_info < (3, 11) and "needs Python 3.11: make PYTHON=python3.11 ...")

# One marker file per set of extras: a second run installs nothing. By uv: with hashes, pip refuses editable packages.
LOCKED := --constraint requirements.lock --build-constraint requirements.lock
$(VENV)/installed-%: pyproject.toml requirements.lock
	test -x $(BIN)/pip || { $(PYTHON) -c '$(IS_NEW_ENOUGH)' && $(PYTHON) -m venv $(VENV); }
	sed -n '/^uv==/,/[^\\]$$/p' requirements.lock > $(VENV)/uv.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes --requirement $(VENV)/uv.lock
	$(BIN)/uv pip install --quiet --python $(BIN)/python $(LOCKED) --editable ".[$*]"
	touch $@

# Pin versions that work together on every supported Python, and the hashes of their files; needs uv. The second
# source is what builds this package, and uv.
lock:
	printf '%s\n' editables hatchling uv | uv pip compile --quiet --universal --all-extras --generate-hashes \
		--no-annotate --no-header --output-file requirements.lock pyproject.toml -

clean:
	rm -rf $(VENV) results
