# Every target does its own set-up: it needs Python >= 3.11 with venv, make and a package index.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
BENCH  := $(VENV)/.ready-bench

.PHONY: demo test lint lint-deploy deploy-test arm64-test bench bench-codecs bench-transport bench-calibration bench-fusion \
	bench-kinect soak \
	soak-agents fuzz docs clean

demo: $(READY)  ## twelve simulated Kinects over loopback UDP, calibrated and fused into build/demo
	$(BIN)/rig-server --calibrate --simulate 12 --frames 5 --out build/demo

# A file's tests stay together: what they share is made once. In order: the long ones come first.
test: $(READY)  ## the whole test suite
	$(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder

lint: $(READY)  ## style, types, import rules
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

lint-deploy: $(VENV)/.ready-deploy  ## the Ansible playbooks
	$(BIN)/yamllint --strict deploy
	cd deploy/ansible && PATH="$(abspath $(BIN)):$$PATH" ansible-lint --offline

deploy-test: $(VENV)/.ready-deploy  ## a PC and a Pi of Debian roots, deployed, booted, upgraded, rolled back; root, 15 minutes
	$(BIN)/pytest -m deploy -s tests/deployment

arm64-test: $(READY)  ## the agent in an emulated arm64 Debian, to a server here; root, 5 minutes
	$(BIN)/pytest -m arm64 -s tests/arm64

bench-codecs: $(READY)  ## sizes and times of the codecs, into docs/performance.md
	$(BIN)/python tests/benchmarks/bench_codecs.py

soak: $(READY)  ## ten minutes of killed programs, pulled cables, clock steps and floods: SOAK_MINUTES=10
	$(BIN)/python tests/benchmarks/transport_chaos.py --soak $(or $(SOAK_MINUTES),10)

soak-agents: $(READY)  ## agents killed every few seconds, for ten minutes, into docs/performance.md: SOAK_MINUTES=10
	$(BIN)/python tests/benchmarks/agent_soak.py $(or $(SOAK_MINUTES),10)

fuzz: $(VENV)/.ready-fuzz  ## every parser of strangers' bytes, 100 s each: FUZZ_SECONDS=100
	for target in server_link agent_link bodies units codecs key_files recordings; do \
	    $(BIN)/python tests/fuzz/fuzz_parsers.py $$target -max_total_time=$(or $(FUZZ_SECONDS),100) || exit 1; \
	done

bench-transport: $(BENCH) bench-codecs  ## the transport against its bars and its peers, into docs/performance.md
	$(BIN)/python tests/benchmarks/bench_transport.py

bench-calibration: $(BENCH)  ## the calibration against its bars, the bound and its peers, into docs/accuracy.md
	$(BIN)/python tests/benchmarks/bench_calibration.py

bench-fusion: $(READY) build/open3d  ## live fusion and meshes against their bars and Open3D, into docs/
	$(BIN)/python tests/benchmarks/bench_fusion.py
	$(BIN)/python tests/benchmarks/bench_recording.py
	$(BIN)/python tests/benchmarks/console_latency.py
	$(BIN)/python tests/benchmarks/surface_error.py
	$(BIN)/python tests/benchmarks/offline_scaling.py

# In a folder of its own: it brings a pytest plugin that the tests' settings refuse. Without it the bench skips it.
build/open3d: $(READY)
	-$(BIN)/python -m pip install --quiet --target $@ 'open3d>=0.19'

bench-kinect: $(READY)  ## a Kinect on the virtual USB bus: cost, torn frames, a thousand replugs
	$(BIN)/python tests/benchmarks/kinect_capture.py
	$(BIN)/python tests/benchmarks/kinect_replug.py
	$(BIN)/python tests/benchmarks/bench_kinect.py

bench: bench-transport bench-calibration bench-fusion  ## all figures, into build/bench.json

docs: $(READY)  ## the pages that are made from the code
	$(BIN)/python docs/generate_configuration.py
	$(BIN)/python docs/generate_monitoring.py

clean:  ## everything that make built
	rm -rf $(VENV) build

$(VENV)/.ready-%: $(READY)
	$(BIN)/python -m pip install --quiet --constraint requirements.lock --editable '.[$*]'
	touch $@

# The lock file pins what was tested; the stamp is newer than everything it was made from.
$(READY): pyproject.toml requirements.lock
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint requirements.lock --editable '.[dev]'
	touch $@

$(BENCH): $(READY)
	$(BIN)/python -m pip install --quiet --constraint requirements.lock --editable '.[bench]'
	touch $@
