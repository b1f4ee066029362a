"""The time left that a display of progress estimates."""

from lfm_ppl.utils import progress
from lfm_ppl.utils.progress import Progress, TaskProgress


def lines_of(monkeypatch, steps, compiles):
    """Lines after steps [(seconds, number done), ...]."""
    clock, lines = [0.0], []
    monkeypatch.setattr(progress.time, "perf_counter", lambda: clock[0])
    with Progress(lines.append, 100, "draws", "trajectories") as display:
        display.start()
        if compiles:
            display.compile("compiling")
        for seconds, done in steps:
            clock[0] = seconds
            display.advance(done)
    return lines


def test_one_draw_gives_no_estimate_of_the_time_left(monkeypatch):
    assert "left" not in lines_of(monkeypatch, [(40.0, 1)], False)[0]
    assert "left" not in lines_of(monkeypatch, [(40.0, 1)], True)[0]
    assert "about 16 min left" in lines_of(monkeypatch, [(10.0, 1), (40.0, 4)], False)[1]
    # The first draw, which compiles, is left out of the pace.
    assert "left" not in lines_of(monkeypatch, [(40.0, 1), (75.0, 2)], True)[1]
    assert "about 28 min left" in lines_of(monkeypatch, [(40.0, 1), (75.0, 3)], True)[1]


def test_one_task_gives_no_estimate_of_the_time_left(monkeypatch):
    monkeypatch.setattr(progress, "EVERY_S", 0.0)
    lines = []
    with TaskProgress(lines.append, 12, 0) as display:
        for seconds in (40.0, 3.0):
            display.end_task("subject", seconds, 1)
    assert "left" not in lines[0] and "about 30 s left" in lines[1]
