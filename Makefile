PY ?= .venv/bin/python

.PHONY: check prose test docs pictures bench kernels
check:  ## lint, format, types
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m pyright --pythonpath $(PY)

prose:  ## spelling and style of what people read
	$(PY) .ci/prose

test:  ## the fast tests
	$(PY) -m pytest

docs:  ## the documentation as a site in build/site, its links checked
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict

kernels:  ## compile the numerical kernels, which tests and runs load
	$(PY) -m stereo_sfm.cli compile -q

pictures:  ## the pictures of the documentation
	$(PY) docs/pictures.py

bench:  ## every number of the documentation
	$(PY) -m benchmarks
