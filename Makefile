# Everything runs in .venv, which `make` builds itself; nothing but Python 3.11 or newer is needed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# As many processes as cores, each with one thread for linear algebra; PARALLEL= runs the tests in one process.
PARALLEL ?= -n logical --maxprocesses 8 --dist worksteal
ONE_THREAD := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 MPLBACKEND=Agg
PYTEST := $(ONE_THREAD) $(BIN)/python -m pytest -q $(PARALLEL)

# Bytecode is written even where the environment forbids it: every process would compile all that it imports again.
export PYTHONDONTWRITEBYTECODE :=

# Short tests whose kernels take longest to compile. Those that `bench` compiles, too, come last.
WARM := $(patsubst %,tests/test_%, \
  assignment.py::test_equals_brute_force \
  association_sums.py::test_exact_sum_equals_every_matching_written_out \
  mixture.py::test_reducing_keeps_the_moments_of_the_whole \
  ranking.py::test_best_associations_are_those_of_brute_force \
  ambiguity.py::test_a_sighting_between_two_landmarks_is_left_unused \
  landmark_slam_input.py::test_a_broken_belief_is_an_estimation_error \
  mixture_checkpoint.py::test_a_resumed_run_is_the_same_bit_for_bit \
  contour_late.py::test_the_latency_of_a_drive \
  set_checkpoint.py::test_a_resumed_run_is_the_same_bit_for_bit \
  bernoulli_kernel.py::test_update_over_all_hypotheses)

.PHONY: demo test test-slow test-all warm lint bench bench-peers clean

$(VENV)/.ready: pyproject.toml src/kalmap/_version.py
	@test -d $(VENV) || $(PYTHON) -m venv $(VENV) || { \
	  echo "this Python cannot make environments; installing its venv package"; \
	  apt-get update -q && apt-get install -y -q python3-venv && rm -rf $(VENV) && $(PYTHON) -m venv $(VENV); }
	@# Most of what pip would compile to bytecode is never imported; the rest is compiled when it is.
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --editable ".[dev]"
	@touch $@

demo: $(VENV)/.ready
	$(BIN)/kalmap demo --out kalmap-demo

test: $(VENV)/.ready
	$(PYTEST) -m "not slow"

# The long Monte Carlo checks; KALMAP_SLOW_SEEDS says how many seeds each takes.
test-slow: $(VENV)/.ready
	$(PYTEST) -m slow

# Both in one go, so that no core waits while the last long one ends.
test-all: $(VENV)/.ready
	$(PYTEST)

# In a fresh clone, before `test-all`: otherwise each of its processes rewrites all tests' assertions and compiles the
# kernels that it needs, at the same time as the others.
warm: $(VENV)/.ready
	$(ONE_THREAD) $(BIN)/python -m pytest -q --collect-only > /dev/null
	$(ONE_THREAD) $(BIN)/python -m pytest -q $(WARM)

lint: $(VENV)/.ready
	$(BIN)/ruff check src tests benchmarks
	$(BIN)/ruff format --check src tests benchmarks
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(VENV)/.ready
	$(BIN)/python benchmarks/smoke.py

# Against GTSAM and MRPT, where they are; see benchmarks/README.md.
bench-peers: $(VENV)/.ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[peers]"
	$(BIN)/python benchmarks/scaling.py
	$(BIN)/python benchmarks/peers_speed.py
	$(BIN)/python benchmarks/peers_accuracy.py

clean:
	rm -rf $(VENV) kalmap-* .pytest_cache .mypy_cache .ruff_cache .hypothesis
