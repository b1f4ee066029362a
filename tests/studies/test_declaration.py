"""A study as a declaration: what its settings refuse, and what a run of it leaves."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
import pytest

from lfm_ppl.parallel.task import Task
from lfm_ppl.plots import style
from lfm_ppl.studies import declaration, drawing, published
from lfm_ppl.studies.datasets import TaskKind, row
from lfm_ppl.studies.declaration import Study, StudyTable, setting
from lfm_ppl.studies.scores import Estimate


@dataclass(frozen=True)
class ExampleSettings(declaration.StudySettings):
    """One field of each kind."""

    runs: int = setting(5, "numbers", quick=2, aliases=declaration.REALISATIONS, per_seed=100)
    left_out: int = setting(0, "of them", least=0)
    scale: float = setting(1.5, "by which they are multiplied")
    kind: str = setting("plain", "of number", choices=("plain", "odd"))
    most: int | None = setting(None, "of them")
    names: tuple[str, ...] = setting(("a", "b"), "of columns", choices=("a", "b", "c"))
    counts: tuple[int, ...] = setting((1, 3), "of anything", quick=(2,), increasing=True)
    nuts: tuple[int, int, int] = setting((2, 10, 10), "NUTS", parts=declaration.CHAINS[:3])
    data: str | None = setting(None, "a folder")
    size: complex = setting(1j, "", quick=2j)


def tasks(settings):
    return [Task(f"square/{k}", settings.seed, {"number": k, "index": k}) for k in range(settings.runs)]


def later(settings, results):
    return [Task("all", settings.seed, {"what": "sum", "of": [float(result["value"]) for result in results.values()]})]


def tabulated(settings, data):
    rows = {"all": row(data["square"], {"mean": "value", "sum": lambda squares: data["sum"]["value"]})}
    frame = StudyTable.from_rows("Squares", rows).frame
    return {"squares": StudyTable("Squares", frame), "hidden": StudyTable("", frame),
            "only printed": StudyTable("Left out", frame, frame, stored=False)}


@style.styled
def plot(*, width="column"):
    figure = style.new_figure(width, 2.0)
    for axes in figure.subplots(1, 2):
        drawing.band(axes, np.arange(3.0), np.zeros(3), np.ones(3))
        axes.plot(np.zeros(3), **drawing.TRUTH)
        drawing.bars(axes, [0.0, 1.0], [Estimate(1.0, 0.1)] * 2, color=style.BLUE, marker="o", label="estimate")
    drawing.legend(figure, drawing.line("more", style.GREY), drawing.patch("area", style.GREY))
    return figure


STUDY = Study(
    ExampleSettings, tasks, {
        "square": TaskKind(lambda task: {"value": task.settings["number"] ** 2}, {"dataset": "value"}),
        "sum": TaskKind(lambda task: {"value": sum(task.settings["of"])}, {"": "value"})},
    tabulated, lambda settings, data: {"squares": plot()}, {"number": ("dataset", range(4))}, follow_up_tasks=later,
    notes=lambda settings, data: (f"{data['square'].sizes['dataset']} squares",))


def test_a_run_computes_tabulates_and_draws_and_goes_on(tmp_path):
    result = STUDY.run(ExampleSettings.quick(runs=4), tmp_path)
    assert result.tables["squares"].loc["all", ["mean", "sum"]].tolist() == [3.5, 14.0]
    assert list(result.tables) == ["squares", "hidden"] and list(result.printed) == ["Squares", "Left out"]
    assert result.printed["Squares"].loc["all", "mean"] == "3.5 (2.0)"  # of 0, 1, 4 and 9
    assert result.notes == ("4 squares",)
    assert result.data["square"]["value"].sel(dataset=2).item() == 4 and len(result.results) == 5
    assert result.data["square"].number.dims == ("dataset",) and result.data["sum"]["value"].shape == ()
    written = STUDY.save(result, tmp_path)
    assert [path.name for path in written] == ["squares.csv", "squares.md", "hidden.csv", "hidden.md", "squares.png"]
    lines = []
    resumed = STUDY.run(ExampleSettings.quick(runs=4), tmp_path, report=lines.append)
    assert lines == ["4 of 4 tasks are stored already", "1 of 1 tasks are stored already"]
    assert resumed.tables["squares"].equals(result.tables["squares"])
    with pytest.raises(ValueError, match="seed is 0 there and 1 now"):
        STUDY.run(ExampleSettings.quick(runs=4, seed=1), tmp_path)


def test_the_quick_version_keeps_what_is_given():
    assert ExampleSettings.quick() == ExampleSettings(runs=2, counts=(2,), size=2j)
    assert ExampleSettings.quick(runs=7, seed=3) == ExampleSettings(runs=7, counts=(2,), size=2j, seed=3)
    assert ExampleSettings.from_command_line(None, True, runs=7) == ExampleSettings.quick(runs=7)
    assert ExampleSettings.from_command_line(None) == ExampleSettings()


def test_the_options_are_the_fields_with_the_seed_last():
    options = {field.name: value_type for field, value_type in declaration.option_fields(ExampleSettings)}
    assert list(options) == ["runs", "left_out", "scale", "kind", "most", "names", "counts", "nuts", "data", "seed"]
    assert options["most"] is int and options["names"] == tuple[str, ...]


@pytest.mark.parametrize("wrong", [
    {"runs": 0}, {"runs": 101}, {"runs": 2.5}, {"left_out": -1}, {"scale": 0.0}, {"kind": "od"}, {"most": 0},
    {"names": ()}, {"names": "ab"}, {"names": ("a", "a")}, {"names": ("d",)}, {"counts": (3, 1)}, {"counts": (1.5,)},
    {"nuts": (2, 10)}, {"nuts": (2, 0, 1)}, {"seed": -1}], ids=str)
def test_settings_say_what_is_wrong(wrong):
    with pytest.raises((TypeError, ValueError), match="data sets" if wrong == {"runs": 101} else next(iter(wrong))):
        ExampleSettings(**wrong)


def test_published_errors_have_errors_of_their_own():
    frame = pd.DataFrame({"RMSE": [1.0, 2.0, 3.0, 4.0], "RMSE se": [0.3, 0.3, 0.3, np.nan],
                          "source": [4.0, 2.5, np.nan, 1.0], "source se": [0.4, 0.4, np.nan, 0.4]}, list("abcd"))
    comparisons = published.compare_with_published(frame, "RMSE", "source")
    assert {row: str(comparison) for row, comparison in comparisons.items()} == {
        "a": "lower than published (z = -6.0)", "b": "consistent", "d": "-"}
    assert published.describe_comparisons("RMSE", comparisons) == (
        "RMSE: 2 of 2 cells count as consistent with the published table, 1 of them lower than published; 0 higher. a: "
        "lower than published (z = -6.0).")
