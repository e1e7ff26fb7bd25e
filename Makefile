# Three commands on a fresh machine (git, make and Python 3.10+ with venv): `make tables`, `make figures`, `make test`.
# Each builds .venv first when it is missing or when the dependencies have changed.
PYTHON ?= python3
ENV := .venv/.installed
ONLY ?= steps peers gp qp
FLOORS := .venv-floors/bin/python
# What tells whether a dependency is too old: every module, models, logs, solvers, recorded flights, figures, sweeps.
SMOKE := tests/test_imports.py tests/test_compiled.py tests/test_animation.py tests/gp/test_storage.py \
	tests/gp/test_casadi.py tests/gp/test_from_gpytorch.py tests/qp/test_cvxpy.py tests/qp/test_agreement.py \
	tests/mpc/test_nmpc.py tests/systems tests/recording tests/logs tests/studies tests/cli/test_run.py \
	tests/cli/test_sweeps.py tests/cli/test_tune.py

.PHONY: tables figures test floors lint bench guard cluster docs live clean

tables: $(ENV)  ## The paper's Tables 1 and 2 beside ours; settings: make tables SET="draws=50 data=paper data.folder=DIR"
	.venv/bin/gpmpc tables $(SET)

figures: $(ENV)  ## Figures 2 to 4 and section 5.2; settings: make figures SET="trials=10 data=paper data.folder=DIR"
	.venv/bin/gpmpc figures $(SET)

# Where Python is told to keep no bytecode, every process that a test starts would compile the sources anew.
test: $(ENV)  ## The whole test suite, on all cores; options: make test ARGS="-k gaussian"
	.venv/bin/python -m compileall -q gpmpc
	.venv/bin/python -m pytest --numprocesses auto --dist loadfile $(ARGS)

# Warnings are none of its business: old libraries warn of newer ones that they rest on.
floors:  ## Smoke tests with the lowest versions that pyproject.toml allows; another torch: make floors TORCH=2.8.0
	$(PYTHON) -m venv --clear .venv-floors
	$(FLOORS) -m pip install --quiet --constraint constraints.txt packaging tomli
	$(FLOORS) .ci/floors.py $(if $(TORCH),torch=$(TORCH)) > .venv-floors/floors.txt
	$(FLOORS) -m pip install --quiet --constraint .venv-floors/floors.txt torch
	$(FLOORS) -m pip install --quiet --constraint .venv-floors/floors.txt --editable ".[dev]"
	NUMBA_CACHE_DIR=.venv-floors/numba $(FLOORS) -m pytest -W ignore --numprocesses auto --dist loadfile $(SMOKE) $(ARGS)

lint: $(ENV)  ## Format check, linter, import contracts and types
	.venv/bin/ruff format --check .
	.venv/bin/ruff check .
	.venv/bin/lint-imports
	.venv/bin/pyright
	.venv/bin/mypy gpmpc examples

bench: $(ENV)  ## What everything costs on this machine, beside others; some of it: make bench ONLY="peers qp"
	for name in $(ONLY); do .venv/bin/python -m benchmarks.$$name || exit 1; done

guard: $(ENV)  ## Whether anything became slower since the last commit, both timed in turns
	.venv/bin/python -m benchmarks.guard

cluster: $(ENV)  ## Sweeps on a real Slurm and a real Ray of two nodes, for more than an hour; root; options: make cluster ARGS="--on ray"
	.venv/bin/python -m pip install --quiet --constraint constraints.txt "ray>=2.40"
	.venv/bin/python -m benchmarks.cluster $(ARGS)

docs: $(ENV)  ## The documentation as a site in docs/_build; a warning is an error
	.venv/bin/python -m pip install --quiet --constraint constraints.txt --editable ".[docs]"
	.venv/bin/python -m sphinx -q -W -b html docs docs/_build

live: $(ENV)  ## A picture of the live view in docs/figures; needs npm and chromium
	.venv/bin/python docs/live_view.py

$(ENV): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' \
		|| { echo "gpmpc needs Python 3.10 or newer; point PYTHON to one: make PYTHON=/path/to/python3.11"; exit 2; }
	$(PYTHON) -m venv .venv
	.venv/bin/python -m pip install --quiet --constraint constraints.txt torch
	.venv/bin/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	@touch $@

clean:
	rm -rf .venv .venv-floors outputs docs/_build docs/api
