"""Estimation under constraints: full information and moving horizon, on the filter's own scans."""
