"""The page of a result: well-formed, escaped, self-contained, with the values of every group."""

import base64
import html.parser
import json
import re

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import lfm_ppl as lfm
from lfm_ppl.accuracy.importance_weights import COLUMNS
from lfm_ppl.cli import pages as cli_page
from lfm_ppl.report import html_report
from lfm_ppl.results import arviz_data

VOID = {"meta", "img", "wbr"}
EVIL = "<script>alert('&\"')</script>"
PIXEL = base64.b64decode("iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGA"
                         "WjR9awAAAABJRU5ErkJggg==")


class Page(html.parser.HTMLParser):
    """Tags, link targets and the text of each section; an error where a tag is not closed."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.tags, self.targets, self.section, self.texts = [], [], [], None, {}
        self.feed(text)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.tags.append(tag)
        self.targets += [attrs[name] for name in ("src", "href") if name in attrs]
        if tag == "section":
            self.section = attrs["id"]
            self.texts[self.section] = ""
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open.pop() == tag, f"</{tag}> closes another tag"
        if tag == "section":
            self.section = None

    def handle_data(self, data):
        if self.section:
            self.texts[self.section] += data


def read(path):
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    for target in page.targets:
        assert target.startswith(("#", "./", "data:image/png;base64,")), target
    assert {target[1:] for target in page.targets if target.startswith("#")} == set(page.texts)
    assert "script" not in page.tags and not re.search(r"@import|url\(|<link", text)
    return page


@pytest.fixture
def attrs():
    return {
        "model": "gene", "model_file": "gene.py", "description": "A gene, switched on & off.\n\n    dx/dt = b - d x",
        "sampler": "nuts", "seed": 3, "fixed": json.dumps({"decay[a]": 0.8}), "data": "genes.csv",
        "command_line": "lfm-ppl fit gene.py --data genes.csv", "time_origin": "2024-03-01T00:00:00",
        "priors": json.dumps({"decay": "median 1, 95% 0.37 to 2.7", "rate": "HalfNormal(1)"}),
        "meanings": json.dumps({"decay": "loss per hour"}),
        "assumptions": json.dumps({"initial state": "x = 0 (known)"}),
    }


@pytest.fixture
def groups():
    """A small result with everything: two outputs, chains that disagree, a check, a forecast, an input, a truth."""
    rng = np.random.default_rng(0)
    sample = {"chain": np.arange(4), "draw": np.arange(50)}
    output = {"output": ["x", "z"]}
    y = rng.normal(size=(6, 2))
    y[1, 0] = np.nan
    draws = rng.normal(size=(4, 50)) + np.array([0.0, 0.0, 0.0, 9.0])[:, None]
    new = rng.normal(size=(4, 50, 60, 2))
    dims = ("chain", "draw", "time", "output")
    return {
        "posterior": xr.Dataset({"decay": (("chain", "draw"), draws), "rate": (("chain", "draw"), new[..., 0, 0])},
                                sample),
        "truth": xr.Dataset({"decay": 0.4375}),
        "data": xr.Dataset({"y": (("time", "output"), y, {"units": json.dumps({"x": "nM"})})},
                                    {"time": ("time", np.arange(6.0), {"units": "h"}), **output}),
        "constant_data": xr.Dataset({"heater": ("heater_time", np.array([0.0, 7.5]),
                                               {"interpolation": "linear", "units": "kW"})},
                                    {"heater_time": np.array([0.0, 5.0])}),
        "predictions": xr.Dataset({"y": (dims, new), "outputs": (dims, new / 2)},
                                  {**sample, **output, "time": ("time", np.arange(4.0, 64.0), {"units": "h"})},
                                  {"observed": "y", "last_observation": 5.0, "command_line": "lfm-ppl forecast r"}),
        "accuracy": xr.Dataset(
            {**{name: ("parameter", np.array([0.125, 0.5])) for name in COLUMNS},
             **{name: (("chain", "draw"), draws) for name in ("log_likelihood", "log_likelihood_reference")}},
            {**sample, "parameter": ["decay", "rate"]},
            {"reference": "grid", "pareto_k": 0.9, "threshold": 0.7, "ess": 20.0, "particles": 0, "noise_sd": 0.0,
             "noise_share": 0.0, "step_change_mean": 0.0, "step_change_sd": 0.01, "steps": 10, "verdict": "re-run",
             "reason": "k is too large.", "command": "lfm-ppl check RESULT --correct",
             "command_line": "lfm-ppl check r"}),
    }  # fmt: skip


def save(groups, attrs, path, **keywords):
    return lfm.save_report(arviz_data.build(groups, attrs), path, figures=(), **keywords)


def test_every_section_has_its_values(groups, attrs, tmp_path):
    for name in ("posterior.nc", "summary.csv", "diary.txt", ".hidden.nc"):
        (tmp_path / name).write_text("")
    (tmp_path / "drawn").mkdir()
    (tmp_path / "drawn" / "trace-2.png").write_bytes(PIXEL)
    path = lfm.save_report(arviz_data.build(groups, attrs), tmp_path, figures=[tmp_path / "drawn" / "trace-2.png"],
                           more={"Scores": pd.DataFrame({"crps": [0.25]}, ["x"])})
    assert path == tmp_path / "report.html"
    page = read(path)
    values = {
        "result": ["R-hat", "re-run", "decay", "rate", "sampled", "truth", "0.438"],
        "forecast": ["40 of 58 times", "2024-03-01 06:00", "2024-03-03 15:00", "q97.5", "Scores", "0.250"],
        "accuracy": ["re-run: k is too large.", f"lfm-ppl check {tmp_path} --correct", "0.90", "0.125"],
        "figures": ["page 2"],
        "convergence": ["r_hat", "decay"],
        "model": ["gene.py", "switched on & off", "dx/dt = b - d x", "0.37 to 2.7", "loss per hour", "x = 0 (known)"],
        "data": ["genes.csv", "1 of 12 values", "0 to 5 h (2024-03-01 00:00 to 2024-03-01 05:00)", "nM", "heater", "kW",
                 "linear", "7.50"],
        "settings": ["nuts", "decay[a] 0.800"],
        "repeat": ["lfm-ppl fit gene.py --data genes.csv\nlfm-ppl check r\nlfm-ppl forecast r"],
        "files": ["posterior.nc", "summary.csv"],
    }
    assert list(page.texts) == list(values), "results come first"
    for section, words in values.items():
        for word in words:
            assert word in page.texts[section], (section, word)
    assert page.targets.count("./posterior.nc") == 1 and "diary" not in page.texts["files"]
    (picture,) = (target for target in page.targets if target.startswith("data:"))
    assert base64.b64decode(picture.partition(",")[2]) == PIXEL


def test_all_text_is_escaped(groups, attrs, tmp_path):
    groups["posterior"] = groups["posterior"].rename({"decay": "d<b>"})
    groups["accuracy"] = groups["accuracy"].assign_coords(parameter=[EVIL, "rate"])
    for name in ("data", "predictions"):
        groups[name] = groups[name].assign_coords(output=[EVIL, "z"])
    attrs |= dict.fromkeys(("model", "description", "data", "note", "command_line", "partial", "sampler", "own"), EVIL)
    page = read(save(groups, attrs, tmp_path / "a.html", more={EVIL: pd.DataFrame({EVIL: [EVIL]}, [EVIL])}))
    for section in ("result", "model", "data", "accuracy", "forecast", "settings", "repeat"):
        assert EVIL in page.texts[section], section
    assert "d<b>" in page.texts["result"] and not {"b", "script"} & set(page.tags)


@pytest.mark.thorough
def test_a_posterior_alone_and_a_call_in_python(groups, tmp_path):
    page = read(save({"posterior": groups["posterior"]}, {"call": "lfm.fit(gene, data)"}, tmp_path / "mine.html"))
    assert list(page.texts) == ["result", "accuracy", "convergence", "model", "data", "repeat"]
    assert "lfm.fit(gene, data)" in page.texts["repeat"]


def test_dates_need_a_unit_of_time(groups, attrs, tmp_path):
    del groups["data"]["time"].attrs["units"]
    page = read(save(groups, attrs, tmp_path / "a.html"))
    assert "0 to 5" in page.texts["data"] and "2024" not in page.texts["data"] + page.texts["forecast"]


def test_a_panel(groups, attrs, tmp_path):
    for name in ("data", "predictions"):
        groups[name] = xr.concat([groups[name]] * 7, pd.Index([f"p{k}" for k in range(7)], name="series"),
                                 data_vars="all")
    page = read(save(groups, attrs, tmp_path / "a.html"))
    assert "7 of 84 values" in page.texts["data"]
    assert "series p4" in page.texts["forecast"] and "series p5" not in page.texts["forecast"]


def test_figures_are_drawn_and_a_failed_figure_is_named(groups, tmp_path, monkeypatch):
    def fail(*arguments, **keywords):
        raise RuntimeError("no <ink>")

    monkeypatch.setattr("lfm_ppl.plots.pairs.plot_pairs", fail)
    page = read(lfm.save_report(arviz_data.build({"posterior": groups["posterior"]}), tmp_path))
    (picture,) = (target for target in page.targets if target.startswith("data:"))
    assert base64.b64decode(picture.partition(",")[2]).startswith(b"\x89PNG")
    assert "no <ink>" in page.texts["figures"]


def test_only_a_page_of_lfm_ppl_is_replaced(groups, attrs, tmp_path, capsys, monkeypatch):
    result = arviz_data.build(groups, attrs)
    path = save(groups, attrs, tmp_path)
    content = path.read_bytes()
    with pytest.raises(FileExistsError, match=r"report\.html"):
        save(groups, attrs, path)
    assert cli_page.report_failure(lambda: html_report.save_report(result, path, figures=())) == 1
    assert "report.html" in capsys.readouterr().err
    assert path.read_bytes() == content
    html_report.refuse_foreign(path, False)
    path.write_text("<html><p>my diary</p></html>")
    with pytest.raises(FileExistsError, match=r"report\.html"):
        html_report.refuse_foreign(path, False)
    html_report.refuse_foreign(path, True)
    assert cli_page.report_failure(lambda: html_report.save_report(result, path, True, figures=())) == 0
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]

    def fail(*arguments, **keywords):
        raise OSError("no space left")

    monkeypatch.setattr(html_report, "write_page", fail)
    assert cli_page.update(result, tmp_path) == 1 and "no space left" in capsys.readouterr().err


def test_update_shows_the_figures_of_this_result_alone(groups, attrs, tmp_path):
    for name in ("trace", "pairs", "states"):  # the states are of a result that was replaced
        (tmp_path / f"{name}.png").write_bytes(PIXEL)
    assert cli_page.update(arviz_data.build({"posterior": groups["posterior"]}, attrs), tmp_path) == 0
    page = read(tmp_path / "report.html")
    assert [target.startswith("data:") for target in page.targets].count(True) == 2
