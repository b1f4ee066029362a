"""Integrators: the prediction of moments over an interval of the scan, one method in each module."""
