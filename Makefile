PY ?= .venv/bin/python

.PHONY: check test bench
check:  ## lint, format, types
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m pyright

test:  ## the fast tests
	$(PY) -m pytest

bench:  ## every number of the README
	$(PY) -m benchmarks
