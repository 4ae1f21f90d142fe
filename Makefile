# SPDX-License-Identifier: Apache-2.0
# make venv   set everything up in .venv          make check  linter, type checker and the fast tests
# make demo   sample bag -> replay -> report      make test   linter, type checker and all tests
# make demo-rgbd  the same with colour and depth of drawn people, compared with the truth
# make bench  speed as ratios, and live nodes     make lint   linter and type checker alone
# make docs   the documentation site, into out/site
# make coverage, release-check, figures, screenshots, config, changelog, lock, test-noble, install-size: see CONTRIBUTING.md

SHELL := /bin/bash
PYTHON := .venv/bin/python
SAMPLE := bags/cache/sample
RGBD := bags/cache/rgbd
# The two variables that the ROS wheels leave in their children would keep another environment's Python from starting.
CLEAN_ENV := env -u _ROS_WHEELS_BOOTSTRAP_COMPLETE
# Tests in this many processes. They keep the order of the files, so that costly fixtures are seldom made twice, and
# whoever is done takes over half of what another one still has to do. Kept bytecode halves the time to start.
WORKERS := 2
PYTEST = $(CLEAN_ENV) -u PYTHONDONTWRITEBYTECODE $(PYTHON) -m pytest --numprocesses $(WORKERS) --dist worksteal

# What runs with the versions of Ubuntu 24.04, which a ROS 2 Jazzy there has: nodes and all that they are made of.
NOBLE_TESTS := test/model test/inference test/flow test/evidence test/image test/body test/stream test/multiview test/bag test/node

.PHONY: venv venv-noble test-noble demo demo-rgbd sample-bag check test coverage lint bench docs figures screenshots config changelog lock release-check install-size clean

venv:
	@python=$$(sh scripts/find_python.sh) && $(CLEAN_ENV) "$$python" -I scripts/make_venv.py

sample-bag: venv
	@$(CLEAN_ENV) $(PYTHON) bags/make_sample.py --out $(SAMPLE)

demo: sample-bag
	@$(CLEAN_ENV) .venv/bin/flowing-puppet replay $(SAMPLE) --out out/demo.mcap --report out/report.html
	@echo "The puppets and bodies are in out/demo.mcap (RViz, Foxglove); the report is out/report.html (any browser)."

demo-rgbd: venv
	@$(CLEAN_ENV) $(PYTHON) bags/make_rgbd_sample.py --out $(RGBD)
	@$(CLEAN_ENV) .venv/bin/flowing-puppet replay $(RGBD) --out out/rgbd.mcap --report out/rgbd.html
	@$(CLEAN_ENV) .venv/bin/flowing-puppet evaluate bag out/rgbd.mcap --input $(RGBD) --truth $(RGBD)/truth.json
	@echo "The bodies are in out/rgbd.mcap (RViz, Foxglove); the report is out/rgbd.html (any browser)."

lint: venv
	@.venv/bin/ruff check .
	@.venv/bin/ruff format --check .
	@.venv/bin/mypy

check: lint
	@$(PYTEST) -m "not slow and not ros"

test: lint
	@$(PYTHON) scripts/ensure_browser.py
	@$(PYTEST)

venv-noble:
	@python=$$(sh scripts/find_python.sh) && $(CLEAN_ENV) "$$python" -I scripts/make_venv.py --noble

test-noble: venv-noble
	@$(CLEAN_ENV) -u PYTHONDONTWRITEBYTECODE .venv-noble/bin/python -m pytest --numprocesses $(WORKERS) --dist worksteal \
		-m "not slow" --ignore test/evidence/image/test_hands.py $(NOBLE_TESTS)

# Coverage sees no line of a compiled kernel run: those are covered where their tests are, not in the table.
coverage: venv
	@$(PYTEST) --cov=flowing_puppet_ros --cov-report=term:skip-covered --cov-report=html:out/coverage

docs: venv
	@$(CLEAN_ENV) $(PYTHON) -m sphinx --quiet --fail-on-warning --keep-going --jobs auto -b html docs out/site
	@echo "The site is out/site/index.html."

figures: venv
	@$(PYTHON) docs/_tools/figures.py

screenshots: demo-rgbd
	@$(PYTHON) docs/_tools/screenshots.py

release-check: venv
	@$(PYTHON) scripts/release_check.py $(if $(TAGGED),--tagged)

install-size: venv
	@$(PYTHON) scripts/install_size.py

bench: venv
	@$(CLEAN_ENV) .venv/bin/flowing-puppet bench
	@$(CLEAN_ENV) .venv/bin/flowing-puppet bench live --seconds 60

config: venv
	@$(PYTHON) scripts/write_config.py

changelog:
	@$(PYTHON) scripts/write_changelog.py

lock: venv
	@$(PYTHON) scripts/lock.py

clean:
	rm -rf build install log out .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find flowing_puppet_ros test scripts bags -name __pycache__ -prune -exec rm -rf {} +
