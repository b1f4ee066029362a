"""``lfm-ppl new`` and ``lfm-ppl models FILE``: from nothing to a model that runs."""

import ast
import shlex

import numpy as np
import pytest

from lfm_ppl.cli import main
from lfm_ppl.io import loading
from lfm_ppl.results import arviz_data


def run(line, capsys):
    try:
        code = main(shlex.split(line))
    except SystemExit as exit_:
        code = exit_.code
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_a_new_model_is_described_and_fitted_at_once(tmp_path, capsys):
    path = tmp_path / "my_model.py"
    code, out, err = run(f"new {path}", capsys)
    assert (code, err) == (0, "")
    assert f"lfm-ppl fit {path}" in out
    text = path.read_text()
    ast.parse(text)
    assert sum(line.lstrip().startswith("#") for line in text.splitlines()) >= 10  # commented
    code, out, err = run(f"models {path}", capsys)
    assert code == 0, err
    for words in ("temperature (degC)", "LogNormal(-1.2, 0.5)", "> 0", "rate at which the room cools (1/h)",
                  "Matern (K/h)", "half_life", "x  (degC)", "exact: the model is linear"):
        assert words in out
    code, out, err = run(f"fit {path} --sampler map --samples 50 --quiet --out {tmp_path / 'result'}", capsys)
    assert code == 0, err
    posterior = arviz_data.group(arviz_data.load(tmp_path / "result"), "posterior")
    assert set(posterior.data_vars) == {"loss", "scale", "lengthscale", "noise_sd", "half_life"}
    np.testing.assert_allclose(posterior["half_life"], np.log(2) / posterior["loss"])
    # The truth is 0.3; the prior's own width is 0.5 in the logarithm.
    assert abs(np.log(posterior["loss"]).mean() - np.log(0.3)) < 1.0
    table = (tmp_path / "result" / "summary.csv").read_text()
    assert "derived" in table and "kind,warnings" in table


def test_a_file_that_exists_is_kept(tmp_path, capsys):
    path = tmp_path / "mine.py"
    path.write_text("precious")
    code, _, err = run(f"new {path}", capsys)
    assert code == 2
    assert "already exists" in err
    assert path.read_text() == "precious"


@pytest.mark.parametrize("name", ["model.txt", "my-model.py", "3.py"])
def test_names_that_are_no_module(tmp_path, capsys, name):
    code, _, err = run(f"new {tmp_path / name}", capsys)
    assert code == 2
    assert "such as my_model.py" in err
    assert not (tmp_path / name).exists()


def test_the_template_is_a_model_file_of_the_public_api():
    """It is checked and typed as a part of the package, and imports what a user would."""
    import lfm_ppl.cli

    path = f"{lfm_ppl.cli.__path__[0]}/template.py"
    assert loading.load(path).outputs == ("temperature",)
    tree = ast.parse(open(path, encoding="utf-8").read())
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert names == {"jax", "jax.numpy", "numpy", "numpyro", "numpyro.distributions", "lfm_ppl"}


def test_a_model_that_does_not_run_is_described_by_its_file(tmp_path, capsys):
    path = tmp_path / "broken.py"
    path.write_text('"""Broken."""\nPARAMETERS = {"rate": "how fast (1/h)"}\nOUTPUTS = ("x",)\n'
                    "def model(times, y=None):\n    raise ValueError('not yet written')\n")
    code, out, err = run(f"models {path}", capsys)
    assert code == 2 and "how fast (1/h)" in out and "could not be run" in out
    assert err == f"lfm-ppl: error: {path}, line 5: not yet written\n"
