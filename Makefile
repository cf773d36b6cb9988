# make paper   solve and replay the paper's maneuver: figures and table in results/paper
# make docs    the documentation in results/docs, from docs and from schemas, docstrings and commands
# make test    lint, type check, tests (with CI set also the slow tests, the quick numerical report, and the
#              tests of the extras agents and ray, whose PyTorch is a download of gigabytes; they are skipped
#              without them)
# make clean   remove the virtual environment and the results

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
COMMA := ,
TEST := test$(if $(CI),$(COMMA)agents$(COMMA)ray)

.PHONY: paper docs test lint lock clean

paper: $(VENV)/installed-plots
	$(BIN)/python scripts/reproduce_paper.py

docs: $(VENV)/installed-docs
	$(BIN)/sphinx-build -q -W -n --keep-going -b html docs results/docs

test: $(VENV)/installed-$(TEST) lint
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist worksteal $(if $(CI),-m "")
	$(if $(CI),$(BIN)/python scripts/report.py --quick)

lint: $(VENV)/installed-$(TEST)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy scripts

# A file per set of extras, so that a second run installs nothing.
$(VENV)/installed-%: pyproject.toml requirements.lock
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint requirements.lock --editable ".[$*]"
	touch $@

# Versions that are known to work together, for every supported Python; needs uv.
lock:
	uv pip compile --quiet --universal --all-extras --no-annotate --no-header --output-file requirements.lock pyproject.toml

clean:
	rm -rf $(VENV) results
