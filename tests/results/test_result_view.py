"""The view of a result: groups, labels, units and settings, looked up once."""

import json

import numpy as np
import pytest
import xarray as xr

import lfm_ppl as lfm
from lfm_ppl.plots import plot_trace, saving
from lfm_ppl.results import arviz_data, tables
from lfm_ppl.results.result_view import LIKELIHOODS, ResultView


def test_a_view_does_not_see_groups_that_are_added_later(result):
    view = ResultView.of(result)
    assert ResultView.of(view) is view
    arviz_data.add_group(result, "field_heat", xr.Dataset({"mean": ("place", [1.0])}))
    assert "field_heat" not in view.groups and "field_heat" in ResultView.of(result).groups
    assert "empty" not in view.with_groups({**view.groups, "empty": xr.Dataset()}).groups
    assert view.with_groups({}, {"seed": 4}).attrs == {"seed": 4} and view.attrs["seed"] == 3


def test_a_missing_group_or_a_choice_of_sites_is_named(result):
    view = ResultView.of(result)
    with pytest.raises(ValueError, match="no group 'accuracy'.*lfm.check_accuracy"):
        view.group("accuracy")
    sites = ResultView({"data_a": xr.Dataset()}, {LIKELIHOODS: json.dumps({"a": {}, "b": {}})})
    for look_up in (lambda: sites.group("data"), sites.refuse_several_sites):
        with pytest.raises(ValueError, match=r"select it: lfm.select_series\(result, 'a'\)"):
            look_up()


def test_readers_take_a_view_in_place_of_a_result(result, tmp_path):
    view = ResultView.of(result)
    assert arviz_data.summary(view).equals(arviz_data.summary(result))
    table = arviz_data.summary(view)
    assert tables.annotate(table, view).equals(tables.annotate(table, result))
    pages, expected = ([name for name, *_ in saving.pages_of(source, "full")] for source in (view, result))
    assert pages == expected and "fit" in pages
    assert len(plot_trace(view, ["lengthscale"]).axes) == 2
    np.testing.assert_array_equal(view.divergences, result["sample_stats"]["diverging"])
    saved = lfm.load(arviz_data.save(view, tmp_path / "posterior.nc"))
    assert ResultView.of(saved).posterior.equals(view.posterior)


@pytest.mark.thorough
def test_the_report_reads_a_result_once(result, tmp_path, monkeypatch):
    conversions = []
    convert = ResultView.of.__func__

    def count(cls, result):
        conversions.append(not isinstance(result, cls))
        return convert(cls, result)

    monkeypatch.setattr(ResultView, "of", classmethod(count))
    lfm.save_report(result, tmp_path / "report.html")
    assert sum(conversions) == 1 and len(conversions) > 1
