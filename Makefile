# make demo    the whole main path on the real workbook, into out/
# make test    linters, types and tests (tests/core, tests/blender, tests/field); TESTS=--once: laws of numbers in one case each
# make test-long   the tests that take minutes: long property runs, workbooks through LibreOffice; TESTS=--once as above
# make bench   speed, accuracy and memory beside other projectors, into docs/; BENCH=--quick: a minute or two, into out/
# make bench-events   event sets beside the usual pipeline with DiffDRR, into docs/; BENCH=--quick: a minute, into out/
# make bench-all   these and others beside all peers in one run, table and picture at the top of docs/benchmarks.md; wants
#               VENV=.venvbench; BENCH=--quick: some minutes, into out/
# make bench-reconstruction   an iteration beside other packages' own loops over our operators; wants VENV=.venvpeers
# make gallery   the documentation's pictures of phantoms, of a CT (CT=FILE), of the scanner's sensitivity and of the demo, into docs/images
# make docs    docs/ as a site in out/docs, with links and references checked; wrong ones are errors
# make tutorial   the tutorial's steps in a real Blender, and its pictures anew in docs/images/tutorial
# make dist    the package's wheels and the extension's zips in dist/, one per platform; PLATFORM=linux-x64 builds for that one
# make test-app   the Linux zip in a real Blender (see tests/app)
# make test-kernels   the C kernels under sanitizers, for arm64 under qemu, for Windows under Wine (see tests/kernels)
# make test-gate  the Monte Carlo exports with GATE 10 itself; wants an environment of its own (2 GB): VENV=.venvgate
# make test-peers   the exported geometry and event sets in the programs that read them, the projector in the packages
#               that it has adapters for; wants an environment of its own: VENV=.venvpeers
# make clean   removes what the others made, environments included
#
# The environment is made in VENV on the first call. PYTHON picks its interpreter (3.11: Blender 4.5, 3.13: Blender 5.2);
# TORCH is what pip installs on Python 3.11, empty for an environment without torch.
PYTHON = python3
VENV = .venv
TORCH = torch==2.13.0
PLATFORM =
OUTPUT = out
TESTS =
CT = $(wildcard ../shared/data/chest_ct_3mm.nii.gz)

BIN = $(VENV)/bin
# Any Python can make the environment; the one that PYTHON names may be a shim that does not run.
ANY_PYTHON = $$(for p in "$(PYTHON)" python3 python3.11 python3.13; do "$$p" -c "" 2>/dev/null && echo "$$p" && break; done)
ENVIRONMENT = @p=$(ANY_PYTHON); [ -n "$$p" ] || { echo "no Python found; name one: make PYTHON=/path/to/python3.11"; exit 1; }; \
	"$$p" tools/environment.py $(VENV) --python "$(PYTHON)"

# The tests' files lie on a RAM disk where one has a gigabyte left: to wait until each is on a real disk takes a twentieth of
# the time.
DISK = $$(df -k /dev/shm 2>/dev/null | awk 'END { print ($$4 > 1000000 ? "/dev/shm" : "/tmp") }')
FOLDER = folder=$$(mktemp -d "$(DISK)/mphdrr-XXXXXX") && trap 'rm -rf "$$folder"' EXIT INT TERM

# Tests in several processes: each leaves the other cores to the others; BLAS and torch would wait for theirs, busily. They
# are told here, since a plugin of pytest's loads them before any file of ours.
PYTESTS = $(FOLDER) && OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal \
	--basetemp "$$folder/tests"

# Python keeps what it has compiled: else each process of the tests compiles everything anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo gallery test test-long lint test-app test-kernels test-gate test-peers bench bench-all bench-events bench-reconstruction docs tutorial dist clean env env-bench env-dev env-gate env-peers

demo: env
	$(BIN)/mphdrr demo --output $(OUTPUT)

gallery: env-dev
	$(BIN)/python examples/gallery.py docs/images $(CT)

test: lint
	$(PYTESTS) $(TESTS)

test-long: env-dev
	$(PYTESTS) -m long $(TESTS)

lint: env-dev
	@$(BIN)/ruff check -q
	@$(BIN)/ruff format -q --check || { echo "not formatted; run: $(BIN)/ruff format"; exit 1; }
	@out=$$($(BIN)/lint-imports --cache-dir .import_linter_cache 2>&1) || { echo "$$out"; exit 1; }
	@cd $(VENV)/src && ../bin/mypy --config-file mphdrr/pyproject.toml --cache-dir mphdrr/.mypy_cache --no-error-summary \
		-p mphdrr.core -p mphdrr.addon -p mphdrr.operators -p mphdrr.panels
	@echo "lint: ruff, import rules and types are clean"

bench: env-dev
	$(BIN)/python benchmarks/projector.py $(BENCH)

bench-events: env-dev
	$(BIN)/python benchmarks/events.py $(BENCH)

bench-all: env-bench
	$(BIN)/python benchmarks/beside.py $(BENCH)

bench-reconstruction: env-peers
	$(BIN)/python benchmarks/reconstruction.py $(BENCH)

docs:
	$(ENVIRONMENT) --extras docs
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet --fresh-env --doctree-dir $(OUTPUT)/docs-parsed docs $(OUTPUT)/docs
	@echo "$(OUTPUT)/docs/index.html"

tutorial: env-dev
	$(BIN)/python tools/build_extension.py --platform linux-x64
	$(BIN)/python -m pytest tests/app/test_windows.py -k tutorial
	$(BIN)/python tools/tutorial_pictures.py

dist: env-dev
	$(BIN)/python tools/build_extension.py $(addprefix --platform ,$(PLATFORM))

test-app: env-dev
	$(BIN)/python tools/build_extension.py --platform linux-x64
	$(BIN)/python -m pytest tests/app -m "not alone" -n 2 --dist worksteal
	$(BIN)/python -m pytest tests/app -m alone

test-kernels: env-dev
	$(PYTESTS) tests/kernels
	@# make test runs at the highest level
	@for level in $$($(BIN)/python -c "from mphdrr.core.rays.backends import cpu; print(*cpu.levels()[:-1])"); do \
		echo "accuracy of $$level"; MPHDRR_CPU_LEVEL=$$level $(BIN)/python -m pytest -k cpu tests/core/test_projector.py \
		tests/core/test_emission.py tests/core/test_emission_gradients.py tests/core/test_geometry_gradients.py tests/core/test_hole_by_depth.py || exit 1; done

test-gate: env-gate
	$(BIN)/python -m pytest tests/core/test_monte_carlo.py

test-peers: env-peers
	@# a missing one would only be skipped; deepinv needs a word before it is imported, which its tests say
	@$(BIN)/python -c "import astra, cv2, itk, kornia, lib3mf, pytomography.algorithms, pytorch3dunet.datasets.hdf5, scipy, spekpy, webdataset; from importlib.metadata import version; version('deepinv')"
	$(BIN)/python -m pytest tests/core/test_geometry_export_peers.py tests/core/test_adapters.py tests/core/test_event_exports_peers.py tests/core/test_xray_spectra.py

env:
	$(ENVIRONMENT) --extras blender

env-dev:
	$(ENVIRONMENT) --extras blender,dev --torch "$(TORCH)"

env-bench:
	$(ENVIRONMENT) --extras bench,dev,peers --torch "$(TORCH)"

env-gate:
	$(ENVIRONMENT) --extras gate

env-peers:
	$(ENVIRONMENT) --extras peers --torch "$(TORCH)"

clean:
	rm -f core/rays/backends/kernels/*.so core/rays/backends/kernels/*.dylib core/rays/backends/kernels/*.dll
	rm -rf out dist build wheels .venv* *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +
