# make demo, make test, make torture: each makes the environment first, if need be.
PYTHON ?= python3
BIN = .venv/bin
# One thread per process: several at once on few cores are many times slower otherwise.
export OMP_NUM_THREADS = 1

.PHONY: demo docs film test test-slow torture lint types wheel dist check clean

demo: .venv/ready
	$(BIN)/fdtasil distill experts/HalfCheetah-v5.onnx HalfCheetah-v5 \
		--episodes 1 --horizon 300 --baseline --out runs/demo

# Expert, cloning and student from one trajectory, side by side.
film: .venv/ready
	$(BIN)/fdtasil distill experts/HalfCheetah-v5.onnx HalfCheetah-v5 \
		--episodes 1 --horizon 300 --out runs/demo
	$(BIN)/fdtasil distill experts/HalfCheetah-v5.onnx HalfCheetah-v5 --probes 0 \
		--episodes 1 --horizon 300 --evaluation-episodes 0 --out runs/cloned
	$(BIN)/fdtasil render HalfCheetah-v5 expert=experts/HalfCheetah-v5.onnx \
		"plain cloning=runs/cloned/student.onnx" student=runs/demo/student.onnx \
		--horizon 150 --every 2 --height 240 --out benchmarks/figures/film.webp

test: .venv/ready
	$(BIN)/python -m pytest -q -n 2 -m "not slow and not torture"

# The others that every change must pass; most of them start processes or train for long.
test-slow: .venv/ready
	$(BIN)/python -m pytest -q -n 2 -m "slow and not torture"

# Everything, in about an hour, and a table of what was survived.
torture: .venv/ready
	$(BIN)/python -m pytest -q -n 2 --figures

lint: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/ready
	$(BIN)/pyright

# An sdist and the wheel of it, installed into an empty environment and used from an empty folder:
# `make wheel` by one Python, `make dist` by each that is there.
wheel: PYTHONS = $(PYTHON)
dist: PYTHONS = python3.11 python3.12 python3.13 python3.14
wheel dist: .venv/ready
	rm -rf dist
	$(BIN)/python -m build --quiet
	@set -e; for python in $(PYTHONS); do \
		if ! $$python --version >/dev/null 2>&1; then echo "skipped: no $$python"; continue; fi; \
		rm -rf .wheel; $$python -m venv .wheel; \
		.wheel/bin/pip install --quiet --disable-pip-version-check -c constraints.txt torch; \
		.wheel/bin/pip install --quiet --disable-pip-version-check -c constraints.txt dist/*.whl; \
		(cd .wheel && bin/python -P ../tests/wheel_run.py); \
	done

check: lint types docs wheel test test-slow

# torch goes first and pinned: left to itself pip would take a build with gigabytes of CUDA.
.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt torch
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $@

# The documentation as pages; a warning is an error.
docs: .venv/ready
	$(BIN)/sphinx-build -q -W --keep-going docs docs/_build/html

clean:
	rm -rf .venv docs/_build .wheel build dist
