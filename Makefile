# SPDX-License-Identifier: Apache-2.0
# make venv   set everything up in .venv          make test   linter, type checker and tests
# make demo   sample bag -> replay -> report      make lint   linter and type checker alone
# make bench  speed as ratios taken in one run, and two minutes of live nodes

SHELL := /bin/bash
PYTHON := .venv/bin/python
SAMPLE := bags/cache/sample
# The two variables that the ROS wheels leave in their children would keep another environment's Python from starting.
CLEAN_ENV := env -u _ROS_WHEELS_BOOTSTRAP_COMPLETE

.PHONY: venv demo sample-bag test lint bench config lock clean

venv:
	@python=$$(sh scripts/find_python.sh) && $(CLEAN_ENV) "$$python" -I scripts/make_venv.py

sample-bag: venv
	@$(CLEAN_ENV) $(PYTHON) bags/make_sample.py --out $(SAMPLE)

demo: sample-bag
	@$(CLEAN_ENV) .venv/bin/flowing-puppet replay $(SAMPLE) --out out/demo.mcap --report out/report.html
	@echo "The puppets and bodies are in out/demo.mcap (RViz, Foxglove); the report is out/report.html (any browser)."

lint: venv
	@.venv/bin/ruff check .
	@.venv/bin/ruff format --check .
	@.venv/bin/mypy

test: lint
	@$(PYTHON) scripts/ensure_browser.py
	@$(CLEAN_ENV) $(PYTHON) -m pytest

bench: venv
	@$(CLEAN_ENV) .venv/bin/flowing-puppet bench
	@$(CLEAN_ENV) .venv/bin/flowing-puppet bench live --seconds 60

config: venv
	@$(PYTHON) scripts/write_config.py

lock: venv
	@$(PYTHON) scripts/lock.py

clean:
	rm -rf build install log out .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find flowing_puppet_ros test scripts bags -name __pycache__ -prune -exec rm -rf {} +
