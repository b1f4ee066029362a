"""A synthetic result as fixtures: three genes under two forces, 4 chains of 100 draws, 30 measurement times."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from lfm_ppl.results import arviz_data
from lfm_ppl.results.scalars import units_attribute

CHAINS, DRAWS, THINNED, AT = 4, 100, 50, 61
GENES = ("CDKN1A", "SESN1", "TNFRSF10b")
FORCES = ("p53", "stress")
DECAY = np.array([0.8, 0.4, 1.1])
UNITS = {"CDKN1A": "a.u.", "SESN1": "a.u.", "TNFRSF10b": "nM", "p53": "1/h", "stress": "K"}


def true_force(time, force):
    if force == "p53":
        return 2.0 * np.exp(-0.5 * ((time - 4.0) / 1.5) ** 2)
    return np.sin(0.9 * time) * np.exp(-0.1 * time)


def true_output(time, gene):
    return 0.5 + gene + (1.0 + 0.4 * gene) * np.exp(-0.5 * ((time - 5.0 - gene) / 2.0) ** 2)


def measurement_times():
    return np.sort(np.concatenate([np.linspace(0.0, 12.0, 26), [0.0, 6.24, 6.24, 12.0]]))


def posterior(rng):
    shape = (CHAINS, DRAWS)
    return xr.Dataset(
        {
            "decay": (("chain", "draw", "gene"), DECAY * np.exp(0.15 * rng.normal(size=(*shape, 3))), {"units": "1/h"}),
            "lengthscale": (("chain", "draw"), rng.gamma(20.0, 0.1, shape), {"units": "h"}),
            "noise_sd": (("chain", "draw"), 0.1 * np.exp(0.1 * rng.normal(size=shape))),
            "anchor": (("chain", "draw"), np.full(shape, 0.8)),
        },
        coords={"chain": np.arange(CHAINS), "draw": np.arange(DRAWS), "gene": list(GENES)},
    )


def smooth_noise(rng, time, size, count):
    """Random smooth functions (..., time, count): a few cosines with random weights."""
    waves = np.array([np.cos(k * np.pi * time / 12.0) / (1 + k) for k in range(4)])
    return size * np.einsum("...jk,kt->...tj", rng.normal(size=(CHAINS, THINNED, count, 4)), waves)


def trajectories(rng):
    time = np.linspace(-0.5, 14.0, AT)
    output = np.stack([true_output(time, g) for g in range(3)], axis=-1)
    output = output + smooth_noise(rng, time, 0.08, 3)
    force = np.stack([true_force(time, f) for f in FORCES], axis=-1)
    return xr.Dataset(
        {
            "forces": (
                ("chain", "draw", "time", "force"),
                force + smooth_noise(rng, time, 0.15, 2),
                units_attribute(FORCES, UNITS),
            ),
            "states": (("chain", "draw", "time", "state"), 1.1 * output, {"units": "nM"}),
            "outputs": (("chain", "draw", "time", "output"), output, units_attribute(GENES, UNITS)),
        },
        coords={
            "chain": np.arange(CHAINS),
            "draw": np.arange(THINNED) * 2,
            "time": ("time", time, {"units": "h"}),
            "force": list(FORCES),
            "state": [f"{gene}_mRNA" for gene in GENES],
            "output": list(GENES),
        },
    )


def by_time(rng):
    """Groups over the measurement times: data, predictive draws, scores, residuals."""
    time = measurement_times()
    clean = np.stack([true_output(time, g) for g in range(3)], axis=-1)
    y = clean + 0.15 * rng.normal(size=clean.shape)
    y[4, :] = np.nan
    y[10:14, 1] = np.nan
    sample = {"chain": np.arange(CHAINS), "draw": np.arange(DRAWS)}
    when = {"time": ("time", time, {"units": "h"})}
    residual = rng.normal(size=(len(time), 3)) + 0.1 * rng.normal(size=(CHAINS, DRAWS, 1, 3))
    residual = np.where(np.isnan(y), np.nan, residual)
    density = -0.5 * (np.log(2 * np.pi) + np.nan_to_num(residual) ** 2).sum(-1)
    noise_free = clean + 0.08 * rng.normal(size=(CHAINS, DRAWS, 1, 3))
    new = noise_free + 0.15 * rng.normal(size=(CHAINS, DRAWS, *clean.shape))
    terms = -0.5 * (np.log(2 * np.pi) + np.nan_to_num(residual) ** 2)
    output = {"output": list(GENES)}
    seen = np.nonzero(~np.isnan(y))
    entries = {"time": ("observation", time[seen[0]], {"units": "h"}),
               "output": ("observation", np.array(GENES)[seen[1]])}
    return {
        "data": xr.Dataset(
            {"y": (("time", "output"), y, units_attribute(GENES, UNITS))}, coords={**when, **output}
        ),
        "observed_data": xr.Dataset({"y": ("observation", y[seen])}, coords=entries),
        "posterior_predictive": xr.Dataset(
            {"y": (("chain", "draw", "observation"), new[:, :, *seen])}, coords={**sample, **entries}
        ),
        "log_likelihood": xr.Dataset(
            {"y": (("chain", "draw", "observation"), terms[:, :, *seen])}, coords={**sample, **entries}
        ),
        "one_step_ahead": xr.Dataset(
            {
                "log_density": (("chain", "draw", "time"), density),
                "residual": (("chain", "draw", "time", "output"), residual),
            },
            coords={**sample, **when, **output},
        ),
    }


def truth():
    time = np.linspace(0.0, 12.0, 49)
    return xr.Dataset(
        {
            "forces": (("time", "force"), np.stack([true_force(time, f) for f in FORCES], axis=-1)),
            "states": (("time", "state"), 1.1 * np.stack([true_output(time, g) for g in range(3)], axis=-1)),
            "decay": ("gene", DECAY),
            "lengthscale": ((), 2.0),
        },
        coords={
            "time": time,
            "force": list(FORCES),
            "state": [f"{gene}_mRNA" for gene in GENES],
            "gene": list(GENES),
        },
    )


@pytest.fixture
def datasets():
    """Every group of a result, made anew for each test."""
    rng = np.random.default_rng(1)
    stats = rng.normal(size=(2, CHAINS, DRAWS))
    diverging = np.zeros((CHAINS, DRAWS), bool)
    diverging[[0, 1, 3], [10, 50, 99]] = True
    sample = ("chain", "draw")
    return {
        "posterior": posterior(rng),
        "sample_stats": xr.Dataset(
            {"diverging": (sample, diverging), "lp": (sample, stats[0]), "energy": (sample, stats[1])},
            coords={"chain": np.arange(CHAINS), "draw": np.arange(DRAWS)},
        ),
        "trajectories": trajectories(rng),
        "truth": truth(),
        **by_time(rng),
    }


@pytest.fixture
def result(datasets):
    attrs = {"model": "transcription", "sampler": "nuts", "seed": 3, "wall_time_s": 1.5}
    return arviz_data.build(datasets, attrs)


def drawn_texts(figure):
    """Every text that a figure shows, with its box in pixels: (text, size, box)."""
    texts = [figure._suptitle, figure._supxlabel, figure._supylabel]
    texts += [text for legend in figure.legends for text in legend.get_texts()]
    for axes in figure.axes:
        texts += [axes.title, axes._left_title, axes.xaxis.label, axes.yaxis.label]
        for axis in (axes.xaxis, axes.yaxis):
            texts.append(axis.get_offset_text())
            low, high = sorted(axis.get_view_interval())
            slack = 1e-9 * (high - low)
            texts += [
                label
                for location, label in zip(axis.get_ticklocs(), axis.get_ticklabels(), strict=False)
                if low - slack <= location <= high + slack
            ]
    return [
        (text.get_text(), text.get_fontsize(), text.get_window_extent())
        for text in texts
        if text is not None and text.get_visible() and text.get_text().strip()
    ]


def assert_readable(figure):
    """No text below 7 pt, none cut off by the figure's edge, none on top of another."""
    texts = drawn_texts(figure)
    assert texts
    width, height = figure.bbox.width, figure.bbox.height
    for text, size, box in texts:
        assert size >= 7.0, (text, size)
        assert -1 <= box.x0 and box.x1 <= width + 1, (text, "beyond the sides", box)
        assert -1 <= box.y0 and box.y1 <= height + 1, (text, "beyond top or bottom", box)
    for number, (text, _, box) in enumerate(texts):
        for other_text, _, box_of_other in texts[number + 1 :]:
            across = min(box.x1, box_of_other.x1) - max(box.x0, box_of_other.x0)
            down = min(box.y1, box_of_other.y1) - max(box.y0, box_of_other.y0)
            # Boxes hold room for accents and descenders that is rarely used.
            assert across < 1 or down < 3, (text, other_text, "overlap", across, down)


@pytest.fixture
def readable():
    return assert_readable


@pytest.fixture
def crowded():
    """Many outputs and parameters with long names, extreme sizes, many draws and times."""
    rng = np.random.default_rng(0)
    names = [f"sensor_{k}_temperature" for k in range(15)]
    time, requested_times = np.linspace(0.0, 5e4, 300), np.linspace(0.0, 5e4, 40)
    wave = [1e-4 * np.sin(t[:, None] / 6e3 + np.arange(15)) for t in (time, requested_times)]
    y = wave[0] + 2e-5 * rng.normal(size=wave[0].shape)
    y[rng.random(y.shape) < 0.1] = np.nan
    sample = ("chain", "draw")
    draws = rng.normal(size=(4, 1000, 20))
    posterior = xr.Dataset(
        {
            "sensitivity": ((*sample, "sensor"), 3e5 * np.exp(0.3 * draws), {"units": "nM/h"}),
            "a_parameter_with_a_long_name": (sample, 2e-5 + 1e-6 * draws[..., 0]),
            "offset": (sample, 1e5 + draws[..., 1]),
        },
        coords={"sensor": names + [f"s{k}" for k in range(5)]},
    )
    noisy = np.where(np.isnan(y), np.nan, rng.normal(size=(4, 25, *y.shape)))
    over = {"time": ("time", time, {"units": "s"}), "output": names}
    units = {"units": "kg m/s²"}
    return arviz_data.build(
        {
            "posterior": posterior,
            "data": xr.Dataset({"y": (("time", "output"), y, units)}, coords=over),
            "trajectories": xr.Dataset(
                {"outputs": ((*sample, "time", "output"), wave[1] + 1e-5 * rng.normal(size=(4, 25, 1, 15)))},
                coords={"time": requested_times, "output": names},
            ),
            "one_step_ahead": xr.Dataset({"residual": ((*sample, "time", "output"), noisy)}, coords=over),
        }
    )
