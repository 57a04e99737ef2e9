# `make demo` and `make test` work on a fresh machine: they first set up .venv (see bootstrap.py) and compile. What other
# targets need besides is installed when they are made.

PYTHON ?= python3
VENV_PYTHON := .venv/bin/python
# A stamp file per step, so that it runs again only when its inputs have changed.
ENVIRONMENT := .venv/pgccd-environment
EXTENSION := build/pgccd-extension
# Packages for what is to be made: downloaded while the extension is compiled for the first time.
PURPOSES := $(filter test docs lint wheel bench-peers,$(MAKECMDGOALS)) $(if $(filter sanitize,$(MAKECMDGOALS)),test)
# The extension depends on PGCCD_CUDA: a new value makes a new file.
CUDA_SETTING := build/pgccd-cuda-$(or $(PGCCD_CUDA),auto)
# Includes folders, so that a removed source triggers a rebuild too.
EXTENSION_INPUTS := setup.py $(wildcard build_support/*.py) $(shell find csrc)
CPP_FILES = find csrc -name '*.h' -o -name '*.cpp' -o -name '*.cuh' -o -name '*.cu'
# Without cached bytecode, importing torch takes twice as long in each of the many processes of ranks and tests.
unexport PYTHONDONTWRITEBYTECODE
# For two cores: many tests wait for processes. xdist may be missing without a network.
PARALLEL = $$($(VENV_PYTHON) -c "import xdist" 2>/dev/null && echo "-n 3")

# The kernels on small scenes, without torch's memory pool: with the pool the tools cannot see where tensors end. Tests
# of graphs, which need the pool, are skipped, and tests of compilation left out.
SANITIZED = tests/kernels/test_rows.py tests/search/test_search_in_parts.py tests/search/test_traverse.py \
	tests/search/test_padded.py tests/search/test_self_collision_padded.py tests/search/test_intersecting.py \
	tests/runtime/test_side_stream.py tests/sim tests/kernels/test_subdomain.py \
	-m "cuda and not slow" -k "not compile and not one_wait"

.PHONY: demo test docs sanitize lint bench bench-peers build wheel clean

demo: $(EXTENSION)
	$(VENV_PYTHON) -m pgccd simulate --robots 10000 --steps 200 --world random --out out/demo --overwrite

test: $(EXTENSION) .venv/pgccd-for-test
	$(VENV_PYTHON) -m pytest -q $(PARALLEL)

# The site. It runs the examples; warnings are errors.
docs: $(EXTENSION) .venv/pgccd-for-docs
	rm -rf docs/tutorials out/docs
	$(VENV_PYTHON) -m sphinx -W --keep-going -q -b html -d build/docs docs out/docs
	@echo "site: out/docs/index.html"

sanitize: $(EXTENSION) .venv/pgccd-for-test
	for tool in memcheck racecheck initcheck; do \
		PYTORCH_NO_CUDA_MEMORY_CACHING=1 compute-sanitizer --tool $$tool --error-exitcode 1 \
			$(VENV_PYTHON) -m pytest -q $(SANITIZED) || exit; \
	done

lint: $(ENVIRONMENT) .venv/pgccd-for-lint
	$(VENV_PYTHON) -m ruff check .
	$(VENV_PYTHON) -m ruff format --check .
	$(CPP_FILES) | xargs -r $(VENV_PYTHON) -c 'import clang_format; clang_format.clang_format()' --dry-run -Werror
	$(VENV_PYTHON) -m mypy

bench: $(EXTENSION)
	for script in figure4 figure5 figure6 ablations plots; do $(VENV_PYTHON) bench/$$script.py || exit; done

bench-peers: $(EXTENSION) .venv/pgccd-for-bench-peers
	$(VENV_PYTHON) bench/peers.py
	$(VENV_PYTHON) bench/plots.py

build: $(ENVIRONMENT)
	$(VENV_PYTHON) setup.py --quiet build_ext --inplace
	@touch $(EXTENSION)

wheel: $(ENVIRONMENT) .venv/pgccd-for-wheel
	$(VENV_PYTHON) -m build_support.wheel

clean:
	rm -rf build dist out docs/tutorials pgccd/*.so *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +

$(CUDA_SETTING):
	@mkdir -p build && rm -f build/pgccd-cuda-* && touch $@

$(ENVIRONMENT): bootstrap.py pyproject.toml $(CUDA_SETTING)
	@mkdir -p build && touch build/began
	$(PYTHON) bootstrap.py $(PURPOSES)
	@touch -r build/began $@  # so that the extension is newer if it has been compiled

# Order only: a new environment does not make the packages of purposes outdated. The environment may have come with them.
.venv/pgccd-for-%: pyproject.toml | $(ENVIRONMENT)
	@test $@ -nt pyproject.toml || $(PYTHON) bootstrap.py $*

$(EXTENSION): $(ENVIRONMENT) $(EXTENSION_INPUTS)
	$(VENV_PYTHON) setup.py --quiet build_ext --inplace
	@touch $@
