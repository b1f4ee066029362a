"""Figures of a result, at the sizes of a paper. Nothing here touches pyplot or the global style."""

from lfm_ppl.plots.accuracy import plot_accuracy
from lfm_ppl.plots.calibration import plot_calibration
from lfm_ppl.plots.chains import plot_trace
from lfm_ppl.plots.fields import plot_field
from lfm_ppl.plots.fit_to_data import plot_fit
from lfm_ppl.plots.inputs import plot_inputs
from lfm_ppl.plots.pairs import plot_pairs
from lfm_ppl.plots.residuals import plot_residuals
from lfm_ppl.plots.saving import save_figures
from lfm_ppl.plots.trajectories import plot_deterministics, plot_forces, plot_states

__all__ = [
    "plot_accuracy",
    "plot_calibration",
    "plot_deterministics",
    "plot_field",
    "plot_fit",
    "plot_forces",
    "plot_inputs",
    "plot_pairs",
    "plot_residuals",
    "plot_states",
    "plot_trace",
    "save_figures",
]
