# What a newcomer types: make demo, make test, make lint, make bench, make docs.
# Everything happens in .venv and target/; a stamp file marks each finished step.

VENV ?= .venv
# A Python to build the environment with; empty: the first one from 3.10 on that works.
PYTHON ?=
# Set to --offline to build from the local crate cache alone.
CARGO_FLAGS ?= --locked

export PATH := $(HOME)/.cargo/bin:$(PATH)
VENV_PATH := $(abspath $(VENV))
BIN := $(VENV_PATH)/bin
PY := $(BIN)/python
# One interpreter for every build of the binding, whatever shims the PATH holds.
export PYO3_PYTHON := $(PY)
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Python compiles the few modules that it loads; pip would compile 8,400. It reads this as --no-compile = off.
export PIP_NO_COMPILE := 0
# Where the environment forbids this, every process of the tests would compile them again.
unexport PYTHONDONTWRITEBYTECODE

ENV_STAMP := $(VENV)/.cmfsim-env
BUILD_STAMP := $(VENV)/.cmfsim-build
DEVELOP_STAMP := $(VENV)/.cmfsim-develop
DOCS_STAMP := $(VENV)/.cmfsim-docs
DEVELOP := VIRTUAL_ENV="$(VENV_PATH)" "$(BIN)/maturin" develop --release $(CARGO_FLAGS)
RUST_SOURCES := Cargo.toml Cargo.lock \
  $(shell find crates -name '*.rs' -o -name 'Cargo.toml' -o -name '*.[ch]')
PYTHON_DIRS := python tests/python scripts examples benches fuzz slicer
CORE_FEATURES := --features mtm-core/metis

.DEFAULT_GOAL := help
.PHONY: help build quick test test-rust test-python test-slow lint lint-rust lint-python format wheel notices bench peers stability elements frontier fuzz demo docs tutorials clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' Makefile | sort | sed -E 's/^([a-z-]+):.*## /  \1\t/' | expand -t 16

# The script keeps an environment that works and replaces one whose Python is gone or too old.
$(ENV_STAMP): pyproject.toml scripts/make_venv.sh
	sh scripts/make_venv.sh "$(VENV)" "$(PYTHON)"
	"$(PY)" -m pip install --quiet --upgrade pip "maturin>=1.16,<2"
	@touch $@

$(BUILD_STAMP): $(ENV_STAMP) $(RUST_SOURCES)
	$(DEVELOP) --extras imaging,mesh,report
	@touch $@

# What tests and linters need comes later: a newcomer's demo does not wait for it.
$(DEVELOP_STAMP): $(BUILD_STAMP)
	$(DEVELOP) --extras imaging,mesh,report,study,test,lint
	@touch $@

$(DOCS_STAMP): $(BUILD_STAMP)
	$(DEVELOP) --extras docs
	@touch $@

build: $(BUILD_STAMP) ## create .venv, compile the core and install cmfsim into it

# The stamps go, so that whatever runs next compiles the core fully again.
quick: $(ENV_STAMP) ## compile a change of the core in seconds, less optimised (the first time in minutes)
	@rm -f $(BUILD_STAMP) $(DEVELOP_STAMP)
	$(subst --release,--profile quick,$(DEVELOP)) --extras imaging,mesh,report,study,test,lint

# While cargo compiles the tests, pip installs what the Python ones need.
test: ## build, then run every test of the project
	"$(MAKE)" --jobs=2 test-rust $(DEVELOP_STAMP)
	"$(MAKE)" test-python

test-rust: $(ENV_STAMP)
	cargo test --workspace --release $(CARGO_FLAGS) $(CORE_FEATURES)

test-python: $(DEVELOP_STAMP)
	"$(PY)" -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

test-slow: $(DEVELOP_STAMP) ## run the tests that take minutes, such as README and docs typed from top to bottom
	"$(PY)" -m pytest -m slow --timeout 3600

lint: lint-rust lint-python ## rustfmt, clippy, rustdoc, ruff, mypy, stubtest, the import rules and the licences

lint-rust: $(ENV_STAMP)
	cargo fmt --all --check
	cargo clippy --profile lint --workspace --all-targets $(CARGO_FLAGS) $(CORE_FEATURES) -- -D warnings
	RUSTDOCFLAGS="-D warnings" cargo doc --profile lint --workspace --no-deps $(CARGO_FLAGS) $(CORE_FEATURES)

lint-python: $(DEVELOP_STAMP)
	"$(BIN)/ruff" check $(PYTHON_DIRS)
	"$(BIN)/ruff" format --check $(PYTHON_DIRS)
	"$(BIN)/mypy" --strict
	cd python && "$(BIN)/stubtest" cmfsim._core
	"$(PY)" scripts/check_imports.py
	"$(PY)" scripts/third_party.py --check

format: $(DEVELOP_STAMP) ## rewrite the sources in the project's format
	cargo fmt --all
	"$(BIN)/ruff" check --fix $(PYTHON_DIRS)
	"$(BIN)/ruff" format $(PYTHON_DIRS)

wheel: $(ENV_STAMP) ## build a wheel into dist/, install it into a new environment and run the demo there
	rm -rf dist
	VIRTUAL_ENV="$(VENV_PATH)" "$(BIN)/maturin" build --release $(CARGO_FLAGS) --out dist
	"$(PY)" scripts/try_wheel.py dist

notices: $(ENV_STAMP) ## write THIRD-PARTY-NOTICES.md again, after a change of Cargo.lock
	"$(PY)" scripts/third_party.py

bench: $(BUILD_STAMP) ## run the benches (minutes; close other programs first)
	cargo bench --workspace $(CARGO_FLAGS) $(CORE_FEATURES)

peers: $(BUILD_STAMP) ## compare with the peers that are installed (benches/peers/README.md)
	"$(PY)" benches/peers/run.py --markdown peers.md --out peers.json

stability: $(BUILD_STAMP) ## measure stiff and extreme cases, and write docs/stability.md
	"$(PY)" -m benches.stability.stability --markdown docs/stability.md

elements: $(BUILD_STAMP) ## measure elements and kinematics on a shell, and put the table into docs/benchmarks.md
	"$(PY)" -m benches.stability.elements --level 1 --layers 2 --markdown docs/benchmarks.md

frontier: $(BUILD_STAMP) ## measure error against run time (hours), and put it into docs/frontier.md
	"$(PY)" -m cmfsim bench frontier -o target/frontier
	"$(PY)" -m benches.speed.fill_frontier target/frontier head

fuzz: $(BUILD_STAMP) ## feed 10,000 damaged files to every reader, and put the table into docs/robustness.md
	"$(PY)" fuzz/readers.py --mutants 10000 --seed 0 --fill docs/robustness.md

demo: $(BUILD_STAMP) ## predict a face after surgery, and open its report
	"$(BIN)/cmfsim" demo

docs: $(DOCS_STAMP) ## build the documentation into site/ (runs the tutorials, a minute or two)
	"$(BIN)/mkdocs" build --strict

tutorials: $(DOCS_STAMP) ## run the tutorials and save them with what they print and draw
	"$(PY)" scripts/save_tutorials.py

clean: ## remove everything that make has made
	rm -rf "$(VENV)" target site .cache cmfsim-demo .pytest_cache .mypy_cache .ruff_cache .hypothesis build dist
	find python tests scripts examples -name __pycache__ -type d -prune -exec rm -rf {} +
	rm -f python/cmfsim/_core*.so python/cmfsim/_core*.pyd
