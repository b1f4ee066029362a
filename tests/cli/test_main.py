"""The command line as a process of its own."""

import gc

import pytest

from lfm_ppl import __main__, cli


@pytest.fixture
def collector(monkeypatch):
    """What was asked of Python's garbage collector, in order; this process keeps its own settings."""
    asked = []
    monkeypatch.setattr(gc, "set_threshold", lambda new, *_: asked.append("rarely" if new > 10_000 else "often"))
    monkeypatch.setattr(gc, "freeze", lambda: asked.append("never again"))
    return asked


def test_the_process_looks_for_garbage_rarely_and_ends_without(monkeypatch, collector):
    monkeypatch.setattr(cli, "main", lambda: collector.append("run") or 3)
    assert __main__.main() == 3
    assert collector == ["rarely", "run", "never again"]


def test_it_ends_without_after_an_error_too(monkeypatch, collector):
    def leave():
        raise SystemExit(2)  # argparse, at a wrong argument

    monkeypatch.setattr(cli, "main", leave)
    with pytest.raises(SystemExit):
        __main__.main()
    assert collector == ["rarely", "never again"]
