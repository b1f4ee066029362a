"""All figures as files."""

import os
from importlib import import_module

import matplotlib.image
import pytest
import xarray as xr

from lfm_ppl.plots import save_figures
from lfm_ppl.results import arviz_data
from lfm_ppl.results.result_view import ResultView

ALL = ["fit", "forces", "states", "trace", "pairs", "residuals"]


def test_every_figure_in_every_format(tmp_path, result):
    folder = tmp_path / "new" / "figures"
    paths = save_figures(result, folder, ("pdf", ".SVG"), width="column")
    expected = [f"{name}.{ending}" for name in ALL for ending in ("pdf", "svg")]
    assert [path.name for path in paths] == expected
    assert sorted(os.listdir(folder)) == sorted(expected)
    assert all(path.read_bytes().startswith(b"%PDF") for path in folder.glob("*.pdf"))
    assert "CDKN1A (a.u.)" in (folder / "fit.svg").read_text(encoding="utf-8")  # text, not outlines


@pytest.mark.thorough
def test_figures_without_their_group_are_left_out(tmp_path, datasets):
    groups = {name: datasets[name] for name in ("posterior", "data")}
    paths = save_figures(arviz_data.build(groups), tmp_path, "png")
    assert [path.name for path in paths] == ["trace.png", "pairs.png"]
    groups["trajectories"] = datasets["trajectories"].drop_dims(["force", "output"])
    groups["posterior"] = groups["posterior"][["anchor"]]
    paths = save_figures(arviz_data.build(groups), tmp_path, "png")
    assert [path.name for path in paths] == ["states.png"]
    assert matplotlib.image.imread(paths[0]).shape[1] == 7.0 * 300
    only = arviz_data.build({"data": xr.Dataset({"y": ("time", [1.0])})})
    assert save_figures(only, tmp_path) == []


def test_nothing_is_overwritten_unasked(tmp_path, datasets):
    states = datasets["trajectories"].drop_dims(["force", "output"])
    result = arviz_data.build({"trajectories": states})
    (tmp_path / "states.pdf").write_text("mine")
    with pytest.raises(FileExistsError, match=r"states\.pdf"):
        save_figures(result, tmp_path, ("png", "pdf"))
    assert os.listdir(tmp_path) == ["states.pdf"]
    save_figures(result, tmp_path, ("png", "pdf"), overwrite=True)
    assert len(os.listdir(tmp_path)) == 2
    assert (tmp_path / "states.pdf").read_bytes().startswith(b"%PDF")


def test_unknown_format(tmp_path, result):
    with pytest.raises(ValueError, match="bmp"):
        save_figures(result, tmp_path, ["bmp"])
    assert not os.listdir(tmp_path)


@pytest.mark.slow
def test_long_lists_go_to_numbered_pages(tmp_path, crowded, monkeypatch):
    saving = import_module("lfm_ppl.plots.saving")
    trajectories = ResultView.of(crowded).group("trajectories")
    data = ResultView.of(crowded).group("data")
    small = arviz_data.build({"trajectories": trajectories, "data": data})
    paths = save_figures(small, tmp_path, width="column")
    assert [path.name for path in paths] == ["fit-1.png", "fit-2.png"]
    monkeypatch.setattr(saving, "MAX_PAGES", 1)
    with pytest.warns(UserWarning, match="12 of 15"):
        save_figures(small, tmp_path / "one")
    assert os.listdir(tmp_path / "one") == ["fit-1.png"]
