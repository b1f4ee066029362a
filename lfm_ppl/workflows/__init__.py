"""Workflows: fit a model, fit many data sets, forecast, backtest, export to ArviZ."""
