"""The page of a result: whole, well-formed, escaped, and in need of nothing else."""

import base64
import html.parser
import json
import re

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import lfm_ppl as lfm
from lfm_ppl.cli import page as cli_page
from lfm_ppl.results import arviz_data, html_report, web_page
from lfm_ppl.results.importance import COLUMNS
from lfm_ppl.results.tables import html_table

VOID = {"meta", "img", "wbr"}
SECTIONS = ["result", "model", "data", "summary", "accuracy", "forecast", "figures", "settings", "repeat", "files"]
EVIL = "<script>alert('&\"')</script>"
PIXEL = base64.b64decode("iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGA"
                         "WjR9awAAAABJRU5ErkJggg==")


class Page(html.parser.HTMLParser):
    """Tags, anchors, what is linked to, and the text of each section; an error where a tag is not closed."""

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
        assert self.open and self.open.pop() == tag, f"</{tag}> closes something else"
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
    assert "default-src 'none'" in text, "the browser is told to load nothing"
    return page


@pytest.fixture
def attrs():
    return {
        "model": "gene", "model_file": "gene.py", "description": "A gene, switched on & off.\n\n    dx/dt = b - d x",
        "sampler": "nuts", "chains": 4, "seed": 3, "rule": "Cubature", "options": json.dumps({"link": "softplus"}),
        "fixed": json.dumps({"decay[a]": 0.8}), "versions": json.dumps({"jax": "0.10"}), "data": "genes.csv",
        "command_line": "lfm-ppl fit gene.py --data genes.csv", "time_origin": "2024-03-01T00:00:00",
        "priors": json.dumps({"decay": "LogNormal(0, 0.5)", "rate": "HalfNormal(1)"}),
        "meanings": json.dumps({"decay": "how fast it goes"}),
        "assumptions": json.dumps({"observation": "x, z: StudentT (df 4)", "initial state": "x = 0 (known)"}),
    }


@pytest.fixture
def groups():
    """A small result with everything: two outputs, three chains that disagree, a check, a forecast, an input."""
    rng = np.random.default_rng(0)
    sample = {"chain": np.arange(4), "draw": np.arange(50)}
    output = {"output": ["x", "z"]}
    y = rng.normal(size=(6, 2))
    y[1, 0] = np.nan
    clock = ("time", np.arange(6.0), {"units": "h"})
    draws = rng.normal(size=(4, 50)) + np.array([0.0, 0.0, 0.0, 9.0])[:, None]
    times = np.arange(4.0, 64.0)
    new = rng.normal(size=(4, 50, 60, 2))
    place = ("chain", "draw", "time", "output")
    return {
        "posterior": xr.Dataset({"decay": (("chain", "draw"), draws), "rate": (("chain", "draw"), new[..., 0, 0])},
                                sample),
        "observed_data": xr.Dataset({"y": (("time", "output"), y, {"units": json.dumps({"x": "nM"})})},
                                    {"time": clock, **output}),
        "constant_data": xr.Dataset({"heater": ("heater_time", np.array([0.0, 7.5]),
                                               {"interpolation": "linear", "units": "kW"})},
                                    {"heater_time": np.array([0.0, 5.0])}),
        "predictions": xr.Dataset({"y": (place, new), "outputs": (place, new / 2)},
                                  {**sample, **output, "time": ("time", times, {"units": "h"})},
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


def test_every_section_says_what_it_is_for(groups, attrs, tmp_path):
    for name in ("posterior.nc", "summary.csv", "fit.png", "forecast.csv", "diary.txt", ".hidden.nc"):
        (tmp_path / name).write_text("")
    result = arviz_data.build(groups, attrs)
    (tmp_path / "drawn").mkdir()
    (tmp_path / "drawn" / "trace-2.png").write_bytes(PIXEL)
    path = lfm.save_report(result, tmp_path, figures=[tmp_path / "drawn" / "trace-2.png"],
                           more={"Scores": pd.DataFrame({"crps": [0.25]}, ["x"])})
    assert path == tmp_path / "report.html"
    page = read(path)
    assert list(page.texts) == SECTIONS
    said = {
        "result": ["R-hat", "re-run"],
        "model": ["gene.py", "switched on & off", "\ndx/dt = b - d x", "LogNormal(0, 0.5)", "how fast it goes",
                  "x, z: StudentT (df 4)", "x = 0 (known)"],
        "data": ["genes.csv", "1 of 12 values", "0 to 5 h (2024-03-01 00:00 to 2024-03-01 05:00)", "nM", "heater", "kW",
                 "linear", "7.50"],
        "summary": ["decay", "rate", "r_hat", "sampled", "R-hat"],
        "accuracy": ["re-run: k is too large.", f"lfm-ppl check {tmp_path} --correct", "0.90 (reliable below 0.70)",
                     "0.125"],
        "forecast": ["40 of 58 times after the last observation", "2024-03-01 06:00", "2024-03-03 15:00", "q97.5",
                     "Scores", "0.250"],
        "figures": ["Chains, page 2"],
        "settings": ["nuts", "Cubature", "link softplus", "decay[a] 0.800", "jax 0.10"],
        "repeat": ["lfm-ppl fit gene.py --data genes.csv\nlfm-ppl check r\nlfm-ppl forecast r"],
    }
    for section, words in said.items():
        for word in words:
            assert word in page.texts[section], (section, word)
    assert page.texts["files"].split() == ["Files", "fit.png", "forecast.csv", "posterior.nc", "summary.csv"]
    assert page.targets.count("./posterior.nc") == 1
    (picture,) = (target for target in page.targets if target.startswith("data:"))
    assert base64.b64decode(picture.partition(",")[2]) == PIXEL


def test_a_row_has_its_own_warning_and_not_that_of_all(groups, attrs, tmp_path):
    diverging = xr.Dataset({"diverging": (("chain", "draw"), np.ones((4, 50), bool))})
    page = read(save({**groups, "sample_stats": diverging}, attrs, tmp_path / "a.html"))
    assert "reparameterise" in page.texts["result"] and "reparameterise" not in page.texts["summary"]
    assert "R-hat is above 1.01 for decay" in page.texts["summary"] and "Run longer" not in page.texts["summary"]


def test_all_text_is_escaped(groups, attrs, tmp_path):
    names = {"output": {"x": EVIL}, "parameter": {"decay": EVIL}}
    for name, dataset in groups.items():
        for dim, new in names.items():
            if dim in dataset.coords:
                groups[name] = groups[name].assign_coords({dim: [new.get(str(value), str(value))
                                                                 for value in dataset[dim].values]})
    groups["posterior"] = groups["posterior"].rename({"decay": "d<b>"})
    groups["constant_data"] = groups["constant_data"].rename({"heater": "h<i>", "heater_time": "h<i>_time"})
    attrs |= dict.fromkeys(("model", "description", "data", "note", "command_line", "partial", "sampler", "own"), EVIL)
    page = read(save(groups, attrs, tmp_path / "a.html", more={EVIL: pd.DataFrame({EVIL: [EVIL]}, [EVIL])}))
    for section in ("result", "model", "data", "accuracy", "forecast", "settings", "repeat"):
        assert EVIL in page.texts[section], section
    assert "d<b>" in page.texts["summary"] and "h<i>" in page.texts["data"]
    assert not {"b", "i", "script"} & set(page.tags)


def test_a_posterior_alone_and_a_call_in_python(groups, tmp_path):
    page = read(save({"posterior": groups["posterior"]}, {"call": "lfm.fit(gene, data)"}, tmp_path / "mine.html"))
    assert list(page.texts) == [name for name in SECTIONS if name not in ("forecast", "settings", "files")]
    assert "lfm.fit(gene, data)" in page.texts["repeat"] and "holds no data" in page.texts["data"]
    assert "has not been measured" in page.texts["accuracy"] and "no docstring" in page.texts["model"]


def test_dates_need_a_unit_of_time(groups, attrs, tmp_path):
    del groups["observed_data"]["time"].attrs["units"]
    page = read(save(groups, attrs, tmp_path / "a.html"))
    assert "0 to 5" in page.texts["data"] and "2024" not in page.texts["data"] + page.texts["forecast"]


def test_a_partial_result_says_so_first(groups, attrs, tmp_path):
    page = read(save(groups, {**attrs, "partial": "50 of 1000 draws a chain"}, tmp_path / "a.html"))
    assert page.texts["result"].strip().startswith("Result\nThis result is partial: 50 of 1000 draws a chain.")


def test_a_panel(groups, attrs, tmp_path):
    for name in ("observed_data", "predictions"):
        groups[name] = xr.concat([groups[name]] * 7, pd.Index([f"p{k}" for k in range(7)], name="series"),
                                 data_vars="all")
    page = read(save(groups, attrs, tmp_path / "a.html"))
    assert "7 of 84 values" in page.texts["data"]
    assert "Series p4" in page.texts["forecast"] and "The first 5 of 7 series" in page.texts["forecast"]


def test_figures_are_drawn_and_one_that_fails_is_named(groups, tmp_path, monkeypatch):
    def fail(*arguments, **keywords):
        raise RuntimeError("no <ink>")

    monkeypatch.setattr("lfm_ppl.results.plots.pairs.plot_pairs", fail)
    path = lfm.save_report(arviz_data.build({"posterior": groups["posterior"]}), tmp_path)
    page = read(path)
    (picture,) = (target for target in page.targets if target.startswith("data:"))
    assert base64.b64decode(picture.partition(",")[2]).startswith(b"\x89PNG")
    assert "The figure pairs could not be drawn: no <ink>" in page.texts["figures"]


def test_nothing_is_overwritten_silently(groups, attrs, tmp_path):
    path = save(groups, attrs, tmp_path)
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match="report.html already exists"):
        save(groups, {**attrs, "model": "other"}, path)
    assert path.read_bytes() == before
    save(groups, {**attrs, "model": "other"}, path, overwrite=True)
    assert b"<h1>other</h1>" in path.read_bytes() and [one.name for one in tmp_path.iterdir()] == ["report.html"]


def test_only_a_page_of_ours_is_brought_up_to_date(groups, attrs, tmp_path):
    path = save(groups, attrs, tmp_path)
    web_page.refuse_foreign(path, overwrite=False)
    path.write_text("<html><p>my diary</p></html>")
    with pytest.raises(FileExistsError, match="already exists"):
        cli_page.refuse_foreign(tmp_path, False)
    cli_page.refuse_foreign(tmp_path, True)


def test_a_page_that_cannot_be_written_costs_nothing_else(groups, attrs, tmp_path, capsys, monkeypatch):
    result = arviz_data.build(groups, attrs)
    assert cli_page.save(result, tmp_path, False, ()) == 0
    assert capsys.readouterr().out == f"wrote    {tmp_path / 'report.html'}\n"
    assert cli_page.save(result, tmp_path, False, ()) == 1
    assert "lfm-ppl: the page could not be written: " in capsys.readouterr().err

    def fail(*arguments, **keywords):
        raise OSError("no space left")

    monkeypatch.setattr(html_report.web_page, "write", fail)
    assert cli_page.update(result, tmp_path) == 1
    assert "no space left" in capsys.readouterr().err


def test_update_shows_the_figures_of_this_result_alone(groups, attrs, tmp_path):
    for name in ("trace", "pairs", "states"):  # the states of a result that was replaced
        (tmp_path / f"{name}.png").write_bytes(PIXEL)
    assert cli_page.update(arviz_data.build({"posterior": groups["posterior"]}, attrs), tmp_path) == 0
    page = read(tmp_path / "report.html")
    assert [target.startswith("data:") for target in page.targets].count(True) == 2
    assert "Chains" in page.texts["figures"] and "States" not in page.texts["figures"]


def test_html_table_escapes_and_aligns():
    text = html_table(pd.DataFrame({"a<b": [1.0, np.nan], "r_hat": [1.0004, 2.0], "t": ["x&y", ""]}, ["k", EVIL]),
                      index_label="p\"q")
    assert "a&lt;b" in text and "x&amp;y" in text and "p&quot;q" in text and EVIL not in text
    assert '<td class="n">1.00</td><td class="n">1.000</td><td>x&amp;y</td>' in text
    assert '<td class="n">-</td>' in text
