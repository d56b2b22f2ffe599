# Two commands on a fresh machine: `make app` and `make test`. Both set up what they need.

PYTHON ?= python3
PORT ?= 5006
VENV := .venv
BIN := $(VENV)/bin

# Tests of what has kernels run as plain Python, too: there their lines count as covered, and an index
# out of bounds is an error. What is marked `compiled` is left out.
KERNELS := blocks fit image_posterior more_estimators motion posterior reductions refinement returns simulate speed tracking trigger

# Some shells forbid compiled modules. The tests start hundreds of processes: each would compile all.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help app test bench load speed tradeoff stability requires paper table2 uniform neighbours returns motion tuning tuned calibration fit results field large fuzz attack wheel clean

help: ## list the commands
	@sed -n 's/^\([a-z0-9]*\):.* ## /\1\t/p' $(MAKEFILE_LIST) | expand -t 12

app: $(VENV)/.app ## serve the app; CAPTURE=path opens a file
	$(BIN)/python -m app --port $(PORT) $(if $(CAPTURE),"$(CAPTURE)")

# Tests that wait leave room for a third worker on two cores; more threads would wait for each other.
test: export OPENBLAS_NUM_THREADS := 1
test: $(VENV)/.test ## everything that CI checks
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest -q -n auto $(KERNELS:%=core/tests/test_%.py) --cov --cov-report=
	$(BIN)/python -m pytest -n 3 --dist worksteal core/tests --cov --cov-append --cov-fail-under=95
	$(BIN)/python -m pytest -n 3 --dist loadfile tests -m "not browser"
	$(BIN)/python -m pytest -n 3 --dist loadgroup tests -m browser

bench: $(VENV)/.test ## slider to changed pixels, through a real browser
	$(BIN)/python -m tests.latency

load: $(VENV)/.test ## twenty sessions at once, and ten thousand interactions in one
	$(BIN)/python -m tests.load

speed: $(VENV)/.app ## kernels compared with plain implementations; fails where a speed-up is lost
	$(BIN)/python -m core speed

tradeoff: $(VENV)/.app ## what accuracy costs, and what to choose; CAPTURE=path for your own
	$(BIN)/python -m core tradeoff $(if $(CAPTURE),--capture "$(CAPTURE)")

stability: $(VENV)/.app ## the range in which each setting of each method can be trusted
	$(BIN)/python -m core stability

requires: $(VENV)/.app ## which parts and corrections a scene needs; SCENE=fog for another
	$(BIN)/python -m core requires $(if $(SCENE),--scene $(SCENE)) --folder requires

paper: $(VENV)/.app ## every figure and table of the paper beside ours, as one page in paper/
	$(BIN)/python -m core paper $(if $(REPETITIONS),--repetitions $(REPETITIONS)) $(if $(FIELD),--field "$(FIELD)")

table2: $(VENV)/.app ## the paper's Table 2 beside ours
	$(BIN)/python -m core table2

uniform: $(VENV)/.app ## every method on random and smooth depths over the gate
	$(BIN)/python -m core uniform

neighbours: $(VENV)/.app ## what neighbouring pixels add, inside surfaces and at edges
	$(BIN)/python -m core neighbours

motion: $(VENV)/.app ## surfaces that move during the pulses: ranges and velocities
	$(BIN)/python -m core motion

returns: $(VENV)/.app ## two surfaces in a pixel: how many are found, how often one is false
	$(BIN)/python -m core returns

tuning: $(VENV)/.app ## the same search for the settings of every method
	$(BIN)/python -m core tuning

tuned: $(VENV)/.app ## what settings chosen for each capture gain
	$(BIN)/python -m core tuned

calibration: $(VENV)/.app ## are confidences and intervals right as often as they say?
	$(BIN)/python -m core calibration

fit: $(VENV)/.app ## are confidences right, or marked, where the model does not hold?
	$(BIN)/python -m core fit

results: $(VENV)/.app ## write the result tables to assets/results/ (an hour)
	$(BIN)/python -m core paper --repetitions 100 --results assets/results/paper.md
	$(BIN)/python -m core uniform --results assets/results/uniform.md
	$(BIN)/python -m core neighbours --results assets/results/neighbours.md
	$(BIN)/python -m core motion --results assets/results/motion.md
	$(BIN)/python -m core returns --results assets/results/returns.md
	$(BIN)/python -m core budget --results assets/results/budget.md
	$(BIN)/python -m core tuning --results assets/results/tuning.md
	$(BIN)/python -m core tuned --results assets/results/tuned.md
	$(BIN)/python -m core calibration --only confidence ranges --seeds 8 --results assets/results/calibration.md
	$(BIN)/python -m core calibration --only judged --seeds 8 --results assets/results/judged.md
	$(BIN)/python -m core calibration --only fluxes --captures 40 --results assets/results/fluxes.md
	$(BIN)/python -m core calibration --only alarms --captures 10 --results assets/results/alarms.md
	$(BIN)/python -m core fit --results assets/results/fit.md
	$(BIN)/python -m core tradeoff --results assets/results/tradeoff.md
	$(BIN)/python -m core speed --results assets/results/speed.md
	$(BIN)/python -m core stability --results assets/results/sensitivity.md
	$(BIN)/python -m core requires --scene worn --results assets/results/ablation.md
	$(BIN)/python -m core requires --power 100 --results assets/results/power.md

field: $(VENV)/.app ## published captures with a truth, in the folder CAPTURES=path
	$(BIN)/python -m core field "$(CAPTURES)"

large: $(VENV)/.app ## a generated capture of 8 GB on a small cluster of bounded memory
	$(BIN)/python -m core large

fuzz: $(VENV)/.test ## 20,000 damaged files: each is read or refused, nothing else happens
	$(BIN)/python -m core.tests.fuzz

attack: $(VENV)/.test ## requests, files and stray photons that should not take a server down
	$(BIN)/python -m tests.attack

wheel: $(VENV)/.test ## build the wheel, and install and run it on every supported Python found here
	$(BIN)/python -m tests.wheel

# Stamps: made again when what they depend on has changed.
$(VENV)/.app: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[app]'
	touch $@

$(VENV)/.test: $(VENV)/.app
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[app,test]'
	sh tests/install_browser.sh $(BIN)/python
	$(BIN)/python -c "import core; core.warm_up()"
	touch $@

clean: ## remove what the other commands made
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis .coverage
