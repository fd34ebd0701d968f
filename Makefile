# make demo   renders chairs, trains I2I on them, evaluates it, draws what it predicts
# make test   the test suite          make lint   ruff, mypy, yamllint, codespell
# make bench  all benchmarks, one after the other: on an idle machine
# make table  the choices inside I2I, from results/ (docs/results.md)
PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip --disable-pip-version-check install --quiet
# Where torch comes from, e.g. TORCH_INDEX=https://... for another build; empty: pip's own default.
TORCH_INDEX ?=
TORCH := $(shell grep '^torch==' requirements.lock)

.PHONY: demo test lint bench table clean
.DELETE_ON_ERROR:

$(VENV)/.installed: requirements.lock pyproject.toml hatch_build.py $(wildcard src/i2i/nn/native/*.[ch]*)
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if (3, 11) <= v[:2] <= (3, 12) else f"i2i wants Python 3.11 or 3.12, {sys.executable} is {v[0]}.{v[1]}. Try: make PYTHON=python3.11 ...")'
	test -x $(PY) || $(PYTHON) -m venv $(VENV)
	$(PIP) $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) $(TORCH)
	grep -v '^torch==' requirements.lock > $(VENV)/lock.txt
	$(PIP) --no-deps -r $(VENV)/lock.txt
	$(PIP) --no-deps --no-build-isolation -e .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed requirements-dev.lock
	$(PIP) --no-deps -r requirements-dev.lock
	touch $@

demo: $(VENV)/.installed
	$(PY) -m i2i.train experiment=demo

test: $(VENV)/.installed-dev
	$(PY) -m pytest -n auto --dist loadfile

lint: $(VENV)/.installed-dev
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy
	$(PY) -m yamllint --strict conf .pre-commit-config.yaml
	$(PY) -m codespell_lib src conf docs tests benchmarks README.md CONTRIBUTING.md CHANGELOG.md

table: $(VENV)/.installed
	$(PY) -m i2i.runs.results results "consistent labels"

bench: $(VENV)/.installed
	for name in parameter_counts oracle c4_spectral network_speed floor processes training_course training_memory predict_rate render_rate loader_rate scaling; do \
		$(PY) benchmarks/$$name.py || exit 1; done

clean:
	rm -rf $(VENV) build dist src/i2i/nn/native/*.so
