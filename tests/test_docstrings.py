"""Every example in a docstring runs and prints what it says."""

import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MODULES = sorted(  # names below lfm_ppl; studies/ is the package lfm_ppl.studies
    ".".join(path.relative_to(root).with_suffix("").parts)
    for root, folder in ((ROOT / "lfm_ppl", ROOT / "lfm_ppl"), (ROOT, ROOT / "studies"))
    for path in folder.rglob("*.py")
    if path.name not in ("__init__.py", "__main__.py") and ">>> " in path.read_text("utf-8"))
# Modules whose examples take several seconds to compile.
COSTLY = {
    "constrained.moving_horizon", "constrained.posterior", "constrained.full_information", "inference.bind",
    "workflows.fit", "workflows.fit_many",
    "workflows.backtest", "workflows.to_arviz", "workflows.forecast", "fokker_planck_grid.fokker_planck",
    "inference.bound_model", "likelihoods.handlers.on_latent_grid", "likelihoods.handlers.approximate",
    "inference.kernels.elliptical_slice", "inference.kernels.particle_marginal", "latent_grid.laplace",
    "latent_grid.latent_grid", "orbits.deviations", "accuracy.check_accuracy", "accuracy.calibration",
    "switching.rao_blackwellised", "switching.switched_simulation"}


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=[pytest.mark.slow] if name in COSTLY else []) for name in MODULES])
def test_examples(name):
    module = importlib.import_module(f"lfm_ppl.{name}")
    outcome = doctest.testmod(module, optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    assert outcome.attempted > 0 and outcome.failed == 0
