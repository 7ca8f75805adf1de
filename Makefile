PY ?= .venv/bin/python

.PHONY: check test docs bench
check:  ## lint, format, types
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m pyright --pythonpath $(PY)

test:  ## the fast tests
	$(PY) -m pytest

docs:  ## the documentation as a site in build/site, its links checked
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict

bench:  ## every number of the documentation
	$(PY) -m benchmarks
